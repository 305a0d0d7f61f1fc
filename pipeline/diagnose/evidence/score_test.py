"""Score tests for a missing effect, from one Jacobian of all states, model parameters and candidates at neutral.

For an effect e in addition to the model's parameters b, with information M and score g summed over segments (their
states projected out): M_e = M_ee - M_eb M_bb^-1 M_be, g_e = g_e - M_eb M_bb^-1 g_b, LM = g_e' M_e^-1 g_e. Where nothing
is missing, LM is distributed as chi2 with as many degrees of freedom as e has parameters (Rao 1948; Breusch & Pagan
1980). This holds in flight. In contact the law itself misses more than noise, and the evidence is compared with that of
data without an effect (see `contact`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import chi2_tail, normal_tail
from ...segments.linearization import Linearization, eliminate, sums, widths
from ..thresholds import THRESHOLDS

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoreTest:
    """Result of a score test of an effect."""

    statistic: float
    """LM in units of the dispersion; 0 where the estimate has the wrong sign."""
    dof: int
    """Degrees of freedom: number of measured directions."""
    p_value: float
    """Probability of a larger statistic without the effect; one-sided where the sign is known."""
    estimate: Array
    """Parameters (k,) after one step from neutral, in their units."""
    covariance: Array
    """Their covariance (k, k)."""
    admissible: bool
    """Whether the estimates have the signs that the effect admits."""


def score_test(
    linear: Linearization, columns: Sequence[int], nuisance: Sequence[int] | None = None, dispersion: float = 1.0
) -> ScoreTest:
    """Test an effect by its score, jointly with nuisance parameters.

    Args:
        linear: The linearization.
        columns: Columns of the effect's parameters.
        nuisance: Columns of the parameters that are fitted jointly; those of the model by default.
        dispersion: Factor by which variances exceed those of the noise.
    """
    joint = list(range(linear.base)) if nuisance is None else list(nuisance)
    information, score = sums(linear, [*joint, *columns])
    width = widths(linear, [*joint, *columns])
    count = len(width) - len(widths(linear, columns))
    size = len(width) - count
    reduced, slope = eliminate(information, score, count)
    estimate, covariance, statistic, rank = solved(reduced, slope, width[count:])
    statistic, covariance = statistic / dispersion, covariance * dispersion
    given = [linear.parameters[k] for k in columns]
    nonnegative = np.array([p.bounds[0] == 0.0 for p in given])
    shared = estimate[: len(given)] if size == len(given) else estimate
    if rank == 0:
        return ScoreTest(statistic=0.0, dof=0, p_value=1.0, estimate=estimate, covariance=covariance, admissible=True)
    if size == 1 and nonnegative[0]:
        z = float(np.sign(estimate[0]) * np.sqrt(statistic))
        return ScoreTest(
            statistic=statistic if z > 0 else 0.0,
            dof=1,
            p_value=normal_tail(z),
            estimate=estimate,
            covariance=covariance,
            admissible=z > 0,
        )
    fine = not (size == len(given) and bool((shared[nonnegative] < 0).any()))
    return ScoreTest(
        statistic=statistic,
        dof=rank,
        p_value=chi2_tail(statistic, rank),
        estimate=estimate,
        covariance=covariance,
        admissible=fine,
    )


def gain_by_episode(linear: Linearization, columns: Sequence[int], nuisance: Sequence[int] | None = None) -> Array:
    """Return the fall of each episode's linearized cost with an effect estimated from the other episodes.

    For episode t: (2 g_t' x - x' M_t x) with the effect's and the model's parameters x estimated from the other
    episodes, less the same with the model's parameters alone. Positive where the effect improves the prediction.
    """
    joint = list(range(linear.base)) if nuisance is None else list(nuisance)
    gains = []
    for episode in np.unique(linear.episode):
        others, own = linear.without_episode(episode), linear.only_episode(episode)
        parts = []
        for chosen in ([*joint, *columns], joint):
            if not chosen:
                parts.append(0.0)
                continue
            information, score = sums(others, chosen)
            x = solved(information, score, widths(linear, chosen))[0]
            mine, slope = sums(replace(own, prior=np.zeros_like(own.prior)), chosen)
            parts.append(float(2 * slope @ x - x @ mine @ x))
        gains.append(parts[0] - parts[1])
    return np.array(gains)


def canonical_correlation(linear: Linearization, a: Sequence[int], b: Sequence[int]) -> float:
    """Return how well an effect of parameters `b` can imitate one of parameters `a`, with the model's fitted jointly.

    This is the largest canonical correlation of their blocks of the information.
    """
    joint = list(range(linear.base))
    information, score = sums(linear, [*joint, *a, *b])
    reduced, _ = eliminate(information, score, len(joint))
    n = len(a)
    roots = [_inverse_root(block) for block in (reduced[:n, :n], reduced[n:, n:])]
    return float(np.clip(np.linalg.svd(roots[0].T @ reduced[:n, n:] @ roots[1], compute_uv=False).max(), 0.0, 1.0))


def solved(information: Array, score: Array, width: Array) -> tuple[Array, Array, float, int]:
    """Solve for the measured directions, and return estimate, covariance, statistic and rank.

    Args:
        information: Information (k, k).
        score: Score (k,).
        width: Widths (k,) of the priors, the units of the parameters.
    """
    values, vectors = np.linalg.eigh(information * np.outer(width, width))
    kept = values > THRESHOLDS.flight.measured
    vectors = vectors[:, kept] * width[:, None]
    along = vectors.T @ score
    estimate = vectors @ (along / values[kept])
    covariance = (vectors / values[kept]) @ vectors.T
    return estimate, covariance, float((along**2 / values[kept]).sum()), int(kept.sum())


def _inverse_root(matrix: Array) -> Array:
    """Return W with W W' the inverse of an information matrix, in its measured directions."""
    scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    kept = values > 1e-8 * max(values.max(initial=0.0), 1e-300)
    return (vectors[:, kept] / np.sqrt(values[kept])) / scale[:, None]
