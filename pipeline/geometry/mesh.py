"""Closed triangle meshes: reading, conversion to a grid, surface samples, mass properties."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...datasets.shapes import meshes
from ...datasets.shapes.meshes import Mesh
from ...schemas import InputDataError
from .solid_grid import Array, MassProperties, Volume


def read_mesh(path: Path) -> Mesh:
    """Read a closed mesh from a .obj or .stl file (binary or text), in metres.

    Raises:
        InputDataError: If the file is missing, cut off or of another format, or the mesh is empty or not closed.
    """
    if not path.is_file():
        raise InputDataError(f"{path}: no such file.", todo="correct the path of the mesh in capture.toml.")
    mesh = meshes.read_mesh(path, merge=False)
    if mesh.faces.shape[0] < 4:
        raise InputDataError(
            f"{path}: no closed mesh; found {mesh.faces.shape[0]} triangles.",
            "a closed mesh, of 4 triangles or more.",
            "export the whole surface of the body.",
        )
    require_closed(mesh, path)
    # triangles of a mesh that is inside out are flipped
    return mesh if _signed_volume(mesh) > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def mesh_mass_properties(mesh: Mesh) -> MassProperties:
    """Return the exact mass properties of a closed mesh, by signed tetrahedra from the origin (divergence theorem)."""
    # `datasets.shapes.meshes.solid_properties` integrates about the vertices' mean instead: the better choice far from
    # the origin, but it changes the last digits, and a fit through impacts turns these into a per mille of friction
    triangles = mesh.corners()
    volumes = np.linalg.det(triangles) / 6
    volume = volumes.sum()
    com = (volumes[:, None] * triangles.sum(1)).sum(0) / (4 * volume)
    sums = triangles.sum(1)
    outer = np.einsum("f,fci,fcj->ij", volumes, triangles, triangles) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    second = outer / (20 * volume) - np.outer(com, com)
    return MassProperties(float(volume), com, np.trace(second) * np.eye(3) - second)


def mesh_volume(mesh: Mesh, resolution: int = 72) -> Volume:
    """Convert a closed mesh to a grid with about `resolution` points along its longest side."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    pitch = float((high - low).max()) / (resolution - 6)
    from scipy.ndimage import binary_erosion

    # An irrational shift keeps rays off vertices and edges, where parity is ambiguous.
    origin = low - pitch * (3 + np.array([0.3178, 0.2361, 0.1417]))
    shape = tuple(int(n) for n in np.ceil((high - origin) / pitch).astype(int) + 4)
    surface, inside = sample_surface(mesh, 0.5 * pitch), _inside(mesh, origin, pitch, shape)
    # walls between the parts of a mesh, as convex decompositions have them, are no surface of the solid
    place = tuple(np.round((surface - origin) / pitch).astype(int).T)
    return Volume.from_inside(inside, origin, pitch, surface[~binary_erosion(inside, iterations=2)[place]])


def sample_surface(mesh: Mesh, spacing: float) -> Array:
    """Return points (S, 3) [m] on all triangles, including the vertices, at most about `spacing` [m] apart."""
    triangles = mesh.corners()
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(1)
    divisions = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    found = [mesh.vertices[np.unique(mesh.faces)]]
    for count in np.unique(divisions):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        kept = i + j <= count
        barycentric = np.stack([i[kept], j[kept], count - i[kept] - j[kept]], 1) / count
        found.append(np.einsum("bc,fcx->fbx", barycentric, triangles[divisions == count]).reshape(-1, 3))
    return np.concatenate(found)


def distance_to_mesh(mesh: Mesh, points: Array) -> Array:
    """Return the exact distance (n,) [m] of points (n, 3) from the nearest triangle of a mesh.

    Source: closest point of a triangle by its regions (Ericson, "Real-Time Collision Detection", 2005, section 5.1.5).
    """
    corners = mesh.vertices[mesh.faces]
    return np.array([float(np.sqrt(_squares_to(corners, point).min())) for point in points])


def _squares_to(corners: Array, point: Array) -> Array:
    """Return the squared distances (F,) [m2] of a point from triangles (F, 3, 3)."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(ab, ac)
    area2 = (normal * normal).sum(1)
    away = point - a
    with np.errstate(divide="ignore", invalid="ignore"):
        v = (np.cross(away, ac) * normal).sum(1) / area2
        w = (np.cross(ab, away) * normal).sum(1) / area2
        plane = (away * normal).sum(1) ** 2 / area2
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (area2 > 0)
    edges = [_squares_to_segment(corners[:, k], corners[:, (k + 1) % 3], point) for k in range(3)]
    return np.where(inside, plane, np.min(edges, axis=0))


def _squares_to_segment(start: Array, end: Array, point: Array) -> Array:
    along = end - start
    share = ((point - start) * along).sum(1) / np.maximum((along * along).sum(1), 1e-30)
    foot = start + share.clip(0, 1)[:, None] * along
    return ((point - foot) ** 2).sum(1)


def _inside(mesh: Mesh, origin: Array, pitch: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which grid points lie inside, by the parity of crossings along z."""
    flips = np.zeros(shape, dtype=np.int32)
    for a, b, c in (mesh.corners() - origin) / pitch:
        low = np.ceil(np.min([a, b, c], 0)[:2]).astype(int)
        high = np.floor(np.max([a, b, c], 0)[:2]).astype(int)
        if (high < low).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1), indexing="ij")
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        z = np.ceil(a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])).astype(int)
        np.add.at(flips, (x[hit], y[hit], np.clip(z[hit], 0, shape[2] - 1)), 1)
    return np.cumsum(flips, axis=2) % 2 == 1


def _signed_volume(mesh: Mesh) -> float:
    return float(np.linalg.det(mesh.corners()).sum() / 6)


def require_closed(mesh: Mesh, path: Path | str) -> None:
    """Check that a mesh is closed: each edge belongs to an even number of triangles.

    Raises:
        InputDataError: If it is not, with the file or part and the number of open edges.
    """
    _, merged = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, counts = np.unique(edges, axis=0, return_counts=True)
    open_edges = int((counts % 2 == 1).sum())
    if open_edges:
        raise InputDataError(
            f"{path}: the mesh is not closed: {open_edges} of {counts.shape[0]} edges belong to an odd number of "
            "triangles.",
            "a closed (watertight) surface.",
            "close its holes in a mesh editor.",
        )
