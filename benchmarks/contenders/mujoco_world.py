"""A world of ours as a MuJoCo model whose contact numbers can be set: the simulator of the rival CEM + MuJoCo + R."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.pipeline.geometry.rotation import quat_conjugate, quat_rotate
from cgwm.pipeline.physics.kinematic import Drive
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World

from .base import Array

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs

STEP_S = 1e-3
_DRIVEN_MASS_KG = 1e4
"""So heavy that contact does not deflect a driven body within a step; pose and velocity are set before each."""
_GROUND = "ground"


@dataclass(frozen=True)
class ContactNumbers:
    """MuJoCo's numbers of a contact; those that are not here keep MuJoCo's defaults.

    friction, friction_driven: with the ground, and with driven bodies [1]; time_constant_s, damping_ratio: solref.
    """

    friction: float
    friction_driven: float
    time_constant_s: float
    damping_ratio: float


class MujocoWorld:
    """MuJoCo's model of a world.

    Elliptic friction cones, impratio 10 against slip and fourth-order Runge-Kutta steps of 1 ms, as its documentation
    advises where accuracy counts; solimp is the default.

    Args:
        world: Bodies, mass properties, ground and gravity; bodies are made of their collision spheres.
        solids: Bodies that are these solids instead, with their convex parts and their own mass properties, by name.
    """

    def __init__(self, world: World, solids: Mapping[str, SolidObject]) -> None:
        self._world = world
        self._model = mujoco.MjModel.from_xml_string(_xml(world, solids))
        self._data = mujoco.MjData(self._model)
        driven = {body.name for body in world.bodies if body.motion == "driven"}
        model = self._model
        owners = [[_owner(model.geom(int(k)).name) for k in pairs] for pairs in (model.pair_geom1, model.pair_geom2)]
        self._pushed = np.array([bool(driven & set(pair)) for pair in zip(*owners, strict=True)], bool)
        moving = [index for index, body in enumerate(world.bodies) if body.motion != "fixed"]
        self._places = {index: (7 * row, 6 * row) for row, index in enumerate(moving)}

    def rollout(
        self, numbers: ContactNumbers, start: State, drives: Mapping[str, Track], times_s: Array
    ) -> tuple[Array, Array]:
        """Return position (F, nb, 3) [m] and quat_wxyz (F, nb, 4) of all bodies; not finite where it diverges."""
        model, data, bodies = self._model, self._data, self._world.bodies
        friction = np.where(self._pushed, numbers.friction_driven, numbers.friction)
        model.pair_friction[:, :2] = friction[:, None]
        model.pair_solref[:] = (numbers.time_constant_s, numbers.damping_ratio)
        mujoco.mj_resetData(model, data)
        for index, (at, rate) in self._places.items():
            state = [values[0, index].numpy() for values in vars(start).values()]
            # a free joint has the velocity of the body frame's origin in the world, and omega in the body, as ours
            data.qpos[at : at + 7] = np.concatenate(state[:2])
            data.qvel[rate : rate + 6] = np.concatenate(state[2:])
        steps = np.maximum(1, np.ceil(np.diff(times_s) / STEP_S - 1e-6).astype(int))
        parts = [a + (b - a) / n * np.arange(n) for a, b, n in zip(times_s[:-1], times_s[1:], steps, strict=True)]
        grid = np.concatenate([*parts, times_s[-1:]])
        driven = [index for index in self._places if bodies[index].motion == "driven"]
        commands = {index: _command(drives[bodies[index].name], grid) for index in driven}
        position, quat = np.empty((len(times_s), len(bodies), 3)), np.empty((len(times_s), len(bodies), 4))
        step = 0
        for frame in range(len(times_s)):
            self._command(commands, step)
            for index, body in enumerate(bodies):
                if index in self._places:
                    at = self._places[index][0]
                    position[frame, index], quat[frame, index] = data.qpos[at : at + 3], data.qpos[at + 3 : at + 7]
                else:
                    assert body.place is not None
                    position[frame, index], quat[frame, index] = body.place[0, :3].numpy(), body.place[0, 3:].numpy()
            if frame == len(steps):
                break
            model.opt.timestep = (times_s[frame + 1] - times_s[frame]) / steps[frame]
            if not commands:
                mujoco.mj_step(model, data, nstep=int(steps[frame]))
            else:
                for _ in range(steps[frame]):
                    self._command(commands, step)
                    mujoco.mj_step(model, data)
                    step += 1
            if any(data.warning[int(kind)].number for kind in _DIVERGED):
                position[frame + 1 :] = np.nan  # MuJoCo starts again from its model's pose when it diverges
                quat[frame + 1 :] = np.nan
                break
        return position, quat

    def _command(self, commands: Mapping[int, tuple[Array, Array]], step: int) -> None:
        """Set the driven bodies to where they are at a step."""
        for index, (pose, rate) in commands.items():
            at, along = self._places[index]
            self._data.qpos[at : at + 7], self._data.qvel[along : along + 6] = pose[step], rate[step]


_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def _owner(geom: str) -> str:
    """Return the body of a geom by the geom's name."""
    return geom.rpartition(" ")[0]


def _command(track: Track, times_s: Array) -> tuple[Array, Array]:
    """Return pose (S, 7) and velocity with omega_body (S, 6) of a command at times (S,)."""
    like = torch.zeros(1, dtype=torch.float64)
    motion = Drive.of([track] * len(times_s), like).at(torch.as_tensor(times_s))
    omega = quat_rotate(quat_conjugate(motion.quat_wxyz), motion.spin)
    pose, rate = torch.cat([motion.com, motion.quat_wxyz], -1), torch.cat([motion.velocity, omega], -1)
    return pose.numpy(), rate.numpy()


def _xml(world: World, solids: Mapping[str, SolidObject]) -> str:
    assets: list[str] = []
    bodies: list[str] = []
    geoms: dict[str, list[str]] = {}
    for body in world.bodies:
        solid = solids.get(body.name)
        if solid is not None:
            forms = []
            for number, part in enumerate(solid.parts):
                assets.append(f'<mesh name="{body.name} {number}" vertex="{_text(part)}"/>')
                forms.append(f'type="mesh" mesh="{body.name} {number}"')
            mass, com, inertia = solid.mass, solid.com, solid.inertia
        else:
            forms = [
                f'type="sphere" pos="{_text(center)}" size="{radius!r}"'
                for center, radius in zip(body.centers[0].numpy(), body.radii[0].tolist(), strict=True)
            ]
            mass, com, inertia = float(body.mass[0]), body.com[0].numpy(), body.inertia[0].numpy()
        geoms[body.name] = [f"{body.name} {number}" for number in range(len(forms))]
        inner = "".join(
            f'<geom name="{name}" {form} mass="0" contype="0" conaffinity="0"/>'
            for name, form in zip(geoms[body.name], forms, strict=True)
        )
        if body.free:
            moments = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            inner += f'<freejoint/><inertial pos="{_text(com)}" mass="{mass!r}" fullinertia="{_text(moments)}"/>'
            bodies.append(f'<body name="{body.name}">{inner}</body>')
        elif body.motion == "driven":
            heavy = _DRIVEN_MASS_KG
            inner += f'<freejoint/><inertial pos="0 0 0" mass="{heavy}" diaginertia="{heavy} {heavy} {heavy}"/>'
            bodies.append(f'<body name="{body.name}" gravcomp="1">{inner}</body>')
        else:
            assert body.place is not None
            place = body.place[0].numpy()
            bodies.append(f'<body name="{body.name}" pos="{_text(place[:3])}" quat="{_text(place[3:])}">{inner}</body>')
    ground = ""
    if world.ground_normal is not None and world.ground_offset is not None:
        normal = world.ground_normal.numpy()
        geoms[_GROUND] = [_GROUND]
        ground = (
            f'<geom name="{_GROUND}" type="plane" size="10 10 1" pos="{_text(float(world.ground_offset[0]) * normal)}" '
            f'zaxis="{_text(normal)}" contype="0" conaffinity="0"/>'
        )
    gravity = _text(world.gravity[0].numpy())
    return f"""<mujoco>
      <option timestep="{STEP_S}" gravity="{gravity}" integrator="RK4" cone="elliptic" impratio="10"/>
      <compiler angle="radian"/>
      <asset>{"".join(assets)}</asset>
      <worldbody>{ground}{"".join(bodies)}</worldbody>
      <contact>{"".join(_pairs(world, geoms))}</contact>
    </mujoco>"""


def _pairs(world: World, geoms: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the pairs that may touch: each free body with everything else."""
    motion = {body.name: body.motion for body in world.bodies}
    names = list(geoms)
    return [
        f'<pair geom1="{one}" geom2="{two}" condim="3"/>'
        for k, first in enumerate(names)
        for second in names[k + 1 :]
        if "free" in (motion.get(first), motion.get(second))
        for one in geoms[first]
        for two in geoms[second]
    ]


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))
