"""Two models on the same episodes: differences episode by episode, and how sure they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..schemas import PairedDifference

LEAST_EPISODES = 6
"""With fewer, no distribution-free statement of 95 % is possible: five episodes that agree have odds of 1 in 16."""
RESAMPLES = 4000


def paired_difference(
    model: str, than: str, error_m: Mapping[str, float], other_m: Mapping[str, float]
) -> PairedDifference | None:
    """Return how the translation error of a model differs from another's on the episodes that both have.

    The interval is the percentile bootstrap over episodes (Efron 1979) of the median difference. It assumes that the
    episodes are independent draws of what one wants to predict, and is somewhat too short with few of them.

    Args:
        model: Name of the model.
        than: Name of the other one.
        error_m: Its error by episode [m].
        other_m: The other's.

    Returns:
        The difference, or None if they share no episode.
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
