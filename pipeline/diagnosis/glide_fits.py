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

from ..estimation.trajectory import STATE_SIZE
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
"""Differences by position [m], rotation [rad], velocity [m/s] and angular velocity [rad/s]."""
PARAMETER_STEP = 0.02
"""Differences by parameters, in widths of their priors."""
ITERATIONS, MAX_DAMPING, FALL, FALL_SHARE = 8, 1e4, 0.2, 2e-3


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
) -> GlideFit:
    """Fit the parameters of each group and the starts of its glides.

    Args:
        segments: Glides (B) with states to start from.
        parameters: Numbers of their world (P).
        values: Of each group (G, P), in fitted coordinates, to start from.
        free: Places of the numbers that each group fits (G, S); -1 for none.
        group: Of each glide (B,).
        iterations: Most steps.
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
        return _added(chi2, group, count) + (prior * fitted * (own - start) ** 2).sum(1)

    start = values.gather(1, place)
    now, cost = start, cost_of(chi2, start)
    damping = torch.full_like(cost, 1e-3)
    active = torch.ones(count, dtype=torch.bool)
    information = torch.zeros(count, size, size).to(values)
    for _ in range(iterations):
        places = active[group].nonzero()[:, 0].tolist()
        some, own = segments.select(places), group[places]
        rows, jacobian, basis = _linear(some, parameters, whole(now)[own], free[own])
        by_value, by_state = jacobian[..., :size], jacobian[..., size:]
        error = rows[..., None]
        normal = by_state.mT @ by_state
        damped = normal + torch.diag_embed(damping[own][:, None] * normal.diagonal(dim1=1, dim2=2) + 1e-9)
        mixed, slope = by_state.mT @ by_value, by_state.mT @ error
        solved = torch.linalg.solve(damped, torch.cat((mixed, slope), -1))
        total = _added(by_value.mT @ by_value - mixed.mT @ solved[..., :size], own, count) + torch.diag_embed(prior)
        score = _added(-(by_value.mT @ error - mixed.mT @ solved[..., size:])[..., 0], own, count)
        score = score - prior * (now - start)
        blocked = ((now <= low) & (score < 0)) | ((now >= high) & (score > 0))
        moving = (fitted & ~blocked & active[:, None]).to(values)
        diagonal = damping[:, None] * total.diagonal(dim1=1, dim2=2) * moving + (1 - moving)
        reduced = total * moving[:, :, None] * moving[:, None] + torch.diag_embed(diagonal)
        trial = torch.minimum(torch.maximum(now + torch.linalg.solve(reduced, score * moving), low), high)
        change = -(solved[..., size:] + solved[..., :size] @ (trial - now)[own][..., None])[..., 0]
        moved = some.moved((basis @ change[..., None])[..., 0])
        found = chi2.clone()
        found[places] = _chi2(moved, parameters, whole(trial)[own])
        after = cost_of(found, trial)
        better = active & (after < cost)
        chi2 = torch.where(better[group], found, chi2)
        segments = _placed(segments, places, moved, better[own])
        now = torch.where(better[:, None], trial, now)
        information = torch.where(active[:, None, None], total, information)
        done = better & (cost - after < FALL + FALL_SHARE * after)
        cost = torch.where(better, after, cost)
        damping = torch.where(better, damping / 6, damping * 8)
        active &= ~done & (damping < MAX_DAMPING)
        if not bool(active.any()):
            break
    return GlideFit(segments, chi2, whole(now), information)


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
    rows = segments.residuals(parameters, values, jacobian=False)[0]
    return torch.nan_to_num(rows.square().sum((1, 2)), nan=1e12, posinf=1e12)


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
    changes += [basis[..., j] for j in range(k)]
    moves += [values] * k
    every = segments.select(list(range(n)) * len(changes)).moved(torch.cat(changes))
    rows = every.residuals(parameters, torch.cat(moves), jacobian=False)[0].flatten(1).unflatten(0, (len(changes), n))
    rows = torch.nan_to_num(rows, nan=0.0, posinf=0.0, neginf=0.0)
    jacobian = (rows[1:] - rows[0]).movedim(0, -1).contiguous()
    jacobian[..., :size] /= steps[free.clamp_min(0)][:, None]
    return rows[0], jacobian, basis
