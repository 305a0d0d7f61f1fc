"""Global search by adaptive importance sampling, and uncertainty from its samples, for rough loss landscapes.

Open-loop errors of bouncing bodies are rough in the parameters: gradients are misleading and the best of many samples
is random, but averages over samples are reliable.

A model error affects every frame alike: a hundred frames of a toss contain a few independent errors, not a hundred.
The likelihood is tempered accordingly (a generalized posterior; Bissiri, Holmes & Walker 2016).
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
"""Factor by which a proposal's covariance exceeds that of the weighted samples, so that tails are covered."""
_RESAMPLED = 400
"""Samples of the episodes from which the scatter of the mean is computed, known to 4 %."""
_LEAST_STD = 0.03
"""Minimum standard deviation of a proposal, as a share of the prior's."""


@dataclass(frozen=True)
class NormalPrior:
    """Normal prior in the fitted coordinates, truncated at bounds."""

    mean: Array
    """Mean (P,)."""
    std: Array
    """Standard deviation (P,)."""
    bounds: Array
    """Lower and upper bounds (P, 2)."""


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """Result of the search."""

    mean: Array
    """Mean (P,) of the tempered posterior."""
    covariance: Array
    """Covariance (P, P) of the tempered posterior."""
    lowest: float
    """Lowest mean cost over episodes."""
    samples: Array
    """All samples (N, P)."""
    costs: Array
    """Their costs (N, E) by episode."""
    log_ratio: Array
    """Logarithm (N,) of the prior's density over that of all proposals, up to a constant."""
    sharpness: float
    """Factor of the square of the mean cost in the negative logarithm of the likelihood, as flat as it became."""
    history: list[float]
    """Lowest mean cost after each generation."""
    effective_samples: float
    """Effective number of the N samples."""


def importance_search(
    costs: Costs,
    prior: NormalPrior,
    *,
    seed: int,
    population: int,
    generations: int,
    errors: float,
    floor: float,
    first: Array | None = None,
    near: bool = False,
    on_generation: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """Sample the posterior under a tempered likelihood, exp(-errors / 2 * (cost / scale)^2) with scale the lowest cost.

    The sampler is population Monte Carlo (Cappe et al. 2004): every generation draws from a normal fitted to the
    weighted samples so far, and all samples are weighted against the mixture of all proposals. While the effective
    number of samples is below a quarter of a generation, the likelihood is flattened further.

    Args:
        costs: See `Costs`; errors in one unit, >= 0.
        prior: The prior, also the first proposal.
        seed: Seed of the samples.
        population: Samples in a generation.
        generations: Number of generations.
        errors: Number of independent errors in the mean cost.
        floor: Cost of the measurement noise alone, the minimum of the scale.
        first: The first sample (P,); the prior's mean by default.
        near: Draw the first generation about `first`, half as wide as the prior, in place of from the prior.
        on_generation: Called with the generation and the lowest cost so far.
    """
    rng, size = np.random.default_rng(seed), len(prior.mean)
    proposals = [(prior.mean.astype(float), np.diag(np.square(prior.std)))]
    if near and first is not None:
        proposals = [(first.astype(float), np.diag(np.square(prior.std / 2)))]
    samples, found = np.empty((0, size)), np.empty((0, 0))
    history: list[float] = []
    mean, covariance, effective = *proposals[0], 0.0
    log_ratio, sharpness = np.zeros(0), 0.0
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
        log_ratio = _log_ratio(samples, prior, proposals)
        if not np.isfinite(history[-1]):
            continue
        scale, least = max(history[-1], floor), max(population / 4, 2.0 * size)
        fit = -0.5 * (np.square(total) - history[-1] ** 2) / scale**2
        weight, effective, resolved = _weights(log_ratio, fit, errors, least)
        sharpness = 0.5 * resolved / scale**2
        mean, covariance = _moments(samples, weight)
        proposals.append((mean, _WIDENING * covariance + np.diag(np.square(_LEAST_STD * prior.std))))
    return SearchResult(
        mean=mean,
        covariance=covariance,
        lowest=history[-1],
        samples=samples,
        costs=found,
        log_ratio=log_ratio,
        sharpness=sharpness,
        history=history,
        effective_samples=effective,
    )


def _moments(samples: Array, weight: Array) -> tuple[Array, Array]:
    """Return the mean (P,) and the covariance (P, P) of weighted samples (N, P)."""
    mean = weight @ samples
    return mean, (samples - mean).T @ ((samples - mean) * weight[:, None])


def _log_ratio(samples: Array, prior: NormalPrior, proposals: list[tuple[Array, Array]]) -> Array:
    """Return the log ratio (N,) of the prior's density to that of the mixture of proposals, up to a constant."""
    logs = []
    for mean, covariance in proposals:
        offset = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
        logs.append(-0.5 * np.square(offset).sum(0) - 0.5 * np.linalg.slogdet(covariance)[1])
    log_prior = -0.5 * np.square((samples - prior.mean) / prior.std).sum(1)
    return log_prior - np.logaddexp.reduce(np.array(logs), axis=0)


def _weights(log_ratio: Array, fit: Array, errors: float, least: float) -> tuple[Array, float, float]:
    """Return normalized weights (N,), their effective number, and `errors`, reduced until this reaches `least`."""
    for _ in range(40):
        log_weight = log_ratio + errors * np.where(np.isfinite(fit), fit, -np.inf)
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        effective = float(1 / np.square(weight).sum())
        if effective >= min(least, len(weight) / 2):
            break
        errors *= 0.8
    return weight, effective, errors


def episode_covariance(result: SearchResult, minimum: int = 8) -> Array | None:
    """Return the covariance (P, P) of the bagged posterior (Huggins & Miller 2019, "Robust inference with BayesBag").

    Episodes are drawn anew with replacement, and the samples are weighed by their costs (the bootstrap; Efron 1979): so
    far would other episodes have moved the mean, also where the model is wrong. To this scatter the posterior's own
    covariance is added, which is the prior's where the data say nothing.

    Args:
        result: Result of the search.
        minimum: Minimum number of episodes.

    Returns:
        The covariance; None for too few episodes.
    """
    count = result.costs.shape[1]
    if count < minimum:
        return None
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), _RESAMPLED) / count
    finite = np.isfinite(result.costs).all(1)
    logs = result.log_ratio[finite, None] - result.sharpness * np.square(result.costs[finite] @ drawn.T)
    weight = np.exp(logs - logs.max(0))
    means = (weight / weight.sum(0)).T @ result.samples[finite]
    scatter = np.atleast_2d(np.cov(means.T)) * count / (count - 1)
    return scatter + result.covariance
