"""Fits of glides: friction and effects shared by all of them, each with a start of its own, by Gauss-Newton.

A glide starts on the ground and stays there: of its state only what moves along the ground is fitted, or the fit would
press the body into the ground for more friction. The law of contact is a soft one without rebound, so that nothing
rattles; the force with which it carries the weight is the same for every law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..estimation.trajectory import STATE_SIZE, TrajectoryResiduals
from ..physics.contact import ContactLaw
from ..physics.parameters import Parameter
from ..physics.rotation import quat_to_matrix
from ..physics.sweeps import tangent_axes
from ..physics.world import State, World
from .phases import is_round
from .segments import Segments

TIME_S = 0.01
"""Contact time of the soft law, critically damped."""
SWEEPS = 4
"""So many suffice where impulses change slowly from step to step."""
STATE_STEPS = (1e-4, 1e-3, 1e-3, 1e-2)
"""Differences by position [m], rotation [rad], velocity [m/s] and angular velocity [rad/s], both ways."""
PARAMETER_STEP = 0.02
"""Differences by parameters, in widths of their priors."""
ITERATIONS, MAX_DAMPING, FALL, FALL_SHARE = 8, 1e5, 0.2, 2e-3
LOADS_UNKNOWN = 0.01
"""How a weight is shared by more than three points, nobody knows better than to this share: a body is never quite flat,
and engines differ by as much. What it turns a sliding body about the normal is no evidence for anything."""
DAMPINGS = (0.1, 1.0, 10.0, 300.0)
"""Of each step so many are tried, in units of the damping that was best before: through the end of a slide the linear
picture holds for small steps only."""


def soft_world(world: World) -> World:
    """Return the world with a soft contact without rebound, on which the body lies as high as on a hard one."""
    law, gravity = world.contact, float(world.gravity[0].norm())
    assert isinstance(law, ContactLaw) and world.ground_offset is not None
    soft = replace(
        law,
        contact_time_s=torch.full_like(law.contact_time_s, TIME_S),
        damping_ratio=torch.ones_like(law.damping_ratio),
    )
    offset = world.ground_offset + gravity * TIME_S**2
    sweeps = min(world.sweeps, SWEEPS)
    return replace(world, contact=soft, ground_offset=offset, step_s=0.5 * TIME_S, sweeps=sweeps)


@dataclass(frozen=True)
class GlideFit:
    """Glides fitted in groups: chi2 (B,) of each; values (G, P) and, of what is free, information (G, P, P)."""

    segments: Segments
    chi2: Tensor
    values: Tensor
    information: Tensor

    @property
    def cost(self) -> float:
        """Chi2 of all glides together."""
        return float(self.chi2.sum())


def fit_groups(
    segments: Segments,
    parameters: Sequence[Parameter],
    values: Tensor,
    free: Tensor,
    group: Tensor,
    iterations: int = ITERATIONS,
    centre: Tensor | None = None,
) -> GlideFit:
    """Fit the parameters of each group and the starts of its glides.

    Args:
        segments: Glides (B) with states to start from.
        parameters: Numbers of their world (P).
        values: Of each group (G, P), in fitted coordinates, to start from.
        free: Places of the numbers that each group fits (G, S); -1 for none.
        group: Of each glide (B,).
        iterations: Most steps.
        centre: Of the priors (G, P); where the fit starts by default.
    """
    width = torch.tensor([p.prior[1] for p in parameters]).to(values)
    limits = torch.tensor([p.limits for p in parameters]).to(values)
    place, fitted = free.clamp_min(0), free >= 0
    low, high, prior = limits[place, 0], limits[place, 1], 1 / width[place] ** 2
    count, size = free.shape
    chi2 = _chi2(segments, parameters, values[group])

    def whole(own: Tensor) -> Tensor:
        return values.scatter_add(1, place, torch.where(fitted, own - start, torch.zeros_like(own)))

    def cost_of(chi2: Tensor, own: Tensor) -> Tensor:
        return _added(chi2, group, count) + (prior * fitted * (own - middle) ** 2).sum(1)

    start = values.gather(1, place)
    middle = start if centre is None else centre.gather(1, place)
    now, cost = start, cost_of(chi2, start)
    damping, active = torch.full_like(cost, 1e-2), torch.ones(count, dtype=torch.bool)
    information = torch.zeros(count, size, size).to(values)
    for _ in range(iterations):
        places = active[group].nonzero()[:, 0].tolist()
        some, own = segments.select(places), group[places]
        rows, jacobian, basis = _linear(some, parameters, whole(now)[own], free[own])

        def step(damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """Return values (G, S), changes of states along the basis (n, K) and information of a damped step."""
            m, g, by_slope, by_value = _projected(rows, jacobian, size, own, damping)  # noqa: B023 used at once
            m, g = m + torch.diag_embed(prior), g - prior * (now - middle)  # noqa: B023
            blocked = ((now <= low) & (g < 0)) | ((now >= high) & (g > 0))  # noqa: B023
            moving = (fitted & ~blocked & active[:, None]).to(values)  # noqa: B023
            diagonal = damping[:, None] * m.diagonal(dim1=1, dim2=2) * moving + (1 - moving)
            reduced = m * moving[:, :, None] * moving[:, None] + torch.diag_embed(diagonal)
            trial = now + torch.linalg.solve(reduced, g * moving)  # noqa: B023
            trial = torch.minimum(torch.maximum(trial, low), high)
            return trial, -(by_slope + by_value @ (trial - now)[own][..., None])[..., 0], m  # noqa: B023

        undamped = step(torch.zeros_like(damping))[2]
        information = torch.where(active[:, None, None], undamped, information)
        trials, changes, _ = zip(*(step(damping * factor) for factor in DAMPINGS), strict=True)
        tried = [some.moved((basis @ change[..., None])[..., 0]) for change in changes]
        # all in one batch: a rollout of many costs little more than one of few
        every = some.select(list(range(len(places))) * len(tried))
        every = every.with_state(State.joined(*(one.observations.state for one in tried)))
        parts = _chi2(every, parameters, torch.cat([whole(trial)[own] for trial in trials]))
        before, used, old = cost, damping, chi2
        for factor, trial, moved, part in zip(
            DAMPINGS, trials, tried, parts.unflatten(0, (len(tried), -1)), strict=True
        ):
            found = old.index_copy(0, torch.tensor(places), part)
            after = cost_of(found, trial)
            better = active & (after < cost)
            chi2 = torch.where(better[group], found, chi2)
            segments = _placed(segments, places, moved, better[own])
            now, cost = torch.where(better[:, None], trial, now), torch.where(better, after, cost)
            damping = torch.where(better, used * factor, damping)
        fell = before - cost
        damping = torch.where(fell > 0, damping, damping * 10 * DAMPINGS[-1])
        active &= ~((fell > 0) & (fell < FALL + FALL_SHARE * cost)) & (damping < MAX_DAMPING)
        if not bool(active.any()):
            break
    return GlideFit(segments, chi2, whole(now), information)


def told_by_each(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> tuple[Tensor, Tensor]:
    """Return information (B, P, P) and score (B, P) of each glide on parameters at values (P,), its start free."""
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
        jacobian: By numbers and states (n, R, S + K).
        size: S.
        own: Group of each glide (n,).
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


def lasting_misfits(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor, others: Tensor, along: int
) -> list[float]:
    """Return what chi2 the first numbers alone leave (K,) of motions without noise that other numbers made.

    Args:
        segments: Glides with fitted states, from which the motions begin.
        parameters: Numbers of their world (P), first those that are fitted.
        values: What they are (P,), in fitted coordinates; from there the fits begin.
        others: What made the motions (K, P).
        along: How many are fitted.
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
    """Return the segments with the states of those that were moved, where taken."""
    state = segments.observations.state
    chosen = torch.tensor(places)[taken]
    fields = [value.clone() for value in vars(state).values()]
    for value, own in zip(fields, vars(moved.observations.state).values(), strict=True):
        value[chosen] = own[taken]
    return segments.with_state(State(*fields))


def _added(values: Tensor, group: Tensor, count: int) -> Tensor:
    return torch.zeros(count, *values.shape[1:]).to(values).index_add(0, group, values)


def _chi2(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Tensor:
    rows = without_loads(segments, segments.residuals(parameters, values, jacobian=False)[0])
    return torch.nan_to_num(rows.square().sum((1, 2)), nan=1e12, posinf=1e12)


def without_loads(segments: Segments, rows: Tensor) -> Tensor:
    """Return residuals (B, T, 6) in sigmas without what unknown loads may have turned the body about the normal.

    Derived. With the columns of U the residuals of turns about the normal by angular accelerations that are constant
    and that grow with time, whose standard deviation is s, the covariance of the residuals is 1 + s^2 U U^T; they are
    multiplied by its inverse root.
    """
    seen, world = segments.observations, segments.world
    body = world.bodies[seen.free[0]]
    if is_round(body):
        return rows
    assert world.ground_normal is not None and isinstance(world.contact, ContactLaw)
    turned = seen.turned[:, :, 0, None] / segments.noise[1]
    times = (seen.times_s - seen.times_s[:, :1])[..., None]
    share = times / times.amax(1, keepdim=True).clamp_min(1e-9)
    axis = quat_to_matrix(seen.quat_wxyz[:, :, 0]).transpose(-1, -2) @ world.ground_normal
    turn = 0.5 * times.square() * axis * turned
    turns = torch.stack([torch.cat((torch.zeros_like(axis), one), -1) for one in (turn, share / 3 * turn)], -1)
    reach = body.centers[0].norm(dim=-1).max()
    torque = world.contact.friction[0] * world.gravity[0].norm() * body.mass[0] * reach
    spread = LOADS_UNKNOWN * torque / body.inertia[0].diagonal().mean()
    turns = segments.innovations(turns)
    directions, sizes, _ = torch.linalg.svd(turns.flatten(1, 2), full_matrices=False)
    known = 1 - (1 + (spread * sizes).square()).rsqrt()
    along = directions.mT @ rows.flatten(1)[..., None]
    return rows - (directions @ (known[..., None] * along)).view_as(rows)


def _basis(segments: Segments) -> Tensor:
    """Return the changes of state (B, 12, K) that keep the body on the ground, each of the size of a difference."""
    seen, world = segments.observations, segments.world
    assert world.ground_normal is not None
    index, count = seen.free[0], len(segments.items)
    normal = world.ground_normal
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
    """Return residuals (B, R), their differences (B, R, S + K) by free numbers and by the basis, and the basis."""
    basis = _basis(segments)
    k, (n, size) = basis.shape[-1], free.shape
    steps = torch.tensor([PARAMETER_STEP * p.prior[1] for p in parameters]).to(values)
    still = torch.zeros(n, STATE_SIZE).to(values)
    changes, moves = [still], [values]
    for slot in range(size):
        at = free[:, slot, None].clamp_min(0)
        changes.append(still)
        moves.append(values.scatter_add(1, at, steps[at] * (free[:, slot, None] >= 0)))
    changes += [sign * basis[..., j] for j in range(k) for sign in (1.0, -1.0)]
    moves += [values] * (2 * k)
    every = segments.select(list(range(n)) * len(changes)).moved(torch.cat(changes))
    rows = every.residuals(parameters, torch.cat(moves), jacobian=False)[0]
    rows = without_loads(every, rows).flatten(1).unflatten(0, (len(changes), n))
    rows = torch.nan_to_num(rows, nan=0.0, posinf=0.0, neginf=0.0)
    by_value = (rows[1 : 1 + size] - rows[0]).movedim(0, -1) / steps[free.clamp_min(0)][:, None]
    by_state = 0.5 * (rows[1 + size :: 2] - rows[2 + size :: 2]).movedim(0, -1)
    return rows[0], torch.cat((by_value, by_state), -1), basis
