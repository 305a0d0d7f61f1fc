"""What a force field of any form would change in fitted flights, to first order, without a rollout of its own.

A force F and a torque T that act along the motion of a flight move the centre of mass by the double integral of F / m
and change the angular momentum, world axes, by the integral of T. The turn theta of the body frame follows from

    theta' = I^-1 (R^T dL - theta x L) - omega x theta

with all in body axes but dL (derived from L = R I omega; for equal moments the terms in theta cancel). So fields may
depend on time, place, velocity and spin in any way, and one costs as little as a sum over the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ...geometry.rotation import quat_to_matrix
from ...physics.body import Body
from ...physics.effects.effect import ActiveEffect, BodyMotion
from ..segments import Segments


class ForceField(NamedTuple):
    """Forces and torques per unit of K numbers, along the motion of flights (B, T)."""

    acceleration: Tensor
    """Of the centre of mass [m/s2], world, shape (B, T, 3, K)."""
    turning: Tensor
    """Torque over the inertia, that is angular acceleration of a body at rest [rad/s2], world, (B, T, 3, K)."""

    @property
    def size(self) -> int:
        """Number K of numbers."""
        return self.acceleration.shape[3]

    def times(self, factor: Tensor) -> ForceField:
        """Return the field times a factor (B, T)."""
        weight = factor[..., None, None]
        return ForceField(self.acceleration * weight, self.turning * weight)

    @staticmethod
    def joined(fields: Sequence[ForceField]) -> ForceField:
        """Return the numbers of several fields as those of one."""
        return ForceField(torch.cat([one[0] for one in fields], 3), torch.cat([one[1] for one in fields], 3))


@dataclass(frozen=True, eq=False)
class FlownMotion:
    """The motion of flights as their world and states have it, in double precision."""

    flight: Segments
    """Segments with fitted states, of one free body."""

    @cached_property
    def _rolled(self) -> tuple[Tensor, ...]:
        body, motion = self.flight.observations.free[0], self.flight.rollout()
        found = (motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s)
        return tuple(values[:, :, body].double() for values in found)

    @cached_property
    def body(self) -> Body:
        """The body, in double precision."""
        body = self.flight.world.bodies[self.flight.observations.free[0]]
        names = ("mass", "inertia", "com", "centers", "radii")
        return replace(body, **{name: getattr(body, name).double() for name in names})

    @cached_property
    def rotation(self) -> Tensor:
        """Rotations, body to world, shape (B, T, 3, 3)."""
        return quat_to_matrix(self._rolled[1])

    @cached_property
    def omega_body_rad_s(self) -> Tensor:
        """Angular velocity in body axes [rad/s], shape (B, T, 3)."""
        return self._rolled[3]

    @cached_property
    def omega_rad_s(self) -> Tensor:
        """Angular velocity in world axes [rad/s], shape (B, T, 3)."""
        return (self.rotation @ self._rolled[3][..., None])[..., 0]

    @cached_property
    def com_m(self) -> Tensor:
        """Centre of mass, world [m], shape (B, T, 3)."""
        return self._rolled[0] + self._arm

    @cached_property
    def velocity_m_s(self) -> Tensor:
        """Velocity of the centre of mass, world [m/s], shape (B, T, 3)."""
        return self._rolled[2] + torch.linalg.cross(self.omega_rad_s, self._arm)

    @property
    def _arm(self) -> Tensor:
        return (self.rotation @ self.body.com[:1, None, :, None])[..., 0]

    @cached_property
    def inside(self) -> Tensor:
        """Whether a frame is one of the flight, not padding, shape (B, T)."""
        place = torch.arange(self.times_s.shape[1])
        return place < torch.tensor(self.flight.lengths)[:, None]

    @property
    def times_s(self) -> Tensor:
        """Times of the frames [s], shape (B, T)."""
        return self.flight.observations.times_s.double()

    @cached_property
    def spans_s(self) -> tuple[Tensor, Tensor]:
        """Time since the first, and until the last frame in flight of the episode [s], each (B, T)."""
        times, episodes = self.times_s, [item.episode for item in self.flight.items]
        ends = [float(row[n - 1]) for row, n in zip(times, self.flight.lengths, strict=True)]
        begun = {k: min(float(row[0]) for row, e in zip(times, episodes, strict=True) if e == k) for k in episodes}
        ended = {k: max(end for end, e in zip(ends, episodes, strict=True) if e == k) for k in episodes}
        first, last = (torch.tensor([of[k] for k in episodes], dtype=torch.float64)[:, None] for of in (begun, ended))
        return times - first, last - times

    @property
    def axes(self) -> tuple[Tensor, Tensor]:
        """The axis against gravity, (3, 1), and two level ones, (3, 2)."""
        up = self.flight.world.up[0].double()
        first = torch.linalg.cross(up, torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())])
        first = first / first.norm()
        return up[:, None], torch.stack((first, torch.linalg.cross(up, first)), 1)

    def median(self, values: Tensor) -> float:
        """Return the median of values (B, T) over all frames of flight."""
        return float(values[self.inside].median())

    def field_of(self, active: ActiveEffect) -> ForceField | None:
        """Return the field of an effect with a wrench, by its parameters; None for any other effect."""
        if not active.effect.has("wrench"):
            return None
        motion, names = self._as_seen_by_effects(), [p.name for p in active.effect.parameters]
        known = {key: value[:1].double() for key, value in active.values.items()}
        fields = []
        for name in names:
            one = {key: torch.full_like(value, float(key == name)) for key, value in known.items() if key in names}
            wrench = active.effect.wrench({**known, **one}, motion)
            nothing = torch.zeros_like(motion.velocity)
            force = nothing if wrench.force is None else wrench.force / motion.mass[:, None]
            torque = nothing if wrench.torque is None else wrench.torque
            turning = torch.linalg.solve(motion.inertia, torque[..., None])[..., 0]
            shape = (*self.times_s.shape, 3, 1)
            fields.append(ForceField(force.reshape(shape), turning.reshape(shape)))
        return ForceField.joined(fields) if fields else None

    def _as_seen_by_effects(self) -> BodyMotion:
        """Return the motion of all frames as effects receive it, in the air as it flows, flattened to (B T)."""
        world, count = self.flight.world, self.times_s.numel()
        rotation, up = self.rotation.reshape(count, 3, 3), world.up.double()
        motion = BodyMotion(
            body=self.body,
            mass=self.body.mass[:1].expand(count),
            inertia=rotation @ self.body.inertia[:1] @ rotation.transpose(-1, -2),
            com=self.com_m.reshape(count, 3),
            rotation=rotation,
            velocity=self.velocity_m_s.reshape(count, 3),
            omega=self.omega_rad_s.reshape(count, 3),
            up=up[:1],
            normal=up[:1] if world.ground_normal is None else world.ground_normal[None].double(),
            ground_offset=None if world.ground_offset is None else world.ground_offset[:1].double(),
        )
        for active in world.effects:
            if active.effect.has("flow"):
                flow = active.effect.flow({key: value[:1].double() for key, value in active.values.items()}, motion)
                motion = replace(motion, air=flow if motion.air is None else motion.air + flow)
        return motion

    def innovations(self, field: ForceField) -> Tensor:
        """Return the change of the flights' innovations (B, F, 6, K), in sigmas, by the numbers of a field."""
        seen, noise = self.flight.observations, self.flight.noise
        turned = self._turned(field.turning) if bool(field.turning.any()) else torch.zeros_like(field.turning)
        arm = torch.linalg.cross(turned, self.body.com[0][None, None, :, None].expand_as(turned), dim=2)
        moved = self._integral(self._integral(field.acceleration)) - self.rotation @ arm
        weight = seen.seen[:, :, :1, None] * seen.measured_axes[:, None, 0, :, None]
        rows = (moved * weight / noise.position_m, turned * seen.has_orientation[:, :, :1, None] / noise.rotation_rad)
        return self.flight.innovations(torch.cat(rows, 2))

    def _integral(self, values: Tensor) -> Tensor:
        """Return the integral over time (B, T, 3, K), 0 at the first frame."""
        step = self.times_s.diff(dim=1)[..., None, None]
        sums = (0.5 * step * (values[:, 1:] + values[:, :-1])).cumsum(1)
        return torch.cat((torch.zeros_like(values[:, :1]), sums), 1)

    def _turned(self, turning: Tensor) -> Tensor:
        """Return the turn theta (B, T, 3, K) of the body frame, by the implicit trapezoidal rule."""
        inertia, omega = self.body.inertia[0], _crossing(self.omega_body_rad_s)
        inverse = torch.linalg.inv(inertia)
        momentum = _crossing(self.omega_body_rad_s @ inertia)
        matrix = inverse @ momentum - omega  # -theta x L = L x theta
        torque = self.rotation @ inertia @ self.rotation.transpose(-1, -2) @ turning
        driven = inverse @ self.rotation.transpose(-1, -2) @ self._integral(torque)
        half, unit = 0.5 * self.times_s.diff(dim=1)[..., None, None], torch.eye(3, dtype=torch.float64)
        found = [torch.zeros_like(driven[:, 0])]
        for k in range(half.shape[1]):
            known = found[-1] + half[:, k] * (matrix[:, k] @ found[-1] + driven[:, k] + driven[:, k + 1])
            found.append(torch.linalg.solve(unit - half[:, k] * matrix[:, k + 1], known))
        return torch.stack(found, 1)


def _crossing(vectors: Tensor) -> Tensor:
    """Return the matrices (..., 3, 3) that take cross products with vectors (..., 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
