"""Intervals of effects beside the scales of lengths that sessions have of their own."""

from types import SimpleNamespace

import numpy as np
import pytest
from cgwm.pipeline.segments.session_spread import Joint, _joined, beside

TRUE, ERROR, DRAWS = 0.01, 1e-3, 100


def estimated(scales: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Estimate and half of the interval of what does the same as another scale, from 8 episodes of the sessions."""
    sessions = np.arange(8) % len(scales)
    seen = TRUE + scales[sessions] + ERROR * rng.standard_normal(8)
    columns = np.column_stack((np.ones(8), np.eye(len(scales))[sessions]))
    joint = Joint(
        information=columns[:, :, None] * columns[:, None] / ERROR**2,
        score=columns * (seen - seen.mean())[:, None] / ERROR**2,
        count=1,
        prior=np.array([1.0]),
    )
    step, covariance, _ = beside(joint, 0.05)
    return float(seen.mean() + step[0]), 1.96 * float(np.sqrt(covariance[0, 0]))


@pytest.mark.parametrize(("spread", "sessions"), [(0.0, 2), (3e-3, 2), (7e-3, 2), (7e-3, 4)])
def test_intervals_hold_the_truth_whether_sessions_differ_or_not(spread: float, sessions: int) -> None:
    rng = np.random.default_rng(7)
    found = np.array([estimated(spread * rng.standard_normal(sessions), rng) for _ in range(DRAWS)])
    assert np.mean(np.abs(found[:, 0] - TRUE) <= found[:, 1]) >= 0.9
    # without the scales half of an interval is 8e-4; that of a mean over two sessions alone 12.7 of its standard errors
    assert np.median(found[:, 1]) < (4e-3 if not spread else 2e-2)


def test_a_session_counts_once_however_many_its_episodes() -> None:
    rows = np.array([0] * 7 + [1])
    columns = np.column_stack((np.ones(8), np.eye(2)[rows]))
    seen = np.where(rows == 0, 0.01, -0.01)
    mean = seen.mean()
    joint = Joint(
        information=columns[:, :, None] * columns[:, None] / 1e-8,
        score=columns * (seen - mean)[:, None] / 1e-8,
        count=1,
        prior=np.array([1e-3]),
    )
    step, _, spread = beside(joint, 0.05)
    assert mean + step[0] == pytest.approx(0.0, abs=1e-4) and step[1] - step[2] == pytest.approx(0.02, rel=1e-2)
    assert spread == pytest.approx((3e-3**2 / 2 + 0.02**2 / 2 / 2) ** 0.5, rel=0.02)


def test_each_session_has_a_scale_of_its_own_and_priors_count_by_their_variance() -> None:
    widths = (0.5, 2.0)
    parameters = [SimpleNamespace(prior=(0.0, width)) for width in widths]
    slopes = np.random.default_rng(3).normal(size=(3, 3))
    information, score = slopes[:, :, None] * slopes[:, None], slopes
    joint = _joined(information, score, np.array([4, 4, 9]), np.array([0, 0, 1]), parameters)  # pyright: ignore[reportArgumentType]
    assert np.allclose(joint.prior, [4.0, 0.25])
    assert np.allclose(joint.score, [[*slopes[:2].sum(0), 0.0], [*slopes[2, :2], 0.0, slopes[2, 2]]])
    assert np.allclose(joint.information[1, 3], [*information[2, 2, :2], 0.0, information[2, 2, 2]])
