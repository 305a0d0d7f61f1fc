"""Paired difference of two models on the same episodes, with a confidence interval."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...schemas import PairedDifference

LEAST_EPISODES = 6
"""Minimum number of episodes for a 95 % interval: with five episodes, even complete agreement of the signs has a
probability of 1 in 16 by chance."""
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
