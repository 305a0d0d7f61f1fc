"""Import of a video of a walk around a resting scene: sharp, well-spaced frames become the photos of a capture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.imports import ImportResult
from ...schemas.printable import typed_path
from ...schemas.regular_files import require_regular_file
from ..capture.images import named_as_photo, write_image
from ..capture.video import frames_of
from ..io.atomic import new_directory
from ..io.outputs import reads
from ..io.progress import progress
from .photo_captures import write_photo_capture

Array = NDArray[np.float64]

FEWEST = 3
"""Smallest number of photos that a calibration can use."""
_FLOW_WIDTH, _SHARP_WIDTH = 320, 960
"""Widths at which motion and sharpness are measured [px]."""
_POINTS = 200
_LEAST_WALK = 0.2
"""Smallest motion of the picture over the whole video, in widths: less is a camera that stands."""
BLURRED = 0.3
"""A frame with less than this share of the median sharpness of the chosen ones is left out."""


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """What is measured of each frame of a video."""

    sharpness: Array
    """Variance of the Laplacian of the grey picture, shape (frame,)."""
    walked: Array
    """Motion of the picture from the first frame on, in widths of the picture, shape (frame,)."""


@reads("source")
def import_video(source: Path | str, out: Path | str, photos: int = 60, overwrite: bool = False) -> ImportResult:
    """Write frames of a video as the photos of a capture, whose cameras `cgwm calibrate` estimates.

    The motion of the picture is followed by optical flow and divided into as many equal parts as photos are wanted;
    each part gives its sharpest frame. Frames are turned upright as the file's rotation says. The scene has to rest:
    videos of a motion belong into `videos/` of a capture.

    Args:
        source: The video: .mp4, .mov, .webm or what else OpenCV decodes.
        out: The capture directory to write.
        photos: Most photos.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the video does not decode, its camera stands, or fewer than three frames are sharp.
        UsageError: If `out` exists, before anything is read.
    """
    source = Path(source)
    with new_directory(out, "capture", overwrite) as directory:
        _require_video(source)
        chosen, blurred = sharp_frames(source, measured(frames_of(source)), photos)
        _write(source, directory, chosen)
        notes = ["a phone reads a picture row by row (rolling shutter), which bends fast turns: walk slowly"]
        if blurred:
            notes.append(f"{blurred} of {photos} parts of the video have no sharp frame")
        return write_photo_capture(directory, out, len(chosen), warnings=notes)


def _require_video(source: Path) -> None:
    """Refuse a folder, and a photo."""
    is_photo = named_as_photo(source)
    if source.is_dir() or (is_photo and source.is_file()):
        folder = source.parent if is_photo else source
        raise InputDataError(
            f"{source}: is a {'photo' if is_photo else 'folder'}.",
            "one video, of a walk around the scene.",
            f"name the video; photos are imported by 'cgwm import photos {typed_path(folder)} --out CAPTURE'.",
        )
    require_regular_file(source)


def sharp_frames(source: Path, figures: FrameFigures, most: int) -> tuple[list[int], int]:
    """Return the frames of a walk to take, and the number of its parts that have no sharp one; refuse too few."""
    require_walk(source, figures)
    chosen, blurred = choose(figures, most)
    if len(chosen) < FEWEST:
        raise InputDataError(
            f"{source}: {len(chosen)} sharp frames.", f"at least {FEWEST}.", "record a longer, slower walk."
        )
    return chosen, blurred


def require_walk(source: Path, figures: FrameFigures) -> None:
    """Refuse a recording whose camera stands, or that has no frames."""
    if not len(figures.walked) or figures.walked[-1] < _LEAST_WALK:
        moved = 100 * figures.walked[-1] if len(figures.walked) else 0.0
        raise InputDataError(
            f"{source}: the picture moves by {moved:.0f} % of its width in {len(figures.walked)} frames: the camera "
            "stands.",
            f"a walk around the scene, over {100 * _LEAST_WALK:.0f} % at least.",
            "record a slow walk all around; a video of a motion belongs into videos/ of a capture.",
        )


def measured(frames: Iterable[NDArray[np.uint8]]) -> FrameFigures:
    """Measure the sharpness of each frame (BGR), and the motion of the picture up to it."""
    sharpness, steps = [], []
    before: NDArray[np.uint8] | None = None
    for frame in progress(frames, "video", unit="frame"):
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        sharpness.append(float(cv2.Laplacian(_narrowed(grey, _SHARP_WIDTH), cv2.CV_64F).var()))
        small = _narrowed(grey, _FLOW_WIDTH)
        steps.append(0.0 if before is None else _step(before, small))
        before = small
    walk = np.array(steps)
    lost = ~np.isfinite(walk)  # a blurred frame, or a picture without texture: as far as the others
    walk[lost] = np.median(walk[1:][~lost[1:]]) if (~lost[1:]).any() else 0.0
    return FrameFigures(np.array(sharpness), np.cumsum(walk))


def choose(figures: FrameFigures, most: int) -> tuple[list[int], int]:
    """Return the sharpest frame of each of `most` equal parts of the walk, and the number of parts without one."""
    part = np.minimum((figures.walked / figures.walked[-1] * most).astype(int), most - 1)
    best = [
        int(np.flatnonzero(part == k)[np.argmax(figures.sharpness[part == k])])
        for k in range(most)
        if (part == k).any()
    ]
    least = BLURRED * float(np.median(figures.sharpness[best]))
    sharp = [k for k in best if figures.sharpness[k] >= least]
    return sharp, len(best) - len(sharp)


def _step(before: NDArray[np.uint8], now: NDArray[np.uint8]) -> float:
    """Return the median motion of points between two pictures, in widths; NaN where too few are found again."""
    points = cv2.goodFeaturesToTrack(before, _POINTS, 0.01, 5)
    if points is None or len(points) < 8:
        return float("nan")
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, now, points, np.empty_like(points))
    good = found.ravel() == 1
    if good.sum() < 8:
        return float("nan")
    return float(np.median(np.linalg.norm((moved - points)[good].reshape(-1, 2), axis=1))) / now.shape[1]


def _narrowed(grey: NDArray, width: int) -> NDArray[np.uint8]:
    height = max(1, round(grey.shape[0] * width / grey.shape[1]))
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _write(source: Path, directory: Path, chosen: list[int]) -> None:
    (directory / "images").mkdir()
    wanted = set(chosen)
    frames: Iterator[NDArray[np.uint8]] = frames_of(source)
    for index, frame in enumerate(frames):
        if index in wanted:
            write_image(directory / "images" / f"{index:06d}.jpg", np.ascontiguousarray(frame[:, :, ::-1]), 97)
        if index == chosen[-1]:
            return
