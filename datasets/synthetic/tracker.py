"""The simulated tracker: tracks of a planned episode with normal noise."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from ..capture.tracks import Track
from .dynamics import FINGERTIP, OBJECT, matrix_from_quat, quat_from_matrix
from .plan import EpisodePlan, ScenePlan

Array = NDArray[np.float64]

TRACK_RATE = 120
"""Frames per second of a track [Hz]."""
POSITION_STD = 0.0005
"""Standard deviation of the position along each axis [m]."""
ROTATION_STD = np.radians(0.3)
"""Standard deviation of the rotation about each axis of the body [rad]."""


def track_times(plan: ScenePlan, episode: EpisodePlan) -> Array:
    """Return the times of an episode's track [s]: from zero to the last frame's end at TRACK_RATE."""
    return np.arange(round(episode.frame_count / plan.frame_rate * TRACK_RATE) + 1) / TRACK_RATE


def measure_tracks(plan: ScenePlan, episode: EpisodePlan) -> dict[str, Track]:
    """Return what a tracker measures: the object with noise, the fingertip's command as it is.

    The noise is normal and independent: POSITION_STD along each axis, and a turn about the body's axes with
    ROTATION_STD about each.
    """
    rng = np.random.default_rng([plan.seed, 11, zlib.crc32(episode.name.encode())])
    times = track_times(plan, episode)
    rows = episode.motion.qpos[episode.motion.rows(times)]
    quats = []
    for quat_wxyz, turn in zip(rows[:, 3:7], ROTATION_STD * rng.standard_normal((len(rows), 3)), strict=True):
        quats.append(_turned(quat_wxyz, turn))
    position = rows[:, :3] + POSITION_STD * rng.standard_normal((len(rows), 3))
    tracks = {
        OBJECT: Track(
            time_s=times,
            position_m=np.round(position, 7),
            quat_wxyz=np.asarray(quats, np.float64).round(9),
            velocity_m_s=None,
            omega_body_rad_s=None,
        )
    }
    if plan.fingertip:
        tracks[FINGERTIP] = Track(
            time_s=times,
            position_m=rows[:, 7:10],
            quat_wxyz=np.tile([1.0, 0, 0, 0], (len(rows), 1)),
            velocity_m_s=None,
            omega_body_rad_s=None,
        )
    return tracks


def _turned(quat_wxyz: Array, rotation_vector: Array) -> Array:
    """Return the orientation turned by a small rotation vector [rad] in body axes."""
    x, y, z = rotation_vector
    angle = float(np.linalg.norm(rotation_vector))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Rodrigues' formula.
    step = np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    return quat_from_matrix(matrix_from_quat(quat_wxyz) @ step)
