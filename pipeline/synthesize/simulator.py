"""Simulation of batches of rollouts with individual parameters, each independent of the rest of the batch.

On a CUDA device the fused kernel simulates them together. Its environments are independent, but the last bits of the
result depend on the number of environments (threads per environment, library routines for small matrices), so each call
has the same number, filled up with copies. The torch engine adds the contacts of an environment in an order that
depends on the others, so it simulates one rollout after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from ...datasets.models.model import Model
from ...datasets.rollouts.rollouts import ContactTable
from ...schemas import ModelFile, NotConvergedError
from ..physics.chains.joint_command import JointCommand
from ..physics.chains.state import joints_of
from ..physics.checks import require_apart
from ..physics.contact_record import ContactRecord
from ..physics.devices import on_device
from ..physics.effects.effect import changed_by_effects
from ..physics.engine import rollout as roll_out
from ..physics.fused import unsupported
from ..physics.fused.host import lacking
from ..physics.kinematic import Drive
from ..physics.model_world import world_of_model
from ..physics.rollout import Rollout, require_finite
from ..physics.state import State
from ..physics.surfaces.thin_walls import require_thick_walls
from ..physics.world import World
from ..runtime.kernel_build import compiler_version
from .draw import Draw
from .start_states import Start

ENVIRONMENTS = 64
"""Number of environments in each call of the fused kernel."""

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Simulated motion of a draw, float64; T frames, B bodies."""

    draw: Draw
    """The draw."""
    file: ModelFile
    """The drawn model with the gravity, masses and inertias after its effects."""
    position_m: np.ndarray
    """Positions of the origins of the body frames [m], world frame, shape (T, B, 3)."""
    quat_wxyz: np.ndarray
    """Orientations (body to world), shape (T, B, 4)."""
    velocity_m_s: np.ndarray
    """Velocities of the origins of the body frames [m/s], world frame, shape (T, B, 3)."""
    omega_body_rad_s: np.ndarray
    """Angular velocities [rad/s], body frame, shape (T, B, 3)."""
    contacts: ContactTable
    """Contacts of all frames."""


@dataclass(frozen=True)
class Diverged:
    """A diverged draw."""

    draw: Draw
    """The draw."""
    error: NotConvergedError
    """Error with its start."""


class Simulator:
    """Simulator of draws of one model.

    Args:
        model: The model with its estimates.
        times_s: Times of the frames, shape (T,).
        device: cpu or cuda.
    """

    def __init__(self, model: Model, times_s: np.ndarray, device: str) -> None:
        self._world = world_of_model(model)
        self._times = torch.as_tensor(times_s, dtype=torch.float64, device=device)
        self._device = device
        self._together = device == "cuda" and unsupported(on_device(self._world, device)) is None

    @property
    def engine(self) -> str:
        """Name of the engine; results of different engines agree to rounding, not to the byte."""
        if self._device == "cuda":
            return "fused on cuda" if self._together else "torch"
        return "torch" if lacking(self._world) is not None else f"fused on cpu, {compiler_version()}"

    @torch.no_grad()
    def run(self, draws: Sequence[Draw], seed: int) -> list[Motion | Diverged]:
        """Simulate rollouts; the result of each equals that of its separate simulation, bit for bit.

        Args:
            draws: The rollouts; one call takes at most `ENVIRONMENTS`.
            seed: The root seed, for messages.

        Raises:
            InputDataError: If a start, a mass or a contact parameter cannot be simulated.
        """
        size = ENVIRONMENTS if self._together else 1
        found: list[Motion | Diverged] = []
        for first in range(0, len(draws), size):
            found += self._at_once(draws[first : first + size], seed, size)
        return found

    def _at_once(self, draws: Sequence[Draw], seed: int, size: int) -> list[Motion | Diverged]:
        names = [f"rollout {draw.index} (seed {seed})" for draw in draws]
        filled = [*draws, *[draws[-1]] * (size - len(draws))]
        worlds = [world_of_model(draw.model, geometry=self._world) for draw in draws]
        for world, draw, name in zip(worlds, draws, names, strict=True):
            require_apart(world, _state([draw.start]), name)
            require_thick_walls(world, _state([draw.start]), name)
        world = joined_worlds([*worlds, *[worlds[-1]] * (size - len(draws))])
        state = _state([draw.start for draw in filled])
        driven = {**self._driven(filled), **self._held(state)}
        there_world, there_state = on_device((world, state), self._device)
        rollout = roll_out(there_world, there_state, self._times, driven, record_contacts=True)
        rollout = on_device(rollout, "cpu")
        return [
            self._result(draw, _as_simulated(draw.model.file, worlds[row]), rollout, row, (world, state), names[row])
            for row, draw in enumerate(draws)
        ]

    def _driven(self, draws: Sequence[Draw]) -> dict[str, Drive]:
        """Return the motions of the driven bodies, batched over all rollouts."""
        names = list(draws[0].start.driven)
        like = torch.zeros(1, dtype=torch.float64, device=self._device)
        return {name: Drive.of([draw.start.driven[name] for draw in draws], like) for name in names}

    def _held(self, state: State) -> dict[str, JointCommand]:
        """Return the commands of servos, which hold the values that their joints have at the start."""
        chains = [chain for chain in self._world.chains if chain.has_servos]
        held = {chain.name: joints_of(self._world, state, chain)[0].to(self._device) for chain in chains}
        return {name: JointCommand.hold_still(values) for name, values in held.items()}

    def _result(
        self, draw: Draw, file: ModelFile, rollout: Rollout, row: int, began: tuple[World, State], name: str
    ) -> Motion | Diverged:
        rows = slice(row, row + 1)
        one = Rollout(
            times_s=rollout.times_s,
            position_m=rollout.position_m[rows],
            quat_wxyz=rollout.quat_wxyz[rows],
            velocity_m_s=rollout.velocity_m_s[rows],
            omega_body_rad_s=rollout.omega_body_rad_s[rows],
        )
        position, quat, velocity, omega = (
            values[0].numpy() for values in (one.position_m, one.quat_wxyz, one.velocity_m_s, one.omega_body_rad_s)
        )
        if not all(np.isfinite(values).all() for values in (position, quat, velocity, omega)):
            try:
                require_finite(one, began[0], began[1].at(rows), [name])
            except NotConvergedError as error:
                return Diverged(draw, error)
        assert rollout.contacts is not None  # requested by `record_contacts`
        return Motion(
            draw=draw,
            file=file,
            position_m=position,
            quat_wxyz=quat,
            velocity_m_s=velocity,
            omega_body_rad_s=omega,
            contacts=_contact_table(rollout.contacts, row),
        )


def joined_worlds(worlds: Sequence[World]) -> World:
    """Return worlds of one environment each as one batched world; tensors that all share stay single.

    Raises:
        ValueError: If they differ in more than batched values.
    """
    return _joined(list(worlds))


def _joined(things: list[T]) -> T:
    first: Any = things[0]
    found: Any = first
    if all(thing is first for thing in things):
        return found
    if isinstance(first, Tensor):
        tensors: list[Any] = things
        found = _joined_tensors(tensors)
    elif isinstance(first, Mapping):
        mappings: list[Any] = things
        found = {key: _joined([mapping[key] for mapping in mappings]) for key in first}
    elif isinstance(first, tuple):
        tuples: list[Any] = things
        found = tuple(_joined(list(parts)) for parts in zip(*tuples, strict=True))
    elif is_dataclass(first) and not isinstance(first, type):
        found = replace(first, **{f.name: _joined([getattr(thing, f.name) for thing in things]) for f in fields(first)})
    return found


def _joined_tensors(tensors: list[Tensor]) -> Tensor:
    """Concatenate tensors with a batch dimension of 1; one that all share, or one without a batch, stays single."""
    first = tensors[0]
    if all(other is first for other in tensors):
        return first
    if first.ndim and first.shape[0] == 1:
        return torch.cat(tensors)
    if not all(torch.equal(first, other) for other in tensors):
        raise ValueError(f"worlds differ in a tensor of shape {tuple(first.shape)}, which has no batch.")
    return first


def _state(starts: Sequence[Start]) -> State:
    names = [field.name for field in fields(State)]
    return State(*(torch.as_tensor(np.stack([getattr(start, name) for start in starts])) for name in names))


def _as_simulated(file: ModelFile, world: World) -> ModelFile:
    """Return the model with the gravity, masses and inertias after its effects."""
    if not any(active.effect.has("world") for active in world.effects):
        return file
    world = changed_by_effects(world)
    bodies = []
    for body, real in zip(file.bodies, world.bodies, strict=True):
        inertia = real.inertia[0].tolist()
        six = tuple(inertia[i][j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        update = {"mass_kg": float(real.mass[0]), "com_m": tuple(real.com[0].tolist()), "inertia_kg_m2": six}
        bodies.append(body.model_copy(update=update))
    return file.model_copy(update={"bodies": tuple(bodies), "gravity_m_s2": tuple(world.gravity[0].tolist())})


def _contact_table(record: ContactRecord, row: int) -> ContactTable:
    """Return the contacts that touch at a frame or transmitted an impulse since the previous frame."""
    impulse = record.impulse_n_s[row].numpy()
    distance = record.distance_m[row].numpy()
    active = (np.abs(impulse).max(-1, initial=0.0) > 0) | (distance <= 0)
    frame, slot = np.nonzero(active)

    def rows(values: Tensor) -> np.ndarray:
        return values[row].numpy()[frame, slot]

    return ContactTable(
        offsets=np.concatenate([[0], np.cumsum(active.sum(1))]).astype(np.int64),
        body_a=record.body_a.numpy()[slot].astype(np.int32),
        body_b=record.body_b.numpy()[slot].astype(np.int32),
        position_m=rows(record.position_m),
        normal=rows(record.normal),
        distance_m=distance[frame, slot],
        impulse_n_s=impulse[frame, slot],
        sliding=rows(record.sliding).astype(np.uint8),
    )
