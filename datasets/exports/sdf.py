"""A model as SDFormat, for Gazebo and Drake: one world with all bodies at their poses in the photos, and meshes.

Source: the SDFormat specification 1.9 (sdformat.org/spec/1.9). Metres, kilograms, radians; a pose is x y z, then roll,
pitch and yaw about fixed axes. Each rigid or jointed body is a model of that name, at the pose of its root. Poses of
links are in the frame of their model, with all joints at 0; a joint is at the origin of the link that it carries, with
its axis in that link's frame.
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
from ..shapes.turns import matrix_of
from .bop_models import ObjectModel
from .robot_parts import (
    HALF_SPACE_M,
    SHEET_M,
    link_poses,
    mean_color,
    moments_of,
    numbers_text,
    roll_pitch_yaw,
    spheres_of,
    write_meshes,
)

Array = NDArray[np.float64]

VERSION = "1.9"
NAME = "world.sdf"
GROUND, LINK = "ground", "link"
"""Names of the model of the ground, and of the one link of models that do not move."""


def write_sdf(
    path: Path,
    model: Model,
    meshes: Mapping[str, ObjectModel],
    restitution: Mapping[str, float],
    check: Callable[[ET.Element], None],
    overwrite: bool = False,
) -> dict[str, int | float | str]:
    """Write `world.sdf` and `meshes/`.

    Args:
        path: The directory to write.
        model: A model with fitted physics.
        meshes: Surface of each body that has spheres, by name.
        restitution: Restitution of each contact law [1], by name of its material: "" is that of all other pairs.
        check: Function that looks at the document, read again, before the directory gets its name.
        overwrite: Replace what is there.

    Returns:
        The number of models, links and joints.

    Raises:
        InputDataError: If two models would have the same name, or a link and a joint of one model.
    """
    root = sdf_of(model, meshes, restitution)
    ET.indent(root)
    text = '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
    with new_directory(path, "SDF folder", overwrite) as folder:
        write_meshes(folder, model, meshes)
        (folder / NAME).write_text(text, encoding="utf-8")
        check(ET.fromstring((folder / NAME).read_text(encoding="utf-8")))
    return {f"{tag}s": len(root.findall(f".//{tag}")) for tag in ("model", "link", "joint")}


def sdf_of(model: Model, meshes: Mapping[str, ObjectModel], restitution: Mapping[str, float]) -> ET.Element:
    """Return the document of a model; arguments and errors as those of :func:`write_sdf`."""
    _require_names(model)
    root = ET.Element("sdf", version=VERSION)
    world = ET.SubElement(root, "world", name="cgwm")
    _text(world, "gravity", model.file.gravity_m_s2)
    laws = _Laws(model, restitution)
    for body in model.file.bodies:
        if body.motion != "link":
            _add_body(world, model, body, meshes, laws)
    for one in model.file.articulations:
        _add_jointed(world, model, one, meshes, laws)
    if model.file.ground is not None:
        normal = np.asarray(model.file.ground.normal, float)
        shape = _plane(normal)
        _add_still(world, GROUND, normal * model.file.ground.offset_m, None, shape, laws(model.file.ground.material))
    for surface in model.file.surfaces:
        place, quat = np.asarray(surface.pose.position_m, float), np.asarray(surface.pose.quat_wxyz, float)
        shape = _shape(surface, surface.name in model.surface_meshes)
        _add_still(world, surface.name, place, quat, shape, laws(surface.material))
    return root


def joint_names(one: ArticulationModel) -> dict[str, str]:
    """Return the name of each joint in the document: links and joints of a model share their names there."""
    return {joint.name: f"{joint.name}_joint" if joint.name in one.links else joint.name for joint in one.joints}


def _require_names(model: Model) -> None:
    names = [body.name for body in model.file.bodies if body.motion != "link"]
    names += [one.name for one in model.file.articulations] + [surface.name for surface in model.file.surfaces]
    names += [GROUND] if model.file.ground is not None else []
    twice = first_repeated(names)
    if twice is not None:
        raise InputDataError(
            f"{model.place}: two things would be the model '{twice}'.",
            "names of bodies, jointed bodies and surfaces that differ, and none is 'ground'.",
            "rename one in the capture.",
        )
    for one in model.file.articulations:
        _require_inner_names(model, one)


def _require_inner_names(model: Model, one: ArticulationModel) -> None:
    """Refuse names of links and joints that SDF cannot have."""
    inside = [*one.links, *joint_names(one).values()]
    wrong = first_repeated(inside) or next(filter(_reserved, inside), None)
    if wrong is not None:
        raise InputDataError(
            f"{model.place}: '{wrong}' of the jointed body '{one.name}' cannot be a name in SDF.",
            "names of links and joints that differ; none is 'world' or begins and ends with two underscores.",
            "rename it in the URDF or MJCF of the capture.",
        )


def _reserved(name: str) -> bool:
    return name == "world" or (name.startswith("__") and name.endswith("__"))


class _Laws:
    """Adds the contact law of a material to a collision: SDF has one for each, and simulators combine the two."""

    def __init__(self, model: Model, restitution: Mapping[str, float]) -> None:
        assert model.file.contact is not None  # the stage export refuses models without fitted physics
        self.friction = {"": model.file.contact.friction}
        self.friction |= {p.materials[0]: p.friction for p in model.file.pairs if p.materials[0] == p.materials[1]}
        self.restitution = restitution

    def __call__(self, material: str | None) -> Callable[[ET.Element], None]:
        name = material if material in self.friction else ""

        def add(collision: ET.Element) -> None:
            surface = ET.SubElement(collision, "surface")
            ode = ET.SubElement(ET.SubElement(surface, "friction"), "ode")
            _text(ode, "mu", [self.friction[name]])
            _text(ode, "mu2", [self.friction[name]])
            bounce = ET.SubElement(surface, "bounce")
            _text(bounce, "restitution_coefficient", [self.restitution[name]])
            _text(bounce, "threshold", [0.0])  # else Gazebo lets nothing bounce

        return add


def _add_body(world: ET.Element, model: Model, body: BodyModel, meshes: Mapping[str, ObjectModel], laws: _Laws) -> None:
    made = ET.SubElement(world, "model", name=body.name)
    if body.motion == "fixed":
        _text(made, "static", "true")
    _pose(made, np.asarray(body.photo_pose.position_m, float), np.asarray(body.photo_pose.quat_wxyz, float))
    made.append(_link(model, body, LINK, meshes, laws, kinematic=body.motion == "driven"))


def _add_jointed(
    world: ET.Element, model: Model, one: ArticulationModel, meshes: Mapping[str, ObjectModel], laws: _Laws
) -> None:
    made = ET.SubElement(world, "model", name=one.name)
    poses = link_poses(model, one)
    place, quat = poses[one.root]
    _pose(made, place, quat)
    turn = matrix_of(quat)
    for name in one.links:
        link = _link(model, model.body(name), name, meshes, laws, name == one.root and one.base == "driven")
        if name != one.root:
            there, turned = poses[name]
            link.insert(0, _pose(None, turn.T @ (there - place), matrix=turn.T @ matrix_of(turned)))
        made.append(link)
    if one.base == "fixed":
        inside = {*one.links, *joint_names(one).values()}
        joint = ET.SubElement(made, "joint", name=_free(f"{one.root}_in_world", inside), type="fixed")
        _text(joint, "parent", "world")
        _text(joint, "child", one.root)
    for joint in one.joints:
        made.append(_joint(joint, joint_names(one)[joint.name]))


def _free(name: str, taken: set[str]) -> str:
    return name if name not in taken else _free(f"{name}_", taken)


def _link(
    model: Model, body: BodyModel, name: str, meshes: Mapping[str, ObjectModel], laws: _Laws, kinematic: bool
) -> ET.Element:
    link = ET.Element("link", name=name)
    _add_inertia(link, body)
    if kinematic:
        _text(link, "kinematic", "true")
    mesh = meshes.get(body.name)
    if mesh is not None:
        _add_visual(link, body, mesh)
    for k, (center, radius) in enumerate(spheres_of(model, body)):
        collision = ET.SubElement(link, "collision", name=f"sphere_{k}")
        _pose(collision, center)
        _add_geometry(collision, ("sphere", {"radius": numbers_text([radius])}))
        laws(body.material)(collision)
    return link


def _add_inertia(link: ET.Element, body: BodyModel) -> None:
    inertial = ET.SubElement(link, "inertial")
    _pose(inertial, np.asarray(body.com_m, float))
    _text(inertial, "mass", [body.mass_kg])
    inertia = ET.SubElement(inertial, "inertia")
    for key, value in moments_of(body).items():
        _text(inertia, key, value)


def _add_visual(link: ET.Element, body: BodyModel, mesh: ObjectModel) -> None:
    visual = ET.SubElement(link, "visual", name="visual")
    _add_geometry(visual, ("mesh", {"uri": f"meshes/{body.name}.obj"}))
    material = ET.SubElement(visual, "material")
    for light in ("ambient", "diffuse"):
        _text(material, light, mean_color(mesh))


def _joint(joint: JointModel, name: str) -> ET.Element:
    made = ET.Element("joint", name=name, type={"hinge": "revolute", "slide": "prismatic"}.get(joint.kind, "fixed"))
    _text(made, "parent", joint.parent)
    _text(made, "child", joint.link)
    if joint.kind == "fixed":
        return made
    axis = ET.SubElement(made, "axis")
    _text(axis, "xyz", np.asarray(joint.axis) / np.linalg.norm(joint.axis))
    effort = 0.0 if joint.stiffness == 0 else joint.torque_limit  # nothing drives a passive joint
    limit = ET.SubElement(axis, "limit")  # without lower and upper there is none
    for key, value in (("lower", joint.lower), ("upper", joint.upper), ("effort", effort)):
        if value is not None:
            _text(limit, key, [value])
    dynamics = ET.SubElement(axis, "dynamics")
    _text(dynamics, "damping", [joint.damping])
    _text(dynamics, "friction", [joint.friction])
    return made


Shape = tuple[str, dict[str, str]]
"""Element of a shape, and its values."""


def _plane(normal: Array) -> Shape:
    return "plane", {"normal": numbers_text(normal), "size": numbers_text([2 * HALF_SPACE_M] * 2)}


def _shape(surface: Surface, meshed: bool) -> Shape:
    if meshed:
        return "mesh", {"uri": f"meshes/{surface.name}.obj"}
    if surface.box is not None:
        return "box", {"size": numbers_text(2 * np.asarray(surface.box.half_extents_m))}
    if surface.cylinder is not None:
        shape = surface.cylinder
        values = {"radius": numbers_text([shape.radius_m]), "length": numbers_text([2 * shape.half_length_m])}
        return "cylinder", values
    if surface.rectangle is not None:
        return "box", {"size": numbers_text([2 * x for x in (*surface.rectangle.half_extents_m, SHEET_M)])}
    return _plane(np.array([0.0, 0.0, 1.0]))


def _add_still(
    world: ET.Element, name: str, place: Array, quat: Array | None, shape: Shape, law: Callable[[ET.Element], None]
) -> None:
    made = ET.SubElement(world, "model", name=name)
    _text(made, "static", "true")
    _pose(made, place, quat)
    link = ET.SubElement(made, "link", name=LINK)
    for kind in ("visual", "collision"):
        part = ET.SubElement(link, kind, name=kind)
        _add_geometry(part, shape)
        if kind == "collision":
            law(part)


def _add_geometry(parent: ET.Element, shape: Shape) -> None:
    tag, values = shape
    made = ET.SubElement(ET.SubElement(parent, "geometry"), tag)
    for key, value in values.items():
        _text(made, key, value)


def _pose(
    parent: ET.Element | None, place: Array, quat: Array | None = None, matrix: Array | None = None
) -> ET.Element:
    """Return a pose from a position and a quaternion or rotation matrix (none: upright), added to `parent` if given."""
    if matrix is None:
        matrix = np.eye(3) if quat is None else matrix_of(quat)
    made = ET.Element("pose") if parent is None else ET.SubElement(parent, "pose")
    made.text = numbers_text([*place, *roll_pitch_yaw(matrix)])
    return made


def _text(parent: ET.Element, tag: str, value: object) -> None:
    ET.SubElement(parent, tag).text = value if isinstance(value, str) else numbers_text(value)
