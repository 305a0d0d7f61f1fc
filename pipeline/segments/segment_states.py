"""States of segments, fitted to their frames in a given world."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..optimization.least_squares import Policy, descend
from ..optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ..physics.parameters import Parameter
from ..physics.state import State
from ..trajectories.residuals import STATE_SIZE, retract, state_prior
from .segments import START_FRAMES, Segments, line_state
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.preparation
DRAWS, STARTS = 32, 3
"""States drawn about the fitted one, and number of the best starts (drawn ones and straight lines) that are fitted.
Which corner strikes first makes separate minima; the residual of a wrong one would be attributed to the model (pitfall
P2)."""
DRAW_SPREAD = 3.0
"""Standard deviation of the draws, in units of the noise of a state between two frames."""
FALL, MAX_DAMPING = 0.02, 1e3
"""Fall of chi2 below which a descent ends, and damping above which it ends, as only tiny steps would lower chi2."""
ITERATIONS = {"flight": 5, "contact": 5}
"""Maximum number of steps by kind of segment."""
SEARCHES, SEARCH_ITERATIONS = 2, 6
"""Number of thorough searches, and steps of each fit of a usual one."""
THOROUGH_STARTS, THOROUGH_ITERATIONS = 8, 8
"""Starts that are fitted in a thorough search, and steps of each fit."""


def fit_states(
    segments: Segments,
    parameters: Sequence[Parameter] = (),
    values: Tensor | None = None,
    iterations: int | None = None,
    search: bool = True,
    thorough: bool = False,
    also: Sequence[State] = (),
) -> Segments:
    """Fit the state of each segment by Levenberg-Marquardt, with a separate damping for each.

    Args:
        segments: With states to start from.
        parameters: Parameters of the world that are set, not fitted.
        values: Their values in fitted coordinates, (P,) or (B, P).
        iterations: Maximum number of steps.
        search: Whether, through contact, to start from straight lines through several numbers of frames too, and to fit
            those that still fit badly from other starts.
        thorough: Whether to search several times, and for every segment that fits badly; else only for those that fit
            worse than most: where the contact law misses all of them by far more than the noise, only those can be at a
            wrong minimum.
        also: Further states (B) to start from, as of another model; a thorough search then searches once.
    """
    given = torch.zeros(0).to(segments.world.gravity) if values is None else values
    count = ITERATIONS[segments.kind] if iterations is None else iterations
    several = search and segments.kind == "contact"
    lines = [line_state(segments, frames) for frames in START_FRAMES] if several else []
    starts = [*lines, *also]
    best = best_of(segments, starts, parameters, given) if starts else segments
    best, cost = _descended(best, parameters, given, count)
    searches = (SEARCHES if thorough and not also else 1) if several else 0
    for seed in range(searches):
        share = cost / segments.dof.clamp_min(1.0)
        usual = 1.0 if thorough else float(share.nanmedian().clamp_min(1.0))
        bad = torch.nonzero(share > LIMITS.bad_fit * usual)[:, 0].tolist()
        if not bad:
            break
        best, cost = _searched(best, cost, bad, parameters, given, seed, thorough)
    return best


def costs_of(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Tensor:
    """Return the sum of squares (B,) of the residuals, in sigmas; infinite where a rollout diverged."""
    return _costs(segments.residuals(parameters, values, jacobian=False)[0])


def best_of(segments: Segments, others: Sequence[State], parameters: Sequence[Parameter], values: Tensor) -> Segments:
    """Return the segments, each in its state or the one of others that fits better, all rolled out at once."""
    every = segments.in_states([segments.observations.state, *others])
    chosen = values if values.ndim == 1 else values.repeat(1 + len(others), 1)
    place = costs_of(every, parameters, chosen).unflatten(0, (1 + len(others), -1)).argmin(0)
    return segments.with_state(every.observations.state.at(place * len(place) + torch.arange(len(place))))


def _searched(
    segments: Segments,
    cost: Tensor,
    bad: Sequence[int],
    parameters: Sequence[Parameter],
    values: Tensor,
    seed: int,
    thorough: bool,
) -> tuple[Segments, Tensor]:
    """Return the segments with the states of the bad ones fitted from the best of many starts, and all costs (B,)."""
    own, count = segments.select(bad), len(bad)
    number, iterations = (THOROUGH_STARTS, THOROUGH_ITERATIONS) if thorough else (STARTS, SEARCH_ITERATIONS)
    given = values if values.ndim == 1 else values[list(bad)]
    starts = [line_state(own, frames) for frames in START_FRAMES]
    starts += [own.moved(change).observations.state for change in _draws(own, seed)]
    every = own.in_states(starts)
    costs = costs_of(every, parameters, given if given.ndim == 1 else given.repeat(len(starts), 1))
    order = costs.unflatten(0, (len(starts), count)).argsort(0)[:number]
    tried = every.select((order * count + torch.arange(count)).flatten().tolist())
    chosen = given if given.ndim == 1 else given.repeat(number, 1)
    tried, found = _descended(tried, parameters, chosen, iterations)
    least, place = found.unflatten(0, (number, count)).min(0)
    fitted = own.with_state(tried.observations.state.at(place * count + torch.arange(count)))
    before = cost[list(bad)]
    return _placed(segments, bad, _merged(least < before, fitted, own)), _put(cost, bad, torch.minimum(least, before))


def _draws(segments: Segments, seed: int) -> Tensor:
    """Return random changes of states (D, B, S) of the size that the noise of two frames makes."""
    position, rotation = segments.noise
    step = float(segments.observations.times_s.diff(dim=1).median())
    spread = [std for std in (position, rotation, position / step, rotation / step) for _ in range(3)]
    bodies = len(segments.observations.free)
    width = DRAW_SPREAD * torch.tensor(spread).to(segments.world.gravity).repeat(bodies)
    generator = torch.Generator().manual_seed(seed)
    # the draws of a segment do not depend on the other segments of the batch
    drawn = torch.randn(DRAWS, 1, STATE_SIZE * bodies, generator=generator, dtype=torch.float64).to(width)
    return (width * drawn).expand(-1, len(segments.items), -1)


def _descended(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor, iterations: int
) -> tuple[Segments, Tensor]:
    """Return the segments with their states at a nearby minimum, and the costs (B,) there."""
    problem = _StateProblem(segments, parameters, values)
    start = Point(values=values.new_zeros(len(segments.items), 0), states=segments.observations.state.tensors)
    policy = Policy(
        iterations=iterations,
        damping=1e-4,
        down=1 / 8,
        up=10.0,
        least_damping=0.0,
        most_damping=MAX_DAMPING,
        absolute=FALL,
    )
    end = descend(problem, start, policy)
    return segments.with_state(State(*end.point.states)), end.cost


class _StateProblem(Problem):
    """States of segments (B) in a given world, each segment a group.

    Args:
        segments: The segments.
        parameters: Parameters of their world that are set (P).
        values: Their values in fitted coordinates, (P,) or (B, P).
    """

    derivatives_with_costs = True

    def __init__(self, segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> None:
        count = len(segments.items)
        self.segments, self.parameters, self.values = segments, parameters, values
        self.owner = torch.arange(count)
        self.box = Box.unbounded(values.new_zeros(count, 0))

    def _at(self, point: Point, rows: Rows) -> Segments:
        return self.segments.select(rows.items.tolist()).with_state(State(*point.states))

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations of the states; those of a diverged rollout are of its finite part."""
        values = self.values if self.values.ndim == 1 else self.values[rows.items]
        segments = self._at(point, rows)
        error, jacobian = segments.residuals(self.parameters, values)
        return normal_equations(segments, error, jacobian[..., len(self.parameters) :], 0)

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the states (b) moved by steps (b, S)."""
        del values, rows
        return retract(State(*point.states), step, self.segments.observations.free).tensors


def normal_equations(segments: Segments, rows: Tensor, jacobian: Tensor, count: int) -> NormalEquations:
    """Return the normal equations of residuals (B, F, 6), with a weak prior on the states; costs are their chi2.

    The Jacobian (B, F, 6, P + S) has P = count parameters. The chi2 of a diverged rollout is infinite, and its
    equations are those of the finite part.
    """
    error = torch.nan_to_num(rows.flatten(1), posinf=0.0, neginf=0.0)
    flat = torch.nan_to_num(jacobian.flatten(1, 2), posinf=0.0, neginf=0.0)
    prior = state_prior(len(segments.observations.free))
    return NormalEquations.of_rows(error, flat, count, _costs(rows), prior=prior)


def _costs(rows: Tensor) -> Tensor:
    """Return the sum of squares (B,); infinite where a rollout diverged."""
    return torch.nan_to_num(rows.square().sum((1, 2)), nan=torch.inf, posinf=torch.inf)


def _merged(choice: Tensor, first: Segments, second: Segments) -> Segments:
    """Return the segments with the states of the first where chosen (B,), of the second elsewhere."""
    rows = torch.arange(len(choice)) + torch.where(choice, 0, len(choice))
    return second.with_state(State.joined(first.observations.state, second.observations.state).at(rows))


def _placed(segments: Segments, places: Sequence[int], some: Segments) -> Segments:
    """Return the segments with the states of some of them replaced."""
    rows = torch.arange(len(segments.items))
    rows[list(places)] = len(rows) + torch.arange(len(places))
    return segments.with_state(State.joined(segments.observations.state, some.observations.state).at(rows))


def _put(values: Tensor, places: Sequence[int], some: Tensor) -> Tensor:
    """Return values with some of them replaced."""
    return values.index_copy(0, torch.tensor(places), some)
