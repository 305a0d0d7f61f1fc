"""The least-squares solver: damped Gauss-Newton (Levenberg-Marquardt) of many independent problems in one batch.

A batch has groups (G), each with parameters (P) of its own, and items (B), each with a state (S) and one group. The
state of an item is coupled to the item's residuals and to the parameters of its group only, so that the normal
equations have arrow structure, and the Schur complement eliminates the states (Triggs et al., "Bundle adjustment - a
modern synthesis", 2000, section 6). Every group has its own damping (Marquardt 1963) and its own reason for stopping. A
problem gives costs, normal equations and moved states; what differs between fits beyond that is a `Policy`.

Geodesic acceleration and a dogleg were measured against this loop and do not pay (`benchmarks/solver.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import pairwise

import torch
from torch import Tensor

from .problem import Box, Equations, Point, Problem, Reduced, Rows, damped, solved


class Stop(IntEnum):
    """Why the descent of a group ended."""

    RUNNING = 0
    """It has not ended."""
    CONVERGED = 1
    """A step lowered the cost by less than the tolerance."""
    SMALL_STEP = 2
    """An accepted step was shorter than the policy's smallest one."""
    NO_LOWER_COST = 3
    """No step lowers the cost, with any damping that the policy admits."""
    ITERATIONS = 4
    """The policy's number of steps was reached."""
    NOT_FINITE = 5
    """Cost or derivatives are not finite."""
    WATCHER = 6
    """The caller ended it."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """How a descent chooses and ends its steps."""

    iterations: int
    """Maximum number of steps, accepted and rejected."""
    steps: int | None = None
    """Maximum number of accepted steps; None for any number."""
    attempts: int | None = None
    """Number of rejected steps in a row that ends a descent; None for any number."""
    damping: float = 1e-3
    """Damping of the first step, relative to the diagonal of the normal equations; 0 for plain Gauss-Newton."""
    down: float = 1 / 5
    """Factor of the damping after an accepted step."""
    up: float = 6.0
    """Factor of the damping after a rejected step."""
    least_damping: float = 1e-8
    """Minimum damping."""
    most_damping: float = 1e8
    """Damping above which a descent ends."""
    damp_states: bool = True
    """Whether the states are damped too, or follow the parameters to their own minimum."""
    factors: tuple[float, ...] = (1.0,)
    """Dampings tried in each step as multiples of the current one, all in one batch; the best is taken."""
    shares: tuple[float, ...] = (1.0,)
    """Parts of a step that are tried, all in one batch; the best is taken."""
    absolute: float = 0.0
    """Fall of the cost below which a descent has converged."""
    relative: float = 0.0
    """The same as a share of the cost; the larger of the two counts."""
    step_limit: float = math.inf
    """Maximum change of a state in one step, in the problem's units."""
    longest: float = math.inf
    """Maximum change of a parameter in one step."""
    small_step: float = 0.0
    """Change of a state in an accepted step below which a descent ends, in the problem's units."""
    linearise_end: bool = True
    """Whether the normal equations of the result are those at its end, or those of the last step."""


@dataclass(frozen=True, kw_only=True)
class Descent:
    """State of a descent, and at its end the result."""

    problem: Problem
    """What descends."""
    point: Point
    """Best point."""
    normal: Equations
    """Normal equations at the point, or where its last step began (see `Policy.linearise_end`)."""
    item_cost: Tensor
    """Cost of each item at the point, shape (B,)."""
    cost: Tensor
    """Cost of each group with its priors, shape (G,)."""
    damping: Tensor
    """Damping of each group, shape (G,)."""
    stop: Tensor
    """Reason for stopping of each group, a `Stop`, shape (G,)."""
    rejected: Tensor
    """Rejected steps in a row of each group, shape (G,)."""
    accepted: Tensor
    """Accepted steps of each group, shape (G,)."""
    evaluations: Tensor
    """Number of points of each group whose cost was computed, shape (G,)."""
    linearisations: Tensor
    """Number of points of each group at which normal equations were used, shape (G,)."""
    history: tuple[Tensor, ...]
    """Cost of each group at the start and after each iteration, each of shape (G,)."""

    def with_groups(self, groups: Tensor, **values: Tensor) -> Descent:
        """Return the descent with fields of some groups (g,) replaced by values (g,)."""
        return replace(self, **{name: getattr(self, name).index_copy(0, groups, one) for name, one in values.items()})

    def ended(self, reason: Stop) -> Tensor:
        """Return the reasons for stopping (G,) with a given one for the groups that are still running."""
        return torch.where(self.stop == Stop.RUNNING, int(reason), self.stop)

    @property
    def reasons(self) -> list[Stop]:
        """Reason for stopping of each group."""
        return [Stop(code) for code in self.stop.tolist()]

    @property
    def converged(self) -> bool:
        """Whether every group was ended by its tolerance, a small step or the lack of a lower cost."""
        return not {Stop.ITERATIONS, Stop.NOT_FINITE, Stop.WATCHER} & set(self.reasons)

    @property
    def costs(self) -> list[float]:
        """Cost of the only group at the start and after each accepted step."""
        costs = [float(cost) for cost in self.history]
        return costs[:1] + [after for before, after in pairwise(costs) if after < before]

    def information(self) -> Tensor:
        """Return the information (G, P, P) on the parameters, states eliminated, with their priors."""
        own = by_group(self.normal.eliminated().information, self.problem.owner, len(self.cost))
        return own + torch.diag_embed(self.problem.box.information)


def descend(
    problem: Problem, start: Point, policy: Policy, watch: Callable[[int, Descent], bool | None] | None = None
) -> Descent:
    """Lower the cost of every group of a problem until each has a reason to stop.

    Args:
        problem: The problem.
        start: Where the descent begins.
        policy: How steps are chosen and ended.
        watch: Called after each iteration with its number; every group stops where it returns True.
    """
    every = Rows.of(problem.owner, len(start.values))
    descent = _started(problem, start, every, policy)
    for iteration in range(policy.iterations):
        running = descent.stop == Stop.RUNNING
        if not bool(running.any()):
            break
        rows = every.where(running)
        descent = _iterated(descent, policy, rows, last=iteration + 1 == policy.iterations)
        descent = replace(descent, history=(*descent.history, descent.cost))
        if watch is not None and watch(iteration, descent):
            descent = replace(descent, stop=descent.ended(Stop.WATCHER))
    stop = torch.where(descent.cost.isfinite(), descent.ended(Stop.ITERATIONS), int(Stop.NOT_FINITE))
    return replace(descent, stop=stop)


def by_group(values: Tensor, owner: Tensor, count: int) -> Tensor:
    """Return the sums of values of items (B, ...) by their group (B,), shape (count, ...)."""
    return values.new_zeros(count, *values.shape[1:]).index_add(0, owner, values)


def _started(problem: Problem, start: Point, rows: Rows, policy: Policy) -> Descent:
    """Return the descent before its first step; `rows` are all rows."""
    count = len(start.values)
    normal = problem.linearised(start, rows)
    cost = by_group(normal.cost, problem.owner, count) + problem.box.cost(start.values)
    none = torch.zeros(count, dtype=torch.long, device=cost.device)
    return Descent(
        problem=problem,
        point=start,
        normal=normal,
        item_cost=normal.cost,
        cost=cost,
        damping=torch.full_like(cost, policy.damping),
        stop=torch.where(_finite(normal, rows), none, int(Stop.NOT_FINITE)),
        rejected=none,
        accepted=none,
        evaluations=none + 1,
        linearisations=none + 1,
        history=(cost,),
    )


@dataclass(frozen=True, kw_only=True)
class _Trials:
    """Points that one iteration tries: K for each of g groups."""

    point: Point
    """The points, K times the groups and items."""
    rows: Rows
    """Their rows."""
    damping: Tensor
    """Damping of each, shape (K, g)."""
    size: Tensor
    """Largest change of a state in any of them, in the problem's units, shape (g,)."""


def _trials(descent: Descent, policy: Policy, rows: Rows) -> _Trials:
    """Return the points that an iteration tries."""
    problem, here = descent.problem, descent.point.at(rows.groups, rows.items)
    normal, box = descent.normal.at(rows.items), descent.problem.box.at(rows.groups)
    points, dampings, sizes = [], [], [torch.zeros_like(descent.cost[rows.groups])]
    for factor in policy.factors:
        damping = factor * descent.damping[rows.groups]
        reduced = normal.eliminated(damping[rows.owner] if policy.damp_states else None, problem.damping_unit)
        step = _step(problem, reduced, here.values, box, damping, rows)
        if policy.longest < math.inf:
            step = step * (policy.longest / step.abs().amax(1, keepdim=True)).clamp_max(1.0)
        for share in policy.shares:
            values = box.clamped(here.values + share * step)
            change = _finite_steps(reduced.following((values - here.values)[rows.owner], share))
            change, size = _limited(change, problem, policy, rows)
            points.append(Point(values=values, states=problem.moved(here, values, change, rows)))
            dampings.append(damping)
            sizes.append(size)
    joined = Point(
        values=torch.cat([point.values for point in points]),
        states=tuple(torch.cat(parts) for parts in zip(*(point.states for point in points), strict=True)),
    )
    size = torch.stack(sizes).amax(0)
    return _Trials(point=joined, rows=rows.repeated(len(points)), damping=torch.stack(dampings), size=size)


def _step(problem: Problem, reduced: Reduced, values: Tensor, box: Box, damping: Tensor, rows: Rows) -> Tensor:
    """Return the damped step (g, P) of the parameters (g, P); those that a bound stops do not move."""
    count = len(values)
    if not values.shape[1]:
        return values
    matrix = by_group(reduced.information, rows.owner, count) + torch.diag_embed(box.information)
    slope = by_group(reduced.score, rows.owner, count) + box.information * (box.centre - values)
    moving = box.moving(values, slope).to(values)
    system = damped(matrix, damping, floor=problem.least_information) * moving[:, :, None] * moving[
        :, None
    ] + torch.diag_embed(1 - moving)
    return _finite_steps(solved(system, (slope * moving)[..., None])[..., 0])


def _finite_steps(step: Tensor) -> Tensor:
    """Return steps (n, S), those that are not finite as none: of equations that no damping makes regular."""
    return torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)


def _limited(change: Tensor, problem: Problem, policy: Policy, rows: Rows) -> tuple[Tensor, Tensor]:
    """Return state changes (b, S) within the policy's limit, and the largest one (g,) of each group in units."""
    largest = change.new_zeros(len(rows.groups))
    if problem.units is None:
        return change, torch.full_like(largest, torch.inf)
    largest = largest.scatter_reduce(0, rows.owner, (change.abs() / problem.units).amax(-1), "amax")
    share = (policy.step_limit / largest).clamp_max(1.0)
    return change * share[rows.owner][:, None], largest * share


def _iterated(descent: Descent, policy: Policy, rows: Rows, last: bool) -> Descent:
    """Return the descent after one step of the running groups, whose rows are given; `last` if none follows."""
    problem, groups = descent.problem, rows.groups
    trials = _trials(descent, policy, rows)
    seen = problem.linearised(trials.point, trials.rows) if problem.derivatives_with_costs else None
    by_item = problem.costs(trials.point, trials.rows) if seen is None else seen.cost
    cost = by_group(by_item, trials.rows.owner, len(trials.rows.groups))
    cost = cost + problem.box.at(trials.rows.groups).cost(trials.point.values)
    found, choice = torch.nan_to_num(cost.unflatten(0, (-1, len(groups))), nan=torch.inf).min(0)
    better = found < descent.cost[groups]
    descent = _judged(descent, policy, rows, trials, (found, choice, better))
    if not bool(better.any()):
        return descent
    won, kept = rows.where(better), better[rows.owner]
    items = (choice[rows.owner] * len(rows.items) + torch.arange(len(rows.items), device=choice.device))[kept]
    places = (choice * len(groups) + torch.arange(len(groups), device=choice.device))[better]
    point = descent.point.put(won, trials.point.at(places, items))
    descent = replace(descent, point=point, item_cost=descent.item_cost.index_copy(0, won.items, by_item[items]))
    if seen is not None:
        return _linearised(descent, won, seen.at(items))
    if not policy.linearise_end:
        won = won.where((descent.stop[won.groups] == Stop.RUNNING) & (not last))
    if not len(won.groups):
        return descent
    return _linearised(descent, won, problem.linearised(point.at(won.groups, won.items), won))


def _judged(
    descent: Descent, policy: Policy, rows: Rows, trials: _Trials, best: tuple[Tensor, Tensor, Tensor]
) -> Descent:
    """Return the descent with costs, dampings, counts and reasons to stop after trials of some groups.

    Args:
        descent: Before the trials.
        policy: Its policy.
        rows: Rows of the groups.
        trials: The trials.
        best: Lowest cost of each group, its trial, and whether it is lower than before, each of shape (g,).
    """
    groups, (found, choice, better) = rows.groups, best
    before, accepted = descent.cost[groups], descent.accepted[groups] + better
    rejected = torch.where(better, 0, descent.rejected[groups] + 1)
    lowered = (trials.damping.gather(0, choice[None])[0] * policy.down).clamp_min(policy.least_damping)
    damping = torch.where(better, lowered, descent.damping[groups] * policy.up)
    hopeless = ~better & (damping > policy.most_damping)
    if policy.attempts is not None:
        hopeless = hopeless | (rejected >= policy.attempts)
    stop = torch.full_like(groups, Stop.RUNNING if policy.steps is None else Stop.ITERATIONS)
    if policy.steps is not None:
        stop = torch.where(accepted >= policy.steps, stop, int(Stop.RUNNING))
    stop = torch.where(hopeless, int(Stop.NO_LOWER_COST), stop)
    stop = torch.where(better & (trials.size < policy.small_step), int(Stop.SMALL_STEP), stop)
    small = better & (before - found < (policy.relative * before).clamp_min(policy.absolute))
    return descent.with_groups(
        groups,
        stop=torch.where(small, int(Stop.CONVERGED), stop),
        cost=torch.where(better, found, before),
        damping=damping,
        rejected=rejected,
        accepted=accepted,
        evaluations=descent.evaluations[groups] + len(trials.damping),
    )


def _linearised(descent: Descent, rows: Rows, normal: Equations) -> Descent:
    """Return the descent with new normal equations of some rows."""
    groups = rows.groups
    own = by_group(normal.cost, rows.owner, len(groups))
    bad = int(Stop.NOT_FINITE)
    descent = descent.with_groups(
        groups,
        cost=own + descent.problem.box.at(groups).cost(descent.point.values[groups]),
        stop=torch.where(_finite(normal, rows), descent.stop[groups], bad),
        linearisations=descent.linearisations[groups] + 1,
    )
    return replace(descent, normal=descent.normal.put(rows.items, normal))


def _finite(normal: Equations, rows: Rows) -> Tensor:
    """Return whether the gradients of all items of each group are finite, shape (g,)."""
    return by_group((~normal.finite()).long(), rows.owner, len(rows.groups)) == 0
