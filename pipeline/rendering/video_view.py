"""Cameras and exposures of a capture's video frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.cameras import Camera, pose_count
from ...datasets.capture.capture import Capture
from ...datasets.models.model import Model
from ...schemas import Exposure

Image = NDArray[np.uint8]


def usable_cameras(capture: Capture, episode: str) -> tuple[list[str], list[str]]:
    """Return the names of the calibrated video cameras of an episode, and of the others."""
    known = capture.cameras.videos if capture.cameras is not None else {}
    names = capture.videos(episode)
    calibrated = [name for name in names if name in known or f"{name}/{episode}" in known]
    return calibrated, [name for name in names if name not in calibrated]


def video_view(capture: Capture, camera: str, episode: str, frame: int, size: tuple[int, int]) -> Camera:
    """Return the camera of a video frame, resized to the frame's size (width, height) [px]."""
    known = capture.cameras.videos if capture.cameras is not None else {}
    entry = known.get(f"{camera}/{episode}") or known.get(camera)
    moving = entry is not None and pose_count(entry) > 1
    view = capture.video_camera(camera, episode, frame if moving else None)
    return view if (view.width, view.height) == tuple(size) else view.resized(*size)


def expose(pictures: Image | NDArray[np.float32], exposure: Exposure) -> NDArray[np.float32]:
    """Apply a camera's gain and offset to the model's colours, 0 to 255; the result is clipped to [0, 1]."""
    gain, offset = (np.asarray(values, np.float32) for values in (exposure.gain_rgb, exposure.offset_rgb))
    return np.clip(pictures.astype(np.float32) / 255 * gain + offset, 0.0, 1.0).astype(np.float32)


def renderable(model: Model) -> bool:
    """Return whether a model can be compared with frames: it has a scene, and spheres of all free bodies."""
    seen = all(body.name in model.body_splats for body in model.file.bodies if body.motion == "free")
    return seen and model.scene is not None
