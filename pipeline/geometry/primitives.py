"""Shapes of the manifest as grids, meshes and mass properties, in the body frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from ...datasets.shapes.meshes import Mesh
from ...datasets.shapes.ply import read_splats
from ...schemas import InputDataError, Shape
from .directions import fibonacci_directions
from .mesh import mesh_mass_properties, mesh_volume, read_mesh
from .solid_grid import Array, MassProperties, Volume, crossings, grid_points
from .surface_distance import union_distance

_BALL_POINTS = 500
"""Number of vertices of the mesh of a ball."""


def shape_volume(shape: Shape, capture_root: Path, radius_factor: float = 2.0) -> Volume:
    """Convert a shape to a grid, in the body frame.

    Args:
        shape: The shape.
        capture_root: Directory to which the shape's path is relative.
        radius_factor: Radius of a shape's Gaussians in units of their scale.
    """
    if shape.sphere is not None:
        return spheres_volume(np.zeros((1, 3)), np.array([shape.sphere.radius_m]))
    if shape.splats is not None:
        splats = read_splats(capture_root / shape.splats.path)
        return spheres_volume(np.asarray(splats.means, float), radius_factor * np.asarray(splats.scales, float))
    return mesh_volume(shape_mesh(shape, capture_root))


def shape_mass_properties(shape: Shape, capture_root: Path, radius_factor: float = 2.0) -> MassProperties:
    """Return the mass properties of a shape of uniform density, in the body frame; exact except for splats."""
    if shape.sphere is not None:
        radius = shape.sphere.radius_m
        return MassProperties(4 / 3 * np.pi * radius**3, np.zeros(3), 0.4 * radius**2 * np.eye(3))
    if shape.splats is not None:
        return shape_volume(shape, capture_root, radius_factor).mass_properties()
    return mesh_mass_properties(shape_mesh(shape, capture_root))


def shape_mesh(shape: Shape, capture_root: Path) -> Mesh:
    """Return the surface mesh of a mesh, a box or a ball (about a thousand triangles), in the body frame."""
    if shape.mesh is not None:
        return read_mesh(capture_root / shape.mesh.path)
    if shape.sphere is not None:
        directions = fibonacci_directions(_BALL_POINTS)
        faces = ConvexHull(directions).simplices.astype(np.int64)
        inwards = np.linalg.det(directions[faces]) < 0
        faces[inwards] = faces[inwards][:, ::-1]
        return Mesh(shape.sphere.radius_m * directions, faces)
    if shape.box is None:
        raise InputDataError(
            "a shape without a surface of triangles.", "box, sphere, mesh.", todo="give the body one of these shapes."
        )
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return Mesh(signs * np.array(shape.box.half_extents_m), np.array(faces))


def spheres_volume(centers: Array, radii: Array, resolution: int = 72) -> Volume:
    """Convert a union of spheres to a grid with about `resolution` points along its longest side."""
    low, high = (centers - radii[:, None]).min(0), (centers + radii[:, None]).max(0)
    pitch = float((high - low).max()) / (resolution - 6)
    origin = low - 3 * pitch
    shape = tuple(int(n) for n in np.ceil((high - origin) / pitch).astype(int) + 4)
    field = union_distance(centers, radii, grid_points(shape, origin, pitch)).reshape(shape)
    return Volume.from_inside(field < 0, origin, pitch, crossings(field, origin, pitch))
