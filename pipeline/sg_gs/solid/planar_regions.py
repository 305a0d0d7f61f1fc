"""Regions of a solid's surface that lie near a plane: where its faces may be flat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...geometry.solid_grid import Array, Volume

LEAST_SHARE = 0.04
"""Smallest region, in units of the whole surface: on a small one a plane and a curved surface look alike."""
NEAR_SHARE = 4e-3
"""Largest distance of a region's points from its plane, in units of the solid's size: a silhouette hull bulges."""
ROUND = 0.025
"""Standard deviation of a region from its plane, in units of the square root of its area, above which it is a cap of a
round body and no face: 0.163 times the square root of its share on a ball (derived), 0.033 for the smallest region.
"""
_ALIKE = 0.94
"""Least cosine between the normal of a point and that of its region's plane: 20 degrees."""
_WIDER, _WIDER_ALIKE = 4.0, 0.8
"""Bounds by which a region grows at last, onto bulges that its plane does not follow: on the distance, in units of the
first bound, and on the cosine (37 degrees).
"""
_SEEDS = 600
_REACH_PITCHES = 8.0
_NEIGHBOURS = 9
_PASSES = 6
_LEAST_POINTS = 20


@dataclass(frozen=True)
class Regions:
    """Regions of a surface; each of its points belongs to one at most."""

    region: NDArray[np.intp]
    """Number of the region of each point of the surface, -1 for none, shape (S,)."""
    planes: Array
    """Unit outward normal n and offset h [m] of each region's least-squares plane, n . x = h, shape (R, 4)."""


def planar_regions(solid: Volume, normals: Array, seed: int) -> Regions:
    """Grow connected regions around the flattest places of a surface, as long as their points lie near a plane.

    Args:
        solid: The solid.
        normals: Smoothed outward unit normals at the points of its surface, shape (S, 3).
        seed: Seed of the choice of places.
    """
    points, tolerance = solid.surface, NEAR_SHARE * solid.size()
    tree = KDTree(points)
    near: NDArray[np.intp] = np.asarray(tree.query(points, k=min(_NEIGHBOURS, len(points)))[1])
    # crossings of grid edges are the denser the more obliquely a surface lies in the grid
    area = 1 / np.maximum(np.abs(normals).sum(1), 0.5)
    region, planes = np.full(len(points), -1), []
    tried = np.zeros(len(points), bool)
    for start in _flattest(tree, points, normals, _REACH_PITCHES * solid.pitch, seed):
        if region[start] >= 0 or tried[start]:
            continue
        members, plane = _grown(points, normals, area, near, region < 0, int(start), tolerance)
        tried[members] = True
        off = points[members] @ plane[:3] - plane[3]
        size = solid.pitch * float(np.sqrt(area[members].sum()))
        if area[members].sum() >= LEAST_SHARE * area.sum() and off.std() <= ROUND * size:
            region[members] = len(planes)
            planes.append(plane)
    return Regions(region, np.array(planes).reshape(-1, 4))


def _flattest(tree: KDTree, points: Array, normals: Array, reach_m: float, seed: int) -> NDArray[np.intp]:
    """Return some points, those first around which the normals are most alike."""
    chosen = np.random.default_rng(seed).permutation(len(points))[:_SEEDS]
    around = tree.query_ball_point(points[chosen], reach_m)
    alike = [float((normals[members] @ normals[k]).mean()) for k, members in zip(chosen, around, strict=True)]
    return chosen[np.argsort(-np.array(alike), kind="stable")]


def _grown(
    points: Array,
    normals: Array,
    area: Array,
    near: NDArray[np.intp],
    free: NDArray[np.bool_],
    start: int,
    tolerance_m: float,
) -> tuple[NDArray[np.intp], Array]:
    """Return the region (m,) around a point and its plane (4,); the plane is fitted again as the region grows."""
    normal, height = normals[start], float(normals[start] @ points[start])

    def around(distance_m: float, alike: float) -> NDArray[np.intp]:
        fits = free & (np.abs(points @ normal - height) < distance_m) & (normals @ normal > alike)
        return _connected(fits, near, start)

    for _ in range(_PASSES):
        found = around(tolerance_m, _ALIKE)
        if len(found) < _LEAST_POINTS:
            return np.array([start]), np.append(normal, height)
        normal, height = _plane(points[found], area[found], normal)
    return around(_WIDER * tolerance_m, _WIDER_ALIKE), np.append(normal, height)


def _plane(points: Array, weights: Array, outward: Array) -> tuple[Array, float]:
    """Return unit normal (3,) and offset [m] of the least-squares plane of points (n, 3)."""
    middle = weights @ points / weights.sum()
    away = points - middle
    normal = np.linalg.eigh((weights[:, None] * away).T @ away)[1][:, 0]
    normal = normal if normal @ outward > 0 else -normal
    return normal, float(normal @ middle)


def _connected(fits: NDArray[np.bool_], near: NDArray[np.intp], start: int) -> NDArray[np.intp]:
    """Return the points that fit and hang together with a point, over neighbours (S, k)."""
    seen = np.zeros(len(fits), bool)
    front = np.array([start]) if fits[start] else np.zeros(0, np.intp)
    while len(front):
        seen[front] = True
        beside = np.unique(near[front])
        front = beside[fits[beside] & ~seen[beside]]
    return np.flatnonzero(seen)
