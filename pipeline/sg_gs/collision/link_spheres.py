"""Collision spheres of the links of an articulated body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ....datasets.robots import Articulation, GeometryOfLink, LinkOfRobot
from ....datasets.shapes.meshes import Mesh
from ....schemas import InputDataError, Shape
from ...geometry.directions import fibonacci_directions
from ...geometry.mesh import mesh_volume, require_closed
from .collision_spheres import distil, shape_to_spheres

Array = NDArray[np.float64]
Spheres = tuple[Array, Array]
LEAST_SPHERES = 4
"""Spheres of the smallest link."""
_ROUND_POINTS = 400
"""Vertices of the mesh of a cylinder or capsule."""


def link_spheres(articulation: Articulation, max_spheres: int) -> dict[str, Spheres]:
    """Return centres (n, 3) [m] and radii (n,) [m] of the spheres of each link, in its frame.

    The budget goes to the links by the size of their surface; equal links get equal spheres.

    Args:
        articulation: The articulated body.
        max_spheres: Maximum number of spheres of all links together.

    Raises:
        InputDataError: If the budget is less than `LEAST_SPHERES` a link, or no sphere fits into a link.
    """
    solid = [link for link in articulation.links if link.geometry]
    if max_spheres < LEAST_SPHERES * len(solid):
        raise InputDataError(
            f"{articulation.path}: {max_spheres} spheres for {len(solid)} links.",
            f"{LEAST_SPHERES * len(solid)} or more: {LEAST_SPHERES} a link.",
            todo="allow more spheres: --set sg-gs.max_collision_spheres=N.",
        )
    meshes = {link.name: [mesh_of_part(part) for part in link.geometry] for link in solid}
    areas = {name: sum(_area(mesh) for mesh in parts) for name, parts in meshes.items()}
    left, total = max_spheres - LEAST_SPHERES * len(solid), sum(areas.values())
    made: dict[bytes, Spheres] = {}
    found: dict[str, Spheres] = {link.name: (np.zeros((0, 3)), np.zeros(0)) for link in articulation.links}
    for link in solid:
        budget = LEAST_SPHERES + int(left * areas[link.name] / total)
        mesh = _joined(meshes[link.name])
        key = mesh.vertices.tobytes() + mesh.faces.tobytes() + bytes([budget % 251])
        if key not in made:
            made[key] = _spheres_of(articulation.path, link.name, link.geometry, mesh, budget)
        found[link.name] = made[key]
    return found


def _spheres_of(path: Path, name: str, parts: Sequence[GeometryOfLink], mesh: Mesh, budget: int) -> Spheres:
    if len(parts) == 1 and parts[0].kind == "sphere":
        return parts[0].position_m[None], np.array(parts[0].size_m)
    if len(parts) == 1 and parts[0].kind == "box" and budget >= 8:
        shape = Shape.model_validate({"box": {"half_extents_m": list(parts[0].size_m)}})
        splats, _ = shape_to_spheres(shape, path.parent, budget)
        centers = np.asarray(splats.means, float) @ parts[0].rotation.T + parts[0].position_m
        return centers, 2.0 * np.asarray(splats.scales, float)
    for part in parts:
        if part.mesh is not None:
            require_closed(part.mesh, f"{path}: link '{name}'")
    try:
        spheres = distil(mesh_volume(mesh), budget)
    except InputDataError as error:
        raise InputDataError(f"{path}: link '{name}': {error.found}", error.allowed, error.todo) from error
    return spheres.centers, spheres.radii


def link_mesh(link: LinkOfRobot) -> Mesh:
    """Return the surface of all that collides of a link, in its frame."""
    return _joined([mesh_of_part(part) for part in link.geometry])


def _area(mesh: Mesh) -> float:
    a, b, c = mesh.corners().transpose(1, 0, 2)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def mesh_of_part(part: GeometryOfLink) -> Mesh:
    """Return the surface of a part in the link's frame."""
    mesh = part.mesh if part.mesh is not None else _hull(_points_of(part))
    return Mesh(mesh.vertices @ part.rotation.T + part.position_m, mesh.faces)


def _points_of(part: GeometryOfLink) -> Array:
    """Return points whose hull is a box, ball, ellipsoid, cylinder or capsule about the origin."""
    if part.kind == "box":
        signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), -1).reshape(-1, 3)
        return signs * np.array(part.size_m)
    directions = fibonacci_directions(_ROUND_POINTS)
    if part.kind in ("sphere", "ellipsoid"):
        return np.array(part.size_m) * directions
    radius, half = part.size_m
    if part.kind == "capsule":
        return radius * directions + half * np.sign(directions[:, 2:]) * np.array([0.0, 0.0, 1.0])
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rim = radius * np.stack((np.cos(angles), np.sin(angles), np.zeros(48)), -1)
    end = np.array([0.0, 0.0, half])
    return np.concatenate([rim + end, rim - end])


def _hull(points: Array) -> Mesh:
    faces = ConvexHull(points).simplices.astype(np.int64)
    normals = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    inwards = (normals * (points[faces].mean(1) - points.mean(0))).sum(1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return Mesh(points, faces)
