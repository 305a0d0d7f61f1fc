"""How the triangles of a mesh hang together: ways into neighbours, pseudonormals, and whether it is closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....datasets.shapes.surfaces import require_areas
from .mesh_overhangs import open_edges, overhangs

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Topology:
    """The triangles of a mesh with what is found from their neighbours, by feature.

    The features of a triangle are its inside, its edges ab, bc and ca, and its corners a, b and c.
    """

    corners: Array
    """Corners of the triangles [m], anticlockwise seen from outside, shape (F, 3, 3)."""
    solid: bool
    """Whether the mesh has an inside."""
    pseudonormals: Array
    """Directions out of the solid at each feature, of any length; zero at borders; shape (F, 7, 3)."""
    ways: Array
    """Unit vectors from features along the mesh, shape (W, 3)."""
    way_start: Indices
    """First way of each feature, shape (F, 7)."""
    way_count: Indices
    """Number of its ways; -1 where another triangle has the feature; shape (F, 7)."""
    prisms: Array
    """Of each triangle its unit normal, the outward unit normals of its edges within its plane, its overhangs above and
    below, and its open edges there, as bits of a number, shape (F, 16)."""

    @staticmethod
    def of(vertices: Array, faces: Indices, *, solid: bool, name: str) -> Topology:
        """Find the neighbours of a mesh.

        Args:
            vertices: Corners [m], shape (V, 3).
            faces: Indices of the triangles' corners (F, 3), of a solid anticlockwise seen from outside.
            solid: Whether it has an inside: a closed mesh, or a height field, whose inside is below it.
            name: What messages call it.

        Raises:
            InputDataError: If a triangle is degenerate.
        """
        vertices, faces = _joined(vertices, faces)
        corners = vertices[faces]
        require_areas(corners, name)
        edges = _Edges.of(vertices, faces)
        start, count, owned, ways = _ways(vertices, faces, edges)
        pseudonormals = _pseudonormals(corners, faces, edges, len(vertices))
        ways = ways if len(ways) else np.zeros((1, 3))
        # whether a point is inside a solid is asked of all triangles at the nearest place
        outward = -edges.inward.reshape(-1, 3, 3)
        owned[:, 4:] = _holds(faces, open_edges(pseudonormals[:, 0], start, count, ways))
        beside = overhangs(corners, pseudonormals[:, 0], outward, (start, count, ways), owned | solid)
        return Topology(
            corners=corners,
            solid=solid,
            pseudonormals=pseudonormals,
            ways=ways,
            way_start=start,
            way_count=np.where(owned, count, -1),
            prisms=np.concatenate((pseudonormals[:, 0], outward.reshape(-1, 9), beside), 1),
        )


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges of a mesh; half-edge 3 f + k goes from corner k of triangle f to the next one."""

    of_half: Indices
    """Number of each half-edge's edge, shape (3 F,)."""
    count: int
    """Number of edges."""
    inward: Array
    """Unit vector of each half-edge into its triangle, across the edge, shape (3 F, 3)."""
    ends: Indices
    """Vertices of each edge, shape (E, 2)."""

    @staticmethod
    def of(vertices: Array, faces: Indices) -> _Edges:
        ends = np.stack((faces, np.roll(faces, -1, 1)), -1).reshape(-1, 2)
        unique, of_half = np.unique(np.sort(ends, 1), axis=0, return_inverse=True)
        side = vertices[ends[:, 1]] - vertices[ends[:, 0]]
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        arm = vertices[np.roll(faces, 1, 1).reshape(-1)] - vertices[ends[:, 0]]
        across = arm - (arm * side).sum(1, keepdims=True) * side
        inward = across / np.linalg.norm(across, axis=1, keepdims=True)
        return _Edges(of_half.reshape(-1), len(unique), inward, unique)


def _joined(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    """Return a mesh whose vertices at one place are joined."""
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)[faces]


def _ways(vertices: Array, faces: Indices, edges: _Edges) -> tuple[Indices, Indices, NDArray[np.bool_], Array]:
    """Return first way and number of ways of each feature (F, 7), whether it is the triangle's, and the ways (W, 3).

    Whose the corners are is told by `_holds`.
    """
    start, count = np.zeros((len(faces), 7), np.int64), np.zeros((len(faces), 7), np.int64)
    owned = np.ones((len(faces), 7), np.bool_)
    # of an edge: into each adjacent triangle; its owner is the first of them
    by_edge = np.argsort(edges.of_half, kind="stable")
    sizes = np.bincount(edges.of_half, minlength=edges.count)
    begins = np.cumsum(sizes) - sizes
    owner = by_edge[begins]
    start[:, 1:4] = begins[edges.of_half].reshape(-1, 3)
    owned[:, 1:4] = (owner[edges.of_half] == np.arange(len(edges.of_half))).reshape(-1, 3)
    count[:, 1:4] = sizes[edges.of_half].reshape(-1, 3)
    ways = edges.inward[by_edge]
    # of a corner: along each adjacent edge
    first, second = edges.ends.T
    along = vertices[second] - vertices[first]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    origin, direction = np.concatenate((first, second)), np.concatenate((along, -along))
    order = np.argsort(origin, kind="stable")
    degree = np.bincount(origin, minlength=len(vertices))
    corner = np.cumsum(degree) - degree + len(ways)
    flat = faces.reshape(-1)
    start[:, 4:] = corner[flat].reshape(-1, 3)
    count[:, 4:] = degree[flat].reshape(-1, 3)
    return start, count, owned, np.concatenate((ways, direction[order]))


def _holds(faces: Indices, open_: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether each corner (F, 3) is the triangle's: that of the first one there, with an open edge if any has.

    Args:
        faces: Indices of the triangles' corners (F, 3).
        open_: Whether the edges from each corner to the next one are open (F, 3).
    """
    flat, first = faces.reshape(-1), (open_ | np.roll(open_, 1, 1)).reshape(-1)
    order = np.lexsort((~first, flat))
    held = np.zeros(len(flat), np.bool_)
    held[order[np.unique(flat[order], return_index=True)[1]]] = True
    return held.reshape(-1, 3)


def _pseudonormals(corners: Array, faces: Indices, edges: _Edges, vertices: int) -> Array:
    """Return normals of triangles, sums of two at edges, and sums weighted by angle at corners; zero at borders.

    Source: Baerentzen & Aanaes, "Signed distance computation using the angle weighted pseudonormal", 2005.
    """
    sides = np.roll(corners, -1, 1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = np.zeros((len(faces), 7, 3))
    found[:, 0] = normal
    sums = np.zeros((edges.count, 3))
    np.add.at(sums, edges.of_half, np.repeat(normal, 3, 0))
    border = np.bincount(edges.of_half, minlength=edges.count) < 2
    sums[border] = 0
    found[:, 1:4] = sums[edges.of_half].reshape(-1, 3, 3)
    unit = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    angle = np.arccos(np.clip(-(unit * np.roll(unit, 1, 1)).sum(-1), -1, 1))
    at = np.zeros((vertices, 3))
    np.add.at(at, faces.reshape(-1), (angle[..., None] * normal[:, None]).reshape(-1, 3))
    at[edges.ends[border].reshape(-1)] = 0
    found[:, 4:] = at[faces]
    return found
