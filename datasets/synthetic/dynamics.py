"""The true motion: MuJoCo with stiff contacts and small steps, recorded at every step."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..shapes.interpolation import by_column
from .friction import CoulombFriction
from .objects import SolidObject

Array = NDArray[np.float64]

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs, so that type checkers do not know its names
MjModel: TypeAlias = Any
"""A `mujoco.MjModel`."""

STEPS_PER_S = 3600
"""Steps per second; a multiple of every frame and track rate used, so that no sample needs interpolation."""
OBJECT, FINGERTIP = "object", "fingertip"
FINGERTIP_RADIUS = 0.012
GRAVITY = 9.81
GROUND_GROUP, BODY_GROUP = 0, 1
_FINGERTIP_MASS = 1e4  # so heavy that contact does not deflect it from its commanded path


@dataclass(frozen=True)
class ContactTruth:
    """Parameters of the true contact: a damped spring along the normal, and Coulomb friction.

    Args:
        friction: Friction coefficient between object and ground [1].
        friction_fingertip: The same between object and fingertip [1].
        natural_time: Inverse of the natural angular frequency of a contact [s].
        damping_ratio: Damping ratio of a contact [1]; a smaller one gives a higher bounce.
        impedance: MuJoCo's constraint impedance [1], the same at every depth.
    """

    friction: float
    friction_fingertip: float
    natural_time: float
    damping_ratio: float
    impedance: float

    @property
    def solref(self) -> tuple[float, float]:
        """MuJoCo's (timeconst, dampratio), where timeconst · dampratio is the natural time."""
        return self.natural_time / self.damping_ratio, self.damping_ratio


def draw_contact(rng: np.random.Generator) -> ContactTruth:
    """Draw contact parameters: contacts of about 10 ms, restitution of roughly 0.15 to 0.45."""
    values = rng.uniform([0.25, 0.2, 0.0025, 0.25, 0.95], [0.5, 0.4, 0.004, 0.5, 0.99])
    return ContactTruth(*(float(np.round(value, 5)) for value in values))


@dataclass(frozen=True)
class Motion:
    """True motion of one episode, one row for each step of 1 / STEPS_PER_S; row 0 may lie before time zero.

    Args:
        start: Time of the first row [s].
        qpos: MuJoCo positions: object position [m] and quat_wxyz, then the fingertip's position if there is one.
        qvel: MuJoCo velocities: object velocity of the body frame's origin [m/s], omega_body [rad/s], fingertip's.
        first_contact: Time of the object's first contact with the fingertip, or with the ground in scenes without a
            fingertip [s]; None if they never touch.
    """

    start: float
    qpos: Array
    qvel: Array
    first_contact: float | None

    def row(self, time: float) -> int:
        """Return the row at a time [s], which must be a multiple of the step to within rounding."""
        return round((time - self.start) * STEPS_PER_S)

    def rows(self, times: Array) -> NDArray[np.int64]:
        """Return the rows at several times [s], shape (time,)."""
        return np.round((times - self.start) * STEPS_PER_S).astype(np.int64)


def build_model(solid: SolidObject, contact: ContactTruth, fingertip: bool, mat_half: float = 1.0) -> MjModel:
    """Build the MuJoCo model: ground plane z = 0, the object with a free joint, and optionally a fingertip.

    Contacts are explicit pairs, whose friction `CoulombFriction` sets in every step.

    Args:
        solid: The object.
        contact: Its contact parameters.
        fingertip: Whether there is a fingertip, on three slide joints.
        mat_half: Half the side of the textured mat [m]; rays beyond it hit nothing; the collision plane is infinite.
    """
    names = [f"part{index}" for index in range(len(solid.parts))]
    assets, geoms = _parts(solid, names)
    moments = solid.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    pairs = [_pair(name, "ground", contact.friction, contact) for name in names]
    if fingertip:
        pairs += [_pair(name, FINGERTIP, contact.friction_fingertip, contact) for name in names]
    xml = f"""<mujoco>
      <option timestep="{1 / STEPS_PER_S!r}" gravity="0 0 {-GRAVITY}" integrator="RK4" cone="elliptic" impratio="20"
        tolerance="1e-12" iterations="50"/>
      <compiler angle="radian"/>
      <asset>{"".join(assets)}</asset>
      <worldbody>
        <geom name="ground" type="plane" size="{mat_half} {mat_half} 0.1" group="{GROUND_GROUP}"
          contype="0" conaffinity="0"/>
        <body name="{OBJECT}"><freejoint/>
          <inertial pos="{_text(solid.com)}" mass="{solid.mass}" fullinertia="{_text(moments)}"/>
          {"".join(geoms)}
        </body>
        {_tip() if fingertip else ""}
      </worldbody>
      <contact>{"".join(pairs)}</contact>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def _parts(solid: SolidObject, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the meshes and the geoms of an object's parts; one that is a box along the axes is no mesh."""
    assets, geoms = [], []
    for name, part in zip(names, solid.parts, strict=True):
        middle, half = (part.max(axis=0) + part.min(axis=0)) / 2, (part.max(axis=0) - part.min(axis=0)) / 2
        if np.allclose(np.abs(part - middle), half):
            form = f'type="box" pos="{_text(middle)}" size="{_text(half)}"'
        else:
            assets.append(f'<mesh name="{name}" vertex="{_text(part.ravel())}"/>')
            form = f'type="mesh" mesh="{name}"'
        geoms.append(f'<geom name="{name}" {form} group="{BODY_GROUP}" contype="0" conaffinity="0"/>')
    return assets, geoms


def _tip() -> str:
    """Return the fingertip on its slides."""
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    return (
        f'<body name="{FINGERTIP}" gravcomp="1">{joints}<geom name="{FINGERTIP}" type="sphere" '
        f'size="{FINGERTIP_RADIUS}" mass="{_FINGERTIP_MASS}" group="{BODY_GROUP}" '
        f'contype="0" conaffinity="0"/></body>'
    )


def simulate(
    model: MjModel,
    qpos: Array,
    qvel: Array,
    start: float,
    end: float,
    command: tuple[Array, Array] | None = None,
) -> Motion:
    """Simulate from `start` to `end` [s] and record every step.

    Args:
        model: From :func:`build_model`.
        qpos: Object position [m] and quat_wxyz at `start`, shape (7,).
        qvel: Object velocity [m/s] and omega_body [rad/s] at `start`, shape (6,).
        start: Time of the initial state [s].
        end: Time of the last recorded state [s].
        command: The fingertip's position [m] and velocity [m/s] at every step, each of shape (step, 3); required if
            the model has one. `first_contact` then refers to the fingertip.
    """
    data = mujoco.MjData(model)
    data.qpos[:7], data.qvel[:6] = qpos, qvel
    count = round((end - start) * STEPS_PER_S) + 1
    positions, velocities = np.empty((count, model.nq)), np.empty((count, model.nv))
    first_contact, friction = None, CoulombFriction(model, OBJECT)
    partner = model.geom("ground" if command is None else FINGERTIP).id
    for step in range(count):
        if command is not None:
            data.qpos[7:], data.qvel[6:] = command[0][step], command[1][step]
        positions[step], velocities[step] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
        friction.update(data)
        # In scenes with a fingertip, contacts with the ground do not count.
        if first_contact is None and data.ncon and partner in data.contact.geom:
            first_contact = start + step / STEPS_PER_S
    return Motion(start, positions, velocities, first_contact)


def smooth_path(points: Array, speed: float, ramp: float, times: Array) -> tuple[Array, Array]:
    """Return positions and velocities along a polyline from time zero on, with smooth start, end and corners.

    The velocity is the piecewise constant velocity of the legs, averaged over a window of `ramp`, so that the
    acceleration is bounded.

    Args:
        points: Corners of the path [m], shape (corner, 3).
        speed: Speed along the legs [m/s].
        ramp: Width of the averaging window [s].
        times: Times [s], shape (time,).

    Returns:
        Position [m] and velocity [m/s] at the times, each of shape (time, 3).
    """
    legs = np.diff(points, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    arrivals = np.concatenate([[0.0], np.cumsum(lengths / speed)])
    knots = np.concatenate([[-1e3], arrivals, [1e3]])
    corners = np.concatenate([points[:1], points, points[-1:]])

    # Exact integral of the piecewise linear path at its knots; between them the integral is quadratic.
    areas = np.concatenate([[np.zeros(3)], np.cumsum((corners[1:] + corners[:-1]) / 2 * np.diff(knots)[:, None], 0)])

    def position(at: Array) -> Array:
        return by_column(at, knots, corners)

    def integral(at: Array) -> Array:
        index = np.searchsorted(knots, at).clip(1, len(knots) - 1) - 1
        return areas[index] + (corners[index] + position(at)) / 2 * (at - knots[index])[:, None]

    # The averaging window lies in the past, so that the path starts at rest at time zero.
    return (integral(times) - integral(times - ramp)) / ramp, (position(times) - position(times - ramp)) / ramp


def lowest(solid: SolidObject, quat_wxyz: Array) -> float:
    """Return the depth of the lowest point of the solid below its body frame's origin, for an orientation [m]."""
    return float(-(solid.vertices @ matrix_from_quat(quat_wxyz).T)[:, 2].min())


def matrix_from_quat(quat_wxyz: Array) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat_wxyz, float))
    return matrix.reshape(3, 3)


def quat_from_matrix(matrix: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix (3, 3), with w >= 0."""
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.ascontiguousarray(matrix, float).ravel())
    return quat_wxyz if quat_wxyz[0] >= 0 else -quat_wxyz


def rest_pose(solid: SolidObject, down_body: Array, yaw: float, x: float, y: float) -> Array:
    """Return the pose of the object at rest on a facet, as MuJoCo's qpos: position [m] and quat_wxyz, shape (7,).

    Args:
        solid: The object.
        down_body: Outward normal of the facet that lies on the ground, body frame.
        yaw: Turn about the vertical [rad].
        x: Position of the body frame's origin [m].
        y: The same.
    """
    side = np.cross(down_body, [1.0, 0, 0] if abs(down_body[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    up = -np.asarray(down_body)
    upright = np.stack([side, np.cross(up, side), up])
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    quat_wxyz = quat_from_matrix(turn @ upright)
    return np.concatenate([[x, y, lowest(solid, quat_wxyz)], quat_wxyz])


def _pair(geom: str, other: str, friction: float, contact: ContactTruth) -> str:
    solref = "{!r} {!r}".format(*contact.solref)
    impedance = f"{contact.impedance} {contact.impedance} 0.001"
    return (
        f'<pair geom1="{geom}" geom2="{other}" condim="3" friction="{friction} {friction} 0.005 0.0001 0.0001" '
        f'solref="{solref}" solimp="{impedance}"/>'
    )


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
