"""MuJoCo with soft contacts and soft friction, as for a rubber ball: restitution falls when the body slips or spins.

Springs of 330 to 420 / s and damping ratios of 0.10 to 0.18, drawn by body (from its contact's two numbers); friction
with a time constant of 2 ms, elliptic cones, impedance 0.95, `impratio` 10, steps of 0.5 ms. A ball rebounds with 0.72
to 0.74 without spin, and less the slower it comes down while it spins. That is no effect of speed alone, and no effect
of the library: `velocity_restitution` is a wrong name here.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Mechanics, Motion, Reader, Start
from cgwm.datasets.synthetic.hidden_effects.things import Array, Thing

mujoco: Any = importlib.import_module("mujoco")
STEP_S = 5e-4


def simulate(mechanics: Mechanics, hidden: Sequence[Hidden], start: Start, length_s: float) -> Motion:
    """Return the motion of a body from a first state on; see `hidden_effects.mujoco_engine.simulate`."""
    model = mujoco.MjModel.from_xml_string(_xml(mechanics))
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate((start.position_m, start.quat_wxyz))
    data.qvel[:] = np.concatenate((start.velocity_m_s, start.omega_body_rad_s))
    count = int(np.ceil(length_s / STEP_S)) + 1
    poses, touching = np.empty((count, 7)), np.zeros(count, bool)
    pushes = [effect.wrench for effect in hidden if effect.wrench]
    touches = [effect.touch for effect in hidden if effect.touch]
    reader, ratio = Reader(mechanics), np.ones(len(model.pair_dim))
    mujoco.mj_forward(model, data)
    for step in range(count):
        poses[step], touching[step] = data.qpos, data.ncon > 0
        if pushes or touches:
            pressed = _pressed(model, data)
            moment = reader.moment(step * STEP_S, data.qpos[:3], data.qpos[3:], data.qvel[:3], data.qvel[3:], pressed)
            for touch in touches:
                touch(moment, model.pair_friction[:, :2], ratio)
            if pushes:
                force, torque = (np.sum(parts, axis=0) for parts in zip(*(p(moment) for p in pushes), strict=True))
                data.xfrc_applied[1, :3], data.xfrc_applied[1, 3:] = force, torque
        mujoco.mj_step(model, data)
    if not np.isfinite(poses).all():
        raise ArithmeticError("MuJoCo's motion is not finite")
    return Motion(np.arange(count, dtype=np.float64) * STEP_S, poses[:, :3], poses[:, 3:], touching)


def facts(thing: Thing) -> dict[str, Any]:
    """Return what the truth says of the engine."""
    frequency, ratio = spring_of(thing)
    numbers = {"natural_frequency_rad_s": frequency, "damping_ratio": ratio}
    return {"name": "mujoco_soft", "version": mujoco.__version__, "comes_with": [], **numbers}


def spring_of(thing: Thing) -> tuple[float, float]:
    """Return the contact's natural frequency [rad/s] and damping ratio [1].

    They lie in their ranges where a body's own lie in those of `draw_thing`: 0.7 to 1 ms, and 0.16 to 0.45.
    """
    fast = np.clip((thing.natural_time_s - 0.7e-3) / 0.3e-3, 0.0, 1.0)
    damped = np.clip((thing.damping_ratio - 0.16) / 0.29, 0.0, 1.0)
    return float(420.0 - 90.0 * fast), float(0.10 + 0.08 * damped)


def _pressed(model: Any, data: Any) -> Array:
    """Return the normal forces (n,) [N] of the points in the previous step."""
    pressed, force = np.zeros(len(model.pair_dim)), np.empty(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        pressed[max(data.contact[k].geom) - 1] += force[0]  # the ground is geom 0, the points follow
    return pressed


def _xml(mechanics: Mechanics) -> str:
    thing = mechanics.thing
    (middles, radius), (frequency, ratio) = thing.spheres, spring_of(thing)
    geoms = "".join(
        f'<geom name="p{k}" type="sphere" size="{radius!r}" pos="{_words(middle)}" contype="0" conaffinity="0"/>'
        for k, middle in enumerate(middles)
    )
    solref, friction = (
        _words((-(frequency**2), -2 * ratio * frequency)),
        _words((*mechanics.friction, 5e-3, 1e-4, 1e-4)),
    )
    pairs = "".join(
        f'<pair geom1="p{k}" geom2="ground" condim="3" friction="{friction}" solref="{solref}"'
        f' solreffriction="0.002 1" solimp="0.95 0.95 0.001"/>'
        for k in range(len(middles))
    )
    six = mechanics.inertia_kg_m2[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f"""<mujoco>
      <option timestep="{STEP_S!r}" gravity="{_words(mechanics.gravity_m_s2)}" impratio="10" cone="elliptic"/>
      <worldbody>
        <geom name="ground" type="plane" size="9 9 1" contype="0" conaffinity="0"/>
        <body name="body"><freejoint/>{geoms}
          <inertial pos="{_words(mechanics.com_m)}" mass="{thing.mass_kg!r}" fullinertia="{_words(six)}"/></body>
      </worldbody>
      <contact>{pairs}</contact>
    </mujoco>"""


def _words(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))
