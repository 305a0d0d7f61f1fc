"""The noise of measured tracks, estimated from the tracks themselves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from ...datasets.tracks import Track

WINDOW = 5
"""Frames of a window; short enough for free flight to be a parabola in position and rotation."""
MAD_TO_STD = 1.4826
FLOOR_M, FLOOR_RAD = 1e-5, 1e-4
"""Smallest noise admitted: noiseless tracks would give infinite weights."""


def estimate_noise(tracks: Iterable[Track]) -> tuple[float, float]:
    """Return the standard deviations of position [m] and rotation [rad], for each axis.

    Each window of consecutive frames is fitted by a parabola in position and in rotation vector (a tumbling body turns
    at a changing rate); the
    residuals' median absolute deviation, scaled for the degrees of freedom used up, ignores the few windows that hold
    an impact.
    """
    positions, rotations = [], []
    for track in tracks:
        for first in range(0, len(track.time_s) - WINDOW + 1, WINDOW // 2):
            rows = slice(first, first + WINDOW)
            t = track.time_s[rows] - track.time_s[rows].mean()
            positions.append(_residual(t, track.position_m[rows], degree=2))
            if track.quat_wxyz is not None:
                turn = Rotation.from_quat(track.quat_wxyz[rows], scalar_first=True)
                rotations.append(_residual(t, (turn[WINDOW // 2].inv() * turn).as_rotvec(), degree=2))
    return max(_spread(positions), FLOOR_M), max(_spread(rotations), FLOOR_RAD)


def _residual(t: np.ndarray, values: np.ndarray, degree: int) -> np.ndarray:
    basis = np.vander(t, degree + 1)
    residual = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    return residual * np.sqrt(len(t) / (len(t) - degree - 1))


def _spread(residuals: list[np.ndarray]) -> float:
    return float(MAD_TO_STD * np.median(np.abs(np.concatenate(residuals)))) if residuals else 0.0
