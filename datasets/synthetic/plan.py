"""A scene before rendering: the object, the true physics, and the true motion of every episode."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..capture.cameras import Camera
from .dynamics import STEPS_PER_S, ContactTruth, Motion, matrix_from_quat
from .objects import SolidObject

Array = NDArray[np.float64]

EXPOSURE_LEAD_S = 1 / 120
"""Motion begins this long before time zero, because the exposure of the first frame begins before it [s]."""


@dataclass(frozen=True)
class EpisodePlan:
    """One episode.

    Args:
        name: Its name in the capture.
        split: The split it belongs to.
        frame_count: Number of video frames.
        motion: The true motion.
    """

    name: str
    split: str
    frame_count: int
    motion: Motion


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """A scene.

    Args:
        name: Name of the scene.
        seed: Seed of all random draws.
        solid: The object.
        contact: The true contact parameters.
        photo_qpos: Object position [m] and quat_wxyz at rest in the photos, shape (7,).
        frame_rate: Frames per second of the videos.
        episodes: All of them, training first.
        fingertip: Whether a driven fingertip takes part.
    """

    name: str
    seed: int
    solid: SolidObject
    contact: ContactTruth
    photo_qpos: Array
    frame_rate: float
    episodes: tuple[EpisodePlan, ...]
    fingertip: bool


def stays_in_view(solid: SolidObject, motion: Motion, cameras: Iterable[Camera]) -> bool:
    """Return whether every corner of the object stays inside every image, 2 % of the image size from its edges."""
    for qpos in motion.qpos[:: STEPS_PER_S // 120]:
        corners = solid.vertices @ matrix_from_quat(qpos[3:7]).T + qpos[:3]
        for camera in cameras:
            pixel, _ = camera.project(corners)
            place = pixel / (camera.width, camera.height)
            if not (place.min() > 0.02 and place.max() < 0.98):
                return False
    return True


def turned_deg(quat_a: Array, quat_b: Array) -> float:
    """Return the angle between two orientations (w, x, y, z) [deg]."""
    return float(np.degrees(2 * np.arccos(min(1.0, abs(float(quat_a @ quat_b))))))


def tilted_deg(quat_a: Array, quat_b: Array) -> float:
    """Return the angle between the vertical directions, in the body frame, of two orientations (w, x, y, z) [deg]."""
    cosine = matrix_from_quat(quat_a)[2] @ matrix_from_quat(quat_b)[2]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
