"""The mixed model against closed forms of balanced groups."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cgwm.pipeline.segments.mixed_model import GroupLayout, GroupPosterior, posterior
from cgwm.pipeline.trajectories.correlated_noise import WindowErrors


def _found(truth: np.ndarray, precision: float, width: float, known: float | None = None) -> GroupPosterior:
    """One value for each of n groups, of one item each that measures it with the given precision."""
    n = len(truth)
    layout = GroupLayout(
        parameters=[SimpleNamespace(name="k", shared="episode")],  # type: ignore[list-item]
        groups=[[str(i) for i in range(n)]],
        place=np.arange(n)[:, None],
        owner=np.zeros(n, dtype=np.int64),
        centre=np.zeros(n),
        width=np.full(n, width),
    )
    parts = np.zeros((n, n, n))
    parts[np.arange(n), np.arange(n), np.arange(n)] = precision
    scores = np.zeros((n, n))
    scores[np.arange(n), np.arange(n)] = precision * truth  # linearised at 0
    solution = SimpleNamespace(
        by_item=torch.tensor(parts), scores=torch.tensor(scores), shared=torch.zeros(n, dtype=torch.float64)
    )
    # the chi2 at 0 leaves exactly one a degree of freedom at the fitted values, so that no variance is inflated
    count = 1e6
    errors = WindowErrors(
        chi2=count + precision * truth**2,
        count=np.full(n, count),
        kind=np.zeros(n, dtype=np.int64),
        inflation=np.ones(2),
    )
    return posterior(solution, errors, layout, None if known is None else np.full(n, known))  # type: ignore[arg-type]


def test_groups_are_shrunk_towards_their_mean_by_the_ratio_of_variances() -> None:
    """Balanced groups: values shrink to the mean by tau^2 / (tau^2 + s^2), and tau^2 + s^2 is their variance."""
    rng = np.random.default_rng(3)
    measured = 2.0 + 0.5 * rng.standard_normal(30)
    found = _found(measured, precision=1 / 0.2**2, width=10.0)
    between = measured.var(ddof=1) - 0.2**2
    assert found.mean[0] == pytest.approx(measured.mean(), rel=1e-3)
    assert found.tau[0] ** 2 == pytest.approx(between, rel=0.05)
    share = found.tau[0] ** 2 / (found.tau[0] ** 2 + 0.2**2)
    expected = measured.mean() + share * (measured - measured.mean())
    np.testing.assert_allclose(found.values, expected, rtol=1e-3)


def test_one_group_alone_keeps_the_widest_prior() -> None:
    found = _found(np.array([3.0]), precision=1.0, width=2.0)
    assert found.tau.tolist() == [2.0] and found.mean.tolist() == [0.0]
    assert found.values[0] == pytest.approx(3.0 * 4 / (4 + 1), rel=1e-4)


def test_a_known_spread_is_not_estimated_again() -> None:
    found = _found(np.array([1.0, 3.0]), precision=4.0, width=9.0, known=0.5)
    assert found.tau.tolist() == [0.5, 0.5]
    np.testing.assert_allclose(found.values, [0.5, 1.5], rtol=1e-3)
