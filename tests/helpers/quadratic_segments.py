"""Contact segments whose cost is quadratic: a contact parameter, and one of a candidate."""

from __future__ import annotations

import numpy as np
from cgwm.pipeline.physics.parameters import Parameter
from cgwm.pipeline.segments.linearization import Linearization
from numpy.typing import NDArray

Array = NDArray[np.float64]


def quadratic_segments(
    rows: Array, seen: Array, episode: NDArray[np.int64], prior_std: float, prior: Array
) -> Linearization:
    """Return segments with residuals `seen` (B, n) and slopes `rows` (B, n, 2) of the episodes (B,)."""
    count = len(rows)
    parameters = tuple(
        Parameter(name=name, unit="1", prior=(0.0, prior_std), bounds=(-9.0, 9.0), logarithmic=False, reveals="")
        for name in "fe"
    )
    return Linearization(
        parameters=parameters,
        base=1,
        information=np.einsum("bti,btj->bij", rows, rows),
        score=np.einsum("bti,bt->bi", rows, seen),
        weight=np.ones(count),
        episode=episode,
        group=np.zeros(count, np.int64),
        prior=prior,
        chi2=(seen**2).sum(1),
        dof=np.full(count, float(rows.shape[1])),
    )
