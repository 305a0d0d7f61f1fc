"""What the least-squares solver descends: a batch of groups with parameters, and of items with states.

A batch has groups (G), each with parameters (P) of its own, and items (B), each with a state (S) and one group. The
state of an item is coupled to the item's residuals and to the parameters of its group only, so that the normal
equations have arrow structure, and the Schur complement eliminates the states (Triggs et al., "Bundle adjustment - a
modern synthesis", 2000, section 6).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol, Self

import torch
from torch import Tensor

FLOOR = 1e-12
"""Minimum diagonal element that damping multiplies, so that directions without information are damped too."""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Some groups (g) of a batch and their items (b), maybe several times."""

    groups: Tensor
    """Index of each group, shape (g,)."""
    items: Tensor
    """Index of each item, shape (b,)."""
    owner: Tensor
    """Place in `groups` of the group of each item, shape (b,)."""

    @staticmethod
    def of(owner: Tensor, count: int) -> Rows:
        """Return all groups, `count` in number, and all items, whose groups are `owner` (B,)."""
        groups = torch.arange(count, device=owner.device)
        return Rows(groups=groups, items=torch.arange(len(owner), device=owner.device), owner=owner)

    def where(self, chosen: Tensor) -> Rows:
        """Return the rows of the groups that a mask (g,) chooses."""
        if bool(chosen.all()):
            return self
        kept = chosen[self.owner]
        place = chosen.cumsum(0) - 1
        return Rows(groups=self.groups[chosen], items=self.items[kept], owner=place[self.owner[kept]])

    def repeated(self, times: int) -> Rows:
        """Return the rows several times, as separate groups."""
        if times == 1:
            return self
        shift = torch.arange(times, device=self.owner.device).repeat_interleave(len(self.items))
        return Rows(
            groups=self.groups.repeat(times),
            items=self.items.repeat(times),
            owner=self.owner.repeat(times) + shift * len(self.groups),
        )


@dataclass(frozen=True, kw_only=True)
class Point:
    """Parameters of groups and states of their items."""

    values: Tensor
    """Parameters, shape (G, P)."""
    states: tuple[Tensor, ...] = ()
    """State of each item in the problem's own form, each of shape (B, ...)."""

    def at(self, groups: Tensor, items: Tensor) -> Point:
        """Return the point of some groups (g,) and items (b,)."""
        return Point(values=self.values[groups], states=tuple(state[items] for state in self.states))

    def put(self, rows: Rows, other: Point) -> Point:
        """Return the point with the rows replaced by those of another one."""
        pairs = zip(self.states, other.states, strict=True)
        return Point(
            values=self.values.index_copy(0, rows.groups, other.values),
            states=tuple(old.index_copy(0, rows.items, new) for old, new in pairs),
        )


@dataclass(frozen=True, kw_only=True)
class Box:
    """Bounds and normal priors of the parameters of each group."""

    low: Tensor
    """Lower bounds, shape (G, P); a parameter whose bounds are equal is not fitted."""
    high: Tensor
    """Upper bounds, shape (G, P)."""
    centre: Tensor
    """Centres of the priors, shape (G, P)."""
    information: Tensor
    """Information of the priors, shape (G, P)."""

    @staticmethod
    def unbounded(like: Tensor) -> Box:
        """Return a box without bounds and priors for parameters (G, P)."""
        zero, far = torch.zeros_like(like), torch.full_like(like, torch.inf)
        return Box(low=-far, high=far, centre=zero, information=zero)

    @staticmethod
    def within(bounds: Tensor, centre: Tensor | None = None, information: Tensor | None = None) -> Box:
        """Return the box of one group with bounds (P, 2) and a prior's centre and information (P,)."""
        zero = torch.zeros_like(bounds[:, 0])
        parts = (bounds[:, 0], bounds[:, 1], *(zero if one is None else one for one in (centre, information)))
        low, high, middle, known = (part[None] for part in parts)
        return Box(low=low, high=high, centre=middle, information=known)

    def at(self, groups: Tensor) -> Box:
        """Return the box of some groups (g,)."""
        return Box(**{one.name: getattr(self, one.name)[groups] for one in fields(self)})

    def cost(self, values: Tensor) -> Tensor:
        """Return the cost (G,) of the priors at values (G, P)."""
        return (self.information * (values - self.centre).square()).sum(-1)

    def clamped(self, values: Tensor) -> Tensor:
        """Return values (G, P) moved to the nearest point within the bounds."""
        return torch.minimum(torch.maximum(values, self.low), self.high)

    def moving(self, values: Tensor, downhill: Tensor) -> Tensor:
        """Return the mask (G, P) of the parameters that no bound stops.

        A bound stops a parameter on it where the cost falls beyond it.

        Args:
            values: The parameters, shape (G, P).
            downhill: The negative gradient of the cost, shape (G, P).
        """
        stopped = ((values <= self.low) & (downhill < 0)) | ((values >= self.high) & (downhill > 0))
        return ~stopped & (self.low < self.high)


class Reduced(Protocol):
    """Normal equations of items with their states eliminated, as far as the solver needs to know them."""

    @property
    def information(self) -> Tensor:
        """Information on the parameters, shape (B, P, P)."""
        ...

    @property
    def score(self) -> Tensor:
        """Negative gradient by the parameters, shape (B, P)."""
        ...

    def following(self, change: Tensor, share: float = 1.0) -> Tensor:
        """Return the step (B, S) of the states for changes (B, P) of the parameters, a share of the whole step."""
        ...


class Equations(Protocol):
    """Normal equations of half the cost of items (B), as far as the solver needs to know them.

    `NormalEquations` are dense. A problem whose states are sparsely coupled has a form of its own.
    """

    @property
    def cost(self) -> Tensor:
        """Cost of each item, shape (B,)."""
        ...

    def at(self, items: Tensor) -> Self:
        """Return the equations of some items (b,)."""
        ...

    def put(self, items: Tensor, other: Self) -> Self:
        """Return the equations with those of some items (b,) replaced."""
        ...

    def finite(self) -> Tensor:
        """Return whether the gradient of each item is finite, shape (B,)."""
        ...

    def eliminated(self, damping: Tensor | None = None, unit: Tensor | None = None) -> Reduced:
        """Eliminate the states, damped by (B,) times a unit of each coordinate (S,)."""
        ...


@dataclass(frozen=True, kw_only=True)
class Eliminated:
    """Normal equations of items with their states eliminated."""

    information: Tensor
    """Information C - M' A^-1 M on the parameters, shape (B, P, P)."""
    score: Tensor
    """Negative gradient g - M' A^-1 g_s by the parameters, shape (B, P)."""
    state_step: Tensor
    """Step A^-1 g_s of the states without a change of the parameters, shape (B, S)."""
    by_parameter: Tensor
    """Response of the states: with parameters that move by d they move by state_step - by_parameter d; (B, S, P)."""

    def following(self, change: Tensor, share: float = 1.0) -> Tensor:
        """Return the step (B, S) of the states for changes (B, P) of the parameters, a share of the whole step."""
        return share * self.state_step - (self.by_parameter @ change[..., None])[..., 0]


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Normal equations of half the cost of items (B), without the priors of the parameters."""

    states: Tensor
    """Information A on the states, shape (B, S, S)."""
    mixed: Tensor
    """Information M by states and parameters, shape (B, S, P)."""
    information: Tensor
    """Information C on the parameters, shape (B, P, P)."""
    state_slope: Tensor
    """Negative gradient g_s by the states, shape (B, S)."""
    slope: Tensor
    """Negative gradient g by the parameters, shape (B, P)."""
    cost: Tensor
    """Cost of each item, shape (B,)."""

    @staticmethod
    def of_parameters(information: Tensor, slope: Tensor, cost: Tensor) -> NormalEquations:
        """Return the equations of items without states; shapes (B, P, P), (B, P), (B,)."""
        batch, count = slope.shape
        return NormalEquations(
            states=slope.new_zeros(batch, 0, 0),
            mixed=slope.new_zeros(batch, 0, count),
            information=information,
            state_slope=slope.new_zeros(batch, 0),
            slope=slope,
            cost=cost,
        )

    @staticmethod
    def of_rows(
        rows: Tensor,
        jacobian: Tensor,
        count: int,
        cost: Tensor,
        weight: Tensor | None = None,
        prior: float | Tensor = 0.0,
    ) -> NormalEquations:
        """Return the equations of residuals.

        Args:
            rows: Residuals, shape (B, R).
            jacobian: Their derivatives by parameters, then by states, shape (B, R, P + S).
            count: P.
            cost: Cost of each item, shape (B,).
            weight: Weight of each residual, shape (B, R); 1 by default.
            prior: Information added on the states' diagonal, a number or of shape (S,) or (B, S).
        """
        heavy = jacobian if weight is None else jacobian * weight[..., None]
        normal = heavy.mT @ jacobian
        slope = -(heavy.mT @ rows[..., None])[..., 0]
        size = jacobian.shape[-1] - count
        weak = torch.as_tensor(prior).to(rows).expand(len(rows), size)
        return NormalEquations(
            states=normal[:, count:, count:] + torch.diag_embed(weak),
            mixed=normal[:, count:, :count],
            information=normal[:, :count, :count],
            state_slope=slope[:, count:],
            slope=slope[:, :count],
            cost=cost,
        )

    @staticmethod
    def joined(parts: Sequence[NormalEquations]) -> NormalEquations:
        """Return the equations of the items of several parts."""
        names = [one.name for one in fields(NormalEquations)]
        return NormalEquations(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})

    def at(self, items: Tensor) -> NormalEquations:
        """Return the equations of some items (b,)."""
        return NormalEquations(**{one.name: getattr(self, one.name)[items] for one in fields(self)})

    def put(self, items: Tensor, other: NormalEquations) -> NormalEquations:
        """Return the equations with those of some items (b,) replaced."""
        pairs = {one.name: (getattr(self, one.name), getattr(other, one.name)) for one in fields(self)}
        return NormalEquations(**{name: old.index_copy(0, items, new) for name, (old, new) in pairs.items()})

    def weighted(self, weight: Tensor) -> NormalEquations:
        """Return the equations of items with weights (B,); the costs are unchanged."""
        one = weight[:, None]
        return NormalEquations(
            states=one[..., None] * self.states,
            mixed=one[..., None] * self.mixed,
            information=one[..., None] * self.information,
            state_slope=one * self.state_slope,
            slope=one * self.slope,
            cost=self.cost,
        )

    def eliminated(self, damping: Tensor | None = None, unit: Tensor | None = None) -> Eliminated:
        """Eliminate the states by the Schur complement.

        Args:
            damping: Damping of the states of each item, shape (B,); none by default.
            unit: What it multiplies, see `damped`.
        """
        if not self.states.shape[-1]:
            return Eliminated(
                information=self.information, score=self.slope, state_step=self.state_slope, by_parameter=self.mixed
            )
        states = self.states
        if damping is not None:
            states = damped(states, damping, unit)
        found = solved(states, torch.cat((self.mixed, self.state_slope[..., None]), -1))
        by_parameter, state_step = found[..., :-1], found[..., -1]
        return Eliminated(
            information=self.information - self.mixed.mT @ by_parameter,
            score=self.slope - (self.mixed.mT @ state_step[..., None])[..., 0],
            state_step=state_step,
            by_parameter=by_parameter,
        )

    def finite(self) -> Tensor:
        """Return whether the gradient of each item is finite, shape (B,)."""
        return self.state_slope.isfinite().all(-1) & self.slope.isfinite().all(-1)


def damped(matrix: Tensor, damping: Tensor, unit: Tensor | None = None, floor: float = FLOOR) -> Tensor:
    """Return matrices (B, N, N) with dampings (B,) added to their diagonals.

    Args:
        matrix: The matrices.
        damping: The dampings.
        unit: What they multiply, shape (N,) (Levenberg, 1944); by default the diagonal itself (Marquardt, 1963).
        floor: Minimum of the diagonal then.
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(floor) if unit is None else unit
    return matrix + torch.diag_embed(damping[:, None] * diagonal)


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve linear systems (B, N, N) for right sides (B, N, k); not finite where a matrix is singular.

    An exception would end the descents of all other items of the batch.
    """
    return torch.linalg.solve_ex(matrix, right)[0]


class Problem(ABC):
    """Groups of items whose costs a descent lowers; see the module."""

    box: Box
    """Bounds and priors of the parameters."""
    owner: Tensor
    """Group of each item, shape (B,)."""
    units: Tensor | None = None
    """Unit of each coordinate of a state's step for the policy's limits, shape (S,)."""
    damping_unit: Tensor | None = None
    """What the damping of states multiplies, shape (S,); by default the diagonal of their information."""
    least_information: float = FLOOR
    """Minimum information of a parameter that its damping multiplies."""
    derivatives_with_costs: bool = False
    """Whether derivatives are computed at every trial, because they cost little more than the cost alone."""

    @abstractmethod
    def linearised(self, point: Point, rows: Rows) -> Equations:
        """Return the normal equations of items (b) at a point of rows."""

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the cost (b,) of each item at a point of rows; infinite or NaN where it has none."""
        return self.linearised(point, rows).cost

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the states after a step: by default, states that add up.

        Args:
            point: Where the rows are.
            values: Where the parameters move, shape (g, P).
            step: Step of the states, shape (b, S).
            rows: The rows.
        """
        return tuple(state + step for state in point.states)
