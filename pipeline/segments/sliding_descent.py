"""Joint descent of groups of sliding segments: parameters of each group and a start state of each segment.

Gauss-Newton with the states eliminated. All groups descend in one batch, each with its own damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..physics.parameters import Parameter
from ..physics.world import State
from .segments import Segments
from .sliding_residuals import chi2_by_segment, finite_differences

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
    problem = _GroupProblem.of(parameters, values, free, group, centre)
    state = _GroupState.of(problem, segments)
    for _ in range(iterations):
        _take_step(problem, state)
        if not bool(state.active.any()):
            break
    return SlidingFit(state.segments, state.chi2, problem.all_values(state.now), state.information)


@dataclass(frozen=True, kw_only=True)
class _GroupProblem:
    """What each group (G) fits to its sliding segments (B): S of the P parameters, with bounds and priors."""

    parameters: Sequence[Parameter]
    """Parameters of the segments' world (P)."""
    values: Tensor
    """Values to start from, in fitted coordinates, shape (G, P)."""
    group: Tensor
    """Group of each segment, shape (B,)."""
    place: Tensor
    """Indices of the free parameters, shape (G, S); 0 where a group has fewer."""
    fitted: Tensor
    """Which of these are fitted, shape (G, S)."""
    free: Tensor
    """The indices with -1 where a group has fewer, shape (G, S)."""
    low: Tensor
    """Lower bounds, shape (G, S)."""
    high: Tensor
    """Upper bounds, shape (G, S)."""
    prior: Tensor
    """Information of the priors, shape (G, S)."""
    start: Tensor
    """Free values to start from, shape (G, S)."""
    middle: Tensor
    """Centres of the priors, shape (G, S)."""

    @staticmethod
    def of(
        parameters: Sequence[Parameter], values: Tensor, free: Tensor, group: Tensor, centre: Tensor | None
    ) -> _GroupProblem:
        """Collect bounds and priors; the priors are centred on the start without a `centre` (G, P)."""
        width = torch.tensor([p.prior[1] for p in parameters]).to(values)
        limits = torch.tensor([p.limits for p in parameters]).to(values)
        place = free.clamp_min(0)
        start = values.gather(1, place)
        return _GroupProblem(
            parameters=parameters,
            values=values,
            group=group,
            place=place,
            fitted=free >= 0,
            free=free,
            low=limits[place, 0],
            high=limits[place, 1],
            prior=1 / width[place] ** 2,
            start=start,
            middle=start if centre is None else centre.gather(1, place),
        )

    def all_values(self, free_values: Tensor) -> Tensor:
        """Return the values (G, P) of all parameters, with the free ones (G, S) as given."""
        moved = torch.where(self.fitted, free_values - self.start, torch.zeros_like(free_values))
        return self.values.scatter_add(1, self.place, moved)

    def cost(self, chi2: Tensor, free_values: Tensor) -> Tensor:
        """Return the cost (G,): chi2 (B,) of the segments of each group, and its priors."""
        data = _added(chi2, self.group, len(self.free))
        return data + (self.prior * self.fitted * (free_values - self.middle) ** 2).sum(1)


@dataclass(kw_only=True)
class _GroupState:
    """Where the descent of each group is."""

    segments: Segments
    """The sliding segments (B), with their states."""
    chi2: Tensor
    """Chi-square of each segment, shape (B,)."""
    now: Tensor
    """Current free values, shape (G, S)."""
    cost: Tensor
    """Cost of each group: chi-square and priors, shape (G,)."""
    damping: Tensor
    """Damping of each group, shape (G,)."""
    active: Tensor
    """Groups that still descend, shape (G,)."""
    information: Tensor
    """Information on the free values including the priors, shape (G, S, S)."""

    @staticmethod
    def of(problem: _GroupProblem, segments: Segments) -> _GroupState:
        """Return the start of the descent."""
        chi2 = chi2_by_segment(segments, problem.parameters, problem.values[problem.group])
        cost = problem.cost(chi2, problem.start)
        count, size = problem.free.shape
        return _GroupState(
            segments=segments,
            chi2=chi2,
            now=problem.start,
            cost=cost,
            damping=torch.full_like(cost, 1e-2),
            active=torch.ones(count, dtype=torch.bool),
            information=torch.zeros(count, size, size).to(problem.values),
        )


def _take_step(problem: _GroupProblem, state: _GroupState) -> None:
    """Try one step with each of several dampings in every active group, and keep the best one that lowers the cost."""
    places = state.active[problem.group].nonzero()[:, 0].tolist()
    some, own = state.segments.select(places), problem.group[places]
    rows, jacobian, basis = finite_differences(
        some, problem.parameters, problem.all_values(state.now)[own], problem.free[own]
    )

    def step(damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _damped_step(problem, state, rows, jacobian, own, damping)

    undamped = step(torch.zeros_like(state.damping))[2]
    state.information = torch.where(state.active[:, None, None], undamped, state.information)
    trials, changes, _ = zip(*(step(state.damping * factor) for factor in DAMPINGS), strict=True)
    tried = [some.moved((basis @ change[..., None])[..., 0]) for change in changes]
    # all in one batch: a rollout of many costs little more than one of few
    every = some.select(list(range(len(places))) * len(tried))
    every = every.with_state(State.joined(*(one.observations.state for one in tried)))
    parts = chi2_by_segment(every, problem.parameters, torch.cat([problem.all_values(trial)[own] for trial in trials]))
    before, used, old = state.cost, state.damping, state.chi2
    for factor, trial, moved, part in zip(DAMPINGS, trials, tried, parts.unflatten(0, (len(tried), -1)), strict=True):
        found = old.index_copy(0, torch.tensor(places), part)
        after = problem.cost(found, trial)
        better = state.active & (after < state.cost)
        state.chi2 = torch.where(better[problem.group], found, state.chi2)
        state.segments = _placed(state.segments, places, moved, better[own])
        state.now = torch.where(better[:, None], trial, state.now)
        state.cost = torch.where(better, after, state.cost)
        state.damping = torch.where(better, used * factor, state.damping)
    fell = before - state.cost
    state.damping = torch.where(fell > 0, state.damping, state.damping * 10 * DAMPINGS[-1])
    ended = (fell > 0) & (fell < FALL + FALL_SHARE * state.cost)
    state.active = state.active & (~ended & (state.damping < MAX_DAMPING))


def _damped_step(
    problem: _GroupProblem, state: _GroupState, rows: Tensor, jacobian: Tensor, own: Tensor, damping: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return values (G, S), state changes along the basis (n, K) and information (G, S, S) of a damped step.

    Args:
        problem: What is fitted.
        state: Where the descent is.
        rows: Residuals (n, R) of the segments of active groups.
        jacobian: Their derivatives (n, R, S + K) by free values and by the basis of the states.
        own: Group of each of these segments (n,).
        damping: Of each group (G,).
    """
    now = state.now
    m, g, by_slope, by_value = _projected(rows, jacobian, problem.free.shape[1], own, damping)
    m, g = m + torch.diag_embed(problem.prior), g - problem.prior * (now - problem.middle)
    blocked = ((now <= problem.low) & (g < 0)) | ((now >= problem.high) & (g > 0))
    moving = (problem.fitted & ~blocked & state.active[:, None]).to(problem.values)
    diagonal = damping[:, None] * m.diagonal(dim1=1, dim2=2) * moving + (1 - moving)
    reduced = m * moving[:, :, None] * moving[:, None] + torch.diag_embed(diagonal)
    trial = now + torch.linalg.solve(reduced, g * moving)
    trial = torch.minimum(torch.maximum(trial, problem.low), problem.high)
    return trial, -(by_slope + by_value @ (trial - now)[own][..., None])[..., 0], m


def information_by_segment(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor
) -> tuple[Tensor, Tensor]:
    """Return information (B, P, P) and score (B, P) of each segment on parameters at values (P,), its state free."""
    count, size = len(segments.items), len(parameters)
    free = torch.arange(size).expand(count, size)
    rows, jacobian, _ = finite_differences(segments, parameters, values.expand(count, size), free)
    return _projected(rows, jacobian, size, torch.arange(count), torch.zeros(count).to(values))[:2]


def _projected(
    rows: Tensor, jacobian: Tensor, size: int, own: Tensor, damping: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return information (G, S, S) and score (G, S) of groups, and how states (n, K, 1 and S) follow a step.

    Args:
        rows: Residuals (n, R).
        jacobian: By parameters and states (n, R, S + K).
        size: S.
        own: Group of each segment (n,).
        damping: Of each group (G,).
    """
    count = len(damping)
    by_value, by_state = jacobian[..., :size], jacobian[..., size:]
    normal, error = by_state.mT @ by_state, rows[..., None]
    mixed, slope = by_state.mT @ by_value, by_state.mT @ error
    loaded = torch.diag_embed(damping[own][:, None] * normal.diagonal(dim1=1, dim2=2) + 1e-9)
    solved = torch.linalg.solve(normal + loaded, torch.cat((mixed, slope), -1))
    by_numbers, by_slope = solved[..., :size], solved[..., size:]
    information = _added(by_value.mT @ by_value - mixed.mT @ by_numbers, own, count)
    score = _added(-(by_value.mT @ error - mixed.mT @ by_slope)[..., 0], own, count)
    return information, score, by_slope, by_numbers


def _placed(segments: Segments, places: list[int], moved: Segments, taken: Tensor) -> Segments:
    """Return the segments with the states of those that were moved, where accepted."""
    state = segments.observations.state
    chosen = torch.tensor(places)[taken]
    fields = [value.clone() for value in vars(state).values()]
    for value, own in zip(fields, vars(moved.observations.state).values(), strict=True):
        value[chosen] = own[taken]
    return segments.with_state(State(*fields))


def _added(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Return the sums of values (n, ...) by group (n,), shape (count, ...)."""
    return torch.zeros(count, *values.shape[1:]).to(values).index_add(0, group, values)
