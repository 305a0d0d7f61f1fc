"""Links of the jointed bodies of a capture, as bodies of its manifest and as parts of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from ...schemas import Articulation as Entry
from ...schemas import Body, CaptureManifest, InputDataError
from ...schemas.articulations import ArticulationModel, JointModel
from ...schemas.regular_files import real_path, require_regular_file
from ..robots import Articulation, JointOfRobot, LinkOfRobot, read_articulation
from .files import optional_file

KINDS: dict[str, Literal["hinge", "slide", "fixed"]] = {"hinge": "hinge", "slide": "slide", "fixed": "fixed"}
"""Kinds of joints in files and in models."""
IMMOVABLE_KG, IMMOVABLE_KG_M2 = 1.0, 1e-9
"""Mass and inertia of a root link that does not move and has none in its file; they do not matter."""


def articulations_of(root: Path, manifest: CaptureManifest) -> dict[str, Articulation]:
    """Read the jointed bodies of a capture, by name; links behind fixed joints are part of what carries them.

    Raises:
        InputDataError: If a file is not there or lies outside the capture, or has what a chain cannot have.
    """
    return {entry.name: _read(root, entry) for entry in manifest.articulations}


def _read(root: Path, entry: Entry) -> Articulation:
    path = _file(root, entry)
    found = read_articulation(require_regular_file(path), bare_links=True).welded()
    _require_passive(path, [joint for joint in found.joints if joint.kind != "fixed"])
    for link in found.links:
        _require_link(path, link, moves=entry.base == "free" or link is not found.links[0])
    return found


def _file(root: Path, entry: Entry) -> Path:
    """Return the file of a jointed body, which must lie inside the capture."""
    path = root / entry.path
    where = f"{root / 'capture.toml'}: [[articulations]] '{entry.name}': '{entry.path}'"
    if not real_path(path).is_relative_to(real_path(root)):
        raise InputDataError(
            f"{where} lies outside the capture.", "a file of the capture directory.", "copy the file into it."
        )
    if optional_file(path) is None:
        raise InputDataError(
            f"{where}: no such file.",
            "a path relative to the capture directory.",
            "add the file, or correct its name in capture.toml.",
        )
    return path


def _require_passive(path: Path, moving: Sequence[JointOfRobot]) -> None:
    """Refuse a joint with a servo, and a body in which no joint moves."""
    served = next((joint.name for joint in moving if joint.stiffness > 0), None)
    if served is not None:
        raise InputDataError(
            f"{path}: joint '{served}' has a servo, and a capture has no commands of joints.",
            "passive joints: hinges and slides that move freely, with damping and friction.",
            "remove the actuator from the file; servos are simulated by the Python API.",
        )
    if not moving:
        raise InputDataError(f"{path}: none of its joints moves.", todo="make it one of [[bodies]] with a shape.")


def _require_link(path: Path, link: LinkOfRobot, moves: bool) -> None:
    """Refuse a link that has nothing that could touch, or that moves and has no mass."""
    if moves and not link.mass_kg > 0:
        raise InputDataError(
            f"{path}: link '{link.name}' moves and has no mass.", "<inertial> with a mass above 0 kg.", "add it."
        )
    link.require_geometry(path, "add one.")


def with_links(root: Path, manifest: CaptureManifest) -> CaptureManifest:
    """Return the manifest with the links of its jointed bodies among the bodies, behind all others.

    Raises:
        InputDataError: As `articulations_of`, or if a link has the name of another body or surface.
    """
    if not manifest.articulations:
        return manifest
    bodies, named = list(manifest.bodies), {body.name for body in manifest.bodies}
    named |= {surface.name for surface in manifest.surfaces}
    read = articulations_of(root, manifest)
    for entry in manifest.articulations:
        for link in read[entry.name].links:
            if link.name in named:
                raise InputDataError(
                    f"{root / 'capture.toml'}: the link '{link.name}' of [[articulations]] '{entry.name}' has the name "
                    "of another body or surface.",
                    "names that differ.",
                    f"rename it in {entry.path}, or the other one.",
                )
            named.add(link.name)
            bodies.append(_body(root, entry, link, link is read[entry.name].links[0]))
    return manifest.model_copy(update={"bodies": tuple(bodies)})


def _body(root: Path, entry: Entry, link: LinkOfRobot, first: bool) -> Body:
    massless = not link.mass_kg > 0
    rows = link.inertia_kg_m2.tolist()
    inertia = (*(rows[k][k] for k in range(3)), rows[0][1], rows[0][2], rows[1][2])
    x, y, z = link.com_m.tolist()
    try:
        return Body(
            name=link.name,
            motion="link",
            mass_kg=IMMOVABLE_KG if massless else link.mass_kg,
            inertia_kg_m2=(IMMOVABLE_KG_M2,) * 3 if massless else inertia,
            com_m=(x, y, z),
            photo_pose=entry.pose if first else None,
            material=entry.material,
        )
    except ValidationError as error:
        told = error.errors()[0]
        raise InputDataError(
            f"{root / entry.path}: link '{link.name}': {told['msg'].removeprefix('Value error, ')}.",
            "a name of letters, digits, _ . -, a mass [kg], and an inertia [kg m2] that a body can have.",
            todo="correct the link in the URDF.",
        ) from None


def articulation_models(manifest: CaptureManifest, read: dict[str, Articulation]) -> tuple[ArticulationModel, ...]:
    """Return the jointed bodies of a capture as parts of a model."""
    return tuple(
        ArticulationModel(
            name=entry.name,
            root=read[entry.name].links[0].name,
            base=entry.base,
            joints=tuple(map(_joint, read[entry.name].joints)),
        )
        for entry in manifest.articulations
    )


def _joint(joint: JointOfRobot) -> JointModel:
    x, y, z = map(float, joint.position_m)
    w, i, j, k = map(float, joint.quat_wxyz)
    a, b, c = map(float, joint.axis)
    return JointModel(
        name=joint.name,
        kind=KINDS[joint.kind],
        link=joint.link,
        parent=joint.parent,
        position_m=(x, y, z),
        quat_wxyz=(w, i, j, k),
        axis=(a, b, c),
        lower=joint.lower if math.isfinite(joint.lower) else None,
        upper=joint.upper if math.isfinite(joint.upper) else None,
        damping=joint.damping,
        friction=joint.friction,
        armature=joint.armature,
    )
