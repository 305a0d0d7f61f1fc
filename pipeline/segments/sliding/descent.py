"""Joint descent of groups of sliding segments: parameters of each group and a start state of each segment.

All groups descend in one batch, each with its own damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...optimization.least_squares import Policy, descend
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ...physics.parameters import Parameter
from ...physics.state import State
from ...trajectories.residuals import retract
from ..segments import Segments
from .residuals import LoadErrors, chi2_by_segment, finite_differences

WEAK = 1e-9
"""Information added to each direction of a state, in difference steps: directions that nothing measured stay solvable.
"""
ITERATIONS, MAX_DAMPING, FALL, FALL_SHARE = 8, 1e5, 0.2, 2e-3
"""Maximum number of steps, damping at which a group stops, and absolute and relative fall of the cost that end a
descent."""
DAMPINGS = (0.1, 1.0, 10.0, 300.0)
"""Dampings tried in each step, in units of the one that was best before: at the end of a slide the linearization holds
for small steps only."""


@dataclass(frozen=True)
class SlidingFit:
    """Sliding segments fitted in groups (G)."""

    segments: Segments
    """The segments (B), with fitted states."""
    chi2: Tensor
    """Chi-square of each segment, shape (B,)."""
    values: Tensor
    """Fitted parameters of each group in fitted coordinates, shape (G, P)."""
    information: Tensor
    """Information on the free values with their priors, shape (G, S, S)."""

    @property
    def cost(self) -> float:
        """Chi2 of all segments together."""
        return float(self.chi2.sum())


def fit_groups(
    segments: Segments,
    parameters: Sequence[Parameter],
    values: Tensor,
    free: Tensor,
    group: Tensor,
    iterations: int = ITERATIONS,
    centre: Tensor | None = None,
) -> SlidingFit:
    """Fit the parameters of each group and the start states of its sliding segments.

    Args:
        segments: Sliding segments (B) with states to start from.
        parameters: Parameters of their world (P).
        values: Of each group (G, P), in fitted coordinates, to start from.
        free: Indices of the parameters that each group fits (G, S); -1 for none.
        group: Of each segment (B,).
        iterations: Maximum number of steps.
        centre: Centres of the priors (G, P); the start by default.
    """
    problem = _SlidingProblem(segments, parameters, values, free, group=group, centre=centre)
    policy = Policy(
        iterations=iterations,
        damping=1e-2,
        down=1.0,
        up=10 * DAMPINGS[-1],
        least_damping=0.0,
        most_damping=MAX_DAMPING,
        factors=DAMPINGS,
        absolute=FALL,
        relative=FALL_SHARE,
        linearise_end=False,
    )
    end = descend(problem, Point(values=problem.start, states=segments.observations.state.tensors), policy)
    return SlidingFit(
        segments.with_state(State(*end.point.states)),
        end.item_cost,
        problem.all_values(end.point.values, torch.arange(len(values))),
        end.information(),
    )


class _SlidingProblem(Problem):
    """What each group (G) fits to its sliding segments (B): S of the P parameters, and the segments' start states.

    Args:
        segments: The segments (B).
        parameters: Parameters of their world (P).
        values: Values of each group to start from, in fitted coordinates (G, P).
        free: Indices of the parameters that each group fits (G, S); -1 for none.
        group: Group of each segment (B,).
        centre: Centres of the priors (G, P); the start by default.
    """

    def __init__(
        self,
        segments: Segments,
        parameters: Sequence[Parameter],
        values: Tensor,
        free: Tensor,
        *,
        group: Tensor,
        centre: Tensor | None,
    ) -> None:
        self.segments, self.parameters, self.values, self.free, self.owner = segments, parameters, values, free, group
        self.loads = LoadErrors.of(segments)
        self.place = free.clamp_min(0)
        self.basis: Tensor | None = None  # directions (B, 12, K) of the states at the last linearisation
        self.start = values.gather(1, self.place)
        width = torch.tensor([p.prior[1] for p in parameters]).to(values)
        limits = torch.tensor([p.limits for p in parameters]).to(values)
        fitted = free >= 0
        self.box = Box(
            low=torch.where(fitted, limits[self.place, 0], self.start),
            high=torch.where(fitted, limits[self.place, 1], self.start),
            centre=self.start if centre is None else centre.gather(1, self.place),
            information=fitted / width[self.place] ** 2,
        )

    def all_values(self, free_values: Tensor, groups: Tensor) -> Tensor:
        """Return the values (g, P) of all parameters of groups (g,), with the free ones (g, S) as given."""
        return self.values[groups].scatter_add(1, self.place[groups], free_values - self.start[groups])

    def _at(self, point: Point, rows: Rows) -> tuple[Segments, Tensor]:
        """Return the segments (b) in their states, and their parameters (b, P)."""
        segments = self.segments.select(rows.items.tolist()).with_state(State(*point.states))
        return segments, self.all_values(point.values, rows.groups)[rows.owner]

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the chi2 (b,) of each segment."""
        segments, values = self._at(point, rows)
        return chi2_by_segment(segments, self.parameters, values, self.loads.select(rows.items))

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations by the free parameters and by changes of state along the ground."""
        segments, values = self._at(point, rows)
        free = self.free[rows.groups][rows.owner]
        found = finite_differences(segments, self.parameters, values, free, self.loads.select(rows.items))
        basis = found.basis if self.basis is None else self.basis
        self.basis = basis.index_copy(0, rows.items, found.basis)
        return NormalEquations.of_rows(found.rows, found.jacobian, free.shape[1], found.chi2, prior=WEAK)

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the states (b) moved by steps (b, K) along the ground."""
        del values
        assert self.basis is not None  # a step follows a linearisation
        change = (self.basis[rows.items] @ step[..., None])[..., 0]
        return retract(State(*point.states), change, self.segments.observations.free).tensors


def information_by_segment(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor
) -> tuple[Tensor, Tensor]:
    """Return information (B, P, P) and score (B, P) of each segment on parameters, its state free.

    Args:
        segments: The segments (B), with fitted states.
        parameters: Parameters of their world (P).
        values: Values at which they are linearised, of all segments (P,) or of each (B, P).
    """
    count, size = len(segments.items), len(parameters)
    free = torch.arange(size).expand(count, size)
    found = finite_differences(segments, parameters, values.expand(count, size), free)
    normal = NormalEquations.of_rows(found.rows, found.jacobian, size, found.chi2, prior=WEAK).eliminated()
    return normal.information, normal.score
