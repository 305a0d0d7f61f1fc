"""Adaptive importance sampling where the posterior is known: normal, and of episodes whose minimizers scatter."""

import numpy as np
import pytest
from cgwm.pipeline.optimization import importance_sampling
from cgwm.pipeline.optimization.importance_sampling import (
    NormalPrior,
    SearchResult,
    _log_ratio,
    _moments,
    _weights,
    episode_covariance,
    importance_search,
)
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

PRIOR = NormalPrior(np.array([0.5, -1.0]), np.array([1.0, 2.0]), np.array([[-4.0, 5.0], [-9.0, 7.0]]))
PLACE, STIFF = np.array([0.2, 0.4]), np.array([[3.0, 0.8], [0.8, 1.5]])
LEAST, ERRORS = 0.3, 4.0


def costs(samples: np.ndarray) -> np.ndarray:
    """Two episodes of one mean: the square is that of LEAST, and a quadratic form about PLACE."""
    away = samples - PLACE
    mean = np.sqrt(LEAST**2 + LEAST**2 * np.einsum("kp,pq,kq->k", away, STIFF, away))
    return np.stack([1.5 * mean, 0.5 * mean], 1)


def searched(first: np.ndarray | None = None, floor: float = 0.0) -> SearchResult:
    return importance_search(
        costs, PRIOR, seed=1, population=1500, generations=4, errors=ERRORS, floor=floor, first=first
    )


@pytest.mark.parametrize(("floor", "share"), [(0.0, 1.0), (2 * LEAST, 0.25)])
def test_the_posterior_is_that_of_a_normal_likelihood_and_prior(floor: float, share: float) -> None:
    """A scale twice the lowest cost leaves a quarter of the likelihood's weight."""
    weight = np.diag(PRIOR.std**-2.0)
    precise = weight + share * ERRORS * STIFF
    mean = np.linalg.solve(precise, weight @ PRIOR.mean + share * ERRORS * STIFF @ PLACE)
    found = searched(floor=floor)
    std = np.sqrt(np.diag(np.linalg.inv(precise)))
    assert np.abs((found.mean - mean) / std).max() < 0.1
    scaled = found.covariance / np.outer(std, std)
    np.testing.assert_allclose(scaled, np.linalg.inv(precise) / np.outer(std, std), atol=0.1)
    assert 1500 / 4 < found.effective_samples <= 6000
    assert found.samples.shape == (6000, 2) and found.costs.shape == (6000, 2)
    assert found.history == sorted(found.history, reverse=True) and len(found.history) == 4
    assert found.lowest == found.history[-1] == found.costs.mean(1).min() == pytest.approx(LEAST, rel=0.01)


def test_the_first_sample_is_the_given_one_and_none_leaves_the_bounds() -> None:
    assert searched().samples[0].tolist() == PRIOR.mean.tolist()
    found = searched(np.array([1.0, 1.0]))
    assert found.samples[0].tolist() == [1.0, 1.0]
    assert (found.samples >= PRIOR.bounds[:, 0]).all() and (found.samples <= PRIOR.bounds[:, 1]).all()


def test_a_generation_in_which_the_model_diverges_teaches_nothing() -> None:
    told: list[tuple[int, float]] = []

    def diverging(samples: np.ndarray) -> np.ndarray:
        found = costs(samples)
        found[:, 1] = np.inf if not told else found[:, 1]
        return found

    found = importance_search(
        diverging, PRIOR, seed=1, population=50, generations=2, errors=ERRORS, floor=0.0,
        on_generation=lambda number, lowest: told.append((number, lowest)),
    )  # fmt: skip
    assert [number for number, _ in told] == [0, 1] and told[0][1] == np.inf > told[1][1] == found.lowest
    assert found.samples[50:].std(0) == pytest.approx(PRIOR.std, rel=0.5)  # drawn from the prior again


def test_samples_are_weighed_against_the_mixture_of_all_proposals() -> None:
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(7, 2))
    proposals = [(PRIOR.mean, np.diag(PRIOR.std**2)), (np.array([0.1, 0.2]), np.array([[0.5, 0.2], [0.2, 0.3]]))]
    mixture = logsumexp([multivariate_normal(*one).logpdf(samples) for one in proposals], axis=0)
    wanted = multivariate_normal(*proposals[0]).logpdf(samples) - mixture
    found = _log_ratio(samples, PRIOR, proposals)
    np.testing.assert_allclose(found - found[0], wanted - wanted[0], atol=1e-12)


def test_the_likelihood_is_flattened_until_enough_samples_count() -> None:
    fit = np.array([0.0, -1.0, -3.0, -np.inf, np.nan])
    weight, effective = _weights(np.zeros(5), fit, 2.0, 1.0)
    np.testing.assert_allclose(weight, np.exp([0.0, -2.0, -6.0, -np.inf, -np.inf]) / (1 + np.exp(-2) + np.exp(-6)))
    assert effective == pytest.approx(1 / (weight**2).sum())
    flat, more = _weights(np.zeros(5), fit, 2.0, 2.4)
    assert more >= 2.4 > effective and flat.sum() == pytest.approx(1.0)
    steps = np.log(-np.log(flat[1] / flat[0]) / 2.0) / np.log(0.8)
    assert steps == pytest.approx(round(steps)) and steps >= 1  # by fifths
    half = _weights(np.zeros(4), np.array([0.0, -9.0, -9.0, -9.0]), 1.0, 100.0)[1]
    assert half >= 2.0  # never more than half of them


def test_moments_are_those_of_the_weights() -> None:
    samples, weight = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, -1.0]]), np.array([0.5, 0.25, 0.25])
    mean, covariance = _moments(samples, weight)
    np.testing.assert_allclose(mean, [1.5, 1.0])
    np.testing.assert_allclose(covariance, np.cov(samples.T, aweights=weight, ddof=0))


def scattered(episodes: int, stiff: np.ndarray, count: int = 90) -> tuple[SearchResult, np.ndarray]:
    """Return samples with the costs of episodes that are quadratic about minimizers of their own, and these."""
    rng = np.random.default_rng(3)
    samples, places = rng.normal(0, (1.0, 0.2), (count, 2)), rng.normal(0, (0.1, 0.03), (episodes, 2))
    away = samples[:, None] - places
    quadratic = 1.0 + 0.5 * np.einsum("kep,pq,keq->ke", away, stiff, away)
    quadratic[0] = np.nan  # the model diverged
    nothing = {"mean": places.mean(0), "covariance": np.eye(2), "lowest": 1.0, "history": [], "effective_samples": 1.0}
    return SearchResult(samples=samples, costs=quadratic, **nothing), places


def test_the_minimizers_covariance_is_that_of_the_mean_of_the_episodes_own() -> None:
    result, places = scattered(9, STIFF)
    found = episode_covariance(result, places.mean(0))
    np.testing.assert_allclose(found, np.cov(places.T) / 9, rtol=1e-6)


def test_a_direction_without_curvature_is_as_wide_as_the_search_allows() -> None:
    result, places = scattered(9, np.diag([4.0, 0.0]))
    result.costs[:, 0] += 0.3 * result.samples[:, 1]  # one episode pulls along it
    found = episode_covariance(result, places.mean(0))
    assert found is not None
    steep = 4.0 * np.nanstd(result.samples[1:, 0]) ** 2
    slope = 0.3 * np.nanstd(result.samples[1:, 1])
    scale = np.nanstd(result.samples[1:, 1])
    assert found[0, 0] == pytest.approx(np.cov(places.T)[0, 0] / 9, rel=1e-6)
    assert found[1, 1] == pytest.approx((slope * scale / (1e-3 * steep)) ** 2 / 9 / 9, rel=1e-6)


def test_few_episodes_few_samples_and_a_maximum_have_no_covariance() -> None:
    assert episode_covariance(*scattered(7, STIFF)[:1], np.zeros(2)) is None
    assert episode_covariance(scattered(8, STIFF, 18)[0], np.zeros(2)) is None  # 17 are finite; three times six needed
    assert episode_covariance(scattered(8, STIFF, 19)[0], np.zeros(2)) is not None
    assert episode_covariance(scattered(9, -STIFF)[0], np.zeros(2)) is None


def test_proposals_are_wider_than_the_samples_and_never_narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    plain = np.random.default_rng

    class Listening:
        def __init__(self, seed: int) -> None:
            self.rng = plain(seed)

        def multivariate_normal(self, mean: np.ndarray, covariance: np.ndarray, count: int) -> np.ndarray:
            drawn.append((mean, covariance))
            return self.rng.multivariate_normal(mean, covariance, count)

    monkeypatch.setattr(importance_sampling.np.random, "default_rng", Listening)
    found = importance_search(costs, PRIOR, seed=1, population=200, generations=2, errors=ERRORS, floor=0.0)
    monkeypatch.undo()
    (first, _), (_, second) = drawn
    assert first.tolist() == PRIOR.mean.tolist()
    fit = -0.5 * (np.square(found.costs[:200].mean(1)) - found.history[0] ** 2) / found.history[0] ** 2
    ratio = _log_ratio(found.samples[:200], PRIOR, [(PRIOR.mean, np.diag(PRIOR.std**2))])
    spread = _moments(found.samples[:200], _weights(ratio, fit, ERRORS, 50.0)[0])[1]
    np.testing.assert_allclose(second, 1.5 * spread + np.diag((0.03 * PRIOR.std) ** 2), rtol=1e-9)
