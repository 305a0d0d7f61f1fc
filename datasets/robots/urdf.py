"""Reader of URDF: links, joints and collision geometry; source of the format: wiki.ros.org/urdf/XML."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ..shapes.meshes import Mesh, read_mesh
from .articulation import Articulation, GeometryOfLink, JointOfRobot, LinkOfRobot

Array = NDArray[np.float64]
_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "fixed": "fixed"}


def read_urdf(path: Path, robot: Element) -> Articulation:
    """Read the tree of a <robot>; see `read_articulation`."""
    _require_expanded(path, robot)
    links: dict[str, LinkOfRobot] = {}
    for element in robot.findall("link"):
        name = _name(path, element, "link")
        if name in links:
            raise InputDataError(
                f"{path}: several links are called '{name}'.", "a name of its own for each link.", "rename one of them."
            )
        links[name] = _link(path, name, element)
    joints = [_joint(path, element) for element in robot.findall("joint")]
    if not joints:
        raise InputDataError(
            f"{path}: the robot has no joints.",
            "a tree of links and joints.",
            "give the body its shape in capture.toml, without a robot's file.",
        )
    return Articulation.tree(robot.get("name", path.stem), path, links, joints)


def _require_expanded(path: Path, robot: Element) -> None:
    """Refuse a file whose macros would have to be expanded, and so lacks links."""
    macro = next((one.tag for one in robot.iter() if "xacro" in one.tag.partition("}")[0].lower()), None)
    if macro is not None:
        raise InputDataError(
            f"{path}: it is a xacro file: it has <xacro:{macro.rpartition('}')[2].removeprefix('xacro_')}>.",
            "a URDF whose macros are expanded.",
            "run `xacro FILE > robot.urdf`, and name that file.",
        )


def _name(path: Path, element: Element, what: str) -> str:
    name = element.get("name", "")
    if not name:
        raise InputDataError(f"{path}: a {what} has no name.", f'<{what} name="...">.', "name it.")
    return name


def _numbers(path: Path, where: str, text: str | None, count: int, default: str) -> Array:
    words = (text if text is not None else default).split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputDataError(
            f"{path}: {where}: '{text}'.",
            f"{count} finite number{'s' if count > 1 else ''}.",
            "correct the number in the file.",
        )
    return values


def _origin(path: Path, where: str, element: Element | None) -> tuple[Array, Array]:
    """Return position (3,) [m] and rotation (3, 3) of an <origin>."""
    xyz = _numbers(path, f"{where}, origin xyz", None if element is None else element.get("xyz"), 3, "0 0 0")
    rpy = _numbers(path, f"{where}, origin rpy", None if element is None else element.get("rpy"), 3, "0 0 0")
    return xyz, rotation_of(rpy)


def rotation_of(rpy: Array) -> Array:
    """Return the rotation (3, 3) of roll, pitch and yaw [rad] about fixed axes x, y, z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def quat_of(rpy: Array) -> Array:
    """Return the quaternion (4,), w first, of roll, pitch and yaw [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * rpy), np.sin(0.5 * rpy)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy,
        ]
    )  # fmt: skip


def _link(path: Path, name: str, element: Element) -> LinkOfRobot:
    where = f"link '{name}'"
    inertial = element.find("inertial")
    mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    if inertial is not None:
        com, turn = _origin(path, where, inertial.find("origin"))
        weight, moments = inertial.find("mass"), inertial.find("inertia")
        mass = float(_numbers(path, f"{where}, mass", None if weight is None else weight.get("value"), 1, "")[0])
        if mass < 0:
            raise InputDataError(
                f"{path}: {where}: its mass is {mass:g} kg.", "0 kg or more.", "correct the mass in the file."
            )
        if moments is not None:
            inertia = turn @ _tensor(path, where, moments) @ turn.T
    parts = [_geometry(path, where, part) for part in element.findall("collision")]
    return LinkOfRobot(name=name, mass_kg=mass, com_m=com, inertia_kg_m2=inertia, geometry=tuple(parts))


def _tensor(path: Path, where: str, moments: Element) -> Array:
    """Return the inertia tensor (3, 3) [kg m2] of an <inertia>."""
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    xx, yy, zz, xy, xz, yz = (float(_numbers(path, f"{where}, {key}", moments.get(key), 1, "0")[0]) for key in keys)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _geometry(path: Path, where: str, element: Element) -> GeometryOfLink:
    position, rotation = _origin(path, where, element.find("origin"))
    holder = element.find("geometry")
    shape = None if holder is None else next(iter(holder), None)
    if shape is None:
        raise InputDataError(
            f"{path}: {where} has a collision element without geometry.",
            "box, sphere, cylinder, mesh.",
            "add a geometry, or remove the collision element.",
        )
    if shape.tag == "mesh":
        found, size = read_mesh(_mesh_path(path, where, shape.get("filename", ""))), ()
        mesh = Mesh(found.vertices * _numbers(path, f"{where}, scale", shape.get("scale"), 3, "1 1 1"), found.faces)
    else:
        mesh, size = None, _size(path, where, shape)
    return GeometryOfLink(kind=shape.tag, size_m=size, rotation=rotation, position_m=position, mesh=mesh)


def _size(path: Path, where: str, shape: Element) -> tuple[float, ...]:
    """Return the half extents, the radius, or radius and half length of a shape [m]."""
    if shape.tag == "box":
        size = tuple(0.5 * _numbers(path, f"{where}, box size", shape.get("size"), 3, ""))
    elif shape.tag == "sphere":
        size = tuple(_numbers(path, f"{where}, radius", shape.get("radius"), 1, ""))
    elif shape.tag in ("cylinder", "capsule"):
        radius = float(_numbers(path, f"{where}, radius", shape.get("radius"), 1, "")[0])
        size = (radius, 0.5 * float(_numbers(path, f"{where}, length", shape.get("length"), 1, "")[0]))
    else:
        raise InputDataError(
            f"{path}: {where}: the geometry <{shape.tag}>.",
            "box, sphere, cylinder, mesh.",
            "replace it by one of these shapes.",
        )
    if any(not x > 0 for x in size):
        raise InputDataError(
            f"{path}: {where}: a {shape.tag} of size {size}.", "sizes above 0 m.", "correct the size in the file."
        )
    return size


def _mesh_path(path: Path, where: str, name: str) -> Path:
    """Return the file of a mesh: relative to the URDF; of a package:// address, below any folder above it."""
    if not name:
        raise InputDataError(
            f"{path}: {where}: a mesh without filename.", 'filename="...".', "name the file of the mesh."
        )
    if not name.startswith("package://"):
        return path.parent / name.removeprefix("file://")
    inside = name.removeprefix("package://")
    tails = [inside, inside.split("/", 1)[-1]]
    folders = [path.parent, *path.parent.parents]
    return next((f / tail for f in folders for tail in tails if (f / tail).is_file()), path.parent / tails[1])


def _joint(path: Path, element: Element) -> JointOfRobot:
    name = _name(path, element, "joint")
    where, kind = f"joint '{name}'", element.get("type", "")
    _require_known(path, where, kind, element)
    ends = [element.find(tag) for tag in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "") for end in ends)
    origin, axis = element.find("origin"), element.find("axis")
    position, _ = _origin(path, where, origin)
    rpy = _numbers(path, where, None if origin is None else origin.get("rpy"), 3, "0 0 0")
    limit, dynamics = element.find("limit"), element.find("dynamics")
    lower, upper = _limits(path, where, kind, limit)
    direction = _numbers(path, f"{where}, axis", None if axis is None else axis.get("xyz"), 3, "1 0 0")
    return JointOfRobot(
        name=name,
        kind=_KINDS[kind],
        parent=parent,
        link=child,
        position_m=position,
        quat_wxyz=quat_of(rpy),
        axis=direction if kind != "fixed" else np.array([0.0, 0.0, 1.0]),
        lower=lower,
        upper=upper,
        damping=_value(path, where, dynamics, "damping", 0.0),
        friction=_value(path, where, dynamics, "friction", 0.0),
        torque_limit=_value(path, where, limit, "effort", math.inf) or math.inf,
    )


def _require_known(path: Path, where: str, kind: str, element: Element) -> None:
    """Refuse a joint of another type, and one that mimics another."""
    if kind not in _KINDS:
        raise InputDataError(
            f"{path}: {where} has the type '{kind}'.",
            ", ".join(_KINDS) + ".",
            "model a floating base by the root's own motion, and a planar or ball joint by several hinges and slides.",
        )
    if element.find("mimic") is not None:
        raise InputDataError(
            f"{path}: {where} mimics another joint, which a chain of independent joints cannot do.",
            "joints without <mimic>.",
            "leave <mimic> out, and command both joints alike.",
        )


def _value(path: Path, where: str, holder: Element | None, key: str, default: float) -> float:
    """Return the number of an attribute; `default` without it, or without the element."""
    text = None if holder is None else holder.get(key)
    return float(_numbers(path, f"{where}, {key}", text, 1, "0")[0]) if text is not None else default


def _limits(path: Path, where: str, kind: str, limit: Element | None) -> tuple[float, float]:
    """Return the lowest and the highest angle [rad] or place [m] of a joint."""
    lower, upper = _value(path, where, limit, "lower", -math.inf), _value(path, where, limit, "upper", math.inf)
    if kind == "continuous":
        return -math.inf, math.inf
    if kind in ("revolute", "prismatic") and not (math.isfinite(lower) and math.isfinite(upper)):
        if limit is None or (limit.get("lower") is None) != (limit.get("upper") is None):
            raise InputDataError(
                f"{path}: {where} is {kind} and has no limits.",
                "<limit lower=... upper=.../>.",
                'give it limits, or the type "continuous".',
            )
        return 0.0, 0.0  # the format's default
    return lower, upper
