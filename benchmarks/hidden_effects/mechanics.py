"""MuJoCo as the truth: one body over a plane, with whatever hidden effects act on it.

A box touches by eight small spheres in its corners, each a contact pair of its own. Contacts are stiff against a frame
(2 to 6 ms). Friction is Coulomb's: MuJoCo's time constant of slip is set in every step by `CoulombFriction`, for with
a constant one a glancing impact is lifted, by as much as a restitution of 0.8 where 0.45 was asked for.

Law 1: hard contacts with MuJoCo's impedance nearly constant, elliptic cones. Law 2: contacts twice as long, whose
impedance grows from 0.8 to 0.98 within 2 mm of depth, so that hard impacts bounce otherwise than soft ones, elliptic
cones. Law 3: as law 2, with pyramidal cones and slip as MuJoCo has it by itself, lifts included; no ground does that,
and no list of cases holds it: it serves to try what a wrong truth does.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from cgwm.datasets.scenes.friction import CoulombFriction
from numpy.typing import NDArray

from .things import Thing

mujoco: Any = importlib.import_module("mujoco")

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
STEP_S = 2e-4
BODY, GROUND = "body", "ground"
_CONE = {1: "elliptic", 2: "elliptic", 3: "pyramidal"}
_IMPEDANCE = {1: "0.95 0.99 0.001", 2: "0.8 0.98 0.002", 3: "0.8 0.98 0.002"}


@dataclass(frozen=True, eq=False)
class Mechanics:
    """What the engine is told of the world before it starts; effects change it.

    Args:
        thing: The body.
        law: Of the contact: 1, 2 or 3.
        com_m: The centre of mass, body frame (3,).
        inertia_kg_m2: About the centre of mass, body axes (3, 3).
        gravity_m_s2: World axes (3,).
        friction: Coefficients along the world's y and x (2,): MuJoCo's cone may be an ellipse.
    """

    thing: Thing
    law: int
    com_m: Array
    inertia_kg_m2: Array
    gravity_m_s2: Array
    friction: tuple[float, float]

    @classmethod
    def of(cls, thing: Thing, law: int) -> Mechanics:
        """Return the world without any effect."""
        inertia, gravity = np.diag(thing.inertia_kg_m2), np.array([0.0, 0.0, -GRAVITY_M_S2])
        return cls(thing, law, np.zeros(3), inertia, gravity, (thing.friction, thing.friction))


@dataclass(eq=False)
class Moment:
    """The state at one time, in world axes.

    time_s; com_m, velocity_m_s (of the centre of mass), omega_rad_s (3,); rotation body to world (3, 3); inertia_kg_m2
    about the centre of mass (3, 3). Of the points that may touch: arms_m from the centre of mass (n, 3),
    heights_m (n,), velocities_m_s (n, 3), pressed_n (n,): the ground's normal force in the step before.
    """

    time_s: float
    mass_kg: float
    com_m: Array
    velocity_m_s: Array
    omega_rad_s: Array
    rotation: Array
    inertia_kg_m2: Array
    arms_m: Array
    heights_m: Array
    velocities_m_s: Array
    pressed_n: Array


Wrench = tuple[Array, Array]
"""Force [N] at the centre of mass and torque [N m] about it, world axes."""


@dataclass(frozen=True, eq=False)
class Hidden:
    """One effect with its true numbers: any of the hooks, each of which does nothing where it is None.

    Args:
        name: Of the effect; that of `cgwm effects list` where it is one of them.
        values: Its true numbers, as they go into the truth.
        form: What the truth is, in words.
        comes_with: Other effects of the library that the truth holds by its nature.
        build: Changes the world before the start.
        wrench: Force and torque at a moment.
        touch: Sets friction (n, 2) and damping ratio (n,) of the points for the next step, in place.
        clock: Measured time over true time [1].
        observe: What is measured of positions (T, 3) and rotations body to world (T, 3, 3).
    """

    name: str
    values: dict[str, Any]
    form: str
    comes_with: tuple[str, ...] = ()
    build: Callable[[Mechanics], Mechanics] | None = None
    wrench: Callable[[Moment], Wrench] | None = None
    touch: Callable[[Moment, Array, Array], None] | None = None
    clock: float = 1.0
    observe: Callable[[Array, Array], tuple[Array, Array]] | None = None


@dataclass(frozen=True, eq=False)
class Start:
    """A first state: the body frame's origin and its velocity (world axes), quat_wxyz, omega in BODY axes."""

    position_m: Array
    quat_wxyz: Array
    velocity_m_s: Array
    omega_body_rad_s: Array


@dataclass(frozen=True, eq=False)
class Motion:
    """The true motion, one row a step: time_s (T,), position_m of the body frame's origin (T, 3), quat_wxyz (T, 4).

    touching (T,): whether any point is in contact.
    """

    time_s: Array
    position_m: Array
    quat_wxyz: Array
    touching: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))


def build(mechanics: Mechanics, hidden: Sequence[Hidden]) -> Mechanics:
    """Return the world with the effects that act before the start."""
    for effect in hidden:
        mechanics = effect.build(mechanics) if effect.build else mechanics
    return mechanics


def simulate(mechanics: Mechanics, hidden: Sequence[Hidden], start: Start, length_s: float) -> Motion:
    """Return the motion of a body from a first state on.

    Args:
        mechanics: The world, effects that act before the start already in it (`build`).
        hidden: The effects.
        start: The first state.
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
    here = _Reader(mechanics)
    mujoco.mj_forward(model, data)
    for step in range(count):
        poses[step], touching[step] = data.qpos, data.ncon > 0
        if pushes or touches:
            moment = here.moment(step * STEP_S, model, data)
            for touch in touches:
                ratio = model.pair_solref[:, 1].copy()
                touch(moment, model.pair_friction[:, :2], ratio)
                model.pair_solref[:, 0] = mechanics.thing.natural_time_s / ratio
                model.pair_solref[:, 1] = ratio
            if pushes:
                force, torque = (np.sum(parts, axis=0) for parts in zip(*(p(moment) for p in pushes), strict=True))
                data.xfrc_applied[1, :3], data.xfrc_applied[1, 3:] = force, torque
        mujoco.mj_step(model, data)
        if friction:
            friction.update(data)
    if not np.isfinite(poses).all():
        raise ArithmeticError("MuJoCo's motion is not finite")
    return Motion(np.arange(count, dtype=np.float64) * STEP_S, poses[:, :3], poses[:, 3:], touching)


class _Reader:
    """Reads what effects look at from MuJoCo's state before a step."""

    def __init__(self, mechanics: Mechanics) -> None:
        middles, self._radius = mechanics.thing.spheres
        self._com, self._arms = mechanics.com_m, middles - mechanics.com_m
        self._mass, self._inertia = mechanics.thing.mass_kg, mechanics.inertia_kg_m2
        self._matrix, self._contact = np.empty(9), np.empty(6)

    def moment(self, time_s: float, model: Any, data: Any) -> Moment:
        """Return the state in world axes."""
        mujoco.mju_quat2Mat(self._matrix, data.qpos[3:7])
        rotation = self._matrix.reshape(3, 3).copy()
        omega = rotation @ data.qvel[3:6]
        offset = rotation @ self._com
        com, velocity = data.qpos[:3] + offset, data.qvel[:3] + cross(omega, offset)
        arms = self._arms @ rotation.T
        arms[:, 2] -= self._radius
        inertia = rotation @ self._inertia @ rotation.T
        heights, moving = com[2] + arms[:, 2], velocity + cross_rows(omega, arms)
        pressed = np.zeros(len(arms))
        for k in range(data.ncon):
            mujoco.mj_contactForce(model, data, k, self._contact)
            pressed[max(data.contact[k].geom) - 1] += self._contact[0]  # the ground is geom 0, the points follow
        return Moment(time_s, self._mass, com, velocity, omega, rotation, inertia, arms, heights, moving, pressed)


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors; a tenth of `np.cross`'s time."""
    (x, y, z), (u, v, w) = a, b
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def cross_rows(a: Array, rows: Array) -> Array:
    """Return a x each row, for a vector a and rows (n, 3)."""
    return rows @ np.array([[0.0, a[2], -a[1]], [-a[2], 0.0, a[0]], [a[1], -a[0], 0.0]])


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


def version() -> str:
    """Return the engine's name and version."""
    return f"mujoco {mujoco.__version__}"
