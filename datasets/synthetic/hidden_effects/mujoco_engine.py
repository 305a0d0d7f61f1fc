"""Simulation of the truth with MuJoCo: one body over a plane, with hidden effects.

A box touches the ground with eight small spheres in its corners, each a separate contact pair. Contacts are short
relative to a frame (2 to 6 ms). Friction is Coulomb's: `CoulombFriction` sets MuJoCo's time constant of slip in every
step, because a constant one lifts the body in oblique impacts (restitution 0.8 instead of the specified 0.45).

Law 1: hard contacts with MuJoCo's impedance nearly constant, elliptic cones. Law 2: contacts twice as long, whose
impedance grows from 0.8 to 0.98 within 2 mm of depth, so that the restitution depends on the impact speed, elliptic
cones. Law 3: as law 2, with pyramidal cones and MuJoCo's default treatment of slip, including the lift. It is not
physical and in no list of cases; it serves to study the effect of a wrong simulator.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..friction import CoulombFriction
from .mechanics import STEP_S, Hidden, Mechanics, Moment, Motion, Reader, Start
from .things import Array, Thing

mujoco: Any = importlib.import_module("mujoco")

BODY, GROUND = "body", "ground"
_CONE = {1: "elliptic", 2: "elliptic", 3: "pyramidal"}
_IMPEDANCE = {1: "0.95 0.99 0.001", 2: "0.8 0.98 0.002", 3: "0.8 0.98 0.002"}


def simulate(mechanics: Mechanics, hidden: Sequence[Hidden], start: Start, length_s: float) -> Motion:
    """Simulate a body from an initial state, and return its motion.

    Args:
        mechanics: The world, to which the `build` hooks have been applied.
        hidden: The effects.
        start: The initial state.
        length_s: Length [s].
    """
    model = mujoco.MjModel.from_xml_string(_xml(mechanics))
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate((start.position_m, start.quat_wxyz))
    data.qvel[:] = np.concatenate((start.velocity_m_s, start.omega_body_rad_s))
    friction = CoulombFriction(model, BODY) if mechanics.law != 3 else None
    count = int(np.ceil(length_s / STEP_S)) + 1
    poses, touching = np.empty((count, 7)), np.zeros(count, bool)
    pushes = [effect.wrench for effect in hidden if effect.wrench]
    touches = [effect.touch for effect in hidden if effect.touch]
    reader = Reader(mechanics)
    mujoco.mj_forward(model, data)
    for step in range(count):
        poses[step], touching[step] = data.qpos, data.ncon > 0
        if pushes or touches:
            pressed = _pressed(model, data, len(model.pair_dim))
            moment = reader.moment(step * STEP_S, data.qpos[:3], data.qpos[3:], data.qvel[:3], data.qvel[3:], pressed)
            for touch in touches:
                _change_contact(model, mechanics, touch, moment)
            data.xfrc_applied[1] = _sum_of(pushes, moment)
        mujoco.mj_step(model, data)
        if friction:
            friction.update(data)
    if not np.isfinite(poses).all():
        raise ArithmeticError("MuJoCo's motion is not finite")
    return Motion(np.arange(count, dtype=np.float64) * STEP_S, poses[:, :3], poses[:, 3:], touching)


def _sum_of(pushes: Sequence[Callable[[Moment], tuple[Array, Array]]], moment: Moment) -> Array:
    """Return the force and the torque (6,) of effects together."""
    return np.sum([np.zeros(6), *(np.concatenate(push(moment)) for push in pushes)], axis=0)


def _change_contact(
    model: Any, mechanics: Mechanics, touch: Callable[[Moment, Array, Array], None], moment: Moment
) -> None:
    """Set friction and damping of all pairs as an effect wants them."""
    ratio = model.pair_solref[:, 1].copy()
    touch(moment, model.pair_friction[:, :2], ratio)
    model.pair_solref[:, 0] = mechanics.thing.natural_time_s / ratio
    model.pair_solref[:, 1] = ratio


def _pressed(model: Any, data: Any, count: int) -> Array:
    """Return the normal forces (n,) [N] of the points in the previous step."""
    pressed, force = np.zeros(count), np.empty(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        pressed[max(data.contact[k].geom) - 1] += force[0]  # the ground is geom 0, the points follow
    return pressed


def facts(thing: Thing) -> dict[str, Any]:
    """Return the facts about the simulator that the truth file records."""
    return {"name": "mujoco", "version": mujoco.__version__, "comes_with": []}


def _xml(mechanics: Mechanics) -> str:
    thing = mechanics.thing
    middles, radius = thing.spheres
    geoms = "".join(
        f'<geom name="p{k}" type="sphere" size="{radius!r}" pos="{_words(middle)}" contype="0" conaffinity="0"/>'
        for k, middle in enumerate(middles)
    )
    friction = _words((*mechanics.friction, 0.005, 1e-4, 1e-4))
    solref = _words((thing.natural_time_s / thing.damping_ratio, thing.damping_ratio))
    pairs = "".join(
        f'<pair geom1="p{k}" geom2="{GROUND}" condim="3" friction="{friction}" solref="{solref}"'
        f' solimp="{_IMPEDANCE[mechanics.law]}"/>'
        for k in range(len(middles))
    )
    six = mechanics.inertia_kg_m2[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f"""<mujoco>
      <option timestep="{STEP_S!r}" gravity="{_words(mechanics.gravity_m_s2)}" integrator="RK4" impratio="20"
        cone="{_CONE[mechanics.law]}" tolerance="1e-12" iterations="50"/>
      <worldbody>
        <geom name="{GROUND}" type="plane" size="9 9 1" contype="0" conaffinity="0"/>
        <body name="{BODY}"><freejoint/>{geoms}
          <inertial pos="{_words(mechanics.com_m)}" mass="{thing.mass_kg!r}" fullinertia="{_words(six)}"/></body>
      </worldbody>
      <contact>{pairs}</contact>
    </mujoco>"""


def _words(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))
