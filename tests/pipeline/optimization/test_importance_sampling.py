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


def far(samples: np.ndarray) -> np.ndarray:
    """Errors of eight slides by the logarithm of a friction, 5.5 standard deviations from its prior, and two others."""
    wrong = np.abs(np.exp(samples[:, 0] - 1.0) - np.exp(-3.75)) + 1e-3 * np.abs(samples[:, 1:]).sum(1)
    return np.tile((1e-3 + wrong)[:, None], (1, 8))


def test_a_search_near_its_start_draws_from_there() -> None:
    prior = NormalPrior(np.zeros(3), np.full(3, 0.5), np.tile([-6.0, 6.0], (3, 1)))
    words = {"seed": 1, "population": 96, "generations": 3, "errors": 24.0, "floor": 6e-4}
    start = np.array([-2.4, 0.0, 0.0])
    wide, near = (importance_search(far, prior, **words, first=start, near=one) for one in (False, True))
    assert abs(near.mean[0] + 2.75) < 0.1 < abs(wide.mean[0] + 2.75)
    assert near.samples[:96].mean(0) == pytest.approx(start, abs=0.1)


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
    weight, effective, resolved = _weights(np.zeros(5), fit, 2.0, 1.0)
    np.testing.assert_allclose(weight, np.exp([0.0, -2.0, -6.0, -np.inf, -np.inf]) / (1 + np.exp(-2) + np.exp(-6)))
    assert effective == pytest.approx(1 / (weight**2).sum()) and resolved == 2.0
    flat, more, errors = _weights(np.zeros(5), fit, 2.0, 2.4)
    assert more >= 2.4 > effective and flat.sum() == pytest.approx(1.0)
    assert -np.log(flat[1] / flat[0]) == pytest.approx(errors)
    steps = np.log(errors / 2.0) / np.log(0.8)
    assert steps == pytest.approx(round(steps)) and steps >= 1  # by fifths
    half = _weights(np.zeros(4), np.array([0.0, -9.0, -9.0, -9.0]), 1.0, 100.0)[1]
    assert half >= 2.0  # never more than half of them


def test_moments_are_those_of_the_weights() -> None:
    samples, weight = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, -1.0]]), np.array([0.5, 0.25, 0.25])
    mean, covariance = _moments(samples, weight)
    np.testing.assert_allclose(mean, [1.5, 1.0])
    np.testing.assert_allclose(covariance, np.cov(samples.T, aweights=weight, ddof=0))


def scattered(stiff: np.ndarray, episodes: int = 30, spread: float = 0.5) -> tuple[SearchResult, np.ndarray]:
    """Return a search among episodes whose costs are quadratic about minimizers of their own, and these."""
    places = PLACE + spread * np.random.default_rng(3).normal(size=(episodes, 2))

    def own(samples: np.ndarray) -> np.ndarray:
        away = samples[:, None] - places
        found = 1.0 + 0.05 * np.einsum("kep,pq,keq->ke", away, stiff, away)
        found[7, 0] = np.nan  # the model diverged
        return found

    found = importance_search(own, PRIOR, seed=1, population=500, generations=5, errors=3.0 * episodes, floor=0.0)
    return found, places


def test_the_means_covariance_is_that_of_the_episodes_minimizers_where_these_tell_it() -> None:
    result, places = scattered(100 * STIFF)
    found = episode_covariance(result)
    assert found is not None
    np.testing.assert_allclose(result.mean, places.mean(0), atol=0.02)
    wanted = np.cov(places.T) / len(places)
    std = np.sqrt(wanted.diagonal())
    scatter = found - result.covariance
    np.testing.assert_allclose(scatter / np.outer(std, std), wanted / np.outer(std, std), atol=0.15)


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_what_the_costs_do_not_show_is_as_unknown_as_before(slope: float) -> None:
    """One episode's slope of a twentieth of its cost along it makes it no worse known, nor the other number."""
    result, places = scattered(np.diag([300.0, 0.0]))
    result.costs[:, 5] += slope * result.samples[:, 1]
    found = episode_covariance(result)
    assert found is not None
    scatter = found - result.covariance
    assert scatter[0, 0] == pytest.approx(np.var(places[:, 0], ddof=1) / len(places), rel=0.2)
    assert 0.85 < found[1, 1] / PRIOR.std[1] ** 2 < 1.15


def test_the_covariance_is_that_of_the_errors_of_repeated_searches_with_a_truth_from_the_prior() -> None:
    """Half known: the mean lies between what the episodes say and the prior's mean."""
    rng, errors, claimed = np.random.default_rng(0), [], []
    prior = NormalPrior(np.zeros(1), np.ones(1), np.array([[-9.0, 9.0]]))
    for seed in range(100):
        truth = rng.normal()
        places = truth + 3.0 * rng.normal(size=12)
        result = importance_search(
            lambda samples, places=places: 3.0 + 0.012 * np.square(samples - places),
            prior, seed=seed, population=200, generations=1, errors=36.0, floor=0.0,
        )  # fmt: skip
        found = episode_covariance(result)
        assert found is not None
        errors.append(result.mean[0] - truth)
        claimed.append(found[0, 0])
    assert 0.4 < np.mean(np.square(errors)) < 0.9
    assert 0.95 < np.mean(claimed) / np.mean(np.square(errors)) < 1.5


def test_few_episodes_have_no_covariance() -> None:
    result, _ = scattered(STIFF, 8)
    assert episode_covariance(result) is not None
    assert episode_covariance(result, minimum=9) is None


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
