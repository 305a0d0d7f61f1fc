"""Input images of structure from motion: the photos, and the first frame of each static video camera."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Mapping as Map
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from ...datasets.capture.capture import Capture
from ...datasets.capture.exif import photo_lens
from ...datasets.capture.files import repeated
from ...datasets.capture.images import image_size, write_image
from ...datasets.io.progress import progress
from ...schemas import CameraIntrinsics, InputDataError
from ..foreground.standing_camera import (
    places_of_camera,
    probes,
    reduced,
    seems_to_stand,
    surroundings,
    turning,
)
from .colmap.features import SfmImage
from .given_intrinsics import known_by_size

STILL_BELOW_PX = 2.0
"""Threshold on the median displacement of the background per 1000 px of image width [px], for a static camera."""
_EPISODES_LOOKED_AT = 4
_FEW_PHOTOS = 6
"""Minimum number of photos of a camera for four lens parameters; with fewer at most k1 is estimated."""
_MASK_MARGIN_PX = 5


@dataclass(frozen=True)
class Source:
    """An image for structure from motion and its origin."""

    label: str
    """The photo's name, or `video:<camera>`."""
    image: SfmImage
    """The image in the working folder."""


@dataclass(frozen=True)
class Inputs:
    """All images of a capture, laid out for COLMAP."""

    root: Path
    """Folder of the images."""
    sources: tuple[Source, ...]
    """The images."""
    notes: tuple[str, ...]
    """Messages for the user: moving video cameras, photos of several sizes."""
    moving: dict[str, str]
    """Omitted video cameras, with the reason."""
    richest: dict[str, str]
    """Richest camera model that is estimated for each camera, from its number of photos."""
    known: dict[str, CameraIntrinsics]
    """Intrinsics of cameras that are given and not estimated."""


_VIDEO = "video:"


def video_label(camera: str) -> str:
    """Return the label of the frame of a video camera, which is distinct from all names of photos."""
    return f"{_VIDEO}{camera}"


def video_of(label: str) -> str | None:
    """Return the camera whose frame of a video a label names; None for a photo."""
    return label.removeprefix(_VIDEO) if label.startswith(_VIDEO) else None


def gather(capture: Capture, folder: Path, intrinsics: Path | None = None, turntable: bool | None = None) -> Inputs:
    """Collect the images of a capture in a working folder, under names that COLMAP can read.

    Args:
        capture: The capture.
        folder: An empty folder, kept for the duration of the calibration.
        intrinsics: File of known intrinsics besides those of the manifest.
        turntable: Whether the camera stands and what it shows turns, so that the surroundings are left out; None looks
            at the photos.
    """
    root = folder / "images"
    sources, notes, richest = _photos(capture, root)
    if turntable or (turntable is None and _seems_to_turn(capture)):
        small = [reduced(capture.photo(source.label)) for source in sources]
        places = places_of_camera(small)
        if turntable and not places:
            places = _places_by_size(small)
        if places:
            sources, note = _without_surroundings(capture, folder, sources, small, places)
            notes.append(note)
    moving: dict[str, str] = {}
    for camera in capture.video_cameras():
        frames, masks = _probe_frames(capture, camera)
        if not frames:
            continue
        flow = background_flow(frames, masks)
        limit = STILL_BELOW_PX * frames[0].shape[1] / 1000.0
        if flow > limit:
            moving[camera] = f"the camera moves: its background shifts by {flow:.1f} px (still: below {limit:.1f} px)"
            notes.append(f"video camera '{camera}' is left out: {moving[camera]}; give its poses in cameras.json")
            continue
        sources.append(_video_source(folder, root, camera, frames[0], masks[0]))
        richest[f"video-{camera}"] = "SIMPLE_PINHOLE"  # one frame does not determine a lens
    known = _known(capture, sources, root, intrinsics)
    return Inputs(root, tuple(sources), tuple(notes), moving, richest, known)


def background_flow(frames: Sequence[NDArray[np.uint8]], masks: Sequence[NDArray[np.uint8] | None]) -> float:
    """Return the largest median displacement of corners between the first frame and any other [px].

    The median is that of the background as long as moving bodies cover less than half of the trackable corners. A
    corner has stayed where it was if its surroundings look more alike there than where they are followed to: from
    coarse to fine pictures a moving body drags the corners around it along, in a small video half of them.

    Args:
        frames: RGB frames of one camera, each (height, width, 3).
        masks: Labels of the frames (height, width), 0 background, or None.
    """
    first = cv2.cvtColor(frames[0], cv2.COLOR_RGB2GRAY)
    mask = None if masks[0] is None else (masks[0] == 0).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(first, 300, 0.01, 8, mask=mask)
    if corners is None:
        return 0.0
    worst = 0.0
    for frame in frames[1:]:
        shift = _shifts(first, cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), corners)
        if len(shift):
            worst = max(worst, float(np.median(shift)))
    return worst


def _shifts(first: MatLike, other: MatLike, corners: MatLike) -> NDArray[np.float64]:
    """Return how far the corners of a picture that are found in another one have moved [px]."""
    lengths, errors = [], []
    for coarser in (0, 3):  # pictures of half the size each, in which they are followed first
        moved, found, error = cv2.calcOpticalFlowPyrLK(first, other, corners, np.zeros_like(corners), maxLevel=coarser)
        lengths.append(np.linalg.norm((moved - corners).reshape(-1, 2), axis=1))
        errors.append(np.where(np.ravel(found) == 1, np.ravel(error), np.inf))
    best = np.argmin(errors, axis=0)
    return np.choose(best, lengths)[np.isfinite(np.min(errors, axis=0))]


def _known(capture: Capture, sources: Sequence[Source], root: Path, file: Path | None) -> dict[str, CameraIntrinsics]:
    """Return the given intrinsics by camera, of a video camera those of a size that no photo has.

    Raises:
        InputDataError: If some are of a size that nothing has.
    """
    videos = [source.image for source in sources if video_of(source.label) is not None]
    photos = [source for source in sources if video_of(source.label) is None]
    sizes = {source.image.camera: image_size(capture.root / "images" / source.label) for source in photos}
    frames = {image.camera: image_size(root / image.name) for image in videos}
    sizes |= {camera: size for camera, size in frames.items() if size not in sizes.values()}
    given = known_by_size(capture, set(sizes.values()), file)
    return {camera: given[size] for camera, size in sizes.items() if size in given}


def _photos(capture: Capture, root: Path) -> tuple[list[Source], list[str], dict[str, str]]:
    (root / "photos").mkdir(parents=True)
    names = capture.photos()
    sizes = {name: image_size(capture.root / "images" / name) for name in names}
    distinct = sorted(set(sizes.values()))
    same = capture.manifest.calibration.same_camera
    lenses = _lenses(capture) if same else {}
    sources, richest = [], {}
    for index, name in enumerate(names):
        # Numbers replace the names, because COLMAP separates lists by blanks.
        inside = f"photos/{index:06d}{Path(name).suffix.lower()}"
        _link(capture.root / "images" / name, root / inside)
        width, height = sizes[name]
        camera = name if not same else "photos" if len(distinct) == 1 else f"photos-{width}x{height}"
        camera += f"-lens{lenses[name]}" if lenses else ""
        alike = sum(_alike(one, name, sizes, lenses) for one in names) if same else 1
        richest[camera] = "OPENCV" if alike >= _FEW_PHOTOS else "SIMPLE_RADIAL"
        sources.append(Source(name, SfmImage(inside, camera)))
    again = repeated([capture.root / "images" / name for name in names])
    notes = [f"{copy.name} is the same photo as {first.name}: remove one" for copy, first in again.items()]
    if same and len(distinct) > 1:
        listed = ", ".join(f"{width}x{height}" for width, height in distinct)
        notes.append(f"photos of {len(distinct)} sizes ({listed}): each size has separate intrinsics")
    if lenses:
        notes.append(
            f"the EXIF data name {len(set(lenses.values()))} lenses or focal lengths: each has separate intrinsics; "
            "photos with one focal length are calibrated best"
        )
    return sources, notes, richest


def _seems_to_turn(capture: Capture) -> bool:
    pairs = [(reduced(capture.photo(a)), reduced(capture.photo(b))) for a, b in probes(capture.photos())]
    return seems_to_stand(pairs)


def _places_by_size(photos: Sequence[NDArray[np.uint8]]) -> list[list[int]]:
    """Return the indices of photos by their size: where a user says that the camera stood, and too little shows it."""
    sizes = [photo.shape for photo in photos]
    return [[k for k, size in enumerate(sizes) if size == one] for one in dict.fromkeys(sizes)]


def _without_surroundings(
    capture: Capture,
    folder: Path,
    sources: list[Source],
    small: Sequence[NDArray[np.uint8]],
    places: Sequence[Sequence[int]],
) -> tuple[list[Source], str]:
    """Write masks that leave out the surroundings, which stand; return the sources with them, and a note.

    What `masks/` shows of bodies is kept, too. Photos from no place of the camera are kept whole.

    Args:
        capture: The capture.
        folder: Folder of the masks.
        sources: The photos.
        small: The same, reduced.
        places: Indices of the photos that were taken from each place of the camera.
    """
    kept = [np.ones(photo.shape[:2], bool) for photo in small]
    for place in places:
        color, known = surroundings([small[k] for k in place])
        for k in place:
            kept[k] = turning(small[k], color, known)
    shares = [float(keep.mean()) for keep in kept]
    if not any(shares):
        raise InputDataError(
            f"{capture.root / 'images'}: all photos are the same: the camera stands, and nothing moves.",
            "photos from many sides.",
            "move the camera, or turn the object, between photos.",
        )
    for source, keep in zip(progress(sources, "surroundings", unit="image"), kept, strict=True):
        _write_kept(capture, folder, source, keep)
    note = (
        f"the camera stands and what it shows turns: features are of the {100 * np.mean(shares):.0f} % of the pixels "
        "that differ from the surroundings; a fit needs masks/ of the bodies, as the surroundings do not turn with "
        "them (if that is wrong: --set calibrate.turntable=false)"
    )
    return [replace(one, image=replace(one.image, mask=folder / "masks", stands=True)) for one in sources], note


def _write_kept(capture: Capture, folder: Path, source: Source, small: NDArray[np.bool_]) -> None:
    """Write which pixels of a photo features are taken from, with those that `masks/` shows of bodies."""
    width, height = image_size(capture.root / "images" / source.label)
    keep = np.asarray(cv2.resize(small.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST), bool)
    given = capture.photo_mask(source.label)
    if given is not None and given.shape == keep.shape:
        keep = keep | (given > 0)
    path = folder / "masks" / f"{source.image.name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.where(keep, 255, 0).astype(np.uint8))


def _alike(one: str, other: str, sizes: Map[str, tuple[int, int]], lenses: Map[str, int]) -> bool:
    return sizes[one] == sizes[other] and lenses.get(one) == lenses.get(other)


def _lenses(capture: Capture) -> dict[str, int]:
    """Return the number of the lens of each photo, from 1, by EXIF data; nothing where all have one.

    Photos without EXIF data count as of the lens of most others.
    """
    texts = {name: photo_lens(capture.root / "images" / name) for name in capture.photos()}
    counts = Counter(text for text in texts.values() if text)
    if len(counts) < 2:
        return {}
    order = [text for text, _ in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]
    return {name: 1 + order.index(text or order[0]) for name, text in texts.items()}


def _video_source(
    folder: Path, root: Path, camera: str, frame: NDArray[np.uint8], mask: NDArray[np.uint8] | None
) -> Source:
    inside = f"videos/{camera}.png"
    (root / "videos").mkdir(exist_ok=True)
    write_image(root / inside, frame)
    masks = None
    if mask is not None:
        # The bodies are at other places in the photos, so matches of their features would contradict the scene.
        masks = folder / "masks"
        (masks / "videos").mkdir(parents=True, exist_ok=True)
        kernel = np.ones((2 * _MASK_MARGIN_PX + 1, 2 * _MASK_MARGIN_PX + 1), np.uint8)
        keep = np.where(cv2.dilate((mask > 0).astype(np.uint8), kernel) > 0, 0, 255).astype(np.uint8)
        write_image(masks / f"{inside}.png", keep)
    return Source(video_label(camera), SfmImage(inside, f"video-{camera}", masks))


def _probe_frames(capture: Capture, camera: str) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8] | None]]:
    """Return the first frame of a camera, then the last ones and those of other episodes, with masks."""
    splits = capture.manifest.splits
    wanted = capture.episodes("train") if "train" in splits else capture.episodes()
    episodes = [episode for episode in wanted if camera in capture.videos(episode)][:_EPISODES_LOOKED_AT]
    frames: list[NDArray[np.uint8]] = []
    masks: list[NDArray[np.uint8] | None] = []
    for episode in episodes:
        video, labels = capture.video_frames(camera, episode), capture.video_masks(camera, episode)
        for index in dict.fromkeys((0, len(video) - 1)):
            frames.append(video[index])
            masks.append(None if labels is None else labels[index])
    sizes = {frame.shape for frame in frames}
    return (frames, masks) if len(sizes) <= 1 else (frames[:2], masks[:2])


def _link(source: Path, target: Path) -> None:
    try:
        os.symlink(source.resolve(), target)
    except OSError:  # file systems and operating systems without links
        shutil.copyfile(source, target)
