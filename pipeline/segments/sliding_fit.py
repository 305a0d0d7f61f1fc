"""Sliding fit: friction and effects shared by all sliding segments, with a start state for each, by Gauss-Newton.

A sliding segment starts on the ground and stays there: only the state coordinates along the ground are fitted, as
otherwise the fit would press the body into the ground to get more friction. The contact law is soft and without
rebound, so that contacts do not rattle; the normal force that carries the weight is the same for every law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..geometry.rotation import quat_to_matrix
from ..physics.contact_law import ContactLaw
from ..physics.impulse_solver import tangent_axes
from ..physics.parameters import FRICTION, GROUND_SHIFT, Parameter, effect_parameters
from ..physics.world import State, World
from ..trajectories.residuals import STATE_SIZE, TrajectoryResiduals
from ..trajectories.segmentation import GroundPlane
from .candidates import Variant, base_parameters, base_values, with_variants
from .contact_phases import is_round
from .impact_law import contact_law
from .linearization import linearize, sums
from .prepare import Prepared
from .segments import Segments, line_state
from .sliding_segments import find_sliding_segments, grounded_states

TIME_S = 0.01
"""Contact time [s] of the soft, critically damped law."""
SWEEPS = 4
"""Maximum number of solver iterations: enough where impulses change slowly from step to step."""
STATE_STEPS = (1e-4, 1e-3, 1e-3, 1e-2)
"""Steps of central differences by position [m], rotation [rad], velocity [m/s] and angular velocity [rad/s]."""
PARAMETER_STEP = 0.02
"""Step of differences by parameters, in widths of their priors."""
ITERATIONS, MAX_DAMPING, FALL, FALL_SHARE = 8, 1e5, 0.2, 2e-3
"""Maximum number of steps, damping at which a group stops, and absolute and relative fall of the cost that end a
descent."""
LOADS_UNKNOWN = 0.01
"""Model error of the load distribution over more than three contact points, as a share of the weight: a body is never
perfectly flat, and engines differ by as much. The torque about the normal that it may cause is not used as evidence."""
DAMPINGS = (0.1, 1.0, 10.0, 300.0)
"""Dampings tried in each step, in units of the one that was best before: at the end of a slide the linearization holds
for small steps only."""
START_FRAMES = (4, 7)
"""Numbers of frames of the straight lines from which states are fitted first."""
START_FRICTION = (0.15, 0.35)
"""Friction coefficients from which each segment is fitted first."""
WELL_KNOWN = 100.0
"""Minimum information on the logarithm of the friction for a segment to contribute to the initial friction (standard
error 0.1)."""
WELL_FITTED = 4.0
"""Maximum chi2 / dof of such a segment."""


def soft_world(world: World) -> World:
    """Return the world with a soft contact without rebound, in which the body rests as high as on a hard one."""
    law, gravity = contact_law(world), float(world.gravity[0].norm())
    soft = replace(
        law,
        contact_time_s=torch.full_like(law.contact_time_s, TIME_S),
        damping_ratio=torch.ones_like(law.damping_ratio),
    )
    offset = GroundPlane.of(world).offset + gravity * TIME_S**2
    sweeps = min(world.sweeps, SWEEPS)
    return replace(world, contact=soft, ground_offset=offset, step_s=0.5 * TIME_S, sweeps=sweeps)


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
        chi2 = _chi2(segments, problem.parameters, problem.values[problem.group])
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
    rows, jacobian, basis = _linear(some, problem.parameters, problem.all_values(state.now)[own], problem.free[own])

    def step(damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _damped_step(problem, state, rows, jacobian, own, damping)

    undamped = step(torch.zeros_like(state.damping))[2]
    state.information = torch.where(state.active[:, None, None], undamped, state.information)
    trials, changes, _ = zip(*(step(state.damping * factor) for factor in DAMPINGS), strict=True)
    tried = [some.moved((basis @ change[..., None])[..., 0]) for change in changes]
    # all in one batch: a rollout of many costs little more than one of few
    every = some.select(list(range(len(places))) * len(tried))
    every = every.with_state(State.joined(*(one.observations.state for one in tried)))
    parts = _chi2(every, problem.parameters, torch.cat([problem.all_values(trial)[own] for trial in trials]))
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
    rows, jacobian, _ = _linear(segments, parameters, values.expand(count, size), free)
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


def noiseless_misfits(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor, others: Tensor, along: int
) -> list[float]:
    """Return the chi2 (K,) that the first parameters alone leave of noiseless motions generated with other values.

    Args:
        segments: Sliding segments with fitted states, from which the motions begin.
        parameters: Parameters of their world (P), first those that are fitted.
        values: Their values (P,), in fitted coordinates; the fits start there.
        others: Values that generate the motions (K, P).
        along: Number of parameters that are fitted.
    """
    count, each, free = len(segments.items), len(others), list(segments.observations.free)
    every = segments.select(list(range(count)) * each)
    seen = every.observations
    made = TrajectoryResiduals(every.world, parameters, seen, *every.noise).rollout(
        others.repeat_interleave(count, 0), torch.zeros(count * each, STATE_SIZE * len(free)).to(values)
    )
    seen = replace(seen, position_m=made.position_m[:, :, free], quat_wxyz=made.quat_wxyz[:, :, free])
    group = torch.arange(each).repeat_interleave(count)
    columns = torch.arange(along).expand(each, along)
    found = fit_groups(replace(every, observations=seen), parameters, values.repeat(each, 1), columns, group)
    return found.chi2.unflatten(0, (each, count)).sum(1).tolist()


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


def _chi2(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Tensor:
    """Return the chi2 (B,) of each segment; 1e12 where a rollout diverged."""
    rows = without_loads(segments, segments.residuals(parameters, values, jacobian=False)[0])
    return torch.nan_to_num(rows.square().sum((1, 2)), nan=1e12, posinf=1e12)


def without_loads(segments: Segments, rows: Tensor) -> Tensor:
    """Return residuals (B, T, 6) in sigmas with the model error of the load distribution whitened.

    Derived. With the columns of U the residuals of rotations about the normal by angular accelerations that are
    constant and that grow with time, whose standard deviation is s, the covariance of the residuals is 1 + s^2 U U^T;
    they are multiplied by its inverse root.
    """
    seen, world = segments.observations, segments.world
    body = world.bodies[seen.free[0]]
    if is_round(body):
        return rows
    normal = GroundPlane.of(world).normal
    turned = seen.turned[:, :, 0, None] / segments.noise[1]
    times = (seen.times_s - seen.times_s[:, :1])[..., None]
    share = times / times.amax(1, keepdim=True).clamp_min(1e-9)
    axis = quat_to_matrix(seen.quat_wxyz[:, :, 0]).transpose(-1, -2) @ normal
    turn = 0.5 * times.square() * axis * turned
    turns = torch.stack([torch.cat((torch.zeros_like(axis), one), -1) for one in (turn, share / 3 * turn)], -1)
    reach = body.centers[0].norm(dim=-1).max()
    torque = contact_law(world).friction[0] * world.gravity[0].norm() * body.mass[0] * reach
    spread = LOADS_UNKNOWN * torque / body.inertia[0].diagonal().mean()
    turns = segments.innovations(turns)
    directions, sizes, _ = torch.linalg.svd(turns.flatten(1, 2), full_matrices=False)
    known = 1 - (1 + (spread * sizes).square()).rsqrt()
    along = directions.mT @ rows.flatten(1)[..., None]
    return rows - (directions @ (known[..., None] * along)).view_as(rows)


def _basis(segments: Segments) -> Tensor:
    """Return the changes of state (B, 12, K) that keep the body on the ground, each as large as a difference step."""
    seen, world = segments.observations, segments.world
    index, count = seen.free[0], len(segments.items)
    normal = GroundPlane.of(world).normal
    tangents = tangent_axes(normal)[1:].T  # (3, 2)
    if is_round(world.bodies[index]):
        turns = torch.eye(3).to(normal).expand(count, 3, 3)
    else:
        up = quat_to_matrix(seen.state.quat_wxyz[:, index]).transpose(-1, -2) @ normal
        turns = up[..., None]
    size = turns.shape[-1]
    basis = torch.zeros(count, STATE_SIZE, 4 + 2 * size).to(normal)
    basis[:, 0:3, 0:2] = STATE_STEPS[0] * tangents
    basis[:, 3:6, 2 : 2 + size] = STATE_STEPS[1] * turns
    basis[:, 6:9, 2 + size : 4 + size] = STATE_STEPS[2] * tangents
    basis[:, 9:12, 4 + size :] = STATE_STEPS[3] * turns
    return basis


def _linear(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor, free: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return residuals (B, R), their derivatives (B, R, S + K) by free parameters and by the basis, and the basis."""
    basis = _basis(segments)
    k, (n, size) = basis.shape[-1], free.shape
    steps = torch.tensor([PARAMETER_STEP * p.prior[1] for p in parameters]).to(values)
    still = torch.zeros(n, STATE_SIZE).to(values)
    changes, moves = [still], [values]
    for column in range(size):
        at = free[:, column, None].clamp_min(0)
        changes.append(still)
        moves.append(values.scatter_add(1, at, steps[at] * (free[:, column, None] >= 0)))
    changes += [sign * basis[..., j] for j in range(k) for sign in (1.0, -1.0)]
    moves += [values] * (2 * k)
    every = segments.select(list(range(n)) * len(changes)).moved(torch.cat(changes))
    rows = every.residuals(parameters, torch.cat(moves), jacobian=False)[0]
    rows = without_loads(every, rows).flatten(1).unflatten(0, (len(changes), n))
    rows = torch.nan_to_num(rows, nan=0.0, posinf=0.0, neginf=0.0)
    by_value = (rows[1 : 1 + size] - rows[0]).movedim(0, -1) / steps[free.clamp_min(0)][:, None]
    by_state = 0.5 * (rows[1 + size :: 2] - rows[2 + size :: 2]).movedim(0, -1)
    return rows[0], torch.cat((by_value, by_state), -1), basis


@dataclass(frozen=True)
class StartedSliding:
    """Sliding segments, each fitted with its own friction, before any effect is tested."""

    segments: Segments
    """Sliding segments in the world with the soft contact."""
    friction: Tensor
    """Median logarithm of the friction over well-determined segments."""
    base: SlidingFit
    """Fit of the model without a candidate, with one friction for all."""
    told: tuple[Parameter, ...]
    """Parameters of effects that act in flight, with their standard errors from the flights as priors. They act during
    sliding too, and are not known exactly: an error of half a thousandth of a radian in a tilt is a millimetre in a
    slide of half a second."""

    @staticmethod
    def of(prepared: Prepared, world: World, flight: Segments | None) -> StartedSliding | None:
        """Find and start the sliding segments of all episodes; return None where there are none.

        Args:
            prepared: The episodes.
            world: The model's world.
            flight: Flights with fitted states; None where there are none.
        """
        if not isinstance(world.contact, ContactLaw) or not prepared.turned:
            return None
        items = find_sliding_segments(world, prepared.whole, prepared.clear, prepared.noise)
        if not items:
            return None
        soft = soft_world(world)
        segments = prepared.segments("contact", soft, items)
        segments, friction = _started(segments, float(world.contact.friction[0]))
        flight_parameters = _flight_priors(flight, soft, prepared.groups)
        base = _base(segments, (friction, world.contact.friction[0].log().to(friction)), flight_parameters)
        return StartedSliding(segments, friction, base, flight_parameters)


def _base(segments: Segments, frictions: Sequence[Tensor], flight_parameters: Sequence[Parameter]) -> SlidingFit:
    """Return the best fit of the model without a candidate, from the first guesses of the logarithm of the friction.

    The guesses are the median over segments and the contact law's value: a single segment can mislead the former, and a
    wrong friction is a local minimum.
    """
    tried = (fit_sliding(segments.world, [], [(segments, one)], flight_parameters)[0] for one in frictions)
    return min(tried, key=lambda fit: fit.cost)


def _started(segments: Segments, known: float) -> tuple[Segments, Tensor]:
    """Return sliding segments each fitted with its own friction, and the median logarithm of these frictions."""
    count = len(segments.items)
    states = [grounded_states(segments, line_state(segments, frames)) for frames in START_FRAMES]
    every = segments.in_states(states * len(START_FRICTION))
    values = torch.tensor([[FRICTION.encode(mu)] for mu in START_FRICTION]).repeat_interleave(len(states) * count, 0)
    values = values.to(segments.world.gravity)
    group = torch.arange(len(values))
    found = fit_groups(every, [FRICTION], values, torch.zeros(len(values), 1, dtype=torch.long), group)
    best = found.chi2.unflatten(0, (-1, count)).argmin(0) * count + torch.arange(count)
    certainty = found.information[best, 0, 0] - 1 / FRICTION.prior[1] ** 2
    good = (certainty > WELL_KNOWN) & (found.chi2[best] < WELL_FITTED * segments.dof)
    own = found.values[best, 0]
    friction = own[good].median() if bool(good.any()) else torch.full_like(own[0], FRICTION.encode(known))
    return segments.with_state(found.segments.observations.state.at(best)), friction


def fit_sliding(
    world: World,
    variants: Sequence[Variant],
    starts: Sequence[tuple[Segments, Tensor]],
    flight_parameters: Sequence[Parameter],
    iterations: int = ITERATIONS,
) -> list[SlidingFit]:
    """Return the fit of each variant together with the nuisance parameters; of these alone without variants.

    Args:
        world: With the soft contact.
        variants: To fit, all in one batch.
        starts: For each variant, segments with states, and the values to start from, of a fit without or with it: as
            many of the first parameters as are known.
        flight_parameters: Parameters estimated in flight, with their standard errors as priors.
        iterations: Maximum number of steps.
    """
    candidates_world, own = with_variants(world, variants, "contact")
    known = nuisance_parameters(world, flight_parameters)
    parameters = [*known, *own]
    place = {p.name: k for k, p in enumerate(parameters)}
    shared = list(range(len(known)))
    rows = [[*shared, *(place[name] for name in v.parameters)] for v in variants] or [shared]
    size, count = max(map(len, rows)), len(starts[0][0].items)
    free = torch.tensor([row + [-1] * (size - len(row)) for row in rows])
    values = base_values(candidates_world, parameters).repeat(len(rows), 1)
    middle = values.clone()
    for k, (row, (_, value)) in enumerate(zip(rows, starts, strict=True)):
        given = value.reshape(-1)
        values[k, row[: len(given)]] = given
    free_start = [k for k, p in enumerate(parameters) if p not in flight_parameters]
    middle[:, free_start] = values[:, free_start]
    segments = starts[0][0]
    every = segments.in_world(candidates_world).select(list(range(count)) * len(rows))
    every = every.with_state(State.joined(*(one.observations.state for one, _ in starts)))
    group = torch.arange(len(rows)).repeat_interleave(count)
    found = fit_groups(every, parameters, values, free, group, iterations, middle)
    fits = []
    for k, row in enumerate(rows):
        chosen = slice(k * count, (k + 1) * count)
        states = found.segments.observations.state.at(torch.arange(k * count, (k + 1) * count))
        information = found.information[k : k + 1, : len(row), : len(row)]
        fits.append(
            SlidingFit(segments.with_state(states), found.chi2[chosen], found.values[k : k + 1, row], information)
        )
    return fits


def nuisance_parameters(world: World, flight_parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return the nuisance parameters of sliding: friction, ground height, contact effects, flight parameters."""
    return [FRICTION, GROUND_SHIFT, *contact_effect_parameters(world), *flight_parameters]


def contact_effect_parameters(world: World) -> list[Parameter]:
    """Return the parameters of the contact effects that the model already has."""
    own = {a.effect.name for a in world.effects if a.effect.phase == "contact"}
    return [p for p in effect_parameters(world) if p.name.partition(".")[0] in own]


def _flight_priors(flight: Segments | None, world: World, groups: Sequence[int]) -> tuple[Parameter, ...]:
    """Return the parameters of effects that act in flight, with the standard errors from the flights as priors."""
    parameters = base_parameters(world, "flight")
    if flight is None or not parameters:
        return ()
    seen = linearize(flight, world, (), groups, robust=False)
    information, _ = sums(seen, range(seen.base))
    deviations = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    return tuple(replace(p, prior=(p.prior[0], float(s))) for p, s in zip(parameters, deviations, strict=True))
