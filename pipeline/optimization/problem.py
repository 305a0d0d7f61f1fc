"""What the least-squares solver descends: a batch of groups with parameters, and of items with states.

A batch has groups (G), each with parameters (P) of its own, and items (B), each with a state (S) and one group.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from .normal_equations import NormalEquations


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


class Problem(ABC):
    """Groups of items whose costs a descent lowers; see the module."""

    box: Box
    """Bounds and priors of the parameters."""
    owner: Tensor
    """Group of each item, shape (B,)."""
    units: Tensor | None = None
    """Unit of each coordinate of a state's step for the policy's limits, shape (S,)."""
    derivatives_with_costs: bool = False
    """Whether derivatives are computed at every trial, because they cost little more than the cost alone."""

    @abstractmethod
    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
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
