"""What commands act on: the interface of a plant, and the model itself as one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from ...schemas import JOINTS
from ..physics.engine import rollout
from ..physics.state import State
from ..physics.world import World
from .horizon import Array
from .objective import drive_of
from .planning import ControlState
from .task_world import TaskWorld, require_start


@dataclass(frozen=True, kw_only=True)
class Truth:
    """True state of a plant."""

    position_m: Array
    """Origin of the object's frame [m], shape (3,)."""
    quat_wxyz: Array
    """Orientation of the object, body to world, shape (4,)."""
    velocity_m_s: Array
    """Velocity of that origin [m/s], shape (3,)."""
    omega_body_rad_s: Array
    """Angular velocity, body frame [rad/s], shape (3,)."""
    finger_m: Array
    """x and y of the finger [m], shape (2,)."""
    force_n: Array
    """Mean force of the finger on the object over the last interval, world frame [N], shape (3,)."""

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(np.isfinite(value).all()) for value in vars(self).values())

    def measured(self, time_s: float, position_m: Array, quat_wxyz: Array) -> ControlState:
        """Return the state as it is measured, with a pose of the object that has errors."""
        return ControlState(
            time_s=time_s,
            joints=dict(zip(JOINTS, map(float, self.finger_m), strict=True)),
            position_m=position_m,
            quat_wxyz=quat_wxyz,
            velocity_m_s=self.velocity_m_s,
            omega_body_rad_s=self.omega_body_rad_s,
        )


class Plant(Protocol):
    """Interface of plants."""

    def reset(self, position_m: Array, turn_rad: float, finger_m: Array) -> Truth:
        """Put the object at rest at x, y [m] and a turn [rad] relative to the photos, and the finger at x, y [m].

        Raises:
            InputDataError: If something begins inside of something else.
        """
        ...

    def advance(self, target_m: Array, interval_s: float) -> Truth:
        """Move the targets of the joints to `target_m` (2,) [m] at constant speed, and return the state then."""
        ...


class ModelPlant:
    """The model as a plant, with its own steps; its finger follows the targets exactly.

    Args:
        found: The task.
    """

    def __init__(self, found: TaskWorld) -> None:
        self._world = _changed(found)
        self._found = replace(found, world=self._world)
        self._state: State | None = None

    def reset(self, position_m: Array, turn_rad: float, finger_m: Array) -> Truth:
        """See :class:`Plant`."""
        state = self._found.state(*self._found.pose(position_m, turn_rad), finger_m)
        require_start(self._found, state, "the start")
        self._state = state
        return self._truth(np.zeros(3))

    @torch.no_grad()
    def advance(self, target_m: Array, interval_s: float) -> Truth:
        """See :class:`Plant`."""
        state = self._started()
        finger = state.position_m[:, self._found.finger]
        speed = (torch.as_tensor(target_m) - finger[:, :2]) / interval_s
        times = torch.tensor([0.0, interval_s], dtype=torch.float64)
        drive = drive_of(times, finger, speed[:, None])
        name = self._world.body_names[self._found.finger]
        found = rollout(self._world, state, times, {name: drive}, record_contacts=True)
        motion = (found.position_m, found.quat_wxyz, found.velocity_m_s, found.omega_body_rad_s)
        self._state = State(*(values[:, -1] for values in motion))
        force = np.zeros(3)
        if found.contacts is not None:
            ours = (found.contacts.body_a == self._found.object) & (found.contacts.body_b == self._found.finger)
            force = found.contacts.impulse_n_s[0, -1, ours].sum(0).numpy() / interval_s
        return self._truth(force)

    def _truth(self, force: Array) -> Truth:
        state, index = self._started(), self._found.object
        values = [part[0, index].numpy().copy() for part in state.tensors]
        finger = state.position_m[0, self._found.finger, :2].numpy().copy()
        return Truth(
            position_m=values[0],
            quat_wxyz=values[1],
            velocity_m_s=values[2],
            omega_body_rad_s=values[3],
            finger_m=finger,
            force_n=force,
        )

    def _started(self) -> State:
        assert self._state is not None  # the runner resets first
        return self._state


def _changed(found: TaskWorld) -> World:
    """Return the world of the model with the errors of friction, mass and size that the task gives."""
    world, plant, index = found.world, found.task.plant, found.object
    mass = plant.mass_factor
    if plant.mass_kg is not None:
        mass = mass * plant.mass_kg / float(world.bodies[index].mass)
    if plant.friction is not None:
        ground = torch.full_like(world.gravity[:, 0], plant.friction)
        world = replace(world, contact=replace(world.contact, friction=ground))
    return changed_world(world, index, plant.friction_factor, mass, plant.size_factor)


def changed_world(world: World, index: int, friction: float, mass: float, size: float) -> World:
    """Return a world with factors of all frictions, and of mass and size of a body [1].

    Args:
        world: The world.
        index: Index of the body.
        friction: Factor of the frictions.
        mass: Factor of the mass.
        size: Factor of the size.
    """
    body = world.bodies[index]
    if friction != 1.0:
        laws = {pair: replace(law, friction=friction * law.friction) for pair, law in world.pair_laws.items()}
        contact = replace(world.contact, friction=friction * world.contact.friction)
        world = replace(world, contact=contact, pair_laws=laws)
    if size == 1.0 and mass == 1.0:
        return world
    return world.with_body(
        index,
        mass=mass * body.mass,
        inertia=mass * size**2 * body.inertia,
        com=size * body.com,
        centers=size * body.centers,
        radii=size * body.radii,
    )


def start_of(found: TaskWorld, seed: int) -> tuple[Array, float, Array]:
    """Return where a run begins: x, y of the object [m], its turn [rad], and x, y of the finger [m].

    The object lies anywhere within a distance from the goal, all places alike; the finger 5 cm beside its outline, in
    any direction.

    Args:
        found: The task.
        seed: Seed of the run.
    """
    task, rng = found.task, np.random.default_rng([seed, 0])
    angle, share, turn, side = rng.uniform(-math.pi, math.pi), rng.uniform(), rng.uniform(), rng.uniform()
    away = task.start.within_m * math.sqrt(share) * np.array([math.cos(angle), math.sin(angle)])
    place = np.asarray(task.goal.position_m) + away if task.start.position_m is None else task.start.position_m
    first, last = np.radians(task.start.turn_deg)
    turn = float(first + turn * (last - first))
    if task.start.finger_m is not None:
        return np.asarray(place, float), turn, np.asarray(task.start.finger_m, float)
    return np.asarray(place, float), turn, _beside(found, np.asarray(place, float), turn, side)


BESIDE_M = 0.05
"""Distance of the finger from the outline at the start [m]."""
_DIRECTIONS = 36


def _beside(found: TaskWorld, place: Array, turn: float, side: float) -> Array:
    """Return a place of the finger beside the object: in a random direction, or the next one within the limits."""
    from .task_world import outline

    centers, radii = outline(found, *found.pose(place, turn))
    limits = np.array([found.task.limits.joints[name] for name in ("x", "y")])
    for step in range(_DIRECTIONS):
        angle = 2 * math.pi * (side + step / _DIRECTIONS)
        ray = np.array([math.cos(angle), math.sin(angle)])
        out = float(((centers - place) @ ray + radii).max())
        point = place + (out + BESIDE_M) * ray
        if (point >= limits[:, 0]).all() and (point <= limits[:, 1]).all():
            return point
    return np.clip(place, limits[:, 0], limits[:, 1])
