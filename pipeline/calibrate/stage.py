"""The stage calibrate: estimate and check cameras from photos and video frames, with a metric scale if given."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.capture.check import check_capture
from ...datasets.capture.exif import upright_in_file
from ...datasets.capture.sparse_points import POINTS_NAME, write_points
from ...datasets.io.atomic import sha256, temporary_directory
from ...datasets.io.file_set import new_files, settle_files
from ...datasets.io.kinds import refuse_other_kind
from ...datasets.io.outputs import reads
from ...datasets.io.places import require_place
from ...datasets.io.progress import progress
from ...schemas import (
    CalibrateConfig,
    CameraIntrinsics,
    CamerasFile,
    CaptureManifest,
    InputDataError,
    PosedImage,
    PosedVideo,
    Scale,
    UsageError,
    read_json,
    read_toml,
)
from ...schemas.calibration import CalibrationAttempt, CalibrationReport, FocalFigures, ImageVerdict
from ...schemas.printable import typed_path
from ..runtime.work_budget import Part, within_budget
from .attempts import MIN_PHOTOS, Candidate, check_figures, estimated, photo_count, photo_labels, search, verdict
from .center_uncertainty import UNCERTAIN_CENTER, pose_stds
from .colmap.features import versions
from .folded_cameras import folded_sides
from .given_intrinsics import read_intrinsics
from .photos import Inputs, gather, video_of
from .reconstruction import Array, SfmCamera, SfmModel, Similarity, world_from_cam
from .turntable.motion import TurntableMotion
from .world_frame.axes import dominant_plane, ground_frame, upright_frame
from .world_frame.depth_scale import from_depth
from .world_frame.markers import detect_markers, dictionary
from .world_frame.metric_scale import MetricFrame, from_camera_distance, from_known_distance, from_markers

CAMERAS_NAME = "cameras.json"
REPORT_NAME = "calibration.json"

_TEMPORARY = "the photos and COLMAP's database"
_FEATURE_BYTES = 76
"""Lower bound of a feature in the database [bytes]: half of its descriptor and place."""
UNCERTAIN_ROTATION_DEG = 0.5
"""Standard deviation of a camera's rotation [deg] above which a warning is given: beyond a degree one time in 20."""
_MANY_WITHOUT_STRONG = 0.5
"""Share of registered images without a pair of many verified matches above which a warning is given."""


@reads("intrinsics")
def calibrate(
    capture_root: Path, config: CalibrateConfig, overwrite: bool = False, intrinsics: Path | None = None
) -> CalibrationReport:
    """Estimate the cameras of a capture and write `cameras.json`, `sparse_points.ply` and `calibration.json`.

    COLMAP's incremental mapping registers the photos and the first frame of each static video camera. A model that
    contradicts its verified matches is rejected and estimated again, first with other seeds, then with other matching
    and more features; a rejected model is never written. The same capture, settings, versions and kind of machine give
    the same bytes of `cameras.json`.

    Args:
        capture_root: The capture's directory.
        config: Settings.
        overwrite: Replace existing cameras.
        intrinsics: Known intrinsics: `intrinsics.json` of a target, or `cameras.json` of an earlier calibration.

    Returns:
        The verdict on every image, the self-check, the attempts and the scale.

    Raises:
        UsageError: If the capture has other cameras and `overwrite` is not set; those of the same photos, manifest and
            settings are kept, and their report is returned.
        InputDataError: If the capture, a marker or a marked point is wrong.
        NotConvergedError: If no model passes the self-check, or fewer than half of the photos are registered.
    """
    start = time.monotonic()
    capture_root = Path(capture_root)
    settle_files(capture_root / CAMERAS_NAME)
    made_of = _input_sha256(capture_root, intrinsics)
    if not overwrite and (kept := _finished(capture_root, config, made_of)) is not None:
        return kept
    capture = _open(capture_root, overwrite)
    require_place(capture_root / CAMERAS_NAME)  # now, not after minutes
    with _room_for_colmap(capture, config), temporary_directory("calibrate", _TEMPORARY) as folder:
        inputs = gather(capture, folder, intrinsics, config.turntable)
        best, attempts = search(folder, inputs, config)
    frame, similarity, world_frame, warnings = _world(capture, best.model)
    model = _colored(capture, best.model).transformed(similarity)
    cameras = _cameras_file(model, _scale(frame))
    report = _report(capture, inputs, config, best, attempts, model, cameras.scale, world_frame)
    report = report.model_copy(
        update={
            "marker_residual_m": frame.residual_m if frame else None,
            "warnings": (*warnings, *report.warnings),
            "input_sha256": made_of,
            "wall_time_s": round(time.monotonic() - start, 3),
        }
    )
    _write(capture_root, cameras, model, report, overwrite)
    return report


def _colored(capture: Capture, model: SfmModel) -> SfmModel:
    """Return a model whose points have the mean colours of the photos' pixels that show them, if they had none."""
    if model.colors.any():
        return model
    total, count = np.zeros((len(model.points), 3)), np.zeros(len(model.points))
    for image in set(model.observations) & set(capture.photos()):
        photo, (pixels, seen) = capture.photo(image), model.observations[image]
        column, row = np.clip(pixels.astype(int), 0, np.array(photo.shape[1::-1]) - 1).T
        np.add.at(total, seen, photo[row, column])
        np.add.at(count, seen, 1)
    return replace(model, colors=(total / np.maximum(count, 1)[:, None]).round().astype(np.uint8))


def _input_sha256(root: Path, intrinsics: Path | None) -> str:
    """Return the hash of all that a calibration reads: the manifest, photos, masks, depth, videos, given intrinsics."""
    names = [name for name in ("capture.toml", "images", "masks", "depth", "videos") if (root / name).exists()]
    parts = [f"{name} {sha256(root / name)}" for name in names]
    if intrinsics is not None:
        parts += [f"intrinsics {read_intrinsics(intrinsics)}"]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _finished(root: Path, config: CalibrateConfig, made_of: str) -> CalibrationReport | None:
    """Return the report of cameras that were estimated from the same inputs with the same settings; None if none is."""
    path = root / REPORT_NAME
    if not (path.is_file() and (root / CAMERAS_NAME).is_file()):
        return None
    with suppress(InputDataError):
        report = read_json(path, CalibrationReport)
        if report.input_sha256 == made_of and report.config == config:
            return report
    return None


def _room_for_colmap(capture: Capture, config: CalibrateConfig) -> AbstractContextManager[None]:
    """Refuse a temporary folder that is too small for COLMAP, which ends the process if its database cannot grow."""
    photos = [capture.root / "images" / name for name in capture.photos()]
    size = sum(photo.stat().st_size for photo in photos) + len(photos) * config.max_features * _FEATURE_BYTES
    what = f"{_TEMPORARY}, of {len(photos)} photos"
    return within_budget([Part(what=what, disk_bytes=size)], "set TMPDIR to another folder.", Path(gettempdir()))


def _open(root: Path, overwrite: bool) -> Capture:
    if overwrite:
        # The old cameras may name deleted photos: that is a reason to replace them, not an error.
        refuse_other_kind(root, "capture")
        capture = Capture(root, read_toml(root / "capture.toml", CaptureManifest))
        check_capture(capture)
    else:
        capture = Capture.open(root)
    if capture.cameras is not None:
        raise UsageError(
            f"{root} has cameras already ({len(capture.cameras.images)} images, "
            f"{len(capture.cameras.videos)} videos; scale: {capture.cameras.scale.kind}).",
            todo=f"use them as they are, or replace them with 'cgwm calibrate {typed_path(root)} --overwrite'.",
        )
    photos = len(capture.photos())
    if photos < MIN_PHOTOS:
        raise InputDataError(
            f"{root / 'images'}: {photos} photo(s).",
            f"at least {MIN_PHOTOS}; 30 to 60 all around the object work well.",
            "add photos (jpg or png), or supply cameras.json.",
        )
    dictionary(capture.manifest.calibration.aruco_dictionary)
    return capture


def _world(capture: Capture, model: SfmModel) -> tuple[MetricFrame | None, Similarity, str, list[str]]:
    """Return the metric frame (or None), the transform into the world, what fixes the world, and warnings."""
    calibration, ground = capture.manifest.calibration, capture.manifest.world.ground
    frame, warnings = None, []
    if calibration.markers:
        frame = from_markers(model, calibration.markers, _find_markers(capture, model))
    elif calibration.known_distance:
        frame = from_known_distance(model, calibration.known_distance)
    elif calibration.known_camera_distance:
        frame = from_camera_distance(model, calibration.known_camera_distance)
    else:
        names = [name for name in capture.photos() if name in model.T_cam_world]
        frame = from_depth(model, names, lambda name: capture.photo_maps(name).depth_m)
    if frame is not None and frame.fixes_frame:
        return frame, frame.similarity, frame.source, warnings
    similarity = frame.similarity if frame else Similarity.identity()
    if ground is None:
        gravity = np.array(capture.manifest.world.gravity_m_s2)
        up = -gravity / np.linalg.norm(gravity) if gravity.any() else np.array([0.0, 0.0, 1.0])
        return frame, *_upright(capture, model, similarity, up), warnings
    normal = np.array(ground.normal)
    motion = ground_frame(model.transformed(similarity), normal)
    if motion is None:
        warnings.append(
            "no plane was found that could be the ground: the axes and the origin of the world are arbitrary; "
            "give a marker with a pose"
        )
        return frame, *_upright(capture, model, similarity, normal), warnings
    height = ground.offset_m * normal if frame else np.zeros(3)
    combined = similarity.then(Similarity(1.0, motion.rotation, motion.translation + height))
    words = "the dominant plane of the sparse points is the ground; the origin and the x axis on it are arbitrary"
    return frame, combined, words, warnings


def _upright(capture: Capture, model: SfmModel, similarity: Similarity, up: Array) -> tuple[Similarity, str]:
    """Return the transform into a world whose vertical is that of the photos, and what fixes the world."""
    photos = capture.photos()
    sides = {name: upright_in_file(capture.root / "images" / name) for name in photos if name in model.T_cam_world}
    motion = upright_frame(model.transformed(similarity), up, sides)
    if motion is None:
        return similarity, "that of structure from motion: arbitrary axes and origin"
    return similarity.then(motion), (
        "that of structure from motion: arbitrary axes and origin; photos, as viewers show them, are taken to be level"
    )


def _find_markers(capture: Capture, model: SfmModel) -> dict[int, dict[str, Array]]:
    aruco = dictionary(capture.manifest.calibration.aruco_dictionary)
    found: dict[int, dict[str, Array]] = {}
    for name in progress([name for name in capture.photos() if name in model.T_cam_world], "markers", unit="image"):
        for identifier, corners in detect_markers(capture.photo(name), aruco).items():
            found.setdefault(identifier, {})[name] = corners
    return found


def _scale(frame: MetricFrame | None) -> Scale:
    if frame is None:
        return Scale(kind="unscaled", source="none given in capture.toml, [calibration]")
    return Scale(kind="metric", source=frame.source, relative_std=frame.relative_std)


def _cameras_file(model: SfmModel, scale: Scale) -> CamerasFile:
    images, videos = {}, {}
    for label in sorted(model.T_cam_world):
        rows = tuple(tuple(float(x) for x in row) for row in world_from_cam(model.T_cam_world[label]))
        camera = model.image_camera[label]
        video = video_of(label)
        if video is not None:
            videos[video] = PosedVideo.model_validate({"camera": camera, "T_world_cam": rows})
        else:
            images[label] = PosedImage.model_validate({"camera": camera, "T_world_cam": rows})
    cameras = {name: _intrinsics(camera) for name, camera in sorted(model.cameras.items())}
    return CamerasFile(scale=scale, cameras=cameras, images=images, videos=videos)


def _intrinsics(camera: SfmCamera) -> CameraIntrinsics:
    distorted = any(camera.distortion)
    return CameraIntrinsics(
        model="OPENCV" if distorted else "PINHOLE",
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=camera.distortion if distorted else (),
    )


def _report(
    capture: Capture,
    inputs: Inputs,
    config: CalibrateConfig,
    best: Candidate,
    attempts: Sequence[CalibrationAttempt],
    model: SfmModel,
    scale: Scale,
    world_frame: str,
) -> CalibrationReport:
    stds, turns = _pose_stds(best, inputs)
    verdicts = {
        source.label: verdict(source.label, best).model_copy(
            update={"center_std_percent": stds.get(source.label), "rotation_std_deg": turns.get(source.label)}
        )
        for source in inputs.sources
    }
    photos = photo_labels(inputs)
    videos = {video: one for label, one in verdicts.items() if (video := video_of(label)) is not None}
    videos |= {camera: ImageVerdict(registered=False, reason=reason) for camera, reason in inputs.moving.items()}
    tilt, height = _ground_check(capture, model, scale)
    return CalibrationReport(
        photos=len(photos),
        photos_registered=photo_count(best.model, inputs),
        images={label: verdicts[label] for label in photos},
        videos=videos,
        points=len(model.points),
        reprojection_error_px=model.reprojection_error_px,
        self_check=check_figures(best.check),
        attempts=tuple(attempts),
        center_std_percent=round(float(np.median(list(stds.values()))), 4),
        scale=scale,
        world_frame=world_frame,
        ground_tilt_deg=tilt,
        ground_height_m=height,
        turntable_rings=_rings(best),
        focal_lengths=_focal_figures(best),
        warnings=(
            *inputs.notes,
            *_warnings(best),
            *_wrong_exif(best),
            *_uncertain_centers(stds),
            *_uncertain_rotations(turns),
        ),
        config=config,
        versions=versions(),
        wall_time_s=0.0,
    )


def _pose_stds(best: Candidate, inputs: Inputs) -> tuple[dict[str, float], dict[str, float]]:
    """Return the standard deviations of optical centres [% of their extent], at most 100, and rotations [deg], 180."""
    centers, turns = pose_stds(*_estimated(best, inputs), noise_px=best.noise_px, moved=best.moved)
    return (
        {image: round(min(100.0 * std, 100.0), 4) for image, std in centers.items()},
        {image: round(min(float(np.degrees(std)), 180.0), 3) for image, std in turns.items()},
    )


def _estimated(best: Candidate, inputs: Inputs) -> tuple[SfmModel, dict[str, str], list[str], TurntableMotion | None]:
    """Return the model, the camera models of estimated intrinsics, the cameras whose EXIF data count, the turntable."""
    with_exif = [camera for camera, focal in best.focals.items() if focal.agree]
    return best.model, estimated(best.camera_model, best.model, inputs), with_exif, best.motion


def _rings(best: Candidate) -> tuple[int, ...]:
    return tuple(len(ring) for ring in best.motion.rings if len(ring) > 1) if best.motion else ()


def _focal_figures(best: Candidate) -> dict[str, FocalFigures]:
    return {
        camera: FocalFigures(
            px=round(best.model.cameras[camera].focal_px, 3),
            exif_px=round(focal.exif_px, 3),
            matches_px=round(focal.matches_px, 3),
            matches_std_percent=round(min(100.0 * focal.matches_std, 100.0), 3),
            exif_used=focal.agree,
        )
        for camera, focal in best.focals.items()
    }


def _wrong_exif(best: Candidate) -> list[str]:
    return [
        f"camera '{camera}': the EXIF data of the photos say a focal length of {focal.exif_px:.0f} px, their matches "
        f"{focal.matches_px:.0f} +- {100.0 * focal.matches_std:.2g} %; the EXIF data were not used (cut-out photos "
        "keep those of the whole ones)"
        for camera, focal in best.focals.items()
        if not focal.agree
    ]


def _uncertain_centers(stds_percent: dict[str, float]) -> list[str]:
    limit = 100.0 * UNCERTAIN_CENTER
    uncertain = {image: std for image, std in stds_percent.items() if std > limit}
    videos = {video: std for image, std in uncertain.items() if (video := video_of(image)) is not None}
    photos = {image: std for image, std in uncertain.items() if video_of(image) is None}
    warnings = []
    if photos:
        worst = max(photos, key=lambda image: photos[image])
        warnings.append(
            f"the optical centres of {len(photos)} of {len(stds_percent)} registered images are less certain than "
            f"{limit:g} % of their extent ({worst}: {photos[worst]:.2g} %): few matches tie them to the others, or the "
            "lens is long; more photos between them, surroundings with texture or known intrinsics "
            "([[calibration.intrinsics]]) make them certain"
        )
    if videos:
        listed = ", ".join(f"{camera}: {std:.2g} %" for camera, std in sorted(videos.items()))
        warnings.append(
            f"the optical centres of video cameras are less certain than {limit:g} % of the extent of all ({listed}): "
            "one frame hardly tells where its lens is centred; known intrinsics ([[calibration.intrinsics]]; a printed "
            "board measures them, --target charuco) make them certain"
        )
    return warnings


def _uncertain_rotations(stds_deg: dict[str, float]) -> list[str]:
    uncertain = [image for image, std in stds_deg.items() if std > UNCERTAIN_ROTATION_DEG]
    if not uncertain:
        return []
    worst = max(uncertain, key=lambda image: stds_deg[image])
    return [
        f"the rotations of {len(uncertain)} of {len(stds_deg)} registered images are less certain than "
        f"{UNCERTAIN_ROTATION_DEG:g} deg ({worst}: {stds_deg[worst]:.2g} deg): few matches tie them to the others, or "
        "tell a rotation from a principal point off the middle; known intrinsics ([[calibration.intrinsics]]) and more "
        "texture around the object make them certain"
    ]


def _warnings(best: Candidate) -> list[str]:
    warnings = []
    others = [len(set(model.T_cam_world) - set(best.model.T_cam_world)) for model in best.models[1:]]
    if any(others):
        sizes = ", ".join(str(count) for count in others if count)
        warnings.append(
            f"the images fall into parts that share too few points: the largest, of {len(best.model.T_cam_world)}, is "
            f"taken; {sizes} images are in others"
        )
    photos = sorted(name for name in best.model.T_cam_world if video_of(name) is None)
    if (sides := folded_sides(best.model, photos)) > 1:
        others = "another" if sides == 2 else f"{sides - 1} others"
        warnings.append(
            f"most photos share their place with {others}: unless they were taken so, the "
            f"object looks alike from {sides} sides, whose cameras lie upon each other; put something "
            "with a print of its own beside it or on it"
        )
    without = len(best.check.images_without_strong_pair)
    if without > _MANY_WITHOUT_STRONG * len(best.model.T_cam_world):
        warnings.append(
            f"{without} of {len(best.model.T_cam_world)} registered images have no pair with 200 verified matches: the "
            "self-check has little evidence; more overlap or more features (max_features) give it more"
        )
    return warnings


def _ground_check(capture: Capture, model: SfmModel, scale: Scale) -> tuple[float | None, float | None]:
    """Return tilt [deg] and height at the origin [m] of the dominant plane relative to the manifest's ground."""
    ground = capture.manifest.world.ground
    if ground is None:
        return None, None
    distances = [
        np.linalg.norm(model.points[index] - model.center(image), axis=1)
        for image, (_, index) in model.observations.items()
    ]
    plane = dominant_plane(model.points, model.centers(), float(np.median(np.concatenate(distances))))
    if plane is None:
        return None, None
    normal, offset = plane
    cosine = float(np.clip(normal @ np.array(ground.normal), -1.0, 1.0))
    height = offset - ground.offset_m if scale.kind == "metric" else None
    return round(float(np.degrees(np.arccos(cosine))), 4), height


def _write(root: Path, cameras: CamerasFile, model: SfmModel, report: CalibrationReport, overwrite: bool) -> None:
    """Write the three files; `cameras.json` is there only with the others, and never with those of other cameras."""
    with new_files(root / CAMERAS_NAME, (REPORT_NAME, POINTS_NAME), "calibration", overwrite) as folder:
        (folder / CAMERAS_NAME).write_text(cameras.model_dump_json(indent=1) + "\n", encoding="utf-8")
        (folder / REPORT_NAME).write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
        unit = "metre" if cameras.scale.kind == "metric" else "arbitrary"
        write_points(folder / POINTS_NAME, model.points, model.colors, unit)
