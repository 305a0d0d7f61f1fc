"""Accelerations of tracked bodies in short windows of their tracks, without assumptions about units or forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .tracks import Track

Array = NDArray[np.float64]

WINDOWS = (9, 17, 33, 65, 129, 257)
"""Lengths of windows [frames]; of these the shortest in which accelerations stand out of the noise."""
SIGNIFICANT = 12.0
"""An acceleration of so many standard errors counts as measured."""
MOST_MISFIT = 0.05
"""Largest residual of the parabola, as a share of its own bend within the window: more is an impact."""
NOISE_RATIO = 4.0
"""Largest residual of the parabola in units of the noise."""


@dataclass(frozen=True, eq=False)
class MotionWindows:
    """Windows of a track in which the position is a parabola, or nothing moves measurably (W windows)."""

    first: NDArray[np.int64]
    """First frame of each window, shape (W,)."""
    length: int
    """Frames of a window."""
    acceleration: Array
    """Acceleration in the units of the track, shape (W, 3)."""
    std_error: Array
    """Its standard error by axis, shape (W,)."""
    noise: float
    """Standard deviation of a coordinate, from the residuals."""

    def extremes(self, values: Array) -> tuple[Array, Array]:
        """Return the smallest and the largest of the values (T,) of the frames of each window, shapes (W,)."""
        if not len(self.first):
            return np.zeros(0), np.zeros(0)
        windows = np.lib.stride_tricks.sliding_window_view(values, self.length)[self.first]
        return windows.min(axis=1), windows.max(axis=1)


def motion_windows(track: Track) -> MotionWindows:
    """Cut a track into half overlapping windows, and fit a parabola to the positions in each.

    The windows are counted in frames, as the times may be in any unit. Windows with an impact are left out: there, the
    residual is larger than the noise and than a small share of the parabola's bend.
    """
    lengths = [length for length in WINDOWS if length <= len(track)] or [len(track)]
    noise = float(np.median(_fits(track, lengths[0])[2])) if len(track) > 3 else 0.0
    best = None
    for length in lengths:
        first, acceleration, residual, per_noise, bend = _fits(track, length)
        smooth = residual <= np.maximum(NOISE_RATIO * noise, MOST_MISFIT * bend)
        error = np.maximum(residual, noise)[smooth] * per_noise[smooth]
        best = MotionWindows(first[smooth], length, acceleration[smooth], error, noise)
        measured = np.linalg.norm(best.acceleration, axis=1) > SIGNIFICANT * error
        if measured.mean() > 0.25 if len(measured) else False:
            break
    assert best is not None  # there is at least one length
    return best


def _fits(track: Track, length: int) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Fit a parabola in each window.

    Returns:
        First frames (W,), accelerations (W, 3), root mean square residuals (W,), standard errors of the acceleration
        per unit of noise (W,), and bends of the parabolas over the window (W,).
    """
    first = np.arange(0, len(track) - length + 1, max(length // 2, 1))
    rows = first[:, None] + np.arange(length)
    t = track.time_s[rows]
    half = (t[:, -1] - t[:, 0])[:, None] / 2
    u = (t - t.mean(axis=1, keepdims=True)) / half
    basis = np.stack([np.ones_like(u), u, u * u], axis=2)
    q, r = np.linalg.qr(basis)
    projected = np.einsum("wnk,wnj->wkj", q, track.position_m[rows])
    residual = track.position_m[rows] - np.einsum("wnk,wkj->wnj", q, projected)
    # The last row of R gives the coefficient of u^2 alone, without the other two.
    last = r[:, 2, 2]
    square = projected[:, 2] / last[:, None]
    freedom = max(length - 3, 1)
    rms = np.sqrt(np.square(residual).sum(axis=(1, 2)) / (3 * freedom))
    scale = 2 / np.square(half[:, 0])
    return first, square * scale[:, None], rms, scale / np.abs(last), np.linalg.norm(square, axis=1)
