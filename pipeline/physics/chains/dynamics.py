"""Motion of a chain over one step: drift half a step, kick, drift half a step, in the chain's generalised velocity.

The generalised velocity v is that of the root (free base: its origin's velocity and its angular velocity, world axes)
and the speeds of the joints. With q half-way through the step, M(q) the mass matrix, b(q, v) the Coriolis, centrifugal
and gravity forces, and servos that are implicit in the step (derived; Featherstone, "Rigid Body Dynamics Algorithms",
2008, for M and b in world axes about one point):

    A v' = (M + I) v + h (k (q_cmd - q) - b(q, (v + v*) / 2)),   A = M + diag(I + h d + h^2 k)

Forces of effects on the links are part of b. v* is the same with b(q, v): the scheme is of second order, and without
servos it keeps the energy to that order. A servo at its torque limit pushes with that limit and has no h^2 k. Contacts
and the joints' rows, which are those of v times A^(-1/2), then change v' to v+, and q goes on by h (v + v+) / 2, as in
`rigid_body.advance`. Links without mass
make A diagonal: a geared hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...geometry.rotation import cross, quat_exp, quat_multiply, quat_normalize, quat_to_matrix
from ..body import Body
from ..rigid_body import Motion
from .chain import Chain, link_velocities
from .joint_command import JointCommand


@dataclass(frozen=True)
class ChainMotion:
    """Motion of a chain at one time, world frame."""

    position: Tensor
    """Origin of the root's frame [m], shape (B, 3)."""
    quat_wxyz: Tensor
    """Orientation of the root, shape (B, 4)."""
    velocity: Tensor
    """Velocity of the root's origin [m/s], shape (B, 3)."""
    omega: Tensor
    """Angular velocity of the root [rad/s], shape (B, 3)."""
    values: Tensor
    """Values of the moving joints [rad or m], shape (B, joints)."""
    speeds: Tensor
    """Speeds of the moving joints [rad/s or m/s], shape (B, joints)."""


@dataclass(frozen=True)
class Kick:
    """What the forces of a step do to a chain before contact: its generalised velocity, and the roots of A."""

    speed: Tensor
    """Generalised velocity without contact, shape (B, nv)."""
    inverse_root: Tensor
    """Inverse of the Cholesky factor L of A = L L^T, shape (B, nv, nv)."""
    rows: Tensor
    """Velocity of each link's origin and its angular velocity by generalised velocity, shape (B, L, 6, nv)."""


@dataclass(frozen=True, kw_only=True)
class Balance:
    """Terms of the equation of motion of a chain: mass v' + bias = the generalised forces on it."""

    mass: Tensor
    """Mass matrix with reflected inertias, shape (B, nv, nv)."""
    bias: Tensor
    """Forces that keep the generalised velocity: Coriolis, centrifugal, and against gravity, shape (B, nv)."""
    rows: Tensor
    """Velocity of each link's origin and its angular velocity by generalised velocity, shape (B, L, 6, nv)."""
    origin: Tensor
    """Origins of the links, world frame [m], shape (B, L, 3)."""


@dataclass(frozen=True)
class CentralMotion:
    """Motion of a body about its centre of mass, world frame, by which effects push it."""

    com: Tensor
    """Centre of mass [m], shape (B, 3)."""
    rotation: Tensor
    """Rotation, body to world, shape (B, 3, 3)."""
    velocity: Tensor
    """Velocity of the centre of mass [m/s], shape (B, 3)."""
    omega: Tensor
    """Angular velocity [rad/s], shape (B, 3)."""


LinkWrench = Callable[[int, CentralMotion], tuple[Tensor, Tensor]]
"""Force [N] through the centre of mass and torque [N m] about it, each (B, 3), on a link given by its index in the
world."""


class ChainDynamics:
    """Equations of motion of a chain.

    Args:
        chain: The chain.
        bodies: The bodies of the world.
    """

    def __init__(self, chain: Chain, bodies: Sequence[Body]) -> None:
        named = {body.name: k for k, body in enumerate(bodies)}
        self.chain = chain
        self.indices = [named[name] for name in chain.links]
        self.free = chain.base == "free"
        links = [bodies[k] for k in self.indices]
        self.mass = _stacked([link.mass for link in links])
        self.inertia = _stacked([link.inertia for link in links])
        self.com = _stacked([link.com for link in links])
        like = links[0].mass
        self.above = torch.tensor(chain.above, dtype=like.dtype, device=like.device).reshape(len(links), -1)
        names = ("stiffness", "damping", "armature", "friction", "torque_limit", "lower", "upper")
        moving = bool(chain.moving)
        self.numbers = {k: chain.numbers(k) if moving else like.new_zeros(1, 0) for k in names}
        self.axes = torch.cat([j.axis for j in chain.moving]) if moving else like.new_zeros(0, 3)
        self.hinge = torch.tensor([j.kind == "hinge" for j in chain.moving], dtype=torch.bool, device=like.device)
        self.carrier = [self.chain.columns.index(c) for c in range(len(chain.moving))]

    @property
    def base_size(self) -> int:
        """Number of coordinates of the base in the generalised velocity."""
        return 6 if self.free else 0

    def generalised(self, motion: ChainMotion) -> Tensor:
        """Return the generalised velocity (B, nv)."""
        if not self.free:
            return motion.speeds
        return torch.cat((motion.velocity, motion.omega, motion.speeds), -1)

    def drift(self, motion: ChainMotion, step_s: Tensor) -> ChainMotion:
        """Return the motion after its velocity acted for `step_s` (B,); a base that is not free stays."""
        h = step_s[:, None]
        values = motion.values + h * motion.speeds
        if not self.free:
            return replace(motion, values=values)
        quat = quat_normalize(quat_multiply(quat_exp(h * motion.omega), motion.quat_wxyz))
        return replace(motion, position=motion.position + h * motion.velocity, quat_wxyz=quat, values=values)

    def with_speed(self, motion: ChainMotion, speed: Tensor) -> ChainMotion:
        """Return the motion with another generalised velocity (B, nv)."""
        if not self.free:
            return replace(motion, speeds=speed)
        return replace(motion, velocity=speed[:, :3], omega=speed[:, 3:6], speeds=speed[:, 6:])

    def links(self, motion: ChainMotion) -> list[Motion]:
        """Return the motions of the links, those of their frames' origins; the spin is the angular velocity."""
        position, quat = self.chain.poses(motion.position, motion.quat_wxyz, motion.values)
        root = (motion.velocity, motion.omega)
        linear, omega = link_velocities(self.chain, position, quat, root, motion.speeds)
        return [Motion(*(x[:, k] for x in (position, quat, linear, omega))) for k in range(len(self.indices))]

    def kick(
        self,
        motion: ChainMotion,
        step_s: Tensor,
        gravity: Tensor,
        target: Tensor | None,
        ahead: Motion | None,
        wrench: LinkWrench | None = None,
    ) -> Kick:
        """Return the generalised velocity after the forces of a step, without contact.

        Args:
            motion: The motion at the start of the step.
            step_s: Step h [s], shape (B,).
            gravity: Gravitational acceleration [m/s2], shape (1 or B, 3).
            target: Targets of the servos at the end of the step [rad or m], shape (B, joints); None for none.
            ahead: Motion of a driven root at the end of the step; None for another base.
            wrench: What effects do to the links; None for nothing.
        """
        h = step_s[:, None]
        half = self.drift(motion, 0.5 * step_s)
        if ahead is not None:  # the root goes on with its command
            quat = quat_normalize(quat_multiply(quat_exp(0.5 * h * motion.omega), motion.quat_wxyz))
            half = replace(half, position=motion.position + 0.5 * h * motion.velocity, quat_wxyz=quat)
        place = _Place.of(self, half)
        k, d, armature = (self.numbers[name] for name in ("stiffness", "damping", "armature"))
        own, force = armature + h * d, torch.zeros_like(motion.values)
        if target is not None:
            limit = self.numbers["torque_limit"]
            error = target - motion.values
            wanted = k * error
            pushed = wanted - h * k * motion.speeds
            limited = pushed.abs() > limit
            own = own + torch.where(limited, torch.zeros_like(h * k), h.square() * k)
            force = torch.where(limited, pushed.detach().sign() * limit, wanted)
        mass = place.mass_matrix()
        nv, base = mass.shape[-1], self.base_size
        extra = torch.zeros(mass.shape[0], nv, dtype=mass.dtype, device=mass.device)
        batch = mass.shape[0]
        extra = torch.cat((extra[:, :base], own.expand(batch, -1)), -1)
        root = torch.linalg.cholesky(mass + torch.diag_embed(extra))
        inverse_root = torch.linalg.inv(root)
        speed = self.generalised(motion)
        still = torch.cat((torch.zeros_like(speed[:, :base]), armature.expand(batch, -1)), -1)
        push = torch.cat((torch.zeros_like(speed[:, :base]), force.expand(batch, -1)), -1)
        kept = (mass @ speed[..., None]).squeeze(-1) + still * speed + h * push
        acceleration = _base_acceleration(motion, ahead, h)

        def after(mean: Tensor) -> Tensor:
            at = self.with_speed(half, mean)
            bias = place.bias(at, gravity, acceleration)
            if wrench is not None:
                bias = bias - place.pushed(at, wrench)
            right = inverse_root @ (kept - h * bias)[..., None]
            return (inverse_root.transpose(-1, -2) @ right).squeeze(-1)

        first = after(speed)
        found = after(0.5 * (speed + first))
        now = _Place.of(self, motion)
        return Kick(found, inverse_root, now.rows())

    def balance(self, motion: ChainMotion, gravity: Tensor) -> Balance:
        """Return the terms of the equation of motion at a motion; gravity [m/s2] of shape (1 or B, 3)."""
        place = _Place.of(self, motion)
        still = motion.speeds.new_zeros(self.base_size)
        own = torch.cat((still, self.numbers["armature"][0]))
        mass = place.mass_matrix() + torch.diag(own)
        origin = place.origin + motion.position[:, None]
        return Balance(mass=mass, bias=place.bias(motion, gravity, None), rows=place.rows(), origin=origin)

    def end(self, motion: ChainMotion, speed: Tensor, step_s: Tensor, ahead: Motion | None) -> ChainMotion:
        """Return the motion at the end of a step, given the generalised velocity there."""
        middle = self.with_speed(self.drift(motion, 0.5 * step_s), speed)
        done = self.drift(middle, 0.5 * step_s)
        if ahead is not None:
            return replace(
                done, position=ahead.com, quat_wxyz=ahead.quat_wxyz, velocity=ahead.velocity, omega=ahead.spin
            )
        return done

    def energy(self, motion: ChainMotion, gravity: Tensor) -> Tensor:
        """Return the kinetic and potential energy (B,) [J], without that of servos."""
        place = _Place.of(self, motion)
        speed = self.generalised(motion)
        mass = place.mass_matrix() + torch.diag_embed(
            torch.cat(
                (torch.zeros_like(speed[:, : self.base_size]), self.numbers["armature"].expand_as(motion.speeds)), -1
            )
        )
        kinetic = 0.5 * (speed * (mass @ speed[..., None]).squeeze(-1)).sum(-1)
        heights = motion.position[:, None] + place.com
        return kinetic - (self.mass * (heights * gravity[:, None]).sum(-1)).sum(-1)


def _stacked(values: list[Tensor]) -> Tensor:
    batch = max(value.shape[0] for value in values)
    return torch.stack([value.expand(batch, *value.shape[1:]) for value in values], 1)


def _base_acceleration(motion: ChainMotion, ahead: Motion | None, h: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the accelerations (B, 3) of a driven root over a step; None for another base."""
    if ahead is None:
        return None
    return (ahead.velocity - motion.velocity) / h, (ahead.spin - motion.omega) / h


@dataclass(frozen=True)
class _Place:
    """A chain at a configuration: world axes, spatial vectors (angular, linear) about the root's origin."""

    dynamics: ChainDynamics
    origin: Tensor
    """Origins of the links, shape (B, L, 3)."""
    rotation: Tensor
    """Rotations of the links, shape (B, L, 3, 3)."""
    com: Tensor
    """Centres of mass of the links, shape (B, L, 3)."""
    inertia: Tensor
    """Inertias of the links about their centres of mass, shape (B, L, 3, 3)."""
    joints: Tensor
    """Motion by joint speed, shape (B, joints, 6)."""

    @staticmethod
    def of(dynamics: ChainDynamics, motion: ChainMotion) -> _Place:
        position, quat = dynamics.chain.poses(motion.position, motion.quat_wxyz, motion.values)
        rotation = quat_to_matrix(quat)
        origin = position - motion.position[:, None]
        com = origin + (rotation @ dynamics.com[..., None]).squeeze(-1)
        inertia = rotation @ dynamics.inertia @ rotation.transpose(-1, -2)
        axes = (rotation[:, dynamics.carrier] @ dynamics.axes[..., None]).squeeze(-1)
        at = origin[:, dynamics.carrier]
        turning = torch.cat((axes, cross(at, axes)), -1)
        sliding = torch.cat((torch.zeros_like(axes), axes), -1)
        joints = torch.where(dynamics.hinge[:, None], turning, sliding)
        return _Place(dynamics, origin, rotation, com, inertia, joints)

    def columns(self) -> Tensor:
        """Return the motion of each link by generalised velocity, about the root's origin, shape (B, L, 6, nv)."""
        joints = self.dynamics.above[None, :, :, None] * self.joints[:, None]
        columns = joints.transpose(-1, -2)
        if not self.dynamics.free:
            return columns
        eye = torch.eye(3, dtype=columns.dtype, device=columns.device)
        zero = torch.zeros_like(eye)
        base = torch.cat((torch.cat((zero, eye), 1), torch.cat((eye, zero), 1)), 0)
        return torch.cat((base.expand(*columns.shape[:2], 6, 6), columns), -1)

    def rows(self) -> Tensor:
        """Return the velocity of each link's origin and its angular velocity by generalised velocity (B, L, 6, nv)."""
        turning, moving = self.columns().split(3, -2)
        arm = self.origin[..., None].expand_as(turning)
        moved = moving + torch.linalg.cross(turning, arm, dim=-2)
        return torch.cat((moved, turning), -2)

    def momentum(self, turning: Tensor, moving: Tensor) -> tuple[Tensor, Tensor]:
        """Return angular (about the root's origin) and linear momentum of the links from their motion (B, L, 3, n)."""
        com = self.com[..., None].expand_as(turning)
        linear = self.dynamics.mass[..., None, None] * (moving + torch.linalg.cross(turning, com, dim=-2))
        return self.inertia @ turning + torch.linalg.cross(com, linear, dim=-2), linear

    def mass_matrix(self) -> Tensor:
        """Return M (B, nv, nv)."""
        columns = self.columns()
        momentum = torch.cat(self.momentum(*columns.split(3, -2)), -2)
        return (columns.transpose(-1, -2) @ momentum).sum(1)

    def velocities(self, motion: ChainMotion) -> Tensor:
        """Return the motions (B, L, 6) of the links about the root's origin at this configuration."""
        own = self.joints * motion.speeds[..., None]
        root = torch.cat((motion.omega, motion.velocity), -1)[:, None]
        return root + (self.dynamics.above[None, :, :, None] * own[:, None]).sum(2)

    def pushed(self, motion: ChainMotion, wrench: LinkWrench) -> Tensor:
        """Return the generalised forces (B, nv) of effects on the links at this configuration."""
        turning, moving = self.velocities(motion).split(3, -1)
        moved = moving + cross(turning, self.com)
        both = []
        for place, index in enumerate(self.dynamics.indices):
            com = motion.position + self.com[:, place]
            link = CentralMotion(com, self.rotation[:, place], moved[:, place], turning[:, place])
            force, torque = wrench(index, link)
            both.append(torch.cat((torque + cross(self.com[:, place], force), force), -1))
        columns = self.columns().transpose(-1, -2)
        return (columns @ torch.stack(both, 1)[..., None]).sum((1, 3))

    def bias(self, motion: ChainMotion, gravity: Tensor, driven: tuple[Tensor, Tensor] | None) -> Tensor:
        """Return the forces b (B, nv) that keep the generalised velocity: Coriolis, centrifugal, and against gravity.

        Args:
            motion: The motion whose velocities count, at this configuration.
            gravity: Gravitational acceleration, shape (1 or B, 3).
            driven: Linear and angular acceleration of a driven root; None for another base.
        """
        above, joints = self.dynamics.above, self.joints
        own = joints * motion.speeds[..., None]
        velocity = self.velocities(motion)
        carried = velocity[:, self.dynamics.carrier]
        turning = cross(carried[..., :3], own[..., :3])
        moving = cross(carried[..., :3], own[..., 3:]) + cross(carried[..., 3:], own[..., :3])
        change = (above[None, :, :, None] * torch.cat((turning, moving), -1)[:, None]).sum(2)
        lift = -gravity - cross(motion.omega, motion.velocity)  # the root's origin moves: its own acceleration is 0
        twist = torch.zeros_like(lift)
        if driven is not None:
            lift, twist = lift + driven[0], driven[1]
        change = change + torch.cat((twist.expand_as(lift), lift), -1)[:, None]
        spin, moved = self.momentum(velocity[..., :3, None], velocity[..., 3:, None])
        spin, moved = spin.squeeze(-1), moved.squeeze(-1)
        torque, force = self.momentum(change[..., :3, None], change[..., 3:, None])
        torque = torque.squeeze(-1) + cross(velocity[..., :3], spin) + cross(velocity[..., 3:], moved)
        force = force.squeeze(-1) + cross(velocity[..., :3], moved)
        both = torch.cat((torque, force), -1)[..., None]
        return (self.columns().transpose(-1, -2) @ both).sum((1, 3))


def target_of(command: JointCommand | None, time_s: Tensor) -> Tensor | None:
    """Return the targets (B, joints) of a command at times (B,); None without a command."""
    return None if command is None else command.at(time_s)
