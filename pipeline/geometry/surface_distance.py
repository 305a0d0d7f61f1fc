"""The surface of a union of spheres, and how far two such surfaces are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from .directions import fibonacci_directions
from .volume import Array

_SAMPLES = 60_000


@dataclass(frozen=True)
class Gap:
    """How far a surface is from another, over its area: mean, 95th percentile and largest distance [m]."""

    mean_m: float
    percentile_95_m: float
    max_m: float

    @staticmethod
    def of(distances: Array) -> Gap:
        """Return the figures of distances (n,) [m] at points that are spread evenly over a surface."""
        return Gap(float(distances.mean()), float(np.percentile(distances, 95)), float(distances.max()))


@dataclass(frozen=True)
class Union:
    """A union of spheres: centres [m] (n, 3), radii [m] (n,), and points spread evenly over its surface [m] (S, 3)."""

    centers: Array
    radii: Array
    surface: Array

    @staticmethod
    def of(centers: Array, radii: Array) -> Union:
        """Return the union of spheres, its surface sampled as densely as about 60,000 points on all spheres allow."""
        centers, radii = np.asarray(centers, float), np.asarray(radii, float)
        spacing = float(np.sqrt(4 * np.pi * (radii**2).sum() / _SAMPLES))
        return Union(centers, radii, union_surface(centers, radii, spacing))

    def distance(self, points: Array) -> Array:
        """Return the distance of points (n, 3) from the surface [m], shape (n,).

        Inside, the nearest point of the sphere in which a point lies deepest is the nearest of all where no other
        sphere covers it; elsewhere the nearest of `surface` stands for it.
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
        """Return how far this surface is from another, and the other from this one."""
        return Gap.of(other.distance(self.surface)), Gap.of(self.distance(other.surface))


def union_distance(centers: Array, radii: Array, points: Array) -> Array:
    """Return min |p - c| - r over spheres at points (n, 3) [m]: the exact distance outside of their union."""
    return _deepest(centers, radii, points)[0]


def _deepest(centers: Array, radii: Array, points: Array) -> tuple[Array, Array]:
    """Return min |p - c| - r over spheres at points (n, 3) [m], and which sphere has it, each (n,)."""
    nearest, which = np.full(points.shape[0], np.inf), np.zeros(points.shape[0], np.int64)
    for index, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        away = np.linalg.norm(points - center, axis=1) - radius
        closer = away < nearest
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
