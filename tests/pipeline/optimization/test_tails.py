"""Tail probabilities against `scipy.stats`."""

import pytest
from cgwm.pipeline.optimization.uncertainty import chi2_tail, f_tail, normal_tail, student_quantile
from scipy import stats


@pytest.mark.parametrize("x", [-1.0, 0.0, 0.3, 4.0, 300.0])
def test_probabilities(x: float) -> None:
    assert chi2_tail(x, 2.5) == pytest.approx(stats.chi2.sf(x, 2.5), rel=1e-12)
    assert f_tail(x, 3, 40.0) == pytest.approx(stats.f.sf(x, 3, 40.0), rel=1e-12)
    assert normal_tail(x) == pytest.approx(stats.norm.sf(x), rel=1e-12)


@pytest.mark.parametrize("dof", [1, 2.5, 30])
def test_quantiles(dof: float) -> None:
    for probability in (0.05, 0.5, 0.975):
        assert student_quantile(probability, dof) == pytest.approx(stats.t.ppf(probability, dof), rel=1e-12, abs=1e-12)
