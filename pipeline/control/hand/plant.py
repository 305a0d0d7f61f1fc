"""What the commands of a hand act on: the model itself, or a scene of MuJoCo with the hand and the object."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from ....datasets.robots.mjcf import control_of, servos_of
from ....datasets.shapes.turns import matrix_of
from ....schemas import HandPlantSection, HandTask, InputDataError, NotConvergedError, did_you_mean
from ...physics.chains.joint_command import JointCommand
from ...physics.chains.state import joints_of
from ...physics.engine import rollout
from ...physics.state import State
from ..horizon import Array
from ..planning import ControlState
from ..plant import changed_world
from ..true_shape import box_of_balls, require_same_body
from .world import HandWorld

GRAVITY_TOLERANCE = 0.02
"""Largest difference of the gravity of scene and model, in units of the larger."""
NO_DYNAMICS, LAGS = 0, (2, 3)
"""MuJoCo's numbers of actuators that act at once, and of those that lag behind (timeconst)."""


@dataclass(frozen=True, kw_only=True)
class HandTruth:
    """True state of a plant."""

    position_m: Array
    """Origin of the object's frame [m], shape (3,)."""
    quat_wxyz: Array
    """Orientation of the object, body to world, shape (4,)."""
    velocity_m_s: Array
    """Velocity of that origin [m/s], shape (3,)."""
    omega_body_rad_s: Array
    """Angular velocity, body frame [rad/s], shape (3,)."""
    names: tuple[str, ...]
    """Names of the joints."""
    joints_rad: Array
    """Values of the joints [rad], shape (joints,)."""
    speeds_rad_s: Array
    """Their speeds [rad/s], shape (joints,)."""
    grip_n: float = 0.0
    """Sum of the sizes of the contact forces on the object, mean over the last interval [N]."""

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(np.isfinite(value).all()) for value in vars(self).values() if isinstance(value, np.ndarray))

    def measured(self, time_s: float, position_m: Array, quat_wxyz: Array) -> ControlState:
        """Return the state as it is measured, with a pose of the object that has errors."""
        return ControlState(
            time_s=time_s,
            joints=dict(zip(self.names, self.joints_rad.tolist(), strict=True)),
            position_m=position_m,
            quat_wxyz=quat_wxyz,
            velocity_m_s=self.velocity_m_s,
            omega_body_rad_s=self.omega_body_rad_s,
            joint_speeds=dict(zip(self.names, self.speeds_rad_s.tolist(), strict=True)),
        )


class HandPlant(Protocol):
    """Interface of plants."""

    def reset(self, position_m: Array, quat_wxyz: Array) -> HandTruth:
        """Put the object at rest at a pose, and the joints where the task has them."""
        ...

    def advance(self, target_rad: Array, interval_s: float) -> HandTruth:
        """Move the targets of the joints to `target_rad` (joints,) at constant speed, and return the state then."""
        ...


class HandModelPlant:
    """The model and the hand as the plant, with the model's steps.

    Args:
        hand: The task.
    """

    def __init__(self, hand: HandWorld) -> None:
        plant = hand.task.plant
        self._hand = hand
        self._world = changed_world(
            hand.world, hand.object, plant.friction_factor, plant.mass_factor, plant.size_factor
        )
        self._state: State | None = None
        self._target = hand.home

    def reset(self, position_m: Array, quat_wxyz: Array) -> HandTruth:
        """See :class:`HandPlant`."""
        hand = self._hand
        joints = dict(zip(hand.joints, hand.home.tolist(), strict=True))
        self._state, self._target = hand.state(position_m, quat_wxyz, joints), hand.home
        return self._truth()

    @torch.no_grad()
    def advance(self, target_rad: Array, interval_s: float) -> HandTruth:
        """See :class:`HandPlant`."""
        times = torch.tensor([[0.0, interval_s]], dtype=torch.float64)
        knots = torch.as_tensor(np.stack((self._target, target_rad)))[None]
        command = {self._hand.chain.name: JointCommand.targets(times, knots)}
        assert self._state is not None  # the runner resets first
        found = rollout(self._world, self._state, times[0], command, record_contacts=True)
        motion = (found.position_m, found.quat_wxyz, found.velocity_m_s, found.omega_body_rad_s)
        self._state, self._target = State(*(values[:, -1] for values in motion)), np.asarray(target_rad, float)
        assert found.contacts is not None  # they were asked for
        ours = (found.contacts.body_a == self._hand.object) | (found.contacts.body_b == self._hand.object)
        truth = self._truth(float(found.contacts.impulse_n_s[0, -1, ours].norm(dim=-1).sum()) / interval_s)
        if not truth.finite:
            raise NotConvergedError("the plant diverged.", todo="take a model with a smaller step_s.")
        return truth

    def _truth(self, grip_n: float = 0.0) -> HandTruth:
        assert self._state is not None
        position, quat, velocity, omega = (part[0, self._hand.object].numpy().copy() for part in self._state.tensors)
        joints, speeds = joints_of(self._world, self._state, self._hand.chain, exact=False)
        return HandTruth(
            position_m=position,
            quat_wxyz=quat,
            velocity_m_s=velocity,
            omega_body_rad_s=omega,
            names=self._hand.joints,
            joints_rad=joints[0].numpy().copy(),
            speeds_rad_s=speeds[0].numpy().copy(),
            grip_n=grip_n,
        )


class HandScenePlant:
    """A scene of MuJoCo: the hand's joints by name, each with a position servo, and the object as a free body.

    Args:
        hand: The task.

    Raises:
        InputDataError: If the scene cannot be read, or lacks a joint, a servo or the object.
    """

    def __init__(self, hand: HandWorld) -> None:
        self._mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs
        self._hand, task = hand, hand.task
        path = task.folder / task.plant.scene
        try:
            self._model = self._mujoco.MjModel.from_xml_path(str(path.absolute()))
        except ValueError as error:
            found = f"{task.source}: [plant] scene: {path}: MuJoCo cannot read it: {error}."
            raise InputDataError(
                found,
                "an MJCF file.",
                todo="correct the file until `python -m mujoco.viewer` opens it, or name another.",
            ) from error
        self._data = self._mujoco.MjData(self._model)
        self._body = self._object(task, str(path))
        self._places = [self._joint(name, str(path)) for name in hand.joints]
        self._servos = [servo for _, _, servo in self._places]
        self._factor, self._offset = np.array([control_of(self._model, servo) for servo in self._servos]).T
        found = hand.world.bodies[hand.object]
        ours = box_of_balls(found.centers[0].numpy(), found.radii[0].numpy())
        require_same_body(f"{path}: body '{task.plant.body}'", ours, self._box())
        self._require_gravity(str(path))
        self._change(task.plant)

    def _require_gravity(self, path: str) -> None:
        """Check that the scene has the gravity of the model."""
        ours, theirs = self._hand.world.gravity[0].numpy(), self._model.opt.gravity
        if np.linalg.norm(theirs - ours) > GRAVITY_TOLERANCE * max(np.linalg.norm(ours), np.linalg.norm(theirs)):
            raise InputDataError(
                f"{path}: its gravity is {theirs.tolist()} m/s2.",
                f"about that of the model, {ours.round(3).tolist()}.",
                todo='write <option gravity="..."/>, or turn the scene: hand and object have the frame of the model.',
            )

    def reset(self, position_m: Array, quat_wxyz: Array) -> HandTruth:
        """See :class:`HandPlant`."""
        model, data = self._model, self._data
        self._mujoco.mj_resetData(model, data)
        first = model.jnt_qposadr[model.body_jntadr[self._body]]
        data.qpos[first : first + 7] = [*position_m, *quat_wxyz]
        data.qpos[[place for place, _, _ in self._places]] = self._hand.home
        data.ctrl[self._servos] = self._factor * self._hand.home + self._offset
        for servo in self._servos:
            if model.actuator_dyntype[servo] != NO_DYNAMICS:  # of a lag, whose output is its control
                data.act[model.actuator_actadr[servo]] = data.ctrl[servo]
        self._mujoco.mj_forward(model, data)
        return self._truth()

    def advance(self, target_rad: Array, interval_s: float) -> HandTruth:
        """See :class:`HandPlant`."""
        data, model = self._data, self._model
        steps = max(1, round(interval_s / model.opt.timestep))
        first, grip = data.ctrl[self._servos].copy(), 0.0
        last = self._factor * np.asarray(target_rad) + self._offset
        for step in range(1, steps + 1):
            data.ctrl[self._servos] = first + (last - first) * step / steps
            self._mujoco.mj_step(model, data)
            grip += self._grip() / steps
        found = self._truth(grip)
        if not found.finite:
            raise NotConvergedError("the plant in MuJoCo diverged.", todo="take a smaller timestep in the scene.")
        return found

    def _grip(self) -> float:
        """Return the sum of the sizes of the contact forces on the object at this step [N]."""
        first, wrench, total = self._model.body_geomadr[self._body], np.zeros(6), 0.0
        geoms = self._data.contact.geom - first
        ours = ((geoms >= 0) & (geoms < self._model.body_geomnum[self._body])).any(1)
        for number in np.flatnonzero(ours):
            self._mujoco.mj_contactForce(self._model, self._data, number, wrench)
            total += float(np.linalg.norm(wrench[:3]))
        return total

    def _object(self, task: HandTask, path: str) -> int:
        """Return the number of the object's body."""
        model = self._model
        joints = [number for number in range(model.njnt) if model.jnt_type[number] == 0]
        free = {model.body(model.jnt_bodyid[number]).name: int(model.jnt_bodyid[number]) for number in joints}
        if task.plant.body not in free:
            raise InputDataError(
                f"{path}: it has no free body '{task.plant.body}'.",
                f"{', '.join(free) or 'none, it has no free body'}.{did_you_mean(task.plant.body, list(free))}",
                "correct [plant] body.",
            )
        return free[task.plant.body]

    def _box(self) -> Array:
        """Return the smallest and largest coordinates (2, 3) of the object in its frame [m]."""
        model, corners = self._model, []
        first = model.body_geomadr[self._body]
        for geom in range(first, first + model.body_geomnum[self._body]):
            middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            signs = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]]), -1).reshape(-1, 3)
            corners.append((middle + signs * half) @ matrix_of(model.geom_quat[geom]).T + model.geom_pos[geom])
        every = np.concatenate(corners)
        return np.stack((every.min(0), every.max(0)))

    def _joint(self, name: str, path: str) -> tuple[int, int, int]:
        """Return the places of a joint's value and speed, and the number of its servo."""
        model = self._model
        known = [model.joint(number).name for number in range(model.njnt)]
        if name not in known:
            near = did_you_mean(name, known)
            raise InputDataError(
                f"{path}: the scene has no joint '{name}'.",
                f"{', '.join(known)}.{near}",
                todo="correct the name in the task, or add the joint to the scene.",
            )
        number = model.joint(name).id
        servos = [k for k in servos_of(model, number) if model.actuator_dyntype[k] in (NO_DYNAMICS, *LAGS)]
        if len(servos) != 1:
            raise InputDataError(
                f"{path}: joint '{name}' has {len(servos) or 'no'} servo{'s' if servos else ''}.",
                "one position actuator for every joint.",
                todo=f"{'leave one' if servos else 'add <position joint=...>'} for it in the scene.",
            )
        return int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number]), servos[0]

    def _change(self, plant: HandPlantSection) -> None:
        """Give the scene the errors of friction, mass and size that the task has."""
        model, body = self._model, self._body
        model.geom_friction[:, 0] *= plant.friction_factor
        model.body_mass[body] *= plant.mass_factor
        model.body_inertia[body] *= plant.mass_factor * plant.size_factor**2
        geoms = slice(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        if plant.size_factor != 1.0:
            meshes = [k for k in range(geoms.start, geoms.stop) if model.geom_type[k] == 7]
            if meshes:
                raise InputDataError(
                    f"{self._hand.task.source}: [plant] size_factor = {plant.size_factor:g}: the object of the scene "
                    "has meshes.",
                    "boxes, balls, capsules or cylinders, whose size can be changed.",
                    "scale the meshes in the scene.",
                )
            model.geom_size[geoms] *= plant.size_factor
            model.geom_pos[geoms] *= plant.size_factor
            model.geom_rbound[geoms] *= plant.size_factor

    def _truth(self, grip_n: float = 0.0) -> HandTruth:
        model, data = self._model, self._data
        joint = model.body_jntadr[self._body]
        place, speed = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        return HandTruth(
            position_m=data.qpos[place : place + 3].copy(),
            quat_wxyz=data.qpos[place + 3 : place + 7].copy(),
            velocity_m_s=data.qvel[speed : speed + 3].copy(),
            omega_body_rad_s=data.qvel[speed + 3 : speed + 6].copy(),
            names=self._hand.joints,
            joints_rad=data.qpos[[place for place, _, _ in self._places]].copy(),
            speeds_rad_s=data.qvel[[speed for _, speed, _ in self._places]].copy(),
            grip_n=grip_n,
        )
