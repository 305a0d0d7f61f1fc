"""Global search for a loss landscape that is bad: adaptive importance sampling, and uncertainty from its samples.

Open-loop errors of bouncing bodies are rough in the parameters: gradients mislead and the best sample of many is luck,
averages over samples are neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Costs = Callable[[Array], Array]
"""Samples (K, P) -> costs of every episode (K, E); not finite where the model diverges."""

_WIDENING = 1.5
"""Each generation's proposal has this many times the covariance of the samples before it, so as not to miss tails."""
_LEAST_STD = 0.03
"""Least spread of a proposal, as a share of the prior's."""


@dataclass(frozen=True)
class Prior:
    """A normal prior in the fitted coordinates: mean (P,), std (P,), cut off at bounds (P, 2)."""

    mean: Array
    std: Array
    bounds: Array


@dataclass(frozen=True)
class SearchResult:
    """What the search saw.

    mean (P,), covariance (P, P): of the tempered posterior; lowest: the lowest mean cost over episodes; samples
    (N, P); costs (N, E); history: the lowest cost after every generation; effective_samples: of the N.
    """

    mean: Array
    covariance: Array
    lowest: float
    samples: Array
    costs: Array
    history: list[float]
    effective_samples: float


def importance_search(
    costs: Costs,
    prior: Prior,
    *,
    seed: int,
    population: int,
    generations: int,
    errors: float,
    floor: float,
    first: Array | None = None,
    on_generation: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """Sample the posterior under a tempered likelihood, exp(-errors / 2 * (cost / scale)^2) with scale the lowest cost.

    A model that misses something misses it in every frame alike: a hundred frames of a toss hold a few independent
    errors and not a hundred, and `errors` says how many (a generalised posterior; Bissiri, Holmes & Walker 2016). The
    sampler is population Monte Carlo (Cappe et al. 2004): every generation draws from a normal fitted to the weighted
    samples so far, and all samples are weighted against the mixture of all proposals. While fewer than a quarter of a
    generation would count, the likelihood is flattened further.

    Args:
        costs: See `Costs`; errors in one unit, >= 0.
        prior: The prior, also the first proposal.
        seed: Seed of the samples.
        population: Samples in a generation.
        generations: Number of generations.
        errors: Number of independent errors in the mean cost.
        floor: Cost that the measurement's noise alone makes; the scale is never below it.
        first: The first sample (P,); the prior's mean by default.
        on_generation: Called with the generation and the lowest cost so far.
    """
    rng = np.random.default_rng(seed)
    size = len(prior.mean)
    proposals = [(prior.mean.astype(float), np.diag(np.square(prior.std)))]
    samples, found = np.empty((0, size)), np.empty((0, 0))
    history: list[float] = []
    mean, covariance, effective = *proposals[0], 0.0
    for generation in range(generations):
        drawn = rng.multivariate_normal(*proposals[-1], population).clip(prior.bounds[:, 0], prior.bounds[:, 1])
        if generation == 0:
            drawn[0] = prior.mean if first is None else first
        new = costs(drawn)
        samples, found = np.concatenate([samples, drawn]), np.concatenate([found.reshape(-1, new.shape[1]), new])
        total = np.where(np.isfinite(found).all(1), found.mean(1), np.inf)
        history.append(float(total.min()))
        if on_generation:
            on_generation(generation, history[-1])
        if not np.isfinite(history[-1]):
            continue
        fit = -0.5 * (np.square(total) - history[-1] ** 2) / max(history[-1], floor) ** 2
        weight, effective = _weights(
            _log_ratio(samples, prior, proposals), fit, errors, max(population / 4, 2.0 * size)
        )
        mean = weight @ samples
        covariance = (samples - mean).T @ ((samples - mean) * weight[:, None])
        proposals.append((mean, _WIDENING * covariance + np.diag(np.square(_LEAST_STD * prior.std))))
    return SearchResult(mean, covariance, history[-1], samples, found, history, effective)


def _log_ratio(samples: Array, prior: Prior, proposals: list[tuple[Array, Array]]) -> Array:
    """Return log of the prior's density over the proposals' mixture (N,), up to a constant."""
    logs = []
    for mean, covariance in proposals:
        offset = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
        logs.append(-0.5 * np.square(offset).sum(0) - 0.5 * np.linalg.slogdet(covariance)[1])
    log_prior = -0.5 * np.square((samples - prior.mean) / prior.std).sum(1)
    return log_prior - np.logaddexp.reduce(np.array(logs), axis=0)


def _weights(log_ratio: Array, fit: Array, errors: float, least: float) -> tuple[Array, float]:
    """Return normalised weights (N,) and their effective number, with as much of `errors` as leaves `least`."""
    for _ in range(40):
        log_weight = log_ratio + errors * np.where(np.isfinite(fit), fit, -np.inf)
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        effective = float(1 / np.square(weight).sum())
        if effective >= min(least, len(weight) / 2):
            break
        errors *= 0.8
    return weight, effective


def episode_covariance(result: SearchResult, at: np.ndarray, minimum: int = 8) -> np.ndarray | None:
    """Return the covariance (P, P) of the minimiser from the scatter between episodes, or None for few episodes.

    A quadratic is fitted to every episode's cost over the samples nearest to `at`; with H the mean curvature and g
    the episodes' slopes there, the covariance is H^-1 cov(g) H^-1 / E (the sandwich of an M-estimator; Huber 1967,
    with derivatives over the width of the sample cloud, where the cost is smooth, not at a point, where it is rough).
    """
    episodes, size = result.costs.shape[1], len(at)
    terms = 1 + size + size * (size + 1) // 2
    finite = np.isfinite(result.costs).all(1)
    samples, costs = result.samples[finite], result.costs[finite]
    if episodes < minimum or len(samples) < 3 * terms:
        return None
    scale = samples.std(0) + 1e-12
    offset = (samples - at) / scale
    near = np.argsort(np.square(offset).sum(1), kind="stable")[: max(3 * terms, len(samples) // 3)]
    x = offset[near]
    upper = [(i, j) for i in range(size) for j in range(i, size)]
    basis = np.column_stack([np.ones(len(x)), x, *(x[:, i] * x[:, j] for i, j in upper)])
    solution = np.linalg.lstsq(basis, costs[near], rcond=None)[0]
    slopes = solution[1 : 1 + size]
    curvature = np.zeros((size, size))
    for (i, j), value in zip(upper, solution[1 + size :].mean(1), strict=True):
        curvature[i, j] += value
        curvature[j, i] += value
    eigenvalues, vectors = np.linalg.eigh(curvature)
    if eigenvalues[-1] <= 0:
        return None
    # a direction without curvature is one that the data do not see: give it the width of the search
    floor = np.maximum(eigenvalues, 1e-3 * eigenvalues[-1])
    inverse = vectors @ np.diag(1 / floor) @ vectors.T
    covariance = inverse @ np.atleast_2d(np.cov(slopes)) @ inverse / episodes
    return covariance * np.outer(scale, scale)
