"""What files of robots share: numbers and angles as text, the folder of meshes, and links with all joints at 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import ArticulationModel, BodyModel
from ..models.model import Model
from ..shapes.meshes import Mesh
from ..shapes.surfaces import obj_text
from ..shapes.turns import matrix_of, quat_product
from .bop_models import ObjectModel

Array = NDArray[np.float64]

HALF_SPACE_M, SHEET_M = 10.0, 0.001
"""Half the sides of what stands for a half space, and half the thickness of what stands for a sheet [m]."""


def numbers_text(values: object) -> str:
    """Return numbers with twelve digits, separated by blanks; no -0."""
    return " ".join(f"{value + 0.0:.12g}" for value in np.asarray(values, float).ravel())


def roll_pitch_yaw(matrix: Array) -> Array:
    """Return roll, pitch and yaw (3,) [rad] about the fixed axes x, y, z of a rotation matrix (3, 3)."""
    pitch = np.arctan2(-matrix[2, 0], np.hypot(matrix[0, 0], matrix[1, 0]))
    if np.hypot(matrix[0, 0], matrix[1, 0]) < 1e-9:  # straight up or down: roll and yaw are about the same axis
        return np.array([np.arctan2(-matrix[1, 2], matrix[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(matrix[2, 1], matrix[2, 2]), pitch, np.arctan2(matrix[1, 0], matrix[0, 0])])


def moments_of(body: BodyModel) -> dict[str, str]:
    """Return the moments of inertia about the centre of mass, in the body's axes, as both formats name them."""
    xx, yy, zz, xy, xz, yz = body.inertia_kg_m2
    moments = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
    return {key: numbers_text([value]) for key, value in moments.items()}


def mean_color(mesh: ObjectModel) -> str:
    """Return the mean colour of a mesh, red, green, blue and opacity in [0, 1], as text."""
    return numbers_text([*np.asarray(mesh.colors, float).mean(0) / 255, 1.0])


def spheres_of(model: Model, body: BodyModel) -> Iterator[tuple[Array, float]]:
    """Yield centre (3,) and radius [m] of each collision sphere of a body, in its frame."""
    spheres = model.collision.get(body.name)
    if spheres is not None:
        radii = np.asarray(spheres.scales, float) * body.radius_factor
        yield from zip(np.asarray(spheres.means, float), map(float, radii), strict=True)


def write_meshes(folder: Path, model: Model, meshes: Mapping[str, ObjectModel]) -> None:
    """Write `meshes/<name>.obj` of bodies and of surfaces that are meshes into a folder."""
    (folder / "meshes").mkdir()
    shapes = {name: Mesh(mesh.vertices, mesh.faces) for name, mesh in meshes.items()} | {**model.surface_meshes}
    for name, mesh in shapes.items():
        (folder / "meshes" / f"{name}.obj").write_text(obj_text(mesh), encoding="utf-8")


def link_poses(model: Model, one: ArticulationModel) -> dict[str, tuple[Array, Array]]:
    """Return position [m] and quaternion of each link with the root as in the photos and all joints at 0, by name."""
    pose = model.body(one.root).photo_pose
    found = {one.root: (np.asarray(pose.position_m, float), np.asarray(pose.quat_wxyz, float))}
    for joint in one.joints:
        place, quat = found[joint.parent]
        offset = matrix_of(quat) @ np.asarray(joint.position_m, float)
        found[joint.link] = (place + offset, quat_product(quat, np.asarray(joint.quat_wxyz, float)))
    return found
