"""Checks of a capture, which return all faults with their places and the facts that were found."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import CamerasFile, InputDataError, did_you_mean
from ...schemas.printable import typed_path
from ...schemas.regular_files import require_regular_file
from ..shapes.meshes import mass_properties, read_mesh
from ..shapes.ply import read_splats
from .cameras import find_cameras, pose_count
from .consistency import check_consistency
from .faults import Faults
from .files import files_under, has_folder
from .folder import CaptureFolder
from .geometry_maps import KINDS, map_names, read_map
from .images import IMAGE_SUFFIXES, UNREAD_SUFFIXES, image_size, read_label
from .video import VIDEO_SUFFIXES, VideoInfo, frame_files, video_info

_UNREAD = {
    "tracks": ((".tsv", ".xls", ".xlsx", ".ods"), ".csv.", "convert it, or see 'cgwm import'."),
    "images": (UNREAD_SUFFIXES, ".jpg and .png.", "convert it, for example: magick mogrify -format jpg FILE"),
    "masks": (UNREAD_SUFFIXES, ".png.", "convert it without loss."),
    "videos": ((".avi", ".mkv", ".m4v"), ".mp4, .mov, .webm, or a directory of frames.", "convert it with ffmpeg."),
}
"""Suffixes that are not read, in lower case, by folder; which are, and what to do."""
_READ = (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES, ".csv", ".npy")
"""Suffixes of files whose readers refuse what is no regular file."""


@dataclass(kw_only=True)
class CaptureFacts:
    """Contents of a capture."""

    photos: int = 0
    """Number of photos."""
    photos_with_camera: int = 0
    """Number of those with a calibrated pose."""
    masks: int = 0
    """Number of masks."""
    geometry_maps: dict[str, int] = field(default_factory=dict)
    """Number of depth, normal and feature maps, by kind."""
    mask_coverage: dict[str, float] = field(default_factory=dict)
    """Mean fraction of a mask's pixels that shows a body, by body."""
    scale: str = "none"
    """"metric", "unscaled" or "none" (no cameras)."""
    bodies: list[str] = field(default_factory=list)
    """Names of the bodies."""
    episodes: int = 0
    """Number of episodes."""
    splits: dict[str, int] = field(default_factory=dict)
    """Number of episodes by split."""
    track_samples: int = 0
    """Number of poses in all tracks."""
    normalised_quaternions: int = 0
    """Number of quaternions whose norm differs from 1 within the tolerance."""
    videos: int = 0
    """Number of videos."""
    video_frames: int = 0
    """Number of their frames."""
    warnings: list[str] = field(default_factory=list)
    """Warnings about what is not a fault."""
    inconsistencies: list[str] = field(default_factory=list)
    """What gravity, ground, shapes and motion disagree about, without a fault."""


def check_capture(capture: CaptureFolder, accept_units: bool = False) -> CaptureFacts:
    """Check a capture and return its facts.

    Args:
        capture: The capture.
        accept_units: Whether units and frames are right although the motion contradicts them.

    Raises:
        InputDataError: For the first fault; its last line counts the others.
    """
    facts, faults = find_faults(capture, accept_units)
    if faults:
        raise _first(faults, capture.root)
    return facts


def find_faults(capture: CaptureFolder, accept_units: bool = False) -> tuple[CaptureFacts, list[InputDataError]]:
    """Check a capture; return the facts and all faults, in the order of the directory's parts.

    Units and frames that the motion contradicts are a fault, unless `accept_units`; see :func:`check_consistency`.
    """
    facts = CaptureFacts(
        bodies=capture.body_names, splits={name: len(names) for name, names in capture.manifest.splits.items()}
    )
    faults = Faults()
    attempt = faults.attempt
    attempt(_check_names, capture)
    for body in capture.manifest.bodies:
        attempt(_check_shape, capture, body.name)
    attempt(capture.surface_meshes)
    _check_files(capture, faults)
    sizes = _check_pictures(capture, facts, faults)
    attempt(_check_cameras, capture, sizes, facts)
    normalised, unturned = _check_episodes(capture, facts, faults)
    attempt(_check_consistency, capture, facts, accept_units)
    if normalised:
        where = normalised[0] + (f" and {len(normalised) - 1} more files" if len(normalised) > 1 else "")
        facts.warnings.append(
            f"{facts.normalised_quaternions} quaternions were normalised (off by up to 1e-3), in {where}."
        )
    if warning := capture.unturned_warning(unturned):
        facts.warnings.append(warning)
    return facts, faults.found


def _check_pictures(capture: CaptureFolder, facts: CaptureFacts, faults: Faults) -> dict[str, tuple[int, int]]:
    """Check photos, and their masks and maps; return width and height of the photos by name."""
    attempt, listed = faults.attempt, faults.listed
    sizes: dict[str, tuple[int, int]] = {}
    photos = listed(capture.photos)
    for name in photos:
        attempt(_check_photo, capture, name, sizes)
    facts.photos = len(sizes)
    coverage: list[NDArray[np.float64]] = []
    by_stem = {Path(name).with_suffix(""): name for name in photos}
    for name in listed(capture.masks):
        attempt(_check_mask, capture, name, by_stem, sizes, coverage)
    facts.masks = len(coverage)
    for kind in KINDS:
        for name in listed(map_names, capture.root, kind):
            attempt(_check_map, capture, kind, name, by_stem, sizes, facts)
    if coverage:
        facts.mask_coverage = dict(zip(facts.bodies, np.mean(coverage, axis=0)[1:].tolist(), strict=True))
    return sizes


def _check_episodes(
    capture: CaptureFolder, facts: CaptureFacts, faults: Faults
) -> tuple[list[str], dict[str, tuple[str, ...]]]:
    """Check tracks and videos; return the track files with normalised quaternions, and bodies that never turn."""
    episodes = faults.listed(capture.episodes)
    facts.episodes = len(episodes)
    normalised: list[str] = []
    unturned: dict[str, tuple[str, ...]] = {}
    for episode in episodes:
        before = facts.normalised_quaternions
        faults.attempt(_check_tracks, capture, episode, facts, unturned)
        if facts.normalised_quaternions > before:
            normalised.append(f"tracks/{episode}.csv")
        for camera in faults.listed(capture.videos, episode):
            faults.attempt(_check_video, capture, camera, episode, facts)
    return normalised, unturned


def _check_consistency(capture: CaptureFolder, facts: CaptureFacts, accept_units: bool) -> None:
    try:
        facts.inconsistencies += check_consistency(capture)
    except InputDataError as fault:
        if not accept_units:
            raise
        facts.inconsistencies.append(f"Accepted with --accept-units: {fault.found}")


def _first(faults: list[InputDataError], root: Path) -> InputDataError:
    first = faults[0]
    if len(faults) == 1:
        return first
    more = f"({len(faults) - 1} more fault(s); 'cgwm validate {typed_path(root)}' lists all.)"
    return InputDataError(first.found, first.allowed, f"{first.todo} {more}".strip())


def _check_names(capture: CaptureFolder) -> None:
    """Check that the episodes and cameras named in the manifest exist on disk."""
    manifest, path = capture.manifest, capture.root / "capture.toml"
    found = capture.episodes()
    splits = manifest.splits if capture.only_splits is None else {s: capture.episodes(s) for s in capture.only_splits}
    todo = f"correct the name, or add tracks/<episode>.csv or videos/<camera>/<episode> to {capture.root}."
    named = [
        (f"[splits] {split} names the episode '{name}'", name) for split, names in splits.items() for name in names
    ]
    if capture.only_splits is None:
        named += [(f"[episodes] names '{name}'", name) for name in manifest.episodes]
    for words, name in named:
        _require_among(found, "episodes", name, f"{path}: {words}, which has neither track nor video.", todo)
    _check_offsets(capture)


def _check_offsets(capture: CaptureFolder) -> None:
    """Check that the cameras whose offsets of time the manifest names exist on disk."""
    path = capture.root / "capture.toml"
    for name in capture.manifest.video.camera_time_offset_s:
        _require_among(
            capture.video_cameras(),
            "cameras",
            name,
            f"{path}: [video] camera_time_offset_s names the camera '{name}', which has no directory in videos/.",
            "correct the name, or remove the entry.",
        )


def _require_among(found: list[str], noun: str, name: str, fault: str, todo: str) -> None:
    """Refuse a name that is not among those on disk."""
    if name not in found:
        raise InputDataError(fault, _listed(found, noun) + did_you_mean(name, found), todo)


def _listed(names: list[str], noun: str) -> str:
    if not names:
        return f"there are no {noun}."
    shown = ", ".join(names[:8])
    return f"{shown}, ... ({len(names)} {noun})." if len(names) > 8 else f"{shown}."


def _check_files(capture: CaptureFolder, faults: Faults) -> None:
    """Refuse what would be silently passed over: files in other formats, and what is no file at all."""
    for folder in dict.fromkeys((*_UNREAD, "video_masks", *KINDS)):
        found = [capture.root / folder / name for name in faults.listed(files_under, capture.root / folder)]
        faults.attempt(_check_formats, folder, found)
        for path in found:
            if path.suffix.lower() not in _READ:
                faults.attempt(require_regular_file, path)


def _check_formats(folder: str, found: list[Path]) -> None:
    """Refuse files in formats that would be silently ignored."""
    unread, allowed, convert = _UNREAD.get(folder, ((), "", ""))
    for path in found:
        suffix = path.suffix.lower()
        if suffix in unread or (folder == "tracks" and suffix == ".csv" != path.suffix):
            raise InputDataError(f"{path}: {path.suffix} is not read.", allowed, convert)


def _check_shape(capture: CaptureFolder, name: str) -> None:
    body = capture.body(name)
    path = capture.shape_file(body)
    if path is None or body.shape is None:
        return
    if body.shape.mesh:
        mass_properties(read_mesh(path), path)
    else:
        read_splats(path)


def _check_photo(capture: CaptureFolder, name: str, sizes: dict[str, tuple[int, int]]) -> None:
    sizes[name] = image_size(capture.root / "images" / name)


def _check_mask(
    capture: CaptureFolder,
    name: str,
    by_stem: dict[Path, str],
    sizes: dict[str, tuple[int, int]],
    coverage: list[NDArray[np.float64]],
) -> None:
    path = capture.root / "masks" / name
    if path.suffix != ".png":
        raise InputDataError(f"{path}: a mask that is no .png.", ".png; JPEG changes labels.", "save masks as PNG.")
    photo = by_stem.get(Path(name).with_suffix(""))
    if photo is None:
        raise InputDataError(
            f"{path}: there is no photo of that name in images/.",
            "the photo's name, with .png.",
            "give it the name of its photo, or remove it.",
        )
    if photo not in sizes:
        return  # the photo itself is at fault, which has been told
    labels = read_label(path)
    _check_labels(capture, path, labels, sizes[photo], f"images/{photo}")
    count = len(capture.manifest.bodies) + 1
    coverage.append(np.bincount(labels.ravel(), minlength=count)[:count] / labels.size)


def _check_map(
    capture: CaptureFolder,
    kind: str,
    name: str,
    by_stem: dict[Path, str],
    sizes: dict[str, tuple[int, int]],
    facts: CaptureFacts,
) -> None:
    path = capture.root / kind / name
    photo = by_stem.get(Path(name).with_suffix(""))
    if photo is None:
        raise InputDataError(
            f"{path}: there is no photo of that name in images/.",
            "the photo's name, its suffix replaced.",
            "give it the name of its photo, or remove it.",
        )
    if photo not in sizes:
        return  # the photo itself is at fault, which has been told
    height, width = read_map(path, kind).shape[:2]
    if kind != "features" and (width, height) != sizes[photo]:
        raise InputDataError(
            f"{path}: the map has {width}x{height} px, images/{photo} has {sizes[photo][0]}x{sizes[photo][1]} px.",
            "a map of its photo's size.",
            "make the map at the size of the photo.",
        )
    facts.geometry_maps[kind] = facts.geometry_maps.get(kind, 0) + 1


def _check_labels(
    capture: CaptureFolder, path: Path, labels: NDArray[np.uint8], size: tuple[int, int], shown: str
) -> None:
    height, width = labels.shape
    if (width, height) != size:
        raise InputDataError(
            f"{path}: the mask has {width}x{height} px, {shown} has {size[0]}x{size[1]} px.",
            "a mask of its image's size.",
            "make the mask at the size of the picture"
            + (", turned upright as its EXIF data say." if (height, width) == size else "."),
        )
    bodies = len(capture.manifest.bodies)
    if labels.max() > bodies:
        raise InputDataError(
            f"{path}: label {labels.max()}, but the manifest has {bodies} [[bodies]].",
            f"0 (background) to {bodies}: label k is the k-th of [[bodies]].",
            _hint(labels, bodies),
        )


def _hint(labels: NDArray[np.uint8], bodies: int) -> str:
    """Return what to do about labels of more bodies than there are."""
    if not bodies:
        return 'name the body in capture.toml: a line [[bodies]], and under it name = "object".'
    if set(np.unique(labels)) <= {0, 255}:
        return "for a mask of 0 and 255, divide it by 255 (and multiply by the body's number)."
    return "correct the mask, or add the bodies to capture.toml."


def _check_cameras(capture: CaptureFolder, sizes: dict[str, tuple[int, int]], facts: CaptureFacts) -> None:
    cameras = capture.cameras
    if cameras is None:
        return
    facts.scale = cameras.scale.kind
    _require_photos(capture, cameras)
    _require_calibrated_sizes(capture, cameras, sizes)
    facts.photos_with_camera = sum(name in cameras.images for name in sizes)
    names = capture.video_cameras()
    for name in cameras.videos:
        if name.partition("/")[0] not in names:
            raise InputDataError(
                f"{capture.root / 'cameras.json'}: a camera for the videos '{name}', which are not in videos/.",
                _listed(names, "cameras") + did_you_mean(name, names),
                "add the videos, or remove the camera from cameras.json.",
            )


def _require_photos(capture: CaptureFolder, cameras: CamerasFile) -> None:
    """Refuse cameras of photos that are not there."""
    photos = set(capture.photos())
    absent = [name for name in cameras.images if name not in photos]
    if absent:
        raise InputDataError(
            f"{find_cameras(capture.root)}: {len(absent)} of {len(cameras.images)} cameras are for photos that are not "
            f"in images/, "
            f"such as '{absent[0]}'.",
            "names relative to images/." + did_you_mean(absent[0], sorted(photos)),
            "add the photos, or remove the cameras.",
        )


def _require_calibrated_sizes(capture: CaptureFolder, cameras: CamerasFile, sizes: dict[str, tuple[int, int]]) -> None:
    """Refuse photos of another size than that of their cameras."""
    for name, image in cameras.images.items():
        camera = cameras.cameras[image.camera]
        if name in sizes and sizes[name] != (camera.width, camera.height):
            raise InputDataError(
                f"{capture.root / 'images' / name}: {sizes[name][0]}x{sizes[name][1]} px, but its camera "
                f"'{image.camera}' has {camera.width}x{camera.height} px.",
                "the image size that the camera was calibrated for.",
                "calibrate these photos at the size that they have.",
            )


def _check_tracks(
    capture: CaptureFolder, episode: str, facts: CaptureFacts, unturned: dict[str, tuple[str, ...]]
) -> None:
    found = capture.checked_tracks(episode)
    facts.track_samples += sum(len(track) for track in found.tracks.values())
    facts.normalised_quaternions += found.normalised
    unturned[episode] = found.unturned
    if found.tracks and (text := capture.window_warning(episode, found.tracks)):
        facts.warnings.append(text)


def _check_video(capture: CaptureFolder, camera: str, episode: str, facts: CaptureFacts) -> None:
    path = capture.video_path(camera, episode)
    info = video_info(path)
    kept = capture.frames_kept(camera, episode, info.frames)
    if kept < 2:
        window = "" if kept == info.frames else f" between start_s and end_s ({info.frames} in all)"
        raise InputDataError(
            f"{path}: episode '{episode}' has {kept} frame(s){window}.", "at least 2.", "add frames, or remove it."
        )
    facts.videos += 1
    facts.video_frames += kept
    rate = capture.manifest.video.frame_rate_hz
    if info.frame_rate_hz is not None and abs(info.frame_rate_hz / rate - 1) > 0.01:
        facts.warnings.append(
            f"{path}: the file says {info.frame_rate_hz:g} frames/s; capture.toml's {rate:g} is used."
        )
    _check_video_camera(capture, camera, episode, path, info)
    _check_video_masks(capture, camera, episode, info)


def _check_video_masks(capture: CaptureFolder, camera: str, episode: str, info: VideoInfo) -> None:
    masks = capture.root / "video_masks" / camera / episode
    if not has_folder(masks):
        return
    files = frame_files(masks)
    if len(files) != info.frames:
        raise InputDataError(
            f"{masks}: {len(files)} masks for {info.frames} frames.",
            "one mask a frame, or no directory.",
            "make one mask for each frame, or remove the folder.",
        )
    for file in files:
        _check_labels(capture, file, read_label(file), (info.width, info.height), f"videos/{camera}/{episode}")


def _check_video_camera(capture: CaptureFolder, camera: str, episode: str, path: Path, info: VideoInfo) -> None:
    if capture.cameras is None:
        return
    videos = capture.cameras.videos
    entry = videos.get(f"{camera}/{episode}") or videos.get(camera)
    if entry is None:
        return
    if pose_count(entry) not in (1, info.frames):
        raise InputDataError(
            f"{path}: {info.frames} frames, but its camera has {pose_count(entry)} poses.",
            "one pose, or one a frame.",
            "cut the video to the frames with poses, or calibrate it again.",
        )
    intrinsics = capture.cameras.cameras[entry.camera]
    if (intrinsics.width, intrinsics.height) != (info.width, info.height):
        raise InputDataError(
            f"{path}: {info.width}x{info.height} px, but its camera '{entry.camera}' has "
            f"{intrinsics.width}x{intrinsics.height} px.",
            "the image size that the camera was calibrated for.",
            f"give the video in that size, or run 'cgwm calibrate {typed_path(capture.root)} --overwrite'.",
        )
