"""Robust fits of a linearization: segments that no candidate explains are downweighted.

The loss of a segment is rho of its excess chi2 - dof (see `segment_fit.robust_excess`), and its chi2 is quadratic in
the parameters. The minimum of the sum is found by iterative reweighting, so that a segment that only the candidate
explains regains its weight; weights from the misfit without the candidate would suppress the most informative segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..optimization.least_squares import Descent, Policy, descend
from ..optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ..segments.linearization import Linearization, layout, widths
from ..segments.segment_fit import robust_excess
from .falsification import Repetition, repetition
from .thresholds import THRESHOLDS

Array = NDArray[np.float64]

ITERATIONS = 12
"""Maximum number of reweighting iterations."""
STEPS = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step that are tried."""
FALL = 1e-6
"""Fall of the cost below which a fit ends."""


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Minimum of the robust loss over chosen parameters."""

    columns: tuple[int, ...]
    """Columns of the parameters in the linearization."""
    value: Array
    """Parameters (k,) in the order of `linearization.layout`."""
    cost: float
    """Robust loss plus the cost of the priors."""
    information: Array
    """Information (k, k) with the weights at the minimum."""
    weight: Array
    """Robust weight of each segment (B,) at the minimum."""
    chi2: Array
    """Chi2 of each segment (B,) at the minimum."""


def with_segment_parameters(linear: Linearization) -> Linearization:
    """Return the linearization with random deviations of the model's parameters in each segment.

    The deviations d of a segment, with prior information L, are projected out: its information M, score g and chi2
    become M - M_b (M_bb + L)^-1 M_b', g - M_b (M_bb + L)^-1 g_b and chi2 - g_b' (M_bb + L)^-1 g_b.
    """
    base = list(range(linear.base))
    if not base:
        return linear
    width = THRESHOLDS.segments.own_share * np.array([linear.parameters[k].prior[1] for k in base])
    chosen = torch.as_tensor(linear.information)
    normal = NormalEquations(
        states=chosen[:, base][:, :, base] + torch.diag(torch.as_tensor(1 / width**2)),
        mixed=chosen[:, base],
        information=chosen,
        state_slope=torch.as_tensor(linear.score[:, base]),
        slope=torch.as_tensor(linear.score),
        cost=torch.as_tensor(linear.chi2),
    )
    found = normal.eliminated()
    return replace(
        linear,
        information=found.information.numpy(),
        score=found.score.numpy(),
        chi2=linear.chi2 - (normal.state_slope * found.state_step).sum(1).numpy(),
    )


def robust_fit(linear: Linearization, columns: Sequence[int], start: Array | None = None) -> RobustFit:
    """Minimize the robust loss over chosen parameters; lower bounds at zero are kept.

    Args:
        linear: The linearization.
        columns: Columns of the parameters, including the model's.
        start: Values to start from, of all parameters (P,); zero by default.
    """
    problem = _RobustProblem(linear, columns, np.ones((1, len(linear.chi2))), start)
    end = _fitted(problem)
    left = problem.left(end.point.values)
    return RobustFit(
        columns=tuple(columns),
        value=end.point.values[0].numpy(),
        cost=float(end.cost[0]),
        information=end.information()[0].numpy(),
        weight=robust_excess(left)[1][0].numpy(),
        chi2=left[0].numpy() + linear.dof,
    )


def robust_repetition(
    linear: Linearization, base: Sequence[int], columns: Sequence[int], tried: int, start: Array | None = None
) -> Repetition:
    """Return whether an effect repeats from episode to episode beyond what the fit with it leaves.

    Args:
        linear: The linearization.
        base: Columns of the model's parameters, the first ones, which are fitted jointly.
        columns: Columns of the effect's parameters.
        tried: Number of effects that were tried; the p-value is corrected for it.
        start: Values to start from, of all parameters (P,); zero by default.
    """
    fit = robust_fit(linear, [*base, *columns], start)
    misfit = max(1.0, float(fit.weight @ fit.chi2) / float(fit.weight @ linear.dof))
    found = repetition(replace(linear, weight=fit.weight), columns, misfit)
    return replace(found, p_value=min(1.0, tried * found.p_value))


def losses_by_others(linear: Linearization, columns: Sequence[int], start: Array | None = None) -> Array:
    """Return each episode's robust loss with parameters estimated from the other episodes.

    Args:
        linear: The linearization.
        columns: Columns of the parameters, including the model's.
        start: Values to start from, of all parameters (P,); zero by default.
    """
    own = (linear.episode == np.unique(linear.episode)[:, None]).astype(np.float64)
    problem = _RobustProblem(linear, columns, 1 - own, start)
    loss, _ = problem.losses(_fitted(problem).point.values)
    return (loss.numpy() * own).sum(1)


def _fitted(problem: _RobustProblem) -> Descent:
    """Return the descent of a problem by Gauss-Newton steps without damping."""
    policy = Policy(iterations=ITERATIONS, damping=0.0, least_damping=0.0, shares=STEPS, attempts=1, absolute=FALL)
    return descend(problem, Point(values=problem.start), policy)


class _RobustProblem(Problem):
    """The robust loss of a linearization's segments (B) by chosen parameters (k), once for each of several weightings.

    Args:
        linear: The linearization.
        columns: Columns of the parameters.
        counts: Weight of each segment in each group, in addition to its robust weight, shape (G, B).
        start: Values to start from, of all parameters of the linearization (P,); zero by default.
    """

    def __init__(
        self, linear: Linearization, columns: Sequence[int], counts: Array, start: Array | None = None
    ) -> None:
        chosen = list(columns)
        places, _ = layout(linear, chosen)
        prior = 1 / widths(linear, chosen) ** 2
        low = np.full(len(prior), -np.inf)
        for k, column in enumerate(chosen):
            if column >= linear.base and linear.parameters[column].bounds[0] == 0.0:
                low[places[:, k]] = 0.0
        self.places, self.counts = torch.as_tensor(places), torch.as_tensor(counts)
        self.information = torch.as_tensor(linear.information[:, chosen][:, :, chosen])
        self.score = torch.as_tensor(linear.score[:, chosen])
        self.excess = torch.as_tensor(linear.chi2 - linear.dof)
        self.owner = torch.arange(len(counts))
        first = np.zeros(len(prior))
        if start is not None:
            first[places] = start[chosen]
        self.start = torch.as_tensor(first).expand(len(counts), -1).clone()
        parts = (
            torch.as_tensor(one).expand(len(counts), -1) for one in (low, np.full_like(low, np.inf), 0 * prior, prior)
        )
        self.box = Box(**dict(zip(("low", "high", "centre", "information"), parts, strict=True)))

    def left(self, values: Tensor) -> Tensor:
        """Return chi2 less the degrees of freedom (g, B) of each segment at parameters (g, n)."""
        own = values[:, self.places]
        moved = (self.information @ own[..., None])[..., 0]
        return self.excess - 2 * (self.score * own).sum(-1) + (moved * own).sum(-1)

    def losses(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return loss and robust weight (g, B) of each segment at parameters (g, n)."""
        return robust_excess(self.left(values))

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the weighted loss (g,) of all segments."""
        return (self.losses(point.values)[0] * self.counts[rows.groups]).sum(1)

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations with the weights at the point."""
        loss, weight = self.losses(point.values)
        heavy = weight * self.counts[rows.groups]
        count, size = point.values.shape
        place = (self.places[:, :, None] * size + self.places[:, None]).flatten()
        own = (heavy[..., None, None] * self.information).flatten(1)
        information = own.new_zeros(count, size * size).index_add(1, place, own).unflatten(1, (size, size))
        score = (heavy[..., None] * self.score).flatten(1)
        score = score.new_zeros(count, size).index_add(1, self.places.flatten(), score)
        slope = score - (information @ point.values[..., None])[..., 0]
        return NormalEquations.of_parameters(information, slope, (loss * self.counts[rows.groups]).sum(1))
