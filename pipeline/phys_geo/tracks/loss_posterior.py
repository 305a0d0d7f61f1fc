"""Posterior of losses in joints and of a factor of mass, where data may leave sums of losses alone.

A push at one speed tells friction + damping * speed, not each of the two: along this line the logarithms, which are
fitted and have the priors, are no normal distribution, and the curvature at the best point would claim one of the two.
Forces are linear in the losses themselves, so that the likelihood is a normal density in these. With u the change of a
loss, in any unit, and of the logarithm of the factor, from the best point, information H and slope g of the data there,

    log p = -u' H u / 2 + g' u - sum ((z - m) / s)^2 / 2.

The priors are densities of the losses, not of their logarithms: equal weight of all logarithms would draw a loss that
data tell to within its size to nothing, while equal weight of all losses leaves it where they tell it to be. Draws of
the normal density, weighted by the priors, are a first sample, and an ensemble of walkers that begin there the final
one (stretch moves: Goodman and Weare, 2010). An interval reaches between the quantiles of the draws, in logarithms;
where the data tell all numbers it is that of the curvature.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...physics.parameters import Parameter

DRAWS, WALKERS, STEPS, STRETCH = 100_000, 400, 200, 2.0
"""Draws of the normal density, walkers of the ensemble, their steps, of which the second half counts, and the largest
stretch of a move."""
WEAK = 0.1
"""Information, as a root, that makes the normal density one where the data tell nothing, in units of the losses."""
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
    low, high = np.array([p.limits for p in parameters]).T
    linear = units > 0
    width = np.array([p.prior[1] for p in parameters])

    def height(z: NDArray[np.float64]) -> NDArray[np.float64]:
        u = np.where(linear, np.exp(z) / np.where(linear, units, 1.0), z) - best
        data = u @ slope - 0.5 * np.einsum("ki,ij,kj->k", u, information, u)
        inside = ((z >= low) & (z <= high)).all(1)
        prior = z.sum(1, where=linear) - 0.5 * np.square((z - middle) / width).sum(1)
        return np.where(inside, data + prior, -np.inf)

    rng, known = np.random.default_rng(0), np.where(linear, WEAK, 1 / width) ** 2
    precision = information + np.diag(known)
    off = rng.multivariate_normal(np.linalg.solve(precision, slope), np.linalg.inv(precision), DRAWS)
    u = best + off
    u = u[(u > 0).all(1, where=linear)]
    z = np.where(linear, np.log(np.where(linear, u * np.where(linear, units, 1.0), 1.0)), u)
    normal = (u - best) @ slope - 0.5 * np.einsum("ki,ij,kj->k", u - best, precision, u - best)
    weight = height(z) - normal - z.sum(1, where=linear)
    share = np.exp(weight - weight.max(initial=-np.inf)) if len(u) else np.zeros(0)
    if not share.sum() > 0:
        z, share = np.clip(middle + width * rng.standard_normal((WALKERS, len(best))), low, high), np.ones(WALKERS)
    draws = _drawn(height, z[rng.choice(len(z), WALKERS, p=share / share.sum())])
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
