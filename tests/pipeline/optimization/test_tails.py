"""Tail probabilities against `scipy.stats`, and correlations at their limits."""

import numpy as np
import pytest
from cgwm.pipeline.optimization.importance_sampling import _moments
from cgwm.pipeline.optimization.tails import chi2_tail, f_tail, normal_tail, student_quantile, student_tail
from cgwm.pipeline.optimization.uncertainty import correlation_of, scaled_pinv
from scipy import stats


@pytest.mark.parametrize("x", [-1.0, 0.0, 0.3, 4.0, 300.0])
def test_probabilities(x: float) -> None:
    assert chi2_tail(x, 2.5) == pytest.approx(stats.chi2.sf(x, 2.5), rel=1e-12)
    assert f_tail(x, 3, 40.0) == pytest.approx(stats.f.sf(x, 3, 40.0), rel=1e-12)
    assert f_tail(x, 9, 2000.0) == pytest.approx(stats.f.sf(x, 9, 2000.0), rel=1e-10, abs=1e-290)
    assert normal_tail(x) == pytest.approx(stats.norm.sf(x), rel=1e-12)
    for dof in (1, 2.5, 300):
        assert student_tail(x, dof) == pytest.approx(stats.t.sf(x, dof), rel=1e-11)


@pytest.mark.parametrize("dof", [1, 2.5, 30, 4000])
def test_quantiles(dof: float) -> None:
    for probability in (1e-6, 0.05, 0.5, 0.975, 0.9999):
        assert student_quantile(probability, dof) == pytest.approx(stats.t.ppf(probability, dof), rel=1e-11, abs=1e-12)


def test_parameters_that_do_the_same_are_correlated_by_no_more_than_1() -> None:
    (_, (below, itself)) = correlation_of(["a", "b"], np.array([[4.0, 2.0000002], [2.0000002, 1.0]])).matrix
    assert (below, itself) == (1.0, 1.0)
    # nor one that rounding has left different on the two sides of the diagonal
    matrix = correlation_of(["a", "b"], np.array([[4.0, -2.0], [-1.96, 1.0]])).matrix
    assert matrix[0][1] == matrix[1][0] == pytest.approx(-0.99)


def test_moments_of_weighted_samples() -> None:
    rng = np.random.default_rng(0)
    samples, weight = rng.normal(3.0, 1.0, (40, 3)), rng.uniform(0, 1, 40)
    weight /= weight.sum()
    mean, covariance = _moments(samples, weight)
    assert mean == pytest.approx(np.average(samples, axis=0, weights=weight))
    assert covariance == pytest.approx(np.cov(samples.T, aweights=weight, ddof=0))


def test_an_inverse_does_not_depend_on_the_units_of_the_parameters() -> None:
    matrix, units = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.0]]), np.diag([1e-12, 1.0, 1e9])
    expected = np.zeros((3, 3))
    expected[:2, :2] = np.linalg.inv(units[:2, :2] @ matrix[:2, :2] @ units[:2, :2])
    np.testing.assert_allclose(scaled_pinv(units @ matrix @ units), expected, rtol=1e-12)  # what nothing tells stays 0
