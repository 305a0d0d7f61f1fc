"""Reader of MJCF by MuJoCo's own compiler: bodies, joints, position servos and collision geometry."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ..shapes.meshes import Mesh
from ..shapes.turns import matrix_of
from .articulation import Articulation, GeometryOfLink, JointOfRobot, LinkOfRobot

Array = NDArray[np.float64]
_GEOMS = {2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 7: "mesh"}
_OTHER_GEOMS = {0: "plane", 1: "height field", 8: "signed distance field"}


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
            f"{path}: it has {f'{len(trees)} bodies in the world: {names}' if trees else 'no body in the world'}.",
            "one tree of bodies.",
            "put the robot under one body of the world, or name a file with that body alone.",
        )
    links: dict[str, LinkOfRobot] = {}
    joints: list[JointOfRobot] = []
    ends: dict[int, tuple[str, Array]] = {}
    for body in range(1, model.nbody):
        _append(path, model, body, links, joints, ends)
    outside = tuple(model.geom(geom).name or f"geom {geom}" for geom in _solid(model, 0))
    return replace(Articulation.tree(path.stem, path, links, joints), outside=outside)


def _solid(model: Any, body: int) -> list[int]:
    """Return the geoms of a body that collide."""
    first = model.body_geomadr[body]
    geoms = range(first, first + model.body_geomnum[body])
    return [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]


def _model_of(path: Path) -> Any:
    """Return MuJoCo's model of a file."""
    mujoco: Any = importlib.import_module("mujoco")

    try:
        return mujoco.MjModel.from_xml_path(str(path.absolute()))
    except ValueError as error:
        raise InputDataError(
            f"{path}: MuJoCo cannot read it: {' '.join(str(error).split()).rstrip('.')}.",
            "an MJCF file.",
            "open the file in MuJoCo's viewer, which names the fault, and correct it.",
        ) from error


def _require_plain_joints(path: Path, model: Any) -> None:
    """Refuse springs, values that do not begin at 0, tendons that pull, and actuators of anything but joints.

    Raises:
        InputDataError: With the first of them.
    """
    springs = np.flatnonzero(_sizes(model.jnt_stiffness))
    losses = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_limited)
    tendons = np.flatnonzero(sum(map(_sizes, losses)))
    others = np.flatnonzero(model.actuator_trntype != 0)
    shifted = [k for k in range(model.njnt) if model.jnt_type[k] in (2, 3) and model.qpos0[model.jnt_qposadr[k]] != 0]
    for found in (
        *(f"joint {_called(model.joint(k))} has a spring" for k in springs),
        *(f"joint {_called(model.joint(k))} is not 0 where the file draws it (ref)" for k in shifted),
        *(f"tendon '{model.tendon(k).name}' has a spring, damping, friction or limits" for k in tendons),
        *(f"actuator {_called(model.actuator(k))} does not act on a joint" for k in others),
        *_odd_servos(model),
    ):
        raise InputDataError(
            f"{path}: {found}.",
            "joints with one servo each (<position joint=...>), damping, armature, frictionloss and limits.",
            "leave it out, or give the joint a servo in its place.",
        )


def _odd_servos(model: Any) -> Iterator[str]:
    """Yield what no servo of a chain can do: follow its target late, or pull in one direction alone."""
    lags = np.flatnonzero(model.actuator_dyntype != 0)
    yield from (f"actuator {_called(model.actuator(k))} has dynamics of its own (intvelocity, timeconst)" for k in lags)
    for joint in range(model.njnt):
        servos = servos_of(model, joint)
        if len(servos) > 1:
            yield f"joint {_called(model.joint(joint))} has {len(servos)} servos"
        if servos and not largest_force(model, joint, servos[0]) > 0:
            yield f"actuator {_called(model.actuator(servos[0]))} pulls in one direction alone, by its range of forces"


def _called(found: Any) -> str:
    """Return the name of a joint or an actuator for a message; its number, from 0, where it has none."""
    return f"'{found.name}'" if found.name else f"number {found.id}"


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
        links[name] = _link(path, model, body, name, np.zeros(3))
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
        links[own] = _link(path, model, body, own, model.jnt_pos[number] if last else None)
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
    servo = _servo(model, number)
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
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
        **(servo | {"damping": float(model.dof_damping[dof]) + servo["damping"]}),
    )


def servos_of(model: Any, joint: int) -> list[int]:
    """Return the actuators of a joint that pull it towards a target: a motor would take a target for a torque."""
    return [
        k
        for k in range(model.nu)
        if model.actuator_trntype[k] == 0
        and model.actuator_trnid[k, 0] == joint
        and (model.actuator_gaintype[k], model.actuator_biastype[k]) == (0, 1)
        and model.actuator_gainprm[k, 0] > 0 > model.actuator_biasprm[k, 1]
        and model.actuator_gear[k, 0] != 0
    ]


def control_of(model: Any, servo: int) -> tuple[float, float]:
    """Return factor and offset of the control of a servo by the target of its joint, where it comes to rest.

    They are 1 and 0 for a <position> without gear; gears and the numbers of a <general> change them.
    """
    gain, (bias, pull) = float(model.actuator_gainprm[servo, 0]), model.actuator_biasprm[servo, :2].tolist()
    return -pull * float(model.actuator_gear[servo, 0]) / gain, -bias / gain


def largest_force(model: Any, joint: int, servo: int) -> float:
    """Return the largest torque or force of a servo on its joint to either side [N m or N]."""
    most = math.inf
    if model.actuator_forcelimited[servo]:
        low, high = model.actuator_forcerange[servo].tolist()
        most = abs(float(model.actuator_gear[servo, 0])) * min(-low, high)
    if model.jnt_actfrclimited[joint]:
        low, high = model.jnt_actfrcrange[joint].tolist()
        most = min(most, -low, high)
    return most


def _servo(model: Any, joint: int) -> dict[str, float]:
    """Return what an actuator gives a joint: gain, damping, largest torque, and the range of targets."""
    servos = servos_of(model, joint)
    ours = [k for k in range(model.nu) if model.actuator_trntype[k] == 0 and model.actuator_trnid[k, 0] == joint]
    gear = model.actuator_gear[:, 0]
    found = {"damping": sum(float(gear[k] ** 2 * max(0.0, -model.actuator_biasprm[k, 2])) for k in ours)}
    if not servos:
        return found
    servo = servos[0]
    found["stiffness"] = float(-model.actuator_biasprm[servo, 1] * gear[servo] ** 2)
    found["torque_limit"] = largest_force(model, joint, servo)
    if model.actuator_ctrllimited[servo]:
        factor, offset = control_of(model, servo)
        ends = sorted((float(end) - offset) / factor for end in model.actuator_ctrlrange[servo])
        found |= {"lowest_target": ends[0], "highest_target": ends[1]}
    return found


def _link(path: Path, model: Any, body: int, name: str, origin: Array | None) -> LinkOfRobot:
    """Return a link with its frame at `origin` of a body; for None one without mass."""
    if origin is None:
        return LinkOfRobot(name=name, mass_kg=0.0, com_m=np.zeros(3), inertia_kg_m2=np.zeros((3, 3)), geometry=())
    turn = matrix_of(model.body_iquat[body])
    solid = _solid(model, body)
    other = next((kind for geom in solid if (kind := int(model.geom_type[geom])) not in _GEOMS), None)
    if other is not None:
        raise InputDataError(
            f"{path}: body '{name}' has a {_OTHER_GEOMS.get(other, 'shape of another kind')}.",
            f"{', '.join(_GEOMS.values())}.",
            "put a box or a mesh in its place.",
        )
    parts = [_geometry(model, geom, origin) for geom in solid]
    return LinkOfRobot(
        name=name,
        mass_kg=float(model.body_mass[body]),
        com_m=model.body_ipos[body] - origin,
        inertia_kg_m2=turn @ np.diag(model.body_inertia[body]) @ turn.T,
        geometry=tuple(parts),
    )


def _geometry(model: Any, geom: int, origin: Array) -> GeometryOfLink:
    kind, size = _GEOMS[int(model.geom_type[geom])], model.geom_size[geom]
    sizes = size[: {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3, "mesh": 0}[kind]]
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
