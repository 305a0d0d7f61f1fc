"""Masks of one body in videos of standing cameras: what differs from a film of the place without it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.capture import Capture
from ...datasets.capture.images import write_image
from ...datasets.capture.video import read_video
from ...datasets.io.atomic import new_directory
from ...datasets.io.kinds import kind_of
from ...datasets.io.outputs import reads
from ...datasets.io.progress import progress
from ...schemas import CaptureManifest, InputDataError, MasksReport, NotConvergedError, read_toml
from ..foreground.graph_cut import Mask
from .stage import MASKS_NAME, body_of, masks_report

_DEVIATIONS_SQUARED = 16.0
"""Squared deviation from the empty place above which a pixel is not of it, in variances of its noise."""
_DARKEST_SHADOW = 0.5
"""Brightness in a shadow, over that outside, below which it counts as the body."""
_SPECK_PX, _GAP_PX = 3, 7
"""Sides of what is removed as noise, and of gaps that are closed [px]."""
_MOST_CHANGED = 0.5
"""Largest share of a picture that differs from the empty place; above it the camera or the light has changed."""


@reads("source")
def mask_videos(
    source: Path | str, out: Path | str, empty: str, body: str | None = None, overwrite: bool = False
) -> MasksReport:
    """Write masks of one body in all videos of a capture: `<camera>/<episode>/<frame>.png`, its label on the body.

    A pixel is the body's where it differs from the film of the empty place by more than the noise there, and not as a
    shadow does, which darkens a place and keeps its colour (Zivkovic's mixtures, 2004, and Prati's test, 2003, as
    OpenCV has them). Of several parts the largest is kept, without holes.

    Args:
        source: A capture whose cameras stand.
        out: The directory to write; usually its `video_masks`.
        empty: The episode in which each camera filmed the place without the body.
        body: Name of the body; None takes the only one.
        overwrite: Replace `out`.

    Returns:
        What `masks.json` holds, with an entry for each frame.

    Raises:
        InputDataError: If `source` is no capture, or a camera has no film of the empty place.
        UsageError: If `out` exists, or there is no such body.
        NotConvergedError: If most of a picture differs from the empty place, or the body is found in fewer than half
            of the frames.
    """
    source = Path(source)
    if kind_of(source) != "capture":
        raise InputDataError(
            f"{source}: no capture, and --empty is about the videos of one.",
            "a directory with capture.toml and videos/.",
            "name the capture.",
        )
    with new_directory(out, "masks", overwrite) as directory:
        capture = Capture(source, read_toml(source / "capture.toml", CaptureManifest))
        name, label = body_of(source, [one.name for one in capture.manifest.bodies], body)
        found: dict[str, Mask] = {}
        for camera in capture.video_cameras():
            place = EmptyPlace(read_video(capture.video_path(camera, empty)))
            films = [one for one in capture.episodes() if one != empty and camera in capture.videos(one)]
            for episode in progress(films, f"videos of {camera}", unit="video"):
                folder = directory / camera / episode
                folder.mkdir(parents=True)
                for number, frame in enumerate(read_video(capture.video_path(camera, episode))):
                    key = f"{camera}/{episode}/{number:06d}.png"
                    found[key] = place.body_in(frame, f"{source}, {camera}, {episode}, frame {number}")
                    write_image(directory / key, np.where(found[key], label, 0).astype(np.uint8))
        if not found:
            raise InputDataError(
                f"{source}: no video besides those of '{empty}'.",
                "videos/<camera>/<episode>.mp4, or folders of frames.",
                "put the films of the motion into videos/.",
            )
        report = masks_report("empty", name, label, list(found), list(found.values()))
        (directory / MASKS_NAME).write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return report


class EmptyPlace:
    """What a standing camera sees without the body.

    Args:
        frames: Frames of the empty place, RGB, shape (T, H, W, 3).
    """

    def __init__(self, frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8]) -> None:
        self._middle = np.maximum(np.median(np.asarray(frames), axis=0), 1.0)
        self._model = cv2.createBackgroundSubtractorMOG2(len(frames), _DEVIATIONS_SQUARED, True)
        self._model.setShadowThreshold(_DARKEST_SHADOW)
        for frame in frames:
            self._model.apply(self._even(frame))

    def body_in(self, frame: NDArray[np.uint8], what: str) -> Mask:
        """Return the mask (H, W) of what stands before the place in a frame, which `what` names in messages.

        Raises:
            InputDataError: If its size is another one.
            NotConvergedError: If most of the picture has changed.
        """
        if frame.shape != self._middle.shape:
            sizes = [f"{shape[1]}x{shape[0]} px" for shape in (frame.shape, self._middle.shape)]
            raise InputDataError(
                f"{what}: {sizes[0]}, and the empty place was filmed with {sizes[1]}.",
                "films of one size from each camera.",
                "film the empty place with the same settings.",
            )
        changed = self._model.apply(self._even(frame), learningRate=0)
        if (changed > 0).mean() > _MOST_CHANGED:
            raise NotConvergedError(
                f"{what}: {(changed > 0).mean():.0%} of the picture differs from the empty place.",
                f"at most {_MOST_CHANGED:.0%}.",
                "film the empty place again: the camera and the light may not change between the films.",
            )
        return largest_part(changed == 255)  # 127 is a shadow

    def _even(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a frame in the exposure of the empty place: by the median ratio of each channel."""
        gain = np.median(self._middle / np.maximum(frame, 1), axis=(0, 1))
        return np.clip(np.rint(frame * gain), 0, 255).astype(np.uint8)


def largest_part(found: Mask) -> Mask:
    """Return the largest part of a mask, without specks, gaps and holes."""
    clean = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((_SPECK_PX, _SPECK_PX), np.uint8))
    clean = cv2.morphologyEx(clean, cv2.MORPH_CLOSE, np.ones((_GAP_PX, _GAP_PX), np.uint8))
    count, parts, figures, _ = cv2.connectedComponentsWithStats(clean)
    if count < 2:
        return clean > 0
    largest = (parts == 1 + figures[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
    outlines, _ = cv2.findContours(largest, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros_like(largest), outlines, -1, 1, cv2.FILLED) > 0
