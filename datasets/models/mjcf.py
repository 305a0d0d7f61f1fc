"""Conversion of a fitted model to MJCF, for simulation in MuJoCo (and robomimic's attribute `model_file`).

The conversion is approximate, because MuJoCo's soft contacts follow another law. `solref = (tau / zeta, zeta)` gives
the same restitution and contact time; the penetration at rest differs.

Friction has a time constant of its own there. MuJoCo lets slip decay with that of solref, which for a bouncy contact is
many contact times, while Coulomb's law makes a body stick as soon as the impulse suffices. A shorter one is no remedy
without limit: MuJoCo's cone of friction adds mu times the demanded slip acceleration to the normal one (its dual
problem, "Computation", section "Constraint model"), so that friction lifts the body. With `solreffriction = (tau, 1)`
slip decays within one contact time, as long as an impact lasts. Over eight sets of friction, contact time and damping
the deviation from Coulomb's law was within a fifth of the least that any time constant between 0.35 tau and 3 tau
reached, except at friction 0.8 (a quarter to a half); other values of solimp, impratio, friction and MuJoCo's pyramidal
cone were no better (`benchmarks/mjcf_contacts.py`). Only a `pair` can have it, so each two geoms that may touch are
one.

Slippery bodies slide through whole impacts, lifted all the while. In their files the normal forces come first, and then
the friction that they allow: an `impratio` of nearly nothing leaves the cone out of the solution for all forces, and
`noslip_iterations` find the friction within the cones of the normal forces found. Where bodies stick it is the worse
way: friction at an edge then changes the normal force, which no longer follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from xml.etree import ElementTree as ET

import numpy as np

from ...schemas import ArticulationModel, BodyModel, ContactParameters, InputDataError, JointModel, ModelFile
from ...schemas.materials import pair_of
from ...schemas.surfaces import Surface
from ..capture.cameras import Camera
from ..shapes.meshes import Mesh
from .laws import refuse_paper_law
from .model import Model

MIN_DAMPING_RATIO = 1e-3
"""Minimum damping ratio that is written, because MuJoCo's solref divides by it."""
HALF_SHEET_M = 1e-3
"""Half the thickness of rectangles, and depth of the wedges behind triangles, which MuJoCo needs to be solid [m]."""
IMPEDANCE = 0.99
"""d of solimp; the penetration at rest in MuJoCo is (1 - d) g tau^2 / number of contacts."""

SLIPPERY = 0.3
"""Largest friction with which normal forces are found before friction."""
APART, APART_ITERATIONS = 1e-6, 10
"""`impratio` and `noslip_iterations` there."""
SLIPPERY_SHARE = 0.5
"""Time in which slip decays there, of the contact time."""

MOVED = ("free", "link")
"""Motions of bodies that physics moves."""
FAR = 1e4
"""Stop that no joint reaches, where a joint has only the other one [rad or m]."""
MOST_PAIRS = 50_000
"""Maximum number of pairs of geoms of two bodies with a contact law of their own."""
MOST_COMMON_PAIRS = 5_000
"""The same where they have the law of all others: with more, they keep the friction of MuJoCo's own contacts."""


@dataclass(frozen=True, kw_only=True)
class Keyframe:
    """Poses and velocities of all B bodies, to be written as a `key`."""

    name: str
    """Name of the keyframe."""
    position_m: np.ndarray
    """Body frame origins [m], world frame, shape (B, 3)."""
    quat_wxyz: np.ndarray
    """Orientations T_world_body, shape (B, 4)."""
    velocity_m_s: np.ndarray
    """Velocities of the origins [m/s], world axes, shape (B, 3)."""
    omega_body_rad_s: np.ndarray
    """Angular velocities [rad/s], body axes, shape (B, 3)."""


def write_mjcf(
    model: Model, cameras: Mapping[str, Camera] | None = None, keyframe: Keyframe | None = None, source: str = ""
) -> str:
    """Return the model as MJCF text.

    Links of jointed bodies are within the links that carry them, with their joints; links of one jointed body do not
    touch each other. Free bodies get a free joint, driven ones are mocap bodies, fixed ones are at their photo pose.
    Collision spheres are `sphere` geoms; without them, the shape from the capture (box or ball) is the geom. Masses,
    inertia, friction and the contact time and damping are those of the model.

    Args:
        model: A model with fitted physics.
        cameras: Cameras to add, by name; MJCF cannot represent their distortion.
        keyframe: A start to add.
        source: Origin of the model, which the file mentions.

    Raises:
        InputDataError: If the model has the contact law of the paper, which MuJoCo cannot express.
    """
    file = model.file
    refuse_paper_law(file, model.place, "MJCF")
    root = ET.Element("mujoco", model="cgwm")
    _add_options(root, model)
    world = ET.SubElement(root, "worldbody")
    _add_surroundings(root, world, model)
    for body in file.bodies:
        if body.motion != "link":
            pose = body.photo_pose
            _add_body(world, body, model, (pose.position_m, pose.quat_wxyz), body.motion)
    for one in file.articulations:
        _add_articulation(world, one, model)
    _add_contacts(root, model)
    _add_servos(root, file)
    for name, camera in (cameras or {}).items():
        _add_camera(world, name, camera)
    if keyframe is not None:
        _add_keyframe(root, file, keyframe)
    if source:
        ET.SubElement(ET.SubElement(root, "custom"), "text", name="source", data=source)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_surroundings(root: ET.Element, world: ET.Element, model: Model) -> None:
    """Add what is fixed: the ground, and the other surfaces."""
    ground = model.file.ground
    if ground is not None:
        normal = np.asarray(ground.normal)
        place = {"pos": _text(normal * ground.offset_m), "zaxis": _text(normal)}
        ET.SubElement(world, "geom", name="ground", type="plane", size="0 0 1").attrib.update(place)
    for surface in model.file.surfaces:
        _add_surface(root, world, surface, model)


def mujoco_states(
    file: ModelFile,
    time_s: np.ndarray,
    pose: tuple[np.ndarray, ...],
    joints: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
) -> np.ndarray:
    """Return MuJoCo's states of the free bodies and of jointed ones: time, qpos, qvel.

    Args:
        file: The model.
        time_s: Times [s], shape (T,).
        pose: position_m (T, B, 3), quat_wxyz (T, B, 4), velocity_m_s (T, B, 3) of the body origin in world axes, and
            omega_body_rad_s (T, B, 3): a free joint's own convention.
        joints: Values [rad or m] and rates (T,) of the joints that move, by name.

    Returns:
        Shape (T, 1 + 13 F + 2 J) for F free bodies and free roots, and J joints.
    """
    names = [body.name for body in file.bodies]
    position, quat, velocity, omega = pose
    qpos, qvel = [], []
    for kind, name in state_order(file):
        if kind == "free":
            index = names.index(name)
            qpos += [position[:, index], quat[:, index]]
            qvel += [velocity[:, index], omega[:, index]]
        else:
            value, rate = (joints or {})[name]
            qpos.append(value[:, None])
            qvel.append(rate[:, None])
    return np.concatenate([time_s[:, None], *qpos, *qvel], 1)


def state_order(file: ModelFile) -> list[tuple[str, str]]:
    """Return what MuJoCo's state consists of, in its order: ("free", body) and ("joint", name).

    MuJoCo numbers bodies depth-first, as they are nested in the file.
    """
    order = [("free", body.name) for body in file.bodies if body.motion == "free"]
    for one in file.articulations:
        order += [("free", one.root)] if one.base == "free" else []
        order += [("joint", name) for name in _nested_joints(one, one.root)]
    return order


def _nested_joints(one: ArticulationModel, link: str) -> Iterator[str]:
    """Yield the joints that move, depth-first from a link."""
    for joint in one.joints:
        if joint.parent == link:
            if joint.kind != "fixed":
                yield joint.name
            yield from _nested_joints(one, joint.link)


def _timestep(file: ModelFile) -> float:
    step = file.solver.step_s
    if file.contact is None:
        return step
    # MuJoCo clips a time constant below two steps; a twentieth of tau keeps the restitution within 0.003.
    return min(step, *(law.contact_time_s / 20 for law in (file.contact, *file.pairs)))


def _contact(contact: ContactParameters | None) -> dict[str, str]:
    if contact is None:
        return {}
    zeta = max(contact.damping_ratio, MIN_DAMPING_RATIO)
    return {
        "friction": _text((contact.friction, 0.0, 0.0)),
        "solref": _text((contact.contact_time_s / zeta, zeta)),
        "solimp": _text((IMPEDANCE, IMPEDANCE, 0.001)),
    }


def _pair(law: ContactParameters, slippery: bool) -> dict[str, str]:
    """Return the attributes of a `pair` with a contact law, in a file of slippery bodies or another."""
    friction = {"friction": _text((law.friction, law.friction, 0.0, 0.0, 0.0)), "condim": "3"}
    decay_s = law.contact_time_s * (SLIPPERY_SHARE if slippery else 1.0)
    return _contact(law) | friction | {"solreffriction": _text((decay_s, 1.0))}


def _slippery(model: Model) -> bool:
    """Return whether all that touches is slippery, and has a `pair`: how forces are found is one option of a file."""
    file = model.file
    laws = [law for law in (file.contact, *file.pairs) if law is not None]
    return bool(laws) and max(law.friction for law in laws) <= SLIPPERY and not softer_pairs(model)


def _add_surface(root: ET.Element, world: ET.Element, surface: Surface, model: Model) -> None:
    """Add a fixed surface as a geom; each triangle of a mesh is one, as MuJoCo makes meshes convex."""
    place = {"pos": _text(surface.pose.position_m), "quat": _text(surface.pose.quat_wxyz)}
    mesh = model.surface_meshes.get(surface.name)
    if mesh is not None:
        _add_triangles(root, world, surface.name, place, mesh)
        return
    if surface.half_space is not None:
        shape = {"type": "plane", "size": "0 0 1"}
    elif surface.cylinder is not None:
        shape = {"type": "cylinder", "size": _text((surface.cylinder.radius_m, surface.cylinder.half_length_m))}
    elif surface.box is not None:
        shape = {"type": "box", "size": _text(surface.box.half_extents_m)}
    else:
        half = surface.rectangle.half_extents_m if surface.rectangle is not None else (1.0, 1.0)
        shape = {"type": "box", "size": _text((*half, HALF_SHEET_M))}
    ET.SubElement(world, "geom", {"name": surface.name, **shape, **place})


def _add_triangles(root: ET.Element, world: ET.Element, name: str, place: dict[str, str], mesh: Mesh) -> None:
    """Add triangles as thin wedges, with their backs behind the mesh."""
    asset = root.find("asset")
    asset = ET.SubElement(root, "asset") if asset is None else asset
    corners = mesh.corners()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    backs = corners.mean(1) - 2 * HALF_SHEET_M * normals
    parent = ET.SubElement(world, "body", {"name": f"{name}_surface", **place})
    for index, (triangle, back) in enumerate(zip(corners, backs, strict=True)):
        label = f"{name}_{index}"
        ET.SubElement(asset, "mesh", name=label, vertex=_text(np.concatenate((triangle.ravel(), back))))

        ET.SubElement(parent, "geom", name=label, type="mesh", mesh=label)


def _add_contacts(root: ET.Element, model: Model) -> None:
    """Add the laws of pairs of geoms, and that links of one articulation do not touch each other."""
    contact = ET.Element("contact")
    _add_pairs(contact, model)
    for one in model.file.articulations:
        for first, second in combinations(one.links, 2):
            ET.SubElement(contact, "exclude", body1=first, body2=second)
    if len(contact):
        root.append(contact)


def _add_options(root: ET.Element, model: Model) -> None:
    """Add the settings of the solver, and what geoms and pairs have in common."""
    file = model.file
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    # RK4: the other integrators damp the tumbling of a free body.
    option = {"timestep": _text(_timestep(file)), "gravity": _text(file.gravity_m_s2), "integrator": "RK4"}
    if _slippery(model):
        option |= {"impratio": _text(APART), "noslip_iterations": str(APART_ITERATIONS)}
    ET.SubElement(root, "option", option, cone="elliptic")
    defaults = ET.SubElement(root, "default")
    geom = ET.SubElement(defaults, "geom", contype="1", conaffinity="1", condim="3")
    geom.attrib.update(_contact(file.contact))
    if file.contact is not None:
        ET.SubElement(defaults, "pair", _pair(file.contact, _slippery(model)))


def _add_pairs(contact: ET.Element, model: Model) -> None:
    """Add a `pair` for each two geoms that may touch.

    A pair takes the place of what MuJoCo makes of the parameters of its two geoms; those of geoms are of all others.
    """
    file = model.file
    laws = {pair_of(*entry.materials): entry for entry in file.pairs}
    for body, other, material, names in _touching(model):
        own = None if body.material is None or material is None else laws.get(pair_of(body.material, material))
        mine = _geoms(body, model)
        count = len(mine) * len(names)
        if own is None and (file.contact is None or count > MOST_COMMON_PAIRS):
            continue
        _require_few_pairs(body.name, other, len(mine), len(names))
        numbers = {} if own is None else _pair(own, _slippery(model))
        for first, second in product(mine, names):
            ET.SubElement(contact, "pair", geom1=first, geom2=second).attrib.update(numbers)


def _require_few_pairs(body: str, other: str, mine: int, others: int) -> None:
    if mine * others > MOST_PAIRS:
        raise InputDataError(
            f"body '{body}' and '{other}' have {mine} and {others} geoms and a contact law of "
            f"their own, which MJCF needs {mine * others} pairs for.",
            f"up to {MOST_PAIRS} pairs.",
            "fit with fewer collision spheres (--spheres), or give the surface fewer triangles.",
        )


def softer_pairs(model: Model) -> list[tuple[str, str]]:
    """Return the bodies and surfaces that have too many pairs of geoms for a time constant of friction of their own."""
    laws = {pair_of(*entry.materials) for entry in model.file.pairs}
    return [
        (body.name, other)
        for body, other, material, names in _touching(model)
        if len(_geoms(body, model)) * len(names) > MOST_COMMON_PAIRS
        and (body.material is None or material is None or pair_of(body.material, material) not in laws)
    ]


def _touching(model: Model) -> Iterator[tuple[BodyModel, str, str | None, list[str]]]:
    """Yield what may touch, of which one moves: a body, and name, material and geoms of a body or surface."""
    file = model.file
    fixed = [(one.name, one.material, _surface_geoms(one, model)) for one in file.surfaces]
    if file.ground is not None:
        fixed.append(("ground", file.ground.material, ["ground"]))
    for index, body in enumerate(file.bodies):
        for other in fixed if body.motion in MOVED else []:
            yield body, *other
        for other in file.bodies[index + 1 :]:
            if {body.motion, other.motion} & set(MOVED) and not _are_joined(file, {body.name, other.name}):
                yield body, other.name, other.material, _geoms(other, model)


def _are_joined(file: ModelFile, names: set[str]) -> bool:
    """Return whether these are links of one jointed body."""
    return any(names <= set(one.links) for one in file.articulations)


def _surface_geoms(surface: Surface, model: Model) -> list[str]:
    """Return the names of a surface's geoms."""
    mesh = model.surface_meshes.get(surface.name)
    return [surface.name] if mesh is None else [f"{surface.name}_{index}" for index in range(len(mesh.faces))]


def _geoms(body: BodyModel, model: Model) -> list[str]:
    """Return the names of a body's geoms."""
    spheres = model.collision.get(body.name)
    if spheres is None:
        shape = body.shape
        known = shape is not None and (shape.box is not None or shape.sphere is not None)
        return [f"{body.name}:0"] if known else []
    return [f"{body.name}:{k}" for k in range(len(spheres))]  # no name of another body or surface has a colon


def _add_articulation(world: ET.Element, one: ArticulationModel, model: Model) -> None:
    """Add the links of a jointed body, each within the link that carries it, with their joints."""
    pose = model.body(one.root).photo_pose
    elements = {one.root: _add_body(world, model.body(one.root), model, (pose.position_m, pose.quat_wxyz), one.base)}
    for joint in one.joints:
        place = (joint.position_m, joint.quat_wxyz)
        element = elements[joint.link] = _add_body(elements[joint.parent], model.body(joint.link), model, place, "link")
        if joint.kind == "fixed":
            continue
        _add_joint(element, joint)


def _add_joint(element: ET.Element, joint: JointModel) -> None:
    """Add a hinge or a slide to the body that it moves."""
    numbers = {"damping": joint.damping, "frictionloss": joint.friction, "armature": joint.armature}
    made = ET.SubElement(element, "joint", name=joint.name, type=joint.kind, axis=_text(joint.axis))
    made.attrib.update({name: _text(value) for name, value in numbers.items()})
    if joint.lower is not None or joint.upper is not None:
        low = -FAR if joint.lower is None else joint.lower
        high = FAR if joint.upper is None else joint.upper
        made.set("range", _text((low, high)))


def _add_servos(root: ET.Element, file: ModelFile) -> None:
    """Add a position actuator for each joint with a servo; its damping is that of the joint."""
    servos = [joint for one in file.articulations for joint in one.joints if joint.stiffness > 0]
    parent = ET.SubElement(root, "actuator") if servos else root
    for joint in servos:
        made = ET.SubElement(parent, "position", name=joint.name, joint=joint.name, kp=_text(joint.stiffness))
        if joint.torque_limit is not None:
            made.set("forcerange", _text((-joint.torque_limit, joint.torque_limit)))


def _add_body(
    parent: ET.Element, body: BodyModel, model: Model, place: tuple[Sequence[float], Sequence[float]], motion: str
) -> ET.Element:
    """Add a body at a place in its parent, and return it."""
    element = ET.SubElement(parent, "body", name=body.name, pos=_text(place[0]), quat=_text(place[1]))
    if motion == "driven":
        element.set("mocap", "true")
    elif motion == "free":
        ET.SubElement(element, "freejoint", name=f"{body.name}_free")
    if motion != "fixed":
        inertia = _text(body.inertia_kg_m2)
        ET.SubElement(element, "inertial", pos=_text(body.com_m), mass=_text(body.mass_kg), fullinertia=inertia)
    _add_geoms(element, body, model)
    return element


def _add_geoms(element: ET.Element, body: BodyModel, model: Model) -> None:
    """Add the collision spheres of a body; without them, its box or ball."""
    spheres = model.collision.get(body.name)
    if spheres is not None:
        radii = np.asarray(spheres.scales, float) * body.radius_factor
        parts = zip(_geoms(body, model), np.asarray(spheres.means, float), radii, strict=True)
        for name, center, radius in parts:
            geom = ET.SubElement(element, "geom", name=name)
            geom.attrib.update(type="sphere", pos=_text(center), size=_text(radius))
    elif body.shape is not None and body.shape.box is not None:
        geom = ET.SubElement(element, "geom", name=_geoms(body, model)[0])
        geom.attrib.update(type="box", size=_text(body.shape.box.half_extents_m))
    elif body.shape is not None and body.shape.sphere is not None:
        geom = ET.SubElement(element, "geom", name=_geoms(body, model)[0])
        geom.attrib.update(type="sphere", size=_text(body.shape.sphere.radius_m))


def _add_keyframe(root: ET.Element, file: ModelFile, keyframe: Keyframe) -> None:
    free, driven = ([k for k, body in enumerate(file.bodies) if body.motion == kind] for kind in ("free", "driven"))
    rows = {"qpos": (free, keyframe.position_m, keyframe.quat_wxyz)}
    rows["qvel"] = (free, keyframe.velocity_m_s, keyframe.omega_body_rad_s)
    values = {name: np.concatenate([a[who], b[who]], 1).ravel() for name, (who, a, b) in rows.items()}
    values |= {"mpos": keyframe.position_m[driven].ravel(), "mquat": keyframe.quat_wxyz[driven].ravel()}
    texts = {name: _text(numbers) for name, numbers in values.items() if numbers.size}
    ET.SubElement(ET.SubElement(root, "keyframe"), "key", name=keyframe.name).attrib.update(texts)


def _add_camera(world: ET.Element, name: str, camera: Camera) -> None:
    pose, K = np.asarray(camera.T_world_cam, float), np.asarray(camera.K, float)
    # MuJoCo looks along -z with y up, OpenCV along z with y down.
    axes = np.concatenate([pose[:3, 0], -pose[:3, 1]])
    offset = (camera.width / 2 - K[0, 2], camera.height / 2 - K[1, 2])
    ET.SubElement(
        world,
        "camera",
        name=name,
        pos=_text(pose[:3, 3]),
        xyaxes=_text(axes),
        resolution=f"{camera.width} {camera.height}",
        sensorsize=_text((camera.width * 1e-5, camera.height * 1e-5)),
        focalpixel=_text((K[0, 0], K[1, 1])),
        principalpixel=_text(offset),
    )


def _text(values: object) -> str:
    return " ".join(f"{value:.10g}" for value in np.atleast_1d(np.asarray(values, float)))
