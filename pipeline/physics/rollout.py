"""Rollouts: the world stepped through time, batched, from given initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .checks import require_physical, require_state
from .contacts import Contacts, PairImpulses
from .detection import Placed
from .driven import Drive
from .effects.effect import BodyMotion, changed_by_effects
from .motion import Inertia, Motion, advance, finish, start
from .records import ContactRecord, Recorder
from .rotation import quat_to_matrix
from .world import State, World

if TYPE_CHECKING:
    from ...datasets.tracks import Track


@dataclass(frozen=True)
class Rollout:
    """Poses and velocities at the frames: times_s (T,) or (B, T); the others (B, T, nb, ...) as in `State`."""

    times_s: Tensor
    position_m: Tensor
    quat_wxyz: Tensor
    velocity_m_s: Tensor
    omega_body_rad_s: Tensor
    contacts: ContactRecord | None = None


def simulate(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive] | None = None,
    record_contacts: bool = False,
) -> Rollout:
    """Roll the world out from `state`, open loop.

    Args:
        world: The world; its tensors and the state's broadcast over the batch B.
        state: The state at the first time; driven and fixed bodies take theirs from `driven` or keep it.
        times_s: Frame times [s], increasing, shape (T,) or (B, T).
        driven: The command of each driven body: a track, or a prepared `Drive`.
        record_contacts: Whether to keep the contacts of every frame.

    Returns:
        The rollout at the frame times.

    Raises:
        InputDataError: If a driven body has no track, the start is not finite, or masses, inertias, contact numbers or
            the step cannot be simulated.
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
    return Rollout(times_s, position, quat, velocity, omega, recorder.record() if recorder is not None else None)


class Engine:
    """The constants of one rollout, its step, and the contacts of the last step, from which the next begins."""

    def __init__(self, world: World, state: State, times_s: Tensor, driven: Mapping[str, Track | Drive]) -> None:
        world = self.world = changed_by_effects(world)
        if world.effects:
            require_physical(world)  # an effect may have made a body that cannot be
        self.inertias = [Inertia.of(body) for body in world.bodies]
        self.times = times_s if times_s.ndim == 2 else times_s[None]
        self.lengths = self.times.diff(dim=1)
        self.substeps = world.substeps(self.times)
        self.wrenches = [active for active in world.effects if active.effect.has("wrench")]
        self.flows = [active for active in world.effects if active.effect.has("flow")]
        self.drives = self._commands(driven, state.position_m.detach())
        self.batch = self._batch(state)
        self.contacts = Contacts(world, self.inertias)
        self.touched: list[PairImpulses] = []

    def _commands(self, driven: Mapping[str, Track | Drive], like: Tensor) -> dict[int, Drive]:
        bodies = enumerate(self.world.bodies)
        return {k: Drive.command(body.name, driven, like) for k, body in bodies if body.motion == "driven"}

    def _batch(self, state: State) -> int:
        """Return the size of the batch that all the tensors together have."""
        world = self.world
        numbers = [world.gravity, self.times, state.position_m, state.velocity_m_s, state.omega_body_rad_s]
        numbers += [getattr(world.contact, name) for name in vars(world.contact)] if world.bodies else []
        numbers += [world.ground_offset] + [value for active in world.effects for value in active.values.values()]
        numbers += [value for body in world.bodies for value in (body.mass, body.inertia, body.com, body.centers)]
        numbers += [drive.times_s for drive in self.drives.values()]
        return max(x.shape[0] for x in numbers if isinstance(x, torch.Tensor))

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
        return motions

    def commanded(self, motions: list[Motion], driven: Mapping[str, Track | Drive]) -> list[Motion]:
        """Take other commands from the first time on, and return the motions with driven bodies as they begin."""
        self.drives = self._commands(driven, motions[0].com)
        first = self.times[:, 0]
        return [self._whole(self.drives[k].at(first)) if k in self.drives else m for k, m in enumerate(motions)]

    def _whole(self, motion: Motion) -> Motion:
        """Return a motion with as many rows as the batch has."""
        return Motion(*(_expanded(x, self.batch) for x in vars(motion).values()))

    def step(self, motions: list[Motion], interval: int, substep: int) -> tuple[list[Motion], list[PairImpulses]]:
        """Return the motions after a sub-step of an interval (counted from 1), and what touched."""
        count = self.substeps[interval - 1]
        h = _expanded(self.lengths[:, interval - 1] / count, self.batch)
        rotations = [quat_to_matrix(m.quat_wxyz) for m in motions]
        # free velocities: gravity and wrenches act, contact does not yet
        ahead = [
            self._free(index, motion, rotations[index], h) if self.world.bodies[index].free else motion
            for index, motion in enumerate(motions)
        ]
        touched = self.contacts.resolve(self._place(ahead, rotations), h, self.touched)
        self.touched = touched
        velocity, spin = self._after(ahead, touched)
        moved = []
        for index, body in enumerate(self.world.bodies):
            if body.free:
                semi_implicit = self.world.contact.name == "published"
                inertia = self.inertias[index]
                moved.append(advance(inertia, motions[index], velocity[index], spin[index], h, semi_implicit))
            elif index in self.drives:
                time = self.times[:, interval - 1] + (substep + 1) * self.lengths[:, interval - 1] / count
                moved.append(self._whole(self.drives[index].at(time)))
            else:
                moved.append(motions[index])
        return moved, touched

    def _free(self, index: int, motion: Motion, rotation: Tensor, h: Tensor) -> Motion:
        velocity, spin = motion.velocity + h[:, None] * self.world.gravity, motion.spin
        if not self.wrenches:
            return replace(motion, velocity=velocity)
        inertia = self.inertias[index]
        seen = self._seen(index, motion, rotation)
        for active in self.wrenches:
            wrench = active.effect.wrench(active.values, seen)
            if wrench.force is not None:
                velocity = velocity + (h / inertia.mass)[:, None] * wrench.force
            if wrench.torque is not None:
                spin = spin + h[:, None] * wrench.torque
        return replace(motion, velocity=velocity, spin=spin)

    def loads(self, motions: Sequence[Motion]) -> dict[int, tuple[Tensor, Tensor]]:
        """Return what effects give each free body now: acceleration (B, 3) [m/s2], torque (B, 3) [N m], world frame."""
        found = {}
        for index, (body, motion) in enumerate(zip(self.world.bodies, motions, strict=True)):
            if body.free:
                one = torch.ones_like(motion.com[:, 0])
                after = self._free(index, motion, quat_to_matrix(motion.quat_wxyz), one)
                found[index] = after.velocity - motion.velocity - self.world.gravity, after.spin - motion.spin
        return found

    def _seen(self, index: int, motion: Motion, rotation: Tensor) -> BodyMotion:
        """Return what effects see of a free body."""
        body, inertia, world = self.world.bodies[index], self.inertias[index], self.world
        omega = inertia.omega(rotation, motion.spin)
        turned = rotation @ inertia.matrix @ rotation.transpose(-1, -2)
        up, offset = world.up, world.ground_offset
        normal = up if world.ground_normal is None else world.ground_normal[None]
        seen = BodyMotion(body, inertia.mass, turned, motion.com, rotation, motion.velocity, omega, up, normal, offset)
        for active in self.flows:
            flow = active.effect.flow(active.values, seen)
            seen = replace(seen, air=flow if seen.air is None else seen.air + flow)
        return seen

    def _place(self, motions: list[Motion], rotations: list[Tensor]) -> list[Placed]:
        placed = []
        for index, (body, motion, rotation) in enumerate(zip(self.world.bodies, motions, rotations, strict=True)):
            omega = self.inertias[index].omega(rotation, motion.spin) if body.free else motion.spin
            placed.append(Placed(body, motion.com, rotation, motion.velocity, omega))
        return placed

    def placed(self, motions: list[Motion]) -> list[Placed]:
        """Return the bodies where they are."""
        return self._place(motions, [quat_to_matrix(m.quat_wxyz) for m in motions])

    def _after(self, ahead: list[Motion], touched: list[PairImpulses]) -> tuple[list[Tensor], list[Tensor]]:
        """Return velocities and angular momenta after the impulses of contact."""
        velocity, spin = [m.velocity for m in ahead], [m.spin for m in ahead]
        for pair in touched:
            for index, (impulse, moment) in pair.on_bodies(ahead).items():
                velocity[index] = velocity[index] + impulse / self.inertias[index].mass[:, None]
                spin[index] = spin[index] + moment
        return velocity, spin

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
