"""Paired differences of two models on the same episodes and pieces of motion, with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...schemas import PairedDifference, ShortDifference
from .short_horizon_errors import ShortErrors

LEAST_EPISODES = 6
"""Minimum number of episodes for a 95 % interval: with five episodes, even complete agreement of the signs has a
probability of 1 in 16 by chance."""
LEAST_PIECES = 12
"""Minimum number of pieces of motion for a 95 % interval."""
RESAMPLES = 4000
"""Number of bootstrap samples."""


def paired_difference(
    model: str, than: str, error_m: Mapping[str, float], other_m: Mapping[str, float]
) -> PairedDifference | None:
    """Compare the translation errors of two models on the episodes that both have.

    The interval is the percentile bootstrap over episodes (Efron 1979) of the median difference. It assumes that the
    episodes are independent draws of the motions to be predicted, and is somewhat too short if they are few.

    Args:
        model: Name of the model.
        than: Name of the other model.
        error_m: Errors of the model by episode [m].
        other_m: Errors of the other model by episode [m].

    Returns:
        The difference, or None if the models share no episode.
    """
    shared = [name for name in error_m if name in other_m]
    if not shared:
        return None
    change = np.array([error_m[name] - other_m[name] for name in shared])
    interval = None
    if len(change) >= LEAST_EPISODES:
        draws = np.random.default_rng(0).integers(0, len(change), (RESAMPLES, len(change)))
        low, high = np.percentile(np.median(change[draws], axis=1), (2.5, 97.5))
        interval = (float(low), float(high))
    return PairedDifference(
        model=model,
        than=than,
        episodes=len(change),
        better=int((change < 0).sum()),
        median_difference_m=float(np.median(change)),
        interval_95_m=interval,
    )


def short_difference(short: Mapping[str, ShortErrors], other: Mapping[str, ShortErrors]) -> ShortDifference | None:
    """Compare the short predictions of two models in the frames that both predict; None if there are none.

    The interval is the percentile bootstrap of the difference of the reduced chi2 over the pieces of motion, whose
    starts are fitted separately: residuals of neighbouring frames are not independent, those of pieces nearly are.

    Args:
        short: Residuals of the model by episode.
        other: Residuals of the other model, of the same pieces.
    """
    rows, frames = [], 0
    for name in (one for one in short if one in other):
        a, b = short[name], other[name]
        known = np.isfinite(a.sigmas) & np.isfinite(b.sigmas)
        seen = known.any((1, 2)) & np.isfinite(a.span_s[:, 0])
        frames += int(seen.sum())
        sums = [np.where(known, values, 0.0).sum((1, 2)) for values in (a.sigmas**2, a.freedom, b.sigmas**2, b.freedom)]
        for start in np.unique(a.span_s[seen, 0]):
            mine = seen & (a.span_s[:, 0] == start)
            rows.append([float(one[mine].sum()) for one in sums])
    table = np.array(rows).reshape(-1, 4)
    total = table.sum(0)
    if min(total[1], total[3]) <= 0:
        return None
    interval = None
    if len(table) >= LEAST_PIECES:
        draws = np.random.default_rng(0).integers(0, len(table), (RESAMPLES, len(table)))
        sums = table[draws].sum(1)
        low, high = np.percentile(
            sums[:, 0] / np.maximum(sums[:, 1], 1e-9) - sums[:, 2] / np.maximum(sums[:, 3], 1e-9), (2.5, 97.5)
        )
        interval = (float(low), float(high))
    return ShortDifference(
        frames=frames,
        pieces=len(table),
        reduced_chi2=float(total[0] / total[1]),
        than_reduced_chi2=float(total[2] / total[3]),
        interval_95=interval,
    )
