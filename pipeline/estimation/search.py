"""Global search for a loss landscape that is bad: the cross-entropy method, and intervals from its samples.

Open-loop errors of bouncing bodies are rough in the parameters: gradients mislead, sampled averages do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Costs = Callable[[np.ndarray], np.ndarray]
"""Samples (K, P) -> costs of every episode (K, E); not finite where the model diverges."""


@dataclass(frozen=True)
class SearchResult:
    """What the search saw: best (P,); cost: its mean over episodes; samples (N, P); costs (N, E); history."""

    best: np.ndarray
    cost: float
    samples: np.ndarray
    costs: np.ndarray
    history: list[float]


def cross_entropy(
    costs: Costs,
    bounds: np.ndarray,
    start: np.ndarray,
    spread: np.ndarray,
    *,
    seed: int,
    population: int = 24,
    generations: int = 8,
    on_generation: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """Minimise the mean cost over episodes by the cross-entropy method (Rubinstein 1999), elites a quarter.

    The first generation draws from the whole box as well as around the start: several starts for a landscape with
    several valleys.

    Args:
        costs: See `Costs`.
        bounds: Box (P, 2).
        start: Centre of the first Gaussian (P,); itself a sample.
        spread: Its standard deviations (P,).
        seed: Seed of the samples.
        population: Samples in a generation.
        generations: Number of generations.
        on_generation: Called with the generation and the best cost so far.
    """
    rng = np.random.default_rng(seed)
    mean, std = start.astype(float), spread.astype(float)
    all_samples, all_costs, history = [], [], []
    best, best_cost = start, np.inf
    for generation in range(generations):
        samples = mean + std * rng.standard_normal((population, len(start)))
        if generation == 0:
            samples[population // 2 :] = rng.uniform(bounds[:, 0], bounds[:, 1], samples[population // 2 :].shape)
        samples[0] = mean if generation else start
        samples = samples.clip(bounds[:, 0], bounds[:, 1])
        found = costs(samples)
        total = np.where(np.isfinite(found).all(1), found.mean(1), np.inf)
        order = np.argsort(total, kind="stable")[: max(3, population // 4)]
        order = order[np.isfinite(total[order])]
        if len(order) and total[order[0]] < best_cost:
            best, best_cost = samples[order[0]], float(total[order[0]])
        if len(order) >= 2:
            mean = samples[order].mean(0)
            std = 0.7 * samples[order].std(0) + 0.3 * std * 0.7
        all_samples.append(samples)
        all_costs.append(found)
        history.append(best_cost)
        if on_generation:
            on_generation(generation, best_cost)
    return SearchResult(best, best_cost, np.concatenate(all_samples), np.concatenate(all_costs), history)


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
