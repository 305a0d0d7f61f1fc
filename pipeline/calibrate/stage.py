"""The stage calibrate: estimate and check cameras from photos and video frames, with a metric scale if given."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.capture.check import check_capture
from ...datasets.capture.sparse_points import POINTS_NAME, write_points
from ...datasets.io.atomic import new_file
from ...datasets.io.kinds import refuse_other_kind
from ...datasets.io.progress import progress
from ...schemas import (
    CalibrateConfig,
    CameraIntrinsics,
    CamerasFile,
    CaptureManifest,
    InputDataError,
    NotConvergedError,
    PosedImage,
    PosedVideo,
    Scale,
    UsageError,
    read_toml,
)
from ...schemas.calibration import CalibrationAttempt, CalibrationReport, ImageVerdict, PairFigures, SelfCheckFigures
from . import colmap
from .consistency_check import SelfCheck, check_model
from .markers import detect_markers, dictionary
from .metric_scale import MetricFrame, from_camera_distance, from_known_distance, from_markers
from .photos import Inputs, gather, video_label
from .reconstruction import Array, SfmCamera, SfmModel, Similarity, VerifiedPair, world_from_cam
from .world_frame import dominant_plane, ground_frame

CAMERAS_NAME = "cameras.json"
REPORT_NAME = "calibration.json"

MIN_PHOTOS = 3
MIN_REGISTERED_FRACTION = 0.5
"""Minimum fraction of registered photos; below it the calibration fails."""
_LOW_PEAK_THRESHOLD = 0.002  # conventions: worked for weak texture
_THOROUGH_TRIALS = 10000  # COLMAP's default: finds pairs with few true matches
_TIGHT_RATIO = 0.7  # Lowe's test for repeated texture
_MANY_WITHOUT_STRONG = 0.5


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    """Result of an attempt."""

    model: SfmModel
    """The largest connected model."""
    check: SelfCheck
    """Self-check of that model."""
    models: tuple[SfmModel, ...]
    """All connected models."""
    pairs: tuple[VerifiedPair, ...]
    """Verified pairs of images."""
    features: dict[str, int]
    """Number of features by image."""
    attempt: int
    """Number of the attempt."""


def calibrate(capture_root: Path, config: CalibrateConfig, overwrite: bool = False) -> CalibrationReport:
    """Estimate the cameras of a capture and write `cameras.json`, `sparse_points.ply` and `calibration.json`.

    COLMAP's incremental mapping registers the photos and the first frame of each static video camera. A model that
    contradicts its verified matches is rejected and estimated again, first with other seeds, then with other matching
    and more features; a rejected model is never written. The same capture, settings, versions and kind of machine give
    the same bytes of `cameras.json`.

    Args:
        capture_root: The capture's directory.
        config: Settings.
        overwrite: Replace existing cameras.

    Returns:
        The verdict on every image, the self-check, the attempts and the scale.

    Raises:
        UsageError: If the capture has cameras and `overwrite` is not set.
        InputDataError: If the capture, a marker or a marked point is wrong.
        NotConvergedError: If no model passes the self-check, or fewer than half of the photos are registered.
    """
    start = time.monotonic()
    capture_root = Path(capture_root)
    capture = _open(capture_root, overwrite)
    with tempfile.TemporaryDirectory(prefix="cgwm-calibrate-") as folder:
        inputs = gather(capture, Path(folder))
        best, attempts = _search(Path(folder), inputs, config)
    frame, similarity, world_frame, warnings = _world(capture, best.model)
    model = best.model.transformed(similarity)
    cameras = _cameras_file(model, _scale(frame))
    report = _report(capture, inputs, config, best, attempts, model, cameras.scale, world_frame)
    report = report.model_copy(
        update={
            "marker_residual_m": frame.residual_m if frame else None,
            "warnings": (*warnings, *report.warnings),
            "wall_time_s": round(time.monotonic() - start, 3),
        }
    )
    _write(capture_root, cameras, model, report, overwrite)
    return report


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
            todo=f"use them as they are, or replace them with 'cgwm calibrate {root} --overwrite'.",
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


def _plan(config: CalibrateConfig) -> list[colmap.SfmSettings]:
    """Return the settings of the attempts: other seeds first, then other matching, then more features."""
    base = colmap.SfmSettings(seed=config.seed, max_features=config.max_features, max_image_size=config.max_image_size)
    more = replace(
        base,
        max_features=2 * config.max_features,
        max_image_size=2 * config.max_image_size,
        peak_threshold=_LOW_PEAK_THRESHOLD,
        verification_trials=_THOROUGH_TRIALS,
    )
    plan = [
        base,
        replace(base, seed=config.seed + 1),
        replace(base, seed=config.seed + 2, guided_matching=True),
        replace(more, seed=config.seed + 3),
        replace(more, seed=config.seed + 4, guided_matching=True, max_ratio=_TIGHT_RATIO),
    ]
    further = config.retries + 1 - len(plan)
    plan += [replace(plan[3 + k % 2], seed=config.seed + 5 + k) for k in range(max(further, 0))]
    return plan[: config.retries + 1]


def _search(folder: Path, inputs: Inputs, config: CalibrateConfig) -> tuple[_Candidate, list[CalibrationAttempt]]:
    """Try settings until a model passes; if it lacks images, try once more with more features."""
    attempts: list[CalibrationAttempt] = []
    passed: list[_Candidate] = []
    last: _Candidate | None = None
    built: colmap.SfmSettings | None = None
    for settings in _plan(config):
        if passed and len(passed[0].model.T_cam_world) == len(inputs.sources):
            break
        incomplete = bool(passed) or (built is not None and (last is None or last.check.passed))
        if incomplete and built is not None and settings.features == built.features:
            continue  # Another seed registers no more images, but more features may.
        second_try = bool(passed)
        candidate, attempt = _attempt(folder, inputs, settings, built, len(attempts))
        attempts.append(attempt)
        built, last = settings, candidate
        if candidate is not None and candidate.check.passed:
            passed.append(candidate)
        if second_try:
            break
    best = max(passed, key=lambda candidate: _rank(candidate, inputs), default=None)
    if best is None or _photo_count(best.model, inputs) < _needed(inputs):
        raise _not_converged(inputs, attempts, best, last)
    attempts[best.attempt] = attempts[best.attempt].model_copy(update={"outcome": "taken"})
    return best, attempts


def _attempt(
    folder: Path, inputs: Inputs, settings: colmap.SfmSettings, built: colmap.SfmSettings | None, number: int
) -> tuple[_Candidate | None, CalibrationAttempt]:
    names = {source.image.name: source.label for source in inputs.sources}
    reuse = built is not None and built.matches == settings.matches
    database = folder / f"attempt-{number}.db"
    if reuse:
        for path in sorted(folder.glob(f"attempt-{number - 1}.*")):
            if path.is_file():
                path.rename(folder / path.name.replace(f"-{number - 1}.", f"-{number}."))
    else:
        colmap.build_database(database, inputs.root, [source.image for source in inputs.sources], settings)
    models = tuple(model.renamed(names) for model in colmap.map_database(database, inputs.root, settings.seed))
    pairs = tuple(
        replace(pair, image_a=names[pair.image_a], image_b=names[pair.image_b]) for pair in colmap.read_pairs(database)
    )
    candidate = None
    if models:
        features = {names[name]: count for name, count in colmap.feature_counts(database).items()}
        candidate = _Candidate(
            model=models[0],
            check=check_model(models[0], pairs),
            models=models,
            pairs=pairs,
            features=features,
            attempt=number,
        )
    return candidate, _attempt_figures(settings, candidate)


def _attempt_figures(settings: colmap.SfmSettings, candidate: _Candidate | None) -> CalibrationAttempt:
    outcome = "no_model" if candidate is None else "passed" if candidate.check.passed else "self_check_failed"
    return CalibrationAttempt(
        seed=settings.seed,
        max_features=settings.max_features,
        max_image_size=settings.max_image_size,
        peak_threshold=settings.peak_threshold,
        guided_matching=settings.guided_matching,
        max_ratio=settings.max_ratio,
        models=len(candidate.models) if candidate else 0,
        registered=len(candidate.model.T_cam_world) if candidate else 0,
        points=len(candidate.model.points) if candidate else 0,
        reprojection_error_px=candidate.model.reprojection_error_px if candidate else None,
        self_check=_check_figures(candidate.check) if candidate else None,
        outcome=outcome,
    )


def _check_figures(check: SelfCheck) -> SelfCheckFigures:
    worst = check.worst
    return SelfCheckFigures(
        passed=check.passed,
        pairs=len(check.pairs),
        strong_pairs=len(check.strong),
        worst=worst
        and PairFigures(
            images=(worst.image_a, worst.image_b), inliers=worst.inliers, consistent=round(worst.consistent, 4)
        ),
        images_without_strong_pair=check.images_without_strong_pair,
    )


def _rank(candidate: _Candidate, inputs: Inputs) -> tuple[int, int, int]:
    return _photo_count(candidate.model, inputs), len(candidate.model.T_cam_world), -candidate.attempt


def _photo_count(model: SfmModel, inputs: Inputs) -> int:
    return sum(label in model.T_cam_world for label in _photo_labels(inputs))


def _photo_labels(inputs: Inputs) -> list[str]:
    return [source.label for source in inputs.sources if not source.image.name.startswith("videos/")]


def _needed(inputs: Inputs) -> int:
    return max(MIN_PHOTOS, int(np.ceil(MIN_REGISTERED_FRACTION * len(_photo_labels(inputs)))))


def _not_converged(
    inputs: Inputs, attempts: Sequence[CalibrationAttempt], best: _Candidate | None, last: _Candidate | None
) -> NotConvergedError:
    photos = len(_photo_labels(inputs))
    rejected = [attempt for attempt in attempts if attempt.outcome == "self_check_failed"]
    if best is None and rejected:
        worst = rejected[0].self_check.worst if rejected[0].self_check else None
        where = ""
        if worst:
            where = (
                f" For example {worst.images[0]} and {worst.images[1]} share {worst.inliers} verified matches, of "
                f"which {100 * worst.consistent:.0f} % agree with the cameras."
            )
        return NotConvergedError(
            f"All {len(rejected)} camera models contradict their own matches ({len(attempts)} attempts).{where}",
            "models in which every pair of images with 200 or more verified matches is at least 50 % consistent.",
            "remove blurred photos and those in which something moved; repeated or symmetric texture can cause this: "
            "put an object or printed pattern with unique texture next to it, and photograph in steps of 10 degrees.",
        )
    candidate = best or last
    registered = _photo_count(candidate.model, inputs) if candidate else 0
    causes: dict[str, int] = {}
    for label in _photo_labels(inputs):
        reason = _verdict(label, candidate).reason.split(":", 1)[0] if candidate else "no model"
        if reason:
            causes[reason] = causes.get(reason, 0) + 1
    listed = ", ".join(f"{count} {reason}" for reason, count in sorted(causes.items(), key=lambda item: -item[1]))
    return NotConvergedError(
        f"{registered} of {photos} photos registered after {len(attempts)} attempts. The others: {listed}.",
        f"at least {_needed(inputs)} of {photos}.",
        "take sharp photos in steps of 10 degrees or less, all around and from two heights, with the same focal "
        "length; keep textured surroundings in view; nothing may move between the photos.",
    )


def _verdict(label: str, candidate: _Candidate) -> ImageVerdict:
    touching = [pair for pair in candidate.pairs if label in (pair.image_a, pair.image_b)]
    features, matches = candidate.features.get(label, 0), sum(len(pair.xy_a) for pair in touching)
    registered = label in candidate.model.T_cam_world
    inliers = len(candidate.model.observations[label][1]) if registered else 0
    reason = ""
    if not registered:
        part = next((model for model in candidate.models if label in model.T_cam_world), None)
        if label not in candidate.features:
            reason = "unreadable: COLMAP cannot decode it"
        elif part is not None:
            reason = f"in another part: connected to {len(part.T_cam_world) - 1} images, not to the largest part"
        elif not touching:
            reason = f"without matches: {features} features, none verified in another image"
        else:
            reason = f"without a pose: {matches} matches with {len(touching)} images, too few see reliable points"
    return ImageVerdict(
        registered=registered,
        reason=reason,
        features=features,
        matched_images=len(touching),
        matches=matches,
        inliers=inliers,
    )


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
    if frame is not None and frame.fixes_frame:
        return frame, frame.similarity, frame.source, warnings
    similarity = frame.similarity if frame else Similarity.identity()
    if ground is None:
        return frame, similarity, "that of structure from motion: arbitrary axes and origin", warnings
    normal = np.array(ground.normal)
    motion = ground_frame(model.transformed(similarity), normal)
    if motion is None:
        warnings.append(
            "no plane was found that could be the ground: the axes and the origin of the world are arbitrary; "
            "give a marker with a pose"
        )
        return frame, similarity, "that of structure from motion: arbitrary axes and origin", warnings
    height = ground.offset_m * normal if frame else np.zeros(3)
    combined = Similarity(
        similarity.scale,
        motion.rotation @ similarity.rotation,
        motion.rotation @ similarity.translation + motion.translation + height,
    )
    words = "the dominant plane of the sparse points is the ground; the origin and the x axis on it are arbitrary"
    return frame, combined, words, warnings


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
        if label.startswith(video_label("")):
            videos[label.removeprefix(video_label(""))] = PosedVideo.model_validate(
                {"camera": camera, "T_world_cam": rows}
            )
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
    best: _Candidate,
    attempts: Sequence[CalibrationAttempt],
    model: SfmModel,
    scale: Scale,
    world_frame: str,
) -> CalibrationReport:
    verdicts = {source.label: _verdict(source.label, best) for source in inputs.sources}
    photos = _photo_labels(inputs)
    videos = {
        label.removeprefix(video_label("")): verdict for label, verdict in verdicts.items() if label not in photos
    }
    videos |= {camera: ImageVerdict(registered=False, reason=reason) for camera, reason in inputs.moving.items()}
    tilt, height = _ground_check(capture, model, scale)
    return CalibrationReport(
        photos=len(photos),
        photos_registered=_photo_count(best.model, inputs),
        images={label: verdicts[label] for label in photos},
        videos=videos,
        points=len(model.points),
        reprojection_error_px=model.reprojection_error_px,
        self_check=_check_figures(best.check),
        attempts=tuple(attempts),
        scale=scale,
        world_frame=world_frame,
        ground_tilt_deg=tilt,
        ground_height_m=height,
        warnings=(*inputs.notes, *_warnings(best)),
        config=config,
        versions=colmap.versions(),
        wall_time_s=0.0,
    )


def _warnings(best: _Candidate) -> list[str]:
    warnings = []
    others = [len(set(model.T_cam_world) - set(best.model.T_cam_world)) for model in best.models[1:]]
    if any(others):
        sizes = ", ".join(str(count) for count in others if count)
        warnings.append(
            f"the images fall into parts that share too few points: the largest, of {len(best.model.T_cam_world)}, is "
            f"taken; {sizes} images are in others"
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
    """Write the three files; `cameras.json` is renamed last, so its presence means that all are complete."""
    with ExitStack() as stack:
        cameras_path = stack.enter_context(new_file(root / CAMERAS_NAME, overwrite))
        report_path = stack.enter_context(new_file(root / REPORT_NAME, overwrite=True))
        points_path = stack.enter_context(new_file(root / POINTS_NAME, overwrite=True))
        cameras_path.write_text(cameras.model_dump_json(indent=1) + "\n", encoding="utf-8")
        report_path.write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
        unit = "metre" if cameras.scale.kind == "metric" else "arbitrary"
        write_points(points_path, model.points, model.colors, unit)
