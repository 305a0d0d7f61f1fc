"""The filter that smoothed the tracks, from the errors of short windows of flight.

A filter bends a path where its velocity jumps, for as long as it remembers. How near a contact a flight may be looked
at follows from the filter: parabolas over n frames (Savitzky & Golay 1964) bend (n - 1) / 2 of them, a Butterworth low
pass of second order that runs forwards and backwards somewhat more than a period of its cut-off. The filter is that of
the largest restricted likelihood, as of the other noise models (`correlated_noise`): errors before it are white or last
for some time, and what passed it has their spectrum times the square of its gain. A filter counts where it is likelier
by far than errors that last without one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .correlated_noise import Windows, restricted_likelihoods, windows_of
from .innovations import CorrelatedNoise, matern, with_white
from .observations import Observations
from .segmentation import Segment
from .thresholds import TRACK_THRESHOLDS

LIMITS = TRACK_THRESHOLDS.track_noise

Array = NDArray[np.float64]

CUTOFFS_HZ = (8.0, 10.0, 12.0, 14.0, 17.0, 20.0, 24.0, 28.0, 34.0, 40.0, 50.0)
"""Cut-offs that are tried, below `HIGHEST` of the frame rate."""
HIGHEST = 0.45
PARABOLAS = (5, 7, 9, 11, 13)
"""Numbers of frames of parabolas that are tried."""
LASTING = ((0.0, 1.0), (0.01, 0.0), (0.01, 0.05), (0.03, 0.0), (0.03, 0.05))
"""How long errors last before the filter [s], and the share of their variance that is white."""
ROUNDING = 1e-4
"""Share of the variance that passes no filter: without any, what a low pass leaves could not be inverted."""
GRID, LAGS = 1024, 200
"""Number of frequencies, and the longest lag in frames, of correlations."""


class SmoothingFilter(NamedTuple):
    """A filter of tracks."""

    reach: int
    """Frames before and after a contact that it bends."""
    low_pass: bool
    """Whether it is a low pass that runs forwards and backwards, which also bends the ends of a record."""


def smoothing_filter(
    whole: Observations, flight: Sequence[Segment], std_m: float, without: CorrelatedNoise
) -> SmoothingFilter | None:
    """Return the filter that smoothed positions; None where errors without one are as likely.

    Args:
        whole: The episodes (E).
        flight: Their flight segments.
        std_m: Standard deviation of positions [m], beside which errors of the frames' times count.
        without: The likeliest errors without a filter.
    """
    windows = windows_of(whole, flight, 0, std_m)
    if sum(w.count for w in windows) < LIMITS.enough:
        return None
    step_s = float(np.median([np.median(np.diff(w.times_s, axis=1)) for w in windows]))

    def plain(w: Windows) -> Tensor:
        return with_white(matern(torch.from_numpy(w.gaps_s), without.time_s, without.order), without.share)[None]

    found, most = None, restricted_likelihoods(windows, plain)[0][0] + LIMITS.sure_filter / 2
    for one, gain in _filters(step_s):
        correlations = [_correlation(gain, *lasting, step_s) for lasting in LASTING]
        likelihood = max(restricted_likelihoods(windows, lambda w, c=correlations: _covariances(w, c, step_s)))[0]
        if likelihood > most:
            found, most = one, likelihood
    return found


def _covariances(windows: Windows, correlations: Sequence[Array], step_s: float) -> Tensor:
    """Return the correlations of windows from those over whole numbers of frames, shape (N, W, n, n)."""
    gap, lags = windows.gaps_s / step_s, np.arange(LAGS)
    found = np.stack([np.interp(gap, lags, one, right=0.0) for one in correlations])
    return torch.from_numpy((1 - ROUNDING) * found + ROUNDING * np.eye(gap.shape[1]))


def _filters(step_s: float) -> Iterator[tuple[SmoothingFilter, Array]]:
    """Yield filters with the squares of their gains."""
    f = _frequencies()
    for fc in CUTOFFS_HZ:
        if fc < HIGHEST / step_s:
            ratio = np.tan(math.pi * f) / math.tan(math.pi * fc * step_s)  # the bilinear transform
            yield SmoothingFilter(math.ceil(LIMITS.cutoff_periods / fc / step_s), True), (1 + ratio**4) ** -2.0
    for count in PARABOLAS:
        half = count // 2
        places = np.arange(-half, half + 1)
        weights = np.linalg.pinv(np.vander(places, 3))[2]  # the value of the parabola of least squares in the middle
        yield SmoothingFilter(half, False), (np.cos(2 * math.pi * f[:, None] * places) @ weights) ** 2


def _frequencies() -> Array:
    """Return frequencies in units of the frame rate."""
    return (np.arange(GRID) + 0.5) / (2 * GRID)


@cache
def _cosines() -> Array:
    """Return the cosines (lags, frequencies) that make correlations of spectra."""
    return np.asarray(np.cos(2 * math.pi * _frequencies() * np.arange(LAGS)[:, None]))


def _correlation(gain: Array, lasting_s: float, white: float, step_s: float) -> Array:
    """Return the correlation of errors that passed a filter, over whole numbers of frames."""
    f, before = _frequencies(), np.ones(GRID)
    if lasting_s:
        kept = math.exp(-step_s / lasting_s)
        before = white + (1 - white) * (1 - kept**2) / (1 - 2 * kept * np.cos(2 * math.pi * f) + kept**2)
    found = _cosines() @ (gain * before)
    return np.asarray(found / found[0])
