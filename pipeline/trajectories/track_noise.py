"""Noise of tracks estimated from windows over all of their frames, before flight and contact are separated."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...datasets.shapes.turns import turn_between

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Track

WINDOW = 5
"""Frames of a window; short enough for free flight to be a parabola in position and rotation."""
LONG_FRAMES, LONG_S = 9, 0.3
"""Minimum frames and length [s] of a window of a centroid's flight. A marker that moves over a ball, or a filter, makes
errors that are correlated over many frames, which a short parabola would follow. A cubic follows a drag of 0.03 / m at
6 m/s within 0.02 mm."""
MAD_TO_STD = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""
FLOOR_M, FLOOR_RAD = 1e-5, 1e-4
"""Minimum noise of position [m] and rotation [rad]: noiseless tracks would get infinite weights."""


class Noise(NamedTuple):
    """Standard deviations of tracked poses."""

    position_m: float
    """Of each coordinate of the position [m]."""
    rotation_rad: float
    """Of the rotation about each axis [rad]."""


def noise_of(given: tuple[float | None, float | None], tracks: Iterable[Track]) -> Noise:
    """Return standard deviations of position [m] and rotation [rad]: the given ones, estimated where there are none.

    Args:
        given: Those that are known; None where one is not.
        tracks: Of free bodies.
    """
    if given[0] and given[1]:
        return Noise(given[0], given[1])
    estimated = estimate_noise(tracks)
    return Noise(given[0] or estimated.position_m, given[1] or estimated.rotation_rad)


def estimate_noise(tracks: Iterable[Track], flying: bool = False) -> Noise:
    """Return the standard deviations of position [m] and rotation [rad] for each axis.

    Each window of consecutive frames is fitted by a parabola in position and in rotation vector (a tumbling body turns
    at a changing rate); the residuals' median absolute deviation, scaled for the degrees of freedom used, ignores the
    few windows that contain an impact. A coordinate that never changes was not measured, and is left out.

    Args:
        tracks: Of free bodies.
        flying: Whether they are in free flight all the time: windows of centroids are then as long as errors that are
            correlated over many frames, which a short parabola would follow.
    """
    positions, rotations = [], []
    for track in tracks:
        window, degree = WINDOW, 2
        if flying and track.quat_wxyz is None:
            window = max(LONG_FRAMES, round(LONG_S / float(np.median(np.diff(track.time_s)))))
            window, degree = min(window, len(track.time_s)), 3
            if window < degree + 2:  # its cubic leaves nothing
                continue
        first = np.arange(0, len(track.time_s) - window + 1, max(window // 2, 1))
        if not len(first):
            continue
        rows = first[:, None] + np.arange(window)
        t = track.time_s[rows] - track.time_s[rows].mean(1, keepdims=True)
        positions.append(polynomial_residuals(t, track.position_m[:, moves(track.position_m)][rows], degree).ravel())
        if track.quat_wxyz is not None:
            turned = turn_between(track.quat_wxyz[rows[:, WINDOW // 2], None], track.quat_wxyz[rows])
            rotations.append(polynomial_residuals(t, turned, degree).ravel())
    return Noise(max(spread(positions), FLOOR_M), max(spread(rotations), FLOOR_RAD))


def moves(position_m: np.ndarray) -> np.ndarray:
    """Return the coordinates (3) of a track (T, 3) that change at all; all three where none does."""
    changes = np.ptp(position_m, axis=0) > 0
    return changes if changes.any() else np.ones(3, bool)


def polynomial_residuals(t: np.ndarray, values: np.ndarray, degree: int) -> np.ndarray:
    """Return the residuals (W, n, k) of polynomials of windows, scaled for the degrees of freedom that they use.

    Args:
        t: Times from the mean of each window [s], shape (W, n).
        values: What the polynomials follow, shape (W, n, k).
        degree: Of the polynomials.
    """
    basis = np.linalg.qr((t / np.abs(t).max(1, keepdims=True))[..., None] ** np.arange(degree + 1))[0]
    residuals = values - basis @ (basis.mT @ values)
    count = t.shape[1]
    return residuals * np.sqrt(count / (count - degree - 1))


def spread(residuals: list[np.ndarray]) -> float:
    """Return the robust standard deviation of residuals; 0 without any."""
    return float(MAD_TO_STD * np.median(np.abs(np.concatenate(residuals)))) if residuals else 0.0
