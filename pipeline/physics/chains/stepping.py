"""The chains of a world in one step of the torch engine: free motion, rows, and motion after contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...geometry.rotation import cross, quat_conjugate, quat_rotate
from ..impulse_solver import Rows
from ..kinematic import Drive
from ..rigid_body import Motion
from ..state import State
from ..world import World
from .chain import Chain
from .dynamics import ChainDynamics, ChainMotion, Kick, LinkWrench, target_of
from .joint_command import JointCommand
from .joint_rows import JointRows
from .state import joints_of

if TYPE_CHECKING:
    from ....datasets.capture.tracks import Track


class ChainStepper:
    """A chain in a rollout: its motion and the impulses of its joints.

    Args:
        world: The world.
        chain: The chain.
        state: The state at the first time.
        driven: The commands.
    """

    def __init__(
        self, world: World, chain: Chain, state: State, driven: Mapping[str, Track | Drive | JointCommand]
    ) -> None:
        self.dynamics = ChainDynamics(chain, world.bodies)
        self.chain, self.gravity = chain, world.gravity
        self.root = self.dynamics.indices[0]
        like = state.position_m.detach()
        self.command = JointCommand.of(chain, driven, like)
        self.drive = Drive.command(chain.root, driven, like) if chain.base == "driven" else None
        self.values, self.speeds = joints_of(world, state, chain)
        self.kicked: Kick | None = None
        self.rows: JointRows | None = None
        self.ahead: Motion | None = None
        self.impulses: Tensor | None = None

    @property
    def tensors(self) -> list[Tensor]:
        """Tensors whose batch is that of the rollout."""
        command = [] if self.command is None else list(vars(self.command).values())
        drive = [] if self.drive is None else [self.drive.times_s]
        return [self.dynamics.mass, *self.dynamics.numbers.values(), *command, *drive]

    def commanded(self, driven: Mapping[str, Track | Drive | JointCommand]) -> None:
        """Replace the commands."""
        like = self.values.detach()
        self.command = JointCommand.of(self.chain, driven, like)
        if self.drive is not None:
            self.drive = Drive.command(self.chain.root, driven, like)

    def begin(self, state: State, time_s: Tensor, batch: int) -> list[Motion]:
        """Return the motions of the links at the first time."""
        position, quat, velocity = (x[:, self.root] for x in (state.position_m, state.quat_wxyz, state.velocity_m_s))
        omega = quat_rotate(quat, state.omega_body_rad_s[:, self.root])
        if self.drive is not None:
            root = self.drive.at(time_s)
            position, quat, velocity, omega = root.com, root.quat_wxyz, root.velocity, root.spin
        elif self.chain.base == "fixed":
            velocity, omega = torch.zeros_like(velocity), torch.zeros_like(omega)
        fields = (position, quat, velocity, omega, self.values, self.speeds)
        self.motion = ChainMotion(*(x.expand(batch, *x.shape[1:]) for x in fields))
        return self.dynamics.links(self.motion)

    def free(self, step_s: Tensor, time_after: Tensor, wrench: LinkWrench | None = None) -> list[Motion]:
        """Return the motions of the links after the forces of a step, without contact, at the poses of its start."""
        self.ahead = None
        if self.drive is not None:
            root = self.drive.at(time_after)
            self.ahead = Motion(*(x.expand(step_s.shape[0], *x.shape[1:]) for x in vars(root).values()))
        target = target_of(self.command, time_after)
        self.kicked = self.dynamics.kick(self.motion, step_s, self.gravity, target, self.ahead, wrench)
        self.rows = JointRows.of(self.dynamics, self.root, self.motion, self.kicked, step_s)
        return self.dynamics.links(self.dynamics.with_speed(self.motion, self.kicked.speed))

    def contact_rows(self, link: int, sign: float, arms: Tensor, axes: Tensor, items: Tensor | None = None) -> Rows:
        """Return the contact rows of a link of the chain, given by its place in `Chain.links`; see `Rows.of`."""
        assert self.kicked is not None
        each = self.kicked.rows[:, link] @ self.kicked.inverse_root.transpose(-1, -2)
        linear = sign * axes.flatten(1, 2) @ each[:, :3]
        turning = sign * cross(arms[:, :, None], axes).flatten(1, 2) @ each[:, 3:]
        branch = self.dynamics.indices[self.chain.branches[link]]
        return Rows(self.root, sign, linear + turning, each[:, 3:], linked=True, branch=branch)

    def after(self, wrenches: Mapping[int, tuple[Tensor, Tensor]], step_s: Tensor) -> list[Motion]:
        """Move the chain to the end of the step, and return the motions of the links there.

        Args:
            wrenches: By index of a link in the world: impulse (B, 3) [N s] and its moment (B, 3) [N m s] about the
                origin of the link's frame.
            step_s: Step [s], shape (B,).
        """
        assert self.kicked is not None and self.rows is not None
        moved = torch.zeros_like(self.kicked.speed)[..., None]
        for place, index in enumerate(self.dynamics.indices):
            if index in wrenches:
                wrench = torch.cat(wrenches[index], -1)[..., None]
                force = self.kicked.rows[:, place].transpose(-1, -2) @ wrench
                moved = moved + self.kicked.inverse_root @ force
        if self.impulses is not None:
            moved = moved + self.rows.motion(self.impulses)
        speed = self.kicked.speed + (self.kicked.inverse_root.transpose(-1, -2) @ moved).squeeze(-1)
        self.motion = self.dynamics.end(self.motion, speed, step_s, self.ahead)
        return self.dynamics.links(self.motion)


def chain_frame(motion: Motion) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return position, quaternion, velocity and omega_body of a link from its motion."""
    return motion.com, motion.quat_wxyz, motion.velocity, quat_rotate(quat_conjugate(motion.quat_wxyz), motion.spin)


def owners(steppers: Sequence[ChainStepper]) -> dict[int, tuple[ChainStepper, int]]:
    """Return for each link its chain and its place there, by index in the world."""
    return {index: (s, place) for s in steppers for place, index in enumerate(s.dynamics.indices)}
