"""Posterior of losses in joints and of a factor of mass, where data may leave sums of losses alone.

A push at one speed tells friction + damping * speed, not each of the two: along this line the logarithms, which are
fitted and have the priors, are no normal distribution, and the curvature at the best point would claim one of the two.
Forces are linear in the losses themselves, so that the likelihood is a normal density in these. With u the change of a
loss, in any unit, and of the logarithm of the factor, from the best point, information H and slope g of the data there,

    log p = -u' H u / 2 + g' u - sum ((z - m) / s)^2 / 2,

which is drawn by an ensemble of walkers (stretch moves: Goodman and Weare, 2010). An interval reaches between the
quantiles of the draws, in logarithms; where the data tell all numbers it is that of the curvature.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...physics.parameters import Parameter

WALKERS, STEPS, STRETCH = 400, 400, 2.0
"""Walkers of the ensemble, their steps, of which the second half counts, and the largest stretch of a move."""
END = 1.96
"""End of an interval, in standard errors."""


def posterior(
    best: NDArray[np.float64],
    units: NDArray[np.float64],
    information: NDArray[Any],
    slope: NDArray[Any],
    parameters: Sequence[Parameter],
) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Return the middle (P,) of the interval of each parameter, and the covariance (P, P), in fitted coordinates.

    Args:
        best: The best point: losses in their units, and logarithms of factors, shape (P,).
        units: Units of the losses; 0 for factors, shape (P,).
        information: Of the data on these coordinates there, shape (P, P).
        slope: Of the logarithm of the data's likelihood there, shape (P,).
        parameters: Losses and factors of mass, with their priors.
    """
    middle = np.array([p.encode(p.prior[0]) for p in parameters])
    width = np.array([p.prior[1] for p in parameters])
    low, high = np.array([p.limits for p in parameters]).T
    linear = units > 0

    def height(z: NDArray[np.float64]) -> NDArray[np.float64]:
        u = np.where(linear, np.exp(z) / np.where(linear, units, 1.0), z) - best
        data = u @ slope - 0.5 * np.einsum("ki,ij,kj->k", u, information, u)
        inside = ((z >= low) & (z <= high)).all(1)
        return np.where(inside, data - 0.5 * np.square((z - middle) / width).sum(1), -np.inf)

    rng = np.random.default_rng(0)
    wide = np.linalg.inv(information + np.diag(np.where(linear, 1e-2, width**-2)))
    u = rng.multivariate_normal(best, wide, WALKERS)
    z = np.where(linear, np.log(np.maximum(u, 1e-9) * np.where(linear, units, 1.0)), u)
    draws = _drawn(height, np.clip(z, low, high))
    bounds = np.quantile(draws, [0.025, 0.975], axis=0)
    std = (bounds[1] - bounds[0]) / (2 * END)
    return bounds.mean(0), np.corrcoef(draws.T).reshape(len(std), -1) * np.outer(std, std)


def _drawn(height: Any, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return draws (N, P) of a density, whose logarithm `height` returns for points (K, P)."""
    rng, half, size = np.random.default_rng(1), len(places) // 2, places.shape[1]
    heights, kept = height(places), []
    for step in range(STEPS):
        for mine, other in ((slice(None, half), slice(half, None)), (slice(half, None), slice(None, half))):
            stretch = ((STRETCH - 1) * rng.random(half) + 1) ** 2 / STRETCH
            partner = places[other][rng.integers(half, size=half)]
            moved = partner + stretch[:, None] * (places[mine] - partner)
            higher = height(moved)
            ratio = (size - 1) * np.log(stretch) + higher - heights[mine]
            taken = np.log(rng.random(half)) < ratio
            places[mine] = np.where(taken[:, None], moved, places[mine])
            heights[mine] = np.where(taken, higher, heights[mine])
        if step >= STEPS // 2:
            kept.append(places.copy())
    return np.concatenate(kept)
