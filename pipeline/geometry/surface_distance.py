"""Surface of a union of spheres, and distances between two such surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from .directions import fibonacci_directions
from .solid_grid import Array

_SAMPLES = 60_000
"""Approximate number of surface samples of all spheres together."""


@dataclass(frozen=True)
class Gap:
    """Statistics of the distance of a surface from another, over its area."""

    mean_m: float
    """Mean distance [m]."""
    percentile_95_m: float
    """95th percentile of the distance [m]."""
    max_m: float
    """Largest distance [m]."""

    @staticmethod
    def of(distances: Array) -> Gap:
        """Return the statistics of distances (n,) [m] at points that are evenly distributed over a surface."""
        return Gap(float(distances.mean()), float(np.percentile(distances, 95)), float(distances.max()))


@dataclass(frozen=True)
class Union:
    """A union of spheres with samples of its surface."""

    centers: Array
    """Centres [m], shape (n, 3)."""
    radii: Array
    """Radii [m], shape (n,)."""
    surface: Array
    """Points evenly distributed over the surface [m], shape (S, 3)."""

    @staticmethod
    def of(centers: Array, radii: Array) -> Union:
        """Build the union of spheres, its surface sampled at the density of about 60,000 points on all spheres."""
        centers, radii = np.asarray(centers, float), np.asarray(radii, float)
        spacing = float(np.sqrt(4 * np.pi * (radii**2).sum() / _SAMPLES))
        return Union(centers, radii, union_surface(centers, radii, spacing))

    def distance(self, points: Array) -> Array:
        """Return the distance of points (n, 3) from the surface [m], shape (n,).

        Inside, the nearest surface point is that of the sphere in which a point lies deepest, if no other sphere covers
        it; otherwise the nearest point of `surface` is used.
        """
        signed, deepest = _deepest(self.centers, self.radii, points)
        inside = np.flatnonzero(signed < 0)
        offset = points[inside] - self.centers[deepest[inside]]
        out = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
        foot = self.centers[deepest[inside]] + self.radii[deepest[inside], None] * out
        covered = inside[union_distance(self.centers, self.radii, foot) < -1e-6 * self.radii.max()]
        distance = np.abs(signed)
        distance[covered] = KDTree(self.surface).query(points[covered])[0]
        return distance

    def gaps(self, other: Union) -> tuple[Gap, Gap]:
        """Return the distance statistics of this surface from another, and of the other from this one."""
        return Gap.of(other.distance(self.surface)), Gap.of(self.distance(other.surface))


def union_distance(centers: Array, radii: Array, points: Array) -> Array:
    """Return min |p - c| - r over spheres at points (n, 3) [m], which is the exact distance outside of their union."""
    return _deepest(centers, radii, points)[0]


def _deepest(centers: Array, radii: Array, points: Array) -> tuple[Array, Array]:
    """Return min |p - c| - r over spheres at points (n, 3) [m], and the index of that sphere, each (n,)."""
    nearest, which = np.full(points.shape[0], np.inf), np.zeros(points.shape[0], np.int64)
    x, y, z = np.ascontiguousarray(points.T, float)
    for index, ((cx, cy, cz), radius) in enumerate(zip(centers, radii, strict=True)):
        away = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - radius
        closer = np.flatnonzero(away < nearest)
        nearest[closer], which[closer] = away[closer], index
    return nearest, which


def union_surface(centers: Array, radii: Array, spacing: float) -> Array:
    """Return points on the surface of a union of spheres, about `spacing` apart [m], shape (S, 3)."""
    tree, largest = KDTree(centers), float(radii.max())
    found = []
    for index, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        count = int(np.ceil(4 * np.pi * radius**2 / spacing**2))
        points = center + radius * fibonacci_directions(count)
        near = np.array(tree.query_ball_point(center, radius + largest))
        near = near[near != index]
        away = np.linalg.norm(points[:, None] - centers[near], axis=2)
        found.append(points[(away >= radii[near] - 1e-9 * largest).all(1)])
    return np.concatenate(found)
