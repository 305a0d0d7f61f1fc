"""Robust fits of a linearization: segments that no candidate explains are downweighted.

The loss of a segment is rho of its excess chi2 - dof (see `segment_fit.robust_excess`), and its chi2 is quadratic in
the parameters. The minimum of the sum is found by iterative reweighting, so that a segment that only the candidate
explains regains its weight; weights from the misfit without the candidate would suppress the most informative segments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.least_squares import Descent, Policy, descend
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ...segments.linearization import Linearization, layout, widths
from ...segments.segment_fit import robust_excess
from ..thresholds import THRESHOLDS
from .falsification import Repetition, repetition

Array = NDArray[np.float64]

ITERATIONS = 12
"""Maximum number of reweighting iterations."""
STEPS = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step that are tried."""
FALL = 1e-6
"""Fall of the cost below which a fit ends."""
MOST_NUMBERS = 2_000_000
"""Maximum number of elements of the information matrices in one batch of fits."""


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
    return robust_fits(linear, [columns], start)[0]


def robust_fits(linear: Linearization, choices: Sequence[Sequence[int]], start: Array | None = None) -> list[RobustFit]:
    """Return the fit of each of several choices of parameters, as `robust_fit` does; those alike in one batch."""
    found: dict[int, RobustFit] = {}
    for some in _alike(linear, choices, 1):
        columns = [choices[k] for k in some]
        problem = _RobustProblem(linear, columns, np.ones((len(some), len(linear.chi2))), np.arange(len(some)), start)
        end = _fitted(problem)
        left, information = problem.left(end.point.values, torch.arange(len(some))), end.information().numpy()
        weight = robust_excess(left)[1].numpy()
        for place, k in enumerate(some):
            found[k] = RobustFit(
                columns=tuple(choices[k]),
                value=end.point.values[place].numpy(),
                cost=float(end.cost[place]),
                information=information[place],
                weight=weight[place],
                chi2=left[place].numpy() + linear.dof,
            )
    return [found[k] for k in range(len(choices))]


def _alike(linear: Linearization, choices: Sequence[Sequence[int]], times: int) -> Iterator[list[int]]:
    """Yield the places of choices of parameters that are laid out alike, as many as one batch takes.

    Args:
        linear: The linearization.
        choices: Columns of the parameters of each choice.
        times: Number of fits of each.
    """
    kinds: dict[tuple[int, bytes], list[int]] = {}
    for k, columns in enumerate(choices):
        places, prior = layout(linear, columns)
        kinds.setdefault((len(prior), places.tobytes()), []).append(k)
    for some in kinds.values():
        numbers = times * len(linear.chi2) * len(choices[some[0]]) ** 2
        size = max(1, MOST_NUMBERS // max(numbers, 1))
        yield from (some[k : k + size] for k in range(0, len(some), size))


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


def losses_by_others(
    linear: Linearization, choices: Sequence[Sequence[int]], start: Array | None = None
) -> list[Array]:
    """Return each episode's robust loss (E,) with parameters estimated from the other episodes, for several choices.

    Args:
        linear: The linearization.
        choices: Columns of the parameters of each choice, including the model's.
        start: Values to start from, of all parameters (P,); zero by default.
    """
    own = (linear.episode == np.unique(linear.episode)[:, None]).astype(np.float64)
    found: dict[int, Array] = {}
    for some in _alike(linear, choices, len(own)):
        chosen, count = np.arange(len(some)).repeat(len(own)), len(some) * len(own)
        problem = _RobustProblem(linear, [choices[k] for k in some], np.tile(1 - own, (len(some), 1)), chosen, start)
        loss, _ = problem.losses(_fitted(problem).point.values, torch.arange(count))
        lost = loss.numpy().reshape(len(some), *own.shape)
        found |= {k: (one * own).sum(1) for k, one in zip(some, lost, strict=True)}
    return [found[k] for k in range(len(choices))]


def _fitted(problem: _RobustProblem) -> Descent:
    """Return the descent of a problem by Gauss-Newton steps without damping."""
    policy = Policy(iterations=ITERATIONS, damping=0.0, least_damping=0.0, shares=STEPS, attempts=1, absolute=FALL)
    return descend(problem, Point(values=problem.start), policy)


class _RobustProblem(Problem):
    """The robust loss of a linearization's segments (B) by chosen parameters (k), once for each of several weightings.

    Args:
        linear: The linearization.
        choices: Columns of the parameters of each choice of them, all laid out alike.
        counts: Weight of each segment in each group, in addition to its robust weight, shape (G, B).
        chosen: Place of the choice of each group, shape (G,).
        start: Values to start from, of all parameters of the linearization (P,); zero by default.
    """

    def __init__(
        self,
        linear: Linearization,
        choices: Sequence[Sequence[int]],
        counts: Array,
        chosen: NDArray[np.int64],
        start: Array | None = None,
    ) -> None:
        columns = np.array([list(one) for one in choices])
        places, _ = layout(linear, choices[0])
        self.places, self.counts, self.chosen = map(torch.as_tensor, (places, counts, chosen))
        every = np.moveaxis(linear.information[:, columns[:, :, None], columns[:, None]], 1, 0)
        self.information = torch.as_tensor(np.ascontiguousarray(every))
        self.score = torch.as_tensor(np.ascontiguousarray(np.moveaxis(linear.score[:, columns], 1, 0)))
        self.excess = torch.as_tensor(linear.chi2 - linear.dof)
        self.owner = torch.arange(len(counts))
        prior = np.stack([1 / widths(linear, one) ** 2 for one in choices])
        low, first = np.full(prior.shape, -np.inf), np.zeros(prior.shape)
        for row, one in enumerate(choices):
            for k, column in enumerate(one):
                if column >= linear.base and linear.parameters[column].bounds[0] == 0.0:
                    low[row, places[:, k]] = 0.0
            if start is not None:
                first[row, places] = start[list(one)]
        self.start = torch.as_tensor(first[chosen])
        low, high, centre, known = (
            torch.as_tensor(one[chosen]) for one in (low, np.full_like(low, np.inf), 0 * prior, prior)
        )
        self.box = Box(low=low, high=high, centre=centre, information=known)

    def left(self, values: Tensor, groups: Tensor) -> Tensor:
        """Return chi2 less the degrees of freedom (g, B) of each segment at parameters (g, n) of groups (g,)."""
        own, chosen = values[:, self.places], self.chosen[groups]
        moved = (self.information[chosen] @ own[..., None])[..., 0]
        return self.excess - 2 * (self.score[chosen] * own).sum(-1) + (moved * own).sum(-1)

    def losses(self, values: Tensor, groups: Tensor) -> tuple[Tensor, Tensor]:
        """Return loss and robust weight (g, B) of each segment at parameters (g, n) of groups (g,)."""
        return robust_excess(self.left(values, groups))

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the weighted loss (g,) of all segments."""
        return (self.losses(point.values, rows.groups)[0] * self.counts[rows.groups]).sum(1)

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations with the weights at the point."""
        chosen = self.chosen[rows.groups]
        loss, weight = self.losses(point.values, rows.groups)
        heavy = weight * self.counts[rows.groups]
        count, size = point.values.shape
        place = (self.places[:, :, None] * size + self.places[:, None]).flatten()
        own = (heavy[..., None, None] * self.information[chosen]).flatten(1)
        information = own.new_zeros(count, size * size).index_add(1, place, own).unflatten(1, (size, size))
        score = (heavy[..., None] * self.score[chosen]).flatten(1)
        score = score.new_zeros(count, size).index_add(1, self.places.flatten(), score)
        slope = score - (information @ point.values[..., None])[..., 0]
        return NormalEquations.of_parameters(information, slope, (loss * self.counts[rows.groups]).sum(1))
