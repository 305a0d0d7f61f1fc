"""Residuals of sliding segments in a world with a soft contact, and their finite differences.

The contact law is soft and without rebound, so that contacts do not rattle; the normal force that carries the weight is
the same for every law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...geometry.rotation import quat_to_matrix
from ...physics.impulse_solver import tangent_axes
from ...physics.parameters import Parameter
from ...physics.world import World
from ...trajectories.residuals import STATE_SIZE
from ...trajectories.segmentation import GroundPlane
from ..contact_phases import is_round
from ..impact_law import contact_law
from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS
from .support import on_surfaces

TIME_S = 0.01
"""Contact time [s] of the soft, critically damped law."""
SURFACE_TIME_S = 0.005
"""The same on fixed surfaces: there the body sinks in by 0.12 mm under its weight."""
SWEEPS = 4
"""Maximum number of solver iterations: enough where impulses change slowly from step to step."""
STATE_STEPS = (1e-4, 1e-3, 1e-3, 1e-2)
"""Steps of central differences by position [m], rotation [rad], velocity [m/s] and angular velocity [rad/s]."""
PARAMETER_STEP = 0.02
"""Step of differences by parameters, in widths of their priors."""
LOADS_UNKNOWN = SEGMENT_THRESHOLDS.sliding_data.loads_unknown
"""Model error of the load distribution over more than three contact points, as a share of the weight: a body is never
perfectly flat, and engines differ by as much. The torque about the normal that it may cause is not used as evidence."""


def soft_world(world: World) -> World:
    """Return the world with a soft contact without rebound, in which the body rests nearly as high as on a hard one.

    On fixed surfaces, which cannot be raised, the contact is shorter: a curved path must not be as much wider.

    It rests 0.53 g tau^2 higher, half a millimetre: in steps of half the contact time tau it sinks by 0.47 g tau^2.
    That is a quarter of the standard deviation of the ground's height, a nuisance of each fit.
    """
    law, gravity = contact_law(world), float(world.gravity[0].norm())
    time_s = SURFACE_TIME_S if on_surfaces(world) else TIME_S
    soft = replace(
        law,
        contact_time_s=torch.full_like(law.contact_time_s, time_s),
        damping_ratio=torch.ones_like(law.damping_ratio),
    )
    if on_surfaces(world):
        return replace(world, contact=soft, step_s=0.5 * time_s, iterations=min(world.iterations, SWEEPS))
    offset = GroundPlane.of(world).offset + gravity * TIME_S**2
    sweeps = min(world.iterations, SWEEPS)
    return replace(world, contact=soft, ground_offset=offset, step_s=0.5 * TIME_S, iterations=sweeps)


@dataclass(frozen=True)
class LoadErrors:
    """Model error of the load distribution in sliding segments (B), as directions of their R = 6 T residuals.

    Derived. With the columns of U the residuals of rotations about the normal by angular accelerations that are
    constant and that grow with time, whose standard deviation is s, the covariance of the residuals is 1 + s^2 U U^T;
    they are multiplied by its inverse root.
    """

    directions: Tensor
    """Orthonormal directions in the residuals of each segment, shape (B, R, 2); of a round body none, (B, R, 0)."""
    known: Tensor
    """Part of the residuals along each direction that the error makes worthless, shape (B, 2) or (B, 0)."""

    @staticmethod
    def of(segments: Segments) -> LoadErrors:
        """Return what the loads of segments (B) may do to their residuals, whatever their states."""
        seen, world = segments.observations, segments.world
        body = world.bodies[seen.free[0]]
        if is_round(body):
            count, frames = seen.times_s.shape
            none = seen.times_s.new_zeros(count, 6 * frames, 0)
            return LoadErrors(none, none[:, 0])
        normal = _normals(segments)
        turned = seen.has_orientation[:, :, 0, None] / segments.noise.rotation_rad
        times = (seen.times_s - seen.times_s[:, :1])[..., None]
        share = times / times.amax(1, keepdim=True).clamp_min(1e-9)
        axis = _in_body(seen.quat_wxyz[:, :, 0], normal)
        turn = 0.5 * times.square() * axis * turned
        turns = torch.stack([torch.cat((torch.zeros_like(axis), one), -1) for one in (turn, share / 3 * turn)], -1)
        reach = body.centers[0].norm(dim=-1).max()
        torque = contact_law(world).friction[0] * world.gravity[0].norm() * body.mass[0] * reach
        spread = LOADS_UNKNOWN * torque / body.inertia[0].diagonal().mean()
        turns = segments.innovations(turns)
        directions, sizes, _ = torch.linalg.svd(turns.flatten(1, 2), full_matrices=False)
        return LoadErrors(directions, 1 - (1 + (spread * sizes).square()).rsqrt())

    def select(self, items: Tensor) -> LoadErrors:
        """Return those of some segments (b,)."""
        return LoadErrors(self.directions[items], self.known[items])

    def whitened(self, rows: Tensor) -> Tensor:
        """Return residuals (K, B, T, 6) in sigmas, K times those of each segment, with this error whitened."""
        if not self.known.shape[1]:
            return rows
        every = rows.flatten(2).movedim(0, -1)  # (B, R, K)
        along = self.known[..., None] * (self.directions.mT @ every)
        return rows - (self.directions @ along).movedim(-1, 0).view_as(rows)


def chi2_by_segment(segments: Segments, parameters: Sequence[Parameter], values: Tensor, loads: LoadErrors) -> Tensor:
    """Return the chi2 (B,) of each segment; 1e12 where a rollout diverged."""
    rows = segments.residuals(parameters, values, jacobian=False)[0]
    return _chi2(loads.whitened(rows[None])[0])


def _chi2(rows: Tensor) -> Tensor:
    """Return the chi2 (B,) of residuals (B, T, 6); 1e12 where a rollout diverged."""
    return torch.nan_to_num(rows.square().sum((1, 2)), nan=1e12, posinf=1e12)


@dataclass(frozen=True, kw_only=True)
class SlidingDifferences:
    """Residuals of sliding segments (B) and their derivatives by S parameters and K directions of the states."""

    rows: Tensor
    """Residuals in sigmas, 0 where a rollout diverged, shape (B, R)."""
    chi2: Tensor
    """Chi-square of each segment, 1e12 where a rollout diverged, shape (B,)."""
    jacobian: Tensor
    """Derivatives by the parameters and along the columns of the basis, shape (B, R, S + K)."""
    basis: Tensor
    """Changes of state that keep the body on the ground, shape (B, 12, K)."""


def finite_differences(
    segments: Segments,
    parameters: Sequence[Parameter],
    values: Tensor,
    free: Tensor,
    loads: LoadErrors | None = None,
    at: Tensor | None = None,
) -> SlidingDifferences:
    """Return residuals of sliding segments with their derivatives by parameters and states.

    Args:
        segments: Sliding segments (B) with states.
        parameters: Parameters of their world (P).
        values: Of each segment (B, P), in fitted coordinates.
        free: Indices (B, S) of the parameters by which the first S derivatives are; -1 for a derivative of 0.
        loads: Model errors of the loads of the segments, where they are known.
        at: Values (S, B, P) at which each of these derivatives is; all leave the residuals of `values`, the default.
    """
    basis = _basis(segments)
    k, (n, size) = basis.shape[-1], free.shape
    steps = torch.tensor([PARAMETER_STEP * p.prior[1] for p in parameters]).to(values)
    still = torch.zeros(n, STATE_SIZE).to(values)
    changes, moves = [still], [values]
    for column in range(size):
        place = free[:, column, None].clamp_min(0)
        changes.append(still)
        start = values if at is None else at[column]
        moves.append(start.scatter_add(1, place, steps[place] * (free[:, column, None] >= 0)))
    changes += [sign * basis[..., j] for j in range(k) for sign in (1.0, -1.0)]
    moves += [values] * (2 * k)
    rows = segments.varied(parameters, torch.stack(moves), torch.stack(changes))
    rows = (LoadErrors.of(segments) if loads is None else loads).whitened(rows)
    chi2 = _chi2(rows[0])
    rows = torch.nan_to_num(rows.flatten(2), nan=0.0, posinf=0.0, neginf=0.0)
    by_value = (rows[1 : 1 + size] - rows[0]).movedim(0, -1) / steps[free.clamp_min(0)][:, None]
    by_state = 0.5 * (rows[1 + size :: 2] - rows[2 + size :: 2]).movedim(0, -1)
    return SlidingDifferences(rows=rows[0], chi2=chi2, jacobian=torch.cat((by_value, by_state), -1), basis=basis)


def _normals(segments: Segments) -> Tensor:
    """Return the ground's normal (3,), or of surfaces those in each frame (B, T, 3)."""
    carried = segments.observations.carried
    # the last of the directions has the largest moment
    return GroundPlane.of(segments.world).normal if carried is None else carried[:, :, 2]


def _in_body(quat_wxyz: Tensor, normal: Tensor) -> Tensor:
    """Return normals (3,) or (..., 3) in the axes of bodies (..., 4)."""
    inverse = quat_to_matrix(quat_wxyz).transpose(-1, -2)
    return inverse @ normal if normal.ndim == 1 else (inverse @ normal[..., None]).squeeze(-1)


def _basis(segments: Segments) -> Tensor:
    """Return the changes of state (B, 12, K) that keep the body on the ground, each as large as a difference step."""
    seen, world = segments.observations, segments.world
    index, count = seen.free[0], len(segments.items)
    normal = _normals(segments)
    if normal.ndim == 1:
        tangents = tangent_axes(normal)[1:].T  # (3, 2)
    else:
        assert seen.carried is not None
        carried = seen.carried[:, 0]
        size, axes = torch.linalg.eigh(torch.eye(3).to(carried) - carried.mT @ carried)
        tangents = (axes * (size > 0.5).to(axes)[:, None])[..., 1:]  # of a groove the first of them is zero
        normal = normal[:, 0]
    if is_round(world.bodies[index]):
        spins = torch.eye(3).to(normal).expand(count, 3, 3)
    else:
        spins = _in_body(seen.state.quat_wxyz[:, index], normal)[..., None]
    # the turns of a ball on fixed surfaces do not count
    turns = spins[..., :0] if is_round(world.bodies[index]) and seen.carried is not None else spins
    parts = [tangents.expand(count, 3, 2), turns, tangents.expand(count, 3, 2), spins]
    basis = torch.zeros(count, STATE_SIZE, sum(part.shape[-1] for part in parts)).to(normal)
    last = 0
    for k, (part, step) in enumerate(zip(parts, STATE_STEPS, strict=True)):
        first, last = last, last + part.shape[-1]
        basis[:, 3 * k : 3 * k + 3, first:last] = step * part
    return basis
