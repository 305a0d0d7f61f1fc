"""MuJoCo as a plant: the object's true mesh on a plane, and a ball on position servos."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from ...datasets.shapes.meshes import Mesh, joined_properties, mass_properties, read_mesh
from ...schemas import InputDataError, NotConvergedError
from ..geometry.rotation import quat_multiply
from .goal import turned
from .horizon import Array
from .plant import Truth
from .task_world import TaskWorld, ground_z
from .true_shape import box_of_balls, require_same_body

CONVEX_EXCESS = 0.05
"""Largest excess of the volume of a part's hull over its own: MuJoCo takes the hull of a mesh."""
SOLREF, SOLIMP = (0.008, 1.0), (0.97, 0.97, 0.001)
"""Contacts of MuJoCo: time constant [s], damping ratio; impedance. Nothing of the fitted contact is in them."""
SMALLEST_GAP_M = 1e-3
"""Smallest gap of object and finger at the start [m]: MuJoCo pushes apart what begins in overlap."""


class MujocoPlant:
    """The true mesh in MuJoCo.

    Args:
        found: The task; `plant.meshes` are convex parts of the true mesh.

    Raises:
        InputDataError: If a mesh cannot be read or is not convex.
    """

    def __init__(self, found: TaskWorld) -> None:
        self._mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs
        self.found = found
        self.parts = _parts(found)
        self._model = self._mujoco.MjModel.from_xml_string(scene_mjcf(found, self.parts))
        self._data = self._mujoco.MjData(self._model)

    def reset(self, position_m: Array, turn_rad: float, finger_m: Array) -> Truth:
        """See :class:`Plant`."""
        found, data = self.found, self._data
        reference = found.goal.reference_wxyz
        quat = quat_multiply(turned(turn_rad, reference), reference).numpy()
        rotation = np.empty(9)
        self._mujoco.mju_quat2Mat(rotation, quat)
        corners = np.concatenate([part.vertices for part in self.parts]) @ rotation.reshape(3, 3).T
        self._mujoco.mj_resetData(self._model, data)
        data.qpos[:7] = [*position_m, ground_z(found.world) - corners[:, 2].min(), *quat]
        data.qpos[7:9] = data.ctrl[:] = finger_m
        self._mujoco.mj_forward(self._model, data)
        inside = [contact.dist for contact in data.contact if self._finger_touches(contact)]
        if inside and min(inside) < -SMALLEST_GAP_M:
            raise InputDataError(
                f"{found.task.source}: the object begins {-1e3 * min(inside):.1f} mm deep inside the finger.",
                "a finger beside the object.",
                "move [start] finger_m or position_m.",
            )
        return self._truth(np.zeros(3))

    def advance(self, target_m: Array, interval_s: float) -> Truth:
        """See :class:`Plant`."""
        data, model = self._data, self._model
        steps = max(1, round(interval_s / model.opt.timestep))
        model.opt.timestep = interval_s / steps
        first, total = data.ctrl.copy(), np.zeros(3)
        for step in range(1, steps + 1):
            data.ctrl[:] = first + (np.asarray(target_m) - first) * step / steps
            self._mujoco.mj_step(model, data)
            total += self._force()
        found = self._truth(total / steps)
        if not found.finite:
            raise NotConvergedError("the plant in MuJoCo diverged.", todo="take a smaller [plant] step_s.")
        return found

    def _finger_touches(self, contact: Any) -> bool:
        return self._model.geom("finger").id in (contact.geom1, contact.geom2)

    def _force(self) -> Array:
        """Return the force of the finger on the object at this step, world frame [N]."""
        total, wrench = np.zeros(3), np.zeros(6)
        for number, contact in enumerate(self._data.contact):
            if self._finger_touches(contact):
                self._mujoco.mj_contactForce(self._model, self._data, number, wrench)
                force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second geom
                total += force if contact.geom1 == self._model.geom("finger").id else -force
        return total

    def _truth(self, force: Array) -> Truth:
        data = self._data
        return Truth(
            position_m=data.qpos[:3].copy(),
            quat_wxyz=data.qpos[3:7].copy(),
            velocity_m_s=data.qvel[:3].copy(),
            omega_body_rad_s=data.qvel[3:6].copy(),
            finger_m=data.qpos[7:9].copy(),
            force_n=force,
        )


def scene_mjcf(found: TaskWorld, parts: list[Mesh]) -> str:
    """Return the scene as MJCF: the plane, the parts of the object as one free body, and the finger on two servos.

    The object is of uniform density; friction is that of the task, or that of the model.

    Args:
        found: The task.
        parts: Convex parts of the object, in its frame.
    """
    task, plant = found.task, found.task.plant
    mass, solid = _true_mass(found), joined_properties(parts, "a part of the object")
    com, inertia = solid.com_m, mass * solid.inertia_per_kg
    ground, finger = (plant.friction_factor * value for value in _frictions(found))
    servo, robot = task.servo, task.robot
    damping = 2 * servo.damping_ratio * math.sqrt(servo.stiffness_n_m * servo.mass_kg)
    assets = "".join(f'<mesh name="part{k}" vertex="{_text(part.vertices)}"/>' for k, part in enumerate(parts))
    geoms = "".join(f'<geom name="part{k}" type="mesh" mesh="part{k}"/>' for k in range(len(parts)))
    pairs = "".join(
        _pair(f"part{k}", "ground", ground) + _pair(f"part{k}", "finger", finger) for k in range(len(parts))
    )
    six = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    z = ground_z(found.world)
    joints = "".join(f'<joint name="{name}" type="slide" axis="{axis}"/>' for name, axis in _AXES)
    servos = "".join(f'<position joint="{name}" kp="{servo.stiffness_n_m!r}" kv="{damping!r}"/>' for name, _ in _AXES)
    return f"""<mujoco>
  <option timestep="{plant.step_s!r}" gravity="{_text(found.world.gravity)}" integrator="implicitfast" cone="elliptic"
    impratio="10"/>
  <compiler angle="radian"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <asset>{assets}</asset>
  <worldbody>
    <geom name="ground" type="plane" size="2 2 0.1" pos="0 0 {z!r}"/>
    <body name="object"><freejoint/>
      <inertial pos="{_text(com)}" mass="{mass!r}" fullinertia="{_text(six)}"/>{geoms}</body>
    <body name="finger" pos="0 0 {found.finger_z!r}" gravcomp="1">{joints}
      <geom name="finger" type="sphere" size="{robot.radius_m!r}" mass="{servo.mass_kg!r}"/></body>
  </worldbody>
  <contact>{pairs}</contact>
  <actuator>{servos}</actuator>
</mujoco>"""


_AXES = (("x", "1 0 0"), ("y", "0 1 0"))


def _pair(part: str, other: str, friction: float) -> str:
    return (
        f'<pair geom1="{part}" geom2="{other}" condim="3" friction="{_text((friction, friction, 0.005, 1e-4, 1e-4))}" '
        f'solref="{_text(SOLREF)}" solimp="{_text(SOLIMP)}"/>'
    )


def _frictions(found: TaskWorld) -> tuple[float, float]:
    """Return the true friction of object and ground, and of object and finger."""
    plant, world = found.task.plant, found.world
    ground = float(world.law_of(found.object, -1).friction) if plant.friction is None else plant.friction
    finger = plant.finger_friction
    return ground, float(world.law_of(found.object, found.finger).friction) if finger is None else finger


def _true_mass(found: TaskWorld) -> float:
    plant = found.task.plant
    mass = float(found.world.bodies[found.object].mass) if plant.mass_kg is None else plant.mass_kg
    return plant.mass_factor * mass


def _parts(found: TaskWorld) -> list[Mesh]:
    """Return the convex parts of the true mesh, with the error of its size."""
    parts = []
    for name in found.task.plant.meshes:
        path = found.task.folder / name
        mesh = _read_part(found.task.source, path)
        volume, hull = mass_properties(mesh, path).volume_m3, float(ConvexHull(mesh.vertices).volume)
        if hull > (1 + CONVEX_EXCESS) * volume:
            raise InputDataError(
                f"{path}: the mesh is not convex: its hull, which MuJoCo takes, is "
                f"{100 * (hull / volume - 1):.0f} % larger.",
                "convex parts, one file for each.",
                "cut the mesh into convex parts, and list them under [plant] meshes.",
            )
        parts.append(Mesh(mesh.vertices, mesh.faces))
    true = np.stack([end([end(part.vertices, 0) for part in parts], 0) for end in (np.min, np.max)])
    require_same_body(f"{found.task.source}: [plant] meshes", box_of_balls(*found.surface), true)
    return [Mesh(found.task.plant.size_factor * part.vertices, part.faces) for part in parts]


def _text(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def _read_part(source: str, path: Path) -> Mesh:
    try:
        return read_mesh(path)
    except InputDataError as error:
        todo = "correct [plant] meshes; the files are relative to the task's folder."
        raise InputDataError(f"{source}: [plant] meshes: {error.found}", error.allowed, todo) from error
