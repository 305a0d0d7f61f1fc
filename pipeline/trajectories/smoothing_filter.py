"""The filter that smoothed the tracks, from the errors of short windows of flight.

A filter bends a path where its velocity jumps, for as long as it remembers. How near a contact a flight may be looked
at follows from the filter: parabolas over n frames (Savitzky & Golay 1964) bend (n - 1) / 2 of them, a Butterworth low
pass of second order that runs forwards and backwards somewhat more than a period of its cut-off. The filter is that of
the largest restricted likelihood, as of the other noise models (`correlated_noise`): errors before it are white or last
for some time, and what passed it has their spectrum times the square of its gain. A filter counts where it is likelier
by far than errors that last without one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .correlated_noise import windows_of
from .innovations import CorrelatedNoise, matern
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
    gaps = [np.abs(w.times_s[:, :, None] - w.times_s[:, None]) for w in windows]
    whitened = [torch.from_numpy(w.both) for w in windows]

    def likelihood(covariances: Sequence[torch.Tensor]) -> float:
        logs, square, count = 0.0, 0.0, sum(w.count for w in windows)
        for w, both, covariance in zip(windows, whitened, covariances, strict=True):
            factor, failed = torch.linalg.cholesky_ex(covariance)
            if bool(failed.any()):
                return -math.inf
            basis, left = torch.linalg.solve_triangular(factor, both, upper=False).tensor_split([w.basis.shape[2]], 2)
            inner = torch.linalg.cholesky(basis.mT @ basis)
            along = torch.linalg.solve_triangular(inner, basis.mT @ left, upper=False)
            square += float(left.square().sum() - along.square().sum())
            roots = [one.diagonal(dim1=1, dim2=2).log().sum(1) for one in (factor, inner)]
            logs += 2 * float((roots[0] + roots[1]) @ torch.from_numpy(w.columns).to(covariance))
        return -0.5 * (logs + count * math.log(max(square / count, 1e-300)))

    def filtered(correlation: Array) -> list[torch.Tensor]:
        parts = [(1 - ROUNDING) * np.interp(gap / step_s, np.arange(LAGS), correlation, right=0.0) for gap in gaps]
        return [torch.from_numpy(part + ROUNDING * np.eye(part.shape[1])) for part in parts]

    own = [torch.from_numpy(gap) for gap in gaps]
    plain = [
        without.share * matern(gap, without.time_s, without.order)
        + (1 - without.share) * torch.eye(gap.shape[1], dtype=torch.float64)
        for gap in own
    ]
    tried = [
        (likelihood(filtered(_correlation(gain, *lasting, step_s))), found)
        for (found, gain), lasting in itertools.product(_filters(step_s), LASTING)
    ]
    most, best = max(tried, key=lambda one: one[0])
    return best if 2 * (most - likelihood(plain)) > LIMITS.sure_filter else None


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
