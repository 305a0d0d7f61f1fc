"""Reader of MJCF by MuJoCo's own compiler: bodies, joints, position servos and collision geometry."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ..shapes.meshes import Mesh
from ..shapes.turns import matrix_of
from .articulation import Articulation, GeometryOfLink, JointOfRobot, LinkOfRobot

Array = NDArray[np.float64]
_GEOMS = {2: "sphere", 3: "capsule", 5: "cylinder", 6: "box", 7: "mesh"}


def read_mjcf(path: Path) -> Articulation:
    """Read the first tree of bodies of an MJCF file; see `read_articulation`.

    The frame of a link whose joint does not lie at its body's origin is moved to the joint. A body with several joints
    becomes as many links, of which the last has its mass and geometry. Collision geometry is what has contype or
    conaffinity.
    """
    model = _model_of(path)
    if model.neq:
        raise InputDataError(
            f"{path}: it has {model.neq} equality constraints (loops or joints that mimic others).",
            "a tree of independent joints.",
            "leave <equality> out.",
        )
    _require_plain_joints(path, model)
    trees = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if len(trees) != 1:
        names = ", ".join(model.body(body).name for body in trees)
        raise InputDataError(
            f"{path}: it has {len(trees)} bodies in the world: {names}.",
            "one tree of bodies.",
            "put the robot under one body of the world, or name a file with that body alone.",
        )
    links: dict[str, LinkOfRobot] = {}
    joints: list[JointOfRobot] = []
    ends: dict[int, tuple[str, Array]] = {}
    for body in range(1, model.nbody):
        _append(path, model, body, links, joints, ends)
    return Articulation.tree(path.stem, path, links, joints)


def _model_of(path: Path) -> Any:
    """Return MuJoCo's model of a file."""
    mujoco: Any = importlib.import_module("mujoco")

    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputDataError(
            f"{path}: MuJoCo cannot read it: {' '.join(str(error).split()).rstrip('.')}.",
            "an MJCF file.",
            "open the file in MuJoCo's viewer, which names the fault, and correct it.",
        ) from error


def _require_plain_joints(path: Path, model: Any) -> None:
    """Refuse springs, tendons that pull, and actuators of anything but joints, which chains do not have.

    Raises:
        InputDataError: With the first of them.
    """
    springs = np.flatnonzero(_sizes(model.jnt_stiffness))
    losses = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_limited)
    tendons = np.flatnonzero(sum(map(_sizes, losses)))
    others = np.flatnonzero(model.actuator_trntype != 0)
    for found in (
        *(f"joint '{model.joint(k).name}' has a spring" for k in springs),
        *(f"tendon '{model.tendon(k).name}' has a spring, damping, friction or limits" for k in tendons),
        *(f"actuator '{model.actuator(k).name}' does not act on a joint" for k in others),
    ):
        raise InputDataError(
            f"{path}: {found}.",
            "joints with servos (<position joint=...>), damping, armature, frictionloss and limits.",
            "leave it out, or give the joint a servo in its place.",
        )


def _sizes(numbers: Array) -> Array:
    """Return the sum of the absolute numbers of each row, which may be a single one."""
    return np.array([np.abs(row).sum() for row in numbers])


def _append(
    path: Path, model: Any, body: int, links: dict[str, LinkOfRobot], joints: list[JointOfRobot],
    ends: dict[int, tuple[str, Array]],
) -> None:  # fmt: skip
    """Append the links and joints of a body; `ends` has for each body its last link and that link's place in it."""
    name = model.body(body).name or f"body{body}"
    moving = _moving_joints(path, model, body)
    parent, place = _carrier(model, body, bool(moving), links, ends)
    position, quat = model.body_pos[body] - place, model.body_quat[body]
    if not moving:
        links[name] = _link(model, body, name, np.zeros(3))
        if parent:
            joints.append(
                JointOfRobot(
                    name=f"{name}/fixed", kind="fixed", parent=parent, link=name, position_m=position, quat_wxyz=quat,
                    axis=np.array([0.0, 0.0, 1.0]),
                )
            )  # fmt: skip
    anchor = np.zeros(3)
    for number in moving:
        last = number == moving[-1]
        own = name if last else f"{name}/{model.joint(number).name or number}"
        shift = model.jnt_pos[number] - anchor
        joints.append(_joint(model, number, parent, own, position + matrix_of(quat) @ shift, quat))
        links[own] = _link(model, body, own, model.jnt_pos[number] if last else None)
        parent, position, quat, anchor = own, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), model.jnt_pos[number].copy()
    ends[body] = (name, anchor)


def _moving_joints(path: Path, model: Any, body: int) -> list[int]:
    """Return the hinges and slides of a body.

    Raises:
        InputDataError: If it has another joint, a free one of the root aside.
    """
    root = model.body_parentid[body] == 0
    moving = []
    for number in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
        kind = int(model.jnt_type[number])
        if kind in (2, 3):
            moving.append(number)
        elif not (root and kind == 0):
            raise InputDataError(
                f"{path}: joint '{model.joint(number).name}' is a {'ball' if kind == 1 else 'free'} joint.",
                "hinge, slide; free for the root.",
                "model a ball joint by three hinges.",
            )
    return moving


def _carrier(
    model: Any, body: int, moving: bool, links: dict[str, LinkOfRobot], ends: dict[int, tuple[str, Array]]
) -> tuple[str, Array]:
    """Return the link above a body, "" for none, and its place in the parent body; joints of the root have the world.

    Args:
        model: The model.
        body: The body.
        moving: Whether it has joints that move.
        links: The links so far, to which the world is added.
        ends: As in `_append`.
    """
    if model.body_parentid[body] != 0:
        return ends[int(model.body_parentid[body])]
    if not moving:
        return "", np.zeros(3)
    links["world"] = LinkOfRobot(
        name="world", mass_kg=0.0, com_m=np.zeros(3), inertia_kg_m2=np.zeros((3, 3)), geometry=()
    )
    return "world", np.zeros(3)


def _joint(model: Any, number: int, parent: str, link: str, position: Array, quat: Array) -> JointOfRobot:
    dof = model.jnt_dofadr[number]
    limited = bool(model.jnt_limited[number])
    stiffness, extra, limit = _servo(model, number)
    return JointOfRobot(
        name=model.joint(number).name or f"joint{number}",
        kind="hinge" if model.jnt_type[number] == 3 else "slide",
        parent=parent,
        link=link,
        position_m=position,
        quat_wxyz=quat.copy(),
        axis=model.jnt_axis[number].copy(),
        lower=float(model.jnt_range[number, 0]) if limited else -math.inf,
        upper=float(model.jnt_range[number, 1]) if limited else math.inf,
        stiffness=stiffness,
        damping=float(model.dof_damping[dof]) + extra,
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
        torque_limit=limit,
    )


def _servo(model: Any, joint: int) -> tuple[float, float, float]:
    """Return stiffness, damping and largest torque of the first actuator of a joint; 0, 0 and infinity without one."""
    for k in range(model.nu):
        if model.actuator_trntype[k] == 0 and model.actuator_trnid[k, 0] == joint:
            stiffness, damping = (max(0.0, -float(value)) for value in model.actuator_biasprm[k, 1:3])
            limited = bool(model.actuator_forcelimited[k])
            return stiffness, damping, float(model.actuator_forcerange[k, 1]) if limited else math.inf
    return 0.0, 0.0, math.inf


def _link(model: Any, body: int, name: str, origin: Array | None) -> LinkOfRobot:
    """Return a link with its frame at `origin` of a body; for None one without mass."""
    if origin is None:
        return LinkOfRobot(name=name, mass_kg=0.0, com_m=np.zeros(3), inertia_kg_m2=np.zeros((3, 3)), geometry=())
    turn = matrix_of(model.body_iquat[body])
    geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
    parts = [
        _geometry(model, geom, origin)
        for geom in geoms
        if (model.geom_contype[geom] or model.geom_conaffinity[geom]) and int(model.geom_type[geom]) in _GEOMS
    ]
    return LinkOfRobot(
        name=name,
        mass_kg=float(model.body_mass[body]),
        com_m=model.body_ipos[body] - origin,
        inertia_kg_m2=turn @ np.diag(model.body_inertia[body]) @ turn.T,
        geometry=tuple(parts),
    )


def _geometry(model: Any, geom: int, origin: Array) -> GeometryOfLink:
    kind, size = _GEOMS[int(model.geom_type[geom])], model.geom_size[geom]
    sizes = {"sphere": size[:1], "capsule": size[:2], "cylinder": size[:2], "box": size[:3], "mesh": size[:0]}[kind]
    mesh = None
    if kind == "mesh":
        data = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[data], model.mesh_vertnum[data]
        face, faces = model.mesh_faceadr[data], model.mesh_facenum[data]
        mesh = Mesh(
            np.asarray(model.mesh_vert[first : first + count], dtype=np.float64),
            np.asarray(model.mesh_face[face : face + faces], dtype=np.int64),
        )
    return GeometryOfLink(
        kind=kind,
        size_m=tuple(float(x) for x in sizes),
        rotation=matrix_of(model.geom_quat[geom]),
        position_m=model.geom_pos[geom] - origin,
        mesh=mesh,
    )
