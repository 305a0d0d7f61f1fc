"""Batched simulation of a world from given initial states, by the torch engine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...schemas import NotConvergedError
from ..geometry.rotation import quat_to_matrix
from .chains.dynamics import CentralMotion
from .chains.joint_command import JointCommand
from .chains.stepping import ChainStepper
from .checks import require_physical, require_state
from .contact_detection import Placed
from .contact_record import ContactRecord, Recorder
from .contact_solver import Contacts, PairImpulses
from .effects.effect import BodyMotion, changed_by_effects
from .kinematic import Drive
from .rigid_body import Inertia, Motion, advance, finish, start
from .state import State
from .world import World

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Track

_SHOWN_STARTS = 3
"""Maximum number of bodies whose start is in the message about a rollout that diverged."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Poses and velocities of all bodies at the frame times, in the order and frames of `State`."""

    times_s: Tensor
    """Frame times [s], shape (T,) or (B, T)."""
    position_m: Tensor
    """Origins of the body frames, world frame [m], shape (B, T, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, body to world, shape (B, T, nb, 4)."""
    velocity_m_s: Tensor
    """Velocities of the origins, world frame [m/s], shape (B, T, nb, 3)."""
    omega_body_rad_s: Tensor
    """Angular velocities, body frame [rad/s], shape (B, T, nb, 3)."""
    contacts: ContactRecord | None = None
    """Contact labels; None where they were not recorded."""


def simulate(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand] | None = None,
    record_contacts: bool = False,
) -> Rollout:
    """Simulate a world from an initial state, open loop.

    Args:
        world: The world; its tensors and the state's broadcast over the batch B.
        state: The state at the first time; driven and fixed bodies take theirs from `driven` or keep it.
        times_s: Frame times [s], increasing, shape (T,) or (B, T), or (b, T) of a batch in which b rows repeat.
        driven: The command of each driven body: a track, or a prepared `Drive`; of the servos of a chain, under the
            name of the chain: a `JointCommand`.
        record_contacts: Whether to keep the contacts of every frame.

    Returns:
        The rollout at the frame times.

    Raises:
        InputDataError: If a driven body has no track, the start is not finite, or masses, inertias, contact
            coefficients or the step cannot be simulated.
        UsageError: If an effect needs what the world or the other effects lack, or the contact law cannot take it.
    """
    require_physical(world)
    require_state(state, world.body_names)
    engine = Engine(world, state, times_s, driven or {})
    motions = engine.begin(state)
    frames = [engine.frame(motions)]
    recorder = Recorder(engine.world, engine.placed(motions)) if record_contacts else None
    for interval in range(1, times_s.shape[-1]):
        for substep in range(engine.substeps[interval - 1]):
            motions, touched = engine.step(motions, interval, substep)
            if recorder is not None:
                recorder.add(touched)
        frames.append(engine.frame(motions))
        if recorder is not None:
            recorder.close_frame(engine.placed(motions))
    position, quat, velocity, omega = (torch.stack([frame[k] for frame in frames], 1) for k in range(4))
    return Rollout(
        times_s=times_s,
        position_m=position,
        quat_wxyz=quat,
        velocity_m_s=velocity,
        omega_body_rad_s=omega,
        contacts=recorder.record() if recorder is not None else None,
    )


def rows_of_times(times_s: Tensor, count: int) -> Tensor:
    """Return times (T,), (B, T) or (b, T) as rows (1 or B, T), those of a batch (count) in which b rows repeat."""
    rows = times_s if times_s.ndim == 2 else times_s[None]
    return rows.repeat(count // len(rows), 1) if 1 < len(rows) < count else rows


class Engine:
    """Time stepper of one rollout: its constants, and the contacts of the last step, which warm-start the next.

    Args:
        world: The world.
        state: The state at the first time.
        times_s: Frame times [s], shape (T,) or (B, T).
        driven: The command of each driven body.
    """

    def __init__(
        self, world: World, state: State, times_s: Tensor, driven: Mapping[str, Track | Drive | JointCommand]
    ) -> None:
        world = self.world = changed_by_effects(world)
        if world.effects:
            require_physical(world)  # an effect may have made a body that cannot be
        self.inertias = [Inertia.of(body) for body in world.bodies]
        self.times = rows_of_times(times_s, len(state.position_m))
        self.lengths = self.times.diff(dim=1)
        self.substeps = world.substeps(self.times)
        self.wrenches = [active for active in world.effects if active.effect.has("wrench")]
        self.flows = [active for active in world.effects if active.effect.has("flow")]
        self.drives = self._commands(driven, state.position_m.detach())
        self.chains = [ChainStepper(world, chain, state, driven) for chain in world.chains]
        self.batch = self._batch(state)
        self.contacts = Contacts(world, self.inertias, self.chains)
        self.touched: list[PairImpulses] = []

    def _commands(self, driven: Mapping[str, Track | Drive | JointCommand], like: Tensor) -> dict[int, Drive]:
        bodies = enumerate(self.world.bodies)
        return {k: Drive.command(body.name, driven, like) for k, body in bodies if body.motion == "driven"}

    def _batch(self, state: State) -> int:
        """Return the batch size common to all tensors."""
        world = self.world
        tensors = [world.gravity, self.times, state.position_m, state.velocity_m_s, state.omega_body_rad_s]
        tensors += [value for law in world.laws for value in vars(law).values()] if world.bodies else []
        tensors += [world.ground_offset] + [value for active in world.effects for value in active.values.values()]
        tensors += [value for body in world.bodies for value in (body.mass, body.inertia, body.com, body.centers)]
        tensors += [drive.times_s for drive in self.drives.values()]
        tensors += [value for surface in world.surfaces for value in surface.tensors]
        tensors += [x for chain in self.chains for x in chain.tensors]
        return max(x.shape[0] for x in tensors if isinstance(x, torch.Tensor))

    def begin(self, state: State) -> list[Motion]:
        """Return the motions of the bodies at the first time."""
        motions = []
        for index, body in enumerate(self.world.bodies):
            position, quat, velocity = (x[:, index] for x in (state.position_m, state.quat_wxyz, state.velocity_m_s))
            if index in self.drives:
                motion = self.drives[index].at(self.times[:, 0])
            elif body.free:
                motion = start(body, position, quat, velocity, state.omega_body_rad_s[:, index])
            else:
                motion = Motion(position, quat, torch.zeros_like(position), torch.zeros_like(position))
            motions.append(self._whole(motion))
        for chain in self.chains:
            for index, motion in zip(
                chain.dynamics.indices, chain.begin(state, self.times[:, 0], self.batch), strict=True
            ):
                motions[index] = self._whole(motion)
        return motions

    def commanded(self, motions: list[Motion], driven: Mapping[str, Track | Drive | JointCommand]) -> list[Motion]:
        """Replace the commands, and return the motions with driven bodies at the start of the new ones."""
        self.drives = self._commands(driven, motions[0].com)
        first = self.times[:, 0]
        for chain in self.chains:
            chain.commanded(driven)
        return [self._whole(self.drives[k].at(first)) if k in self.drives else m for k, m in enumerate(motions)]

    def _whole(self, motion: Motion) -> Motion:
        """Return a motion expanded to the size of the batch."""
        return Motion(*(_expanded(x, self.batch) for x in vars(motion).values()))

    def step(self, motions: list[Motion], interval: int, substep: int) -> tuple[list[Motion], list[PairImpulses]]:
        """Return the motions after a sub-step of an interval (counted from 1), and the impulses of the contacts."""
        count = self.substeps[interval - 1]
        h = _expanded(self.lengths[:, interval - 1] / count, self.batch)
        rotations = [quat_to_matrix(m.quat_wxyz) for m in motions]
        # free velocities: gravity and wrenches act, contact does not yet
        ahead = [
            self._free(index, motion, rotations[index], h) if self.world.bodies[index].free else motion
            for index, motion in enumerate(motions)
        ]
        time = self.times[:, interval - 1] + (substep + 1) * self.lengths[:, interval - 1] / count
        for chain in self.chains:
            wrench = self._on_link if self.wrenches else None
            for index, motion in zip(chain.dynamics.indices, chain.free(h, time, wrench), strict=True):
                ahead[index] = self._whole(motion)
        touched = self.contacts.resolve(self._place(ahead, rotations), h, self.touched)
        self.touched = touched
        velocity, spin, wrenches = self._after(ahead, touched)
        moved = []
        for index, body in enumerate(self.world.bodies):
            if body.free:
                semi_implicit = self.world.contact.name == "published"
                inertia = self.inertias[index]
                moved.append(advance(inertia, motions[index], velocity[index], spin[index], h, semi_implicit))
            elif index in self.drives:
                moved.append(self._whole(self.drives[index].at(time)))
            else:
                moved.append(motions[index])
        for chain in self.chains:
            for index, motion in zip(chain.dynamics.indices, chain.after(wrenches, h), strict=True):
                moved[index] = self._whole(motion)
        return moved, touched

    def _free(self, index: int, motion: Motion, rotation: Tensor, h: Tensor) -> Motion:
        velocity, spin = motion.velocity + h[:, None] * self.world.gravity, motion.spin
        if not self.wrenches:
            return replace(motion, velocity=velocity)
        inertia = self.inertias[index]
        omega = inertia.omega(rotation, motion.spin)
        current = self._body_motion(index, CentralMotion(motion.com, rotation, motion.velocity, omega))
        for active in self.wrenches:
            wrench = active.effect.wrench(active.values, current)
            if wrench.force is not None:
                velocity = velocity + (h / inertia.mass)[:, None] * wrench.force
            if wrench.torque is not None:
                spin = spin + h[:, None] * wrench.torque
        return replace(motion, velocity=velocity, spin=spin)

    def _on_link(self, index: int, link: CentralMotion) -> tuple[Tensor, Tensor]:
        """Return what all effects do to a link: force (B, 3) [N] and torque (B, 3) [N m] about its centre of mass."""
        force, torque = torch.zeros_like(link.velocity), torch.zeros_like(link.velocity)
        current = self._body_motion(index, link)
        for active in self.wrenches:
            wrench = active.effect.wrench(active.values, current)
            force = force if wrench.force is None else force + wrench.force
            torque = torque if wrench.torque is None else torque + wrench.torque
        return force, torque

    def loads(self, motions: Sequence[Motion]) -> dict[int, tuple[Tensor, Tensor]]:
        """Return the effect on each free body now: acceleration (B, 3) [m/s2] and torque (B, 3) [N m], world frame."""
        found = {}
        for index, (body, motion) in enumerate(zip(self.world.bodies, motions, strict=True)):
            if body.free:
                one = torch.ones_like(motion.com[:, 0])
                after = self._free(index, motion, quat_to_matrix(motion.quat_wxyz), one)
                found[index] = after.velocity - motion.velocity - self.world.gravity, after.spin - motion.spin
        return found

    def _body_motion(self, index: int, motion: CentralMotion) -> BodyMotion:
        """Return the motion of a free body or link as effects receive it."""
        body, inertia, world = self.world.bodies[index], self.inertias[index], self.world
        turned = motion.rotation @ inertia.matrix @ motion.rotation.transpose(-1, -2)
        up, offset = world.up, world.ground_offset
        normal = up if world.ground_normal is None else world.ground_normal[None]
        current = BodyMotion(
            body=body,
            mass=inertia.mass,
            inertia=turned,
            com=motion.com,
            rotation=motion.rotation,
            velocity=motion.velocity,
            omega=motion.omega,
            up=up,
            normal=normal,
            ground_offset=offset,
        )
        for active in self.flows:
            flow = active.effect.flow(active.values, current)
            current = replace(current, air=flow if current.air is None else current.air + flow)
        return current

    def _place(self, motions: list[Motion], rotations: list[Tensor]) -> list[Placed]:
        placed = []
        for index, (body, motion, rotation) in enumerate(zip(self.world.bodies, motions, rotations, strict=True)):
            omega = self.inertias[index].omega(rotation, motion.spin) if body.free else motion.spin
            placed.append(
                Placed(body=body, reference=motion.com, rotation=rotation, velocity=motion.velocity, omega=omega)
            )
        return placed

    def placed(self, motions: list[Motion]) -> list[Placed]:
        """Return the bodies at their current poses."""
        return self._place(motions, [quat_to_matrix(m.quat_wxyz) for m in motions])

    def _after(
        self, ahead: list[Motion], touched: list[PairImpulses]
    ) -> tuple[list[Tensor], list[Tensor], dict[int, tuple[Tensor, Tensor]]]:
        """Return velocities and angular momenta after the impulses of contact, and what acts on links of chains."""
        velocity, spin = [m.velocity for m in ahead], [m.spin for m in ahead]
        wrenches: dict[int, tuple[Tensor, Tensor]] = {}
        for pair in touched:
            for index, (impulse, moment) in pair.on_bodies(ahead).items():
                if not self.world.bodies[index].free:
                    old = wrenches.get(index, (0.0, 0.0))
                    wrenches[index] = (impulse + old[0], moment + old[1])
                    continue
                velocity[index] = velocity[index] + impulse / self.inertias[index].mass[:, None]
                spin[index] = spin[index] + moment
        return velocity, spin, wrenches

    def frame(self, motions: list[Motion]) -> tuple[Tensor, ...]:
        """Return the fields of the `State` (B, nb, ...) of the motions."""
        columns = []
        for index, (body, motion) in enumerate(zip(self.world.bodies, motions, strict=True)):
            if body.free:
                columns.append(finish(body, self.inertias[index], motion))
            else:
                omega = (quat_to_matrix(motion.quat_wxyz).transpose(-1, -2) @ motion.spin[..., None]).squeeze(-1)
                columns.append((motion.com, motion.quat_wxyz, motion.velocity, omega))
        return tuple(torch.stack([column[k] for column in columns], 1) for k in range(4))


def _expanded(x: Tensor, batch: int) -> Tensor:
    return x if x.shape[0] == batch else x.expand(batch, *x.shape[1:])


def require_finite(
    rollout: Rollout, world: World, state: State, names: Sequence[str] = (), frames: Sequence[int] = ()
) -> None:
    """Check that a rollout stayed finite; the error has the initial state, so that it can be replayed.

    Args:
        rollout: The rollout.
        world: The world that was simulated.
        state: The initial state.
        names: Names of the environments in messages; their numbers where left out.
        frames: Number of frames of each environment to check; all where left out.

    Raises:
        NotConvergedError: If a state is not finite, with the environment, the step, and the start of the bodies whose
            state is not.
    """
    poses = torch.cat((rollout.position_m, rollout.quat_wxyz, rollout.velocity_m_s, rollout.omega_body_rad_s), -1)
    finite = torch.isfinite(poses).flatten(2).all(-1)
    for item, count in enumerate(frames):
        finite[item, count:] = True
    wrong = (~finite).nonzero()
    if not len(wrong):
        return
    item, frame = (int(k) for k in wrong[0])
    times = rollout.times_s if rollout.times_s.ndim == 1 else rollout.times_s[min(item, len(rollout.times_s) - 1)]
    since = float(times[frame] - times[0])
    lost = (~torch.isfinite(poses[item, frame]).all(-1)).nonzero()[:_SHOWN_STARTS, 0].tolist()
    began = _start(state, world.body_names, item, lost)
    raise NotConvergedError(
        f"{names[item] if names else f'environment {item}'} diverged by step {math.ceil(since / world.step_s - 1e-6)}, "
        f"{since:.4g} s after its start: its state is not finite. Its start: {began}.",
        todo="fit again with a smaller step (--set phys-geo.step_s=...), or check masses, units and the sampling plan.",
    )


def _start(state: State, names: Sequence[str], item: int, bodies: Sequence[int]) -> str:
    """Return the state of some bodies of one environment as JSON, with all digits."""
    fields = {key: getattr(state, key) for key in State.__dataclass_fields__}
    found = {
        names[index]: {key: values[min(item, len(values) - 1), index].tolist() for key, values in fields.items()}
        for index in bodies
    }
    return json.dumps(found)
