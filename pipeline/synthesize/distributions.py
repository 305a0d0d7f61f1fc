"""Draws from the distributions of a sampling plan."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr, ndtri

from ...schemas import Distribution
from ...schemas.plan import CUT_OFF


def draw(distribution: Distribution, rng: np.random.Generator) -> float:
    """Return a draw; a fixed value consumes no random number, any other distribution one."""
    if distribution.fixed is not None:
        return distribution.fixed
    if distribution.uniform is not None:
        return float(rng.uniform(*distribution.uniform))
    if distribution.log_uniform is not None:
        low, high = distribution.log_uniform
        return min(max(math.exp(rng.uniform(math.log(low), math.log(high))), low), high)
    if distribution.normal is not None:
        mean, std = distribution.normal
        tail = ndtr(-CUT_OFF)
        return mean + std * float(ndtri(tail + rng.random() * (1 - 2 * tail)))
    values = distribution.choice or ()
    return values[int(rng.integers(len(values)))]
