"""A model as URDF: one file for each rigid or jointed body, one for the fixed surfaces, and their meshes.

Source: the URDF specification (wiki.ros.org/urdf/XML). Metres, kilograms, radians; roll, pitch and yaw about fixed
axes. A link's frame is the body frame; inertia is about the centre of mass, in the body's axes. A joint's axis is in
the frame of the link that it carries, whose origin it goes through: both as in the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from ...schemas import ArticulationModel, BodyModel, InputDataError, JointModel
from ...schemas.distinct import first_repeated
from ...schemas.surfaces import Surface
from ..io.atomic import new_directory
from ..models.model import Model
from ..shapes.turns import matrix_of, quat_of_normal
from .bop_models import ObjectModel
from .robot_parts import (
    HALF_SPACE_M,
    SHEET_M,
    mean_color,
    moments_of,
    numbers_text,
    roll_pitch_yaw,
    spheres_of,
    write_meshes,
)

Array = NDArray[np.float64]

WORLD = "world"
"""Name of the link that does not move, where there is one."""
FAR = 1e4
"""Limit of a joint that has one on the other side alone [rad or m]; URDF gives both or none."""
FAST = 1e3
"""Largest rate of a joint, which URDF requires [rad/s or m/s]: of no joint of a model it is known."""


def write_urdf(
    path: Path,
    model: Model,
    meshes: Mapping[str, ObjectModel],
    check: Callable[[Path], None],
    overwrite: bool = False,
) -> dict[str, int | float | str]:
    """Write `<body>.urdf` of every body that no joint moves, `<name>.urdf` of jointed ones, `scene.urdf` and `meshes/`.

    Collision geometry is the spheres, visual geometry the meshes. Jointed bodies on a fixed root and fixed bodies hang
    on the link `world`; the poses of others are not in the files.

    Args:
        path: The directory to write.
        model: The model.
        meshes: Surface of each body that has spheres, by name.
        check: Function that looks at the directory before it gets its name.
        overwrite: Replace what is there.

    Returns:
        The number of files and links.

    Raises:
        InputDataError: If a link or joint would have the name of another one in its file.
    """
    robots = robots_of(model)
    with new_directory(path, "URDF folder", overwrite) as folder:
        write_meshes(folder, model, meshes)
        links = 0
        for name in robots:
            root = urdf_of(model, name, meshes)
            links += len(root.findall("link"))
            ET.indent(root)
            text = '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
            (folder / f"{name}.urdf").write_text(text, encoding="utf-8")
        check(folder)
    return {"files": len(robots), "links": links}


def robots_of(model: Model) -> list[str]:
    """Return the names of the files without suffix: jointed bodies, other bodies, and `scene` where there is one.

    Raises:
        InputDataError: If two of them have the same name.
    """
    names = [one.name for one in model.file.articulations]
    names += [body.name for body in model.file.bodies if body.motion != "link"]
    names += ["scene"] if _has_scene(model) else []
    twice = first_repeated(names)
    if twice is not None:
        raise InputDataError(
            f"{model.place}: two things would be {twice}.urdf.",
            "names of bodies and jointed bodies that differ, and none is 'scene'.",
            "rename one in the capture.",
        )
    return names


def urdf_of(model: Model, name: str, meshes: Mapping[str, ObjectModel]) -> ET.Element:
    """Return the URDF of a jointed body, of another body, or of the `scene`, by name."""
    root = ET.Element("robot", name=name)
    entry = next((one for one in model.file.articulations if one.name == name), None)
    if entry is not None:
        _add_jointed(root, model, entry, meshes)
    elif name == "scene" and _has_scene(model):
        _add_scene(root, model)
    else:
        body = model.body(name)
        if body.motion == "fixed":
            _hang(root, body)
        root.append(_link(model, body, meshes))
    return root


def _has_scene(model: Model) -> bool:
    return bool(model.file.surfaces) or model.file.ground is not None


def _add_jointed(root: ET.Element, model: Model, entry: ArticulationModel, meshes: Mapping[str, ObjectModel]) -> None:
    if entry.base == "fixed":
        _hang(root, model.body(entry.root))
    for name in entry.links:
        root.append(_link(model, model.body(name), meshes))
    for joint in entry.joints:
        root.append(_joint(joint))


def _hang(root: ET.Element, body: BodyModel) -> None:
    """Add the link `world`, and the joint that holds a body where it was in the photos."""
    if body.name == WORLD:
        raise InputDataError(
            f"the body '{WORLD}' has the name of the link that does not move.", todo="rename it in the capture."
        )
    ET.SubElement(root, "link", name=WORLD)
    joint = ET.SubElement(root, "joint", name=f"{body.name}_in_{WORLD}", type="fixed")
    ET.SubElement(joint, "parent", link=WORLD)
    ET.SubElement(joint, "child", link=body.name)
    _origin(joint, np.asarray(body.photo_pose.position_m), np.asarray(body.photo_pose.quat_wxyz))


def _link(model: Model, body: BodyModel, meshes: Mapping[str, ObjectModel]) -> ET.Element:
    link = ET.Element("link", name=body.name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers_text(body.com_m), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=numbers_text([body.mass_kg]))
    ET.SubElement(inertial, "inertia", moments_of(body))
    mesh = meshes.get(body.name)
    if mesh is not None:
        visual = ET.SubElement(link, "visual")
        ET.SubElement(ET.SubElement(visual, "geometry"), "mesh", filename=f"meshes/{body.name}.obj")
        material = ET.SubElement(visual, "material", name=f"{body.name}_color")
        ET.SubElement(material, "color", rgba=mean_color(mesh))
    for center, radius in spheres_of(model, body):
        collision = ET.SubElement(link, "collision")
        ET.SubElement(collision, "origin", xyz=numbers_text(center), rpy="0 0 0")
        ET.SubElement(ET.SubElement(collision, "geometry"), "sphere", radius=numbers_text([radius]))
    return link


def _joint(joint: JointModel) -> ET.Element:
    endless = joint.lower is None and joint.upper is None
    kinds = {"hinge": "continuous" if endless else "revolute", "slide": "prismatic", "fixed": "fixed"}
    made = ET.Element("joint", name=joint.name, type=kinds[joint.kind])
    ET.SubElement(made, "parent", link=joint.parent)
    ET.SubElement(made, "child", link=joint.link)
    _origin(made, np.asarray(joint.position_m), np.asarray(joint.quat_wxyz))
    if joint.kind == "fixed":
        return made
    axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    ET.SubElement(made, "axis", xyz=numbers_text(axis))
    ET.SubElement(made, "dynamics", damping=numbers_text([joint.damping]), friction=numbers_text([joint.friction]))
    ET.SubElement(made, "limit", _limits(joint, kinds[joint.kind] == "continuous"))
    return made


def _limits(joint: JointModel, endless: bool) -> dict[str, str]:
    """Return the attributes of <limit>, in which an absent number is a large one."""
    effort = joint.torque_limit if joint.torque_limit is not None else (FAR if joint.stiffness > 0 else 0.0)
    limits = {"effort": numbers_text([effort]), "velocity": numbers_text([FAST])}
    if endless:
        return limits
    lower, upper = (far if end is None else end for far, end in ((-FAR, joint.lower), (FAR, joint.upper)))
    return limits | {"lower": numbers_text([lower]), "upper": numbers_text([upper])}


def _add_scene(root: ET.Element, model: Model) -> None:
    """Add the ground and the fixed surfaces as geometry of the link `world`."""
    link = ET.SubElement(root, "link", name=WORLD)
    ground = model.file.ground
    if ground is not None:
        normal = np.asarray(ground.normal)
        place = normal * (ground.offset_m - HALF_SPACE_M)
        _add_shape(link, "box", {"size": numbers_text([2 * HALF_SPACE_M] * 3)}, place, quat_of_normal(normal))
    for surface in model.file.surfaces:
        place, quat = np.asarray(surface.pose.position_m), np.asarray(surface.pose.quat_wxyz)
        tag, values, below = _shape(surface, surface.name in model.surface_meshes)
        _add_shape(link, tag, values, place - below * matrix_of(quat)[:, 2], quat)


def _shape(surface: Surface, meshed: bool) -> tuple[str, dict[str, str], float]:
    """Return the element of a surface, its attributes, and how far its middle lies below the surface's frame [m]."""
    if meshed:
        return "mesh", {"filename": f"meshes/{surface.name}.obj"}, 0.0
    if surface.box is not None:
        return "box", {"size": numbers_text(2 * np.asarray(surface.box.half_extents_m))}, 0.0
    if surface.cylinder is not None:
        shape = surface.cylinder
        return (
            "cylinder",
            {"radius": numbers_text([shape.radius_m]), "length": numbers_text([2 * shape.half_length_m])},
            0.0,
        )
    if surface.rectangle is not None:
        return "box", {"size": numbers_text([2 * x for x in (*surface.rectangle.half_extents_m, SHEET_M)])}, 0.0
    return "box", {"size": numbers_text([2 * HALF_SPACE_M] * 3)}, HALF_SPACE_M


def _add_shape(link: ET.Element, tag: str, values: dict[str, str], place: Array, quat: Array) -> None:
    for kind in ("visual", "collision"):
        part = ET.SubElement(link, kind)
        _origin(part, place, quat)
        ET.SubElement(ET.SubElement(part, "geometry"), tag, values)


def _origin(parent: ET.Element, place: Array, quat: Array) -> None:
    ET.SubElement(parent, "origin", xyz=numbers_text(place), rpy=numbers_text(roll_pitch_yaw(matrix_of(quat))))
