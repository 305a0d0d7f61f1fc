"""Faces of convex hulls. Those of few points need no scipy, whose import takes longer than all else here."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEW = 24
"""Number of points up to which all planes through three of them are tried (2,024)."""
ON_PLANE = 1e-9
"""Distance from a plane, relative to the extent of the points, up to which a point lies in it."""


@dataclass(frozen=True, kw_only=True)
class HullFace:
    """A flat face of a convex hull, or a triangle of one."""

    normal: Array
    """Outward unit normal, shape (3,)."""
    offset: float
    """Offset of its plane: normal . x + offset is 0 there and negative inside."""
    corners: NDArray[np.int64]
    """Indices of its corners, in order around it."""
    area: float
    """Its area."""


def hull_faces(points: Array) -> list[HullFace]:
    """Return the faces of the convex hull of points (N, 3); none where these lie in a plane."""
    if len(points) < 4:
        return []
    return _faces_of_few(points) if len(points) <= FEW else _triangles(points)


def _faces_of_few(points: Array) -> list[HullFace]:
    """Return the faces as planes through three points that have no point beyond them."""
    triples = np.array(list(combinations(range(len(points)), 3)), np.int64)
    a, b, c = points[triples].swapaxes(0, 1)
    across = np.cross(b - a, c - a)
    size = float(np.ptp(points, axis=0).max())
    length = np.linalg.norm(across, axis=1)
    wide = length > ON_PLANE * size**2
    normals = across[wide] / length[wide, None]
    distance = ((points[:, None] - a[wide]) * normals).sum(-1)  # (N, T)
    highest, lowest = distance.max(0), distance.min(0)
    near = ON_PLANE * size
    outward = np.where((highest <= near)[:, None], normals, -normals)
    faces = {}
    for k in np.flatnonzero((highest <= near) != (lowest >= -near)):
        on_it = np.flatnonzero(np.abs(distance[:, k]) <= near)
        if tuple(on_it) not in faces:
            faces[tuple(on_it)] = _face(points, on_it, outward[k])
    return list(faces.values())


def _face(points: Array, on_it: NDArray[np.int64], normal: Array) -> HullFace:
    """Return the face with some points in its plane: those at its corners, by Andrew's monotone chain."""
    first = points[on_it[1]] - points[on_it[0]]
    first /= np.linalg.norm(first)
    least = ON_PLANE * float(np.ptp(points[on_it], axis=0).max()) ** 2
    x, y = points[on_it] @ first, points[on_it] @ np.cross(normal, first)
    order = np.lexsort((y, x))
    chain: list[int] = []
    for run in (order, order[::-1]):
        begin = len(chain)
        for k in run:
            while len(chain) > begin + 1 and _turn(x, y, chain[-2], chain[-1], k) <= least:
                chain.pop()
            chain.append(int(k))
        chain.pop()
    corners = on_it[chain]
    arms = points[corners[1:]] - points[corners[0]]
    area = 0.5 * float(np.cross(arms[:-1], arms[1:]).sum(0) @ normal)
    return HullFace(normal=normal, offset=-float(normal @ points[corners].mean(0)), corners=corners, area=area)


def _turn(x: Array, y: Array, a: int, b: int, c: int) -> float:
    return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])


def _triangles(points: Array) -> list[HullFace]:
    """Return the triangles of the hull of many points."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return []
    a, b, c = points[hull.simplices].swapaxes(0, 1)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return [
        HullFace(normal=plane[:3], offset=float(plane[3]), corners=corners.astype(np.int64), area=float(area))
        for plane, corners, area in zip(hull.equations, hull.simplices, areas, strict=True)
    ]
