"""Solids on a regular grid: signed distance, surface points and mass properties."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[Any]

_BESIDE = 2.0
"""Largest distance between a point of a flat face and the foot of a point that it is nearest to, in pitches."""


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of a solid of uniform density."""

    volume_m3: float
    """Volume [m3]."""
    com_m: Array
    """Centre of mass in the solid's frame [m], shape (3,)."""
    inertia_m2: Array
    """Inertia about the centre of mass for a mass of 1 kg, axes of the solid's frame [m2], shape (3, 3)."""

    def shifted(self, offset: Array) -> MassProperties:
        """Return the properties of the solid translated by `offset` (3,) [m], in the same frame."""
        return MassProperties(self.volume_m3, self.com_m + offset, self.inertia_m2)


@dataclass(frozen=True)
class Faces:
    """Flat faces of a solid."""

    planes: Array
    """Unit outward normal n and offset h [m] of each, n . x = h, shape (F, 4)."""
    of_point: NDArray[np.intp]
    """Number of the face on which each point of the surface lies, -1 for none, shape (S,); empty without faces."""

    def distance(self, points: Array, nearest: NDArray[np.intp], away: Array, beside_m: float) -> Array:
        """Return distances from the surface [m], exact where the nearest point of the surface lies on a flat face.

        Args:
            points: Points, shape (n, 3) [m].
            nearest: Number of the point of the surface that is nearest to each, shape (n,).
            away: Distance from it [m], shape (n,).
            beside_m: Largest distance between that point and the foot on the plane [m]; farther, the foot lies beside
                the face.
        """
        if not len(self.planes):
            return away
        face = self.of_point[nearest]
        plane = self.planes[face]
        height = np.abs((points * plane[:, :3]).sum(1) - plane[:, 3])
        return np.where((face >= 0) & (away**2 - height**2 < beside_m**2), height, away)

    def with_normals(self, normals: Array) -> Array:
        """Return the normals (S, 3) of the points of the surface, those of the planes for points on flat faces."""
        if not len(self.planes):
            return normals
        return np.where(self.of_point[:, None] >= 0, self.planes[self.of_point, :3], normals)

    def moved(self, rotation: Array, offset: Array) -> Faces:
        """Return the faces after x -> rotation x + offset [m]."""
        normals = self.planes[:, :3] @ rotation.T
        return Faces(np.c_[normals, self.planes[:, 3] + normals @ offset], self.of_point)


NO_FACES = Faces(np.zeros((0, 4)), np.zeros(0, np.intp))


@dataclass(frozen=True, kw_only=True)
class Volume:
    """A solid as its signed distance on a regular grid."""

    origin: Array
    """Position of grid point (0, 0, 0) [m], shape (3,)."""
    pitch: float
    """Grid spacing [m]."""
    distance: Array
    """Signed distance to the surface at the grid points [m], positive outside, shape (X, Y, Z)."""
    surface: Array
    """Points on the surface [m], at least about one per square pitch, shape (S, 3)."""
    normals: Array
    """Outward unit normals at `surface`, shape (S, 3)."""
    corner_count: int = 0
    """Number of points at the end of `surface` that are tips finer than the grid."""
    faces: Faces = NO_FACES
    """Flat faces, and which points of the surface lie on them."""

    @staticmethod
    def from_inside(
        inside: NDArray[np.bool_],
        origin: Array,
        pitch: float,
        surface: Array,
        corner_count: int = 0,
        faces: Faces = NO_FACES,
    ) -> Volume:
        """Build a volume from an occupancy grid and accurate points on its surface.

        Args:
            inside: Whether each grid point lies inside, shape (X, Y, Z).
            origin: Position of grid point (0, 0, 0) [m].
            pitch: Grid spacing [m].
            surface: Points on the surface [m], at most about a pitch apart, shape (S, 3).
            corner_count: Number of points at the end of `surface` that are tips finer than the grid.
            faces: Flat faces of the solid; the distance to a flat face is exact.
        """
        away = _distance_to(surface, inside.shape, np.asarray(origin, float), pitch, faces)
        distance = np.where(inside, -away, away)
        gradient = np.stack([np.gradient(distance, pitch, axis=k) for k in range(3)], -1)
        normals = np.stack([_interpolate(gradient[..., k], origin, pitch, surface) for k in range(3)], 1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        normals = faces.with_normals(normals)
        return Volume(
            origin=np.asarray(origin, float),
            pitch=pitch,
            distance=distance,
            surface=surface,
            normals=normals,
            corner_count=corner_count,
            faces=faces,
        )

    def at(self, points: Array) -> Array:
        """Return the signed distance (n,) [m] at points (n, 3) [m], interpolated, clamped at the border."""
        return _interpolate(self.distance, self.origin, self.pitch, points)

    @property
    def tolerance(self) -> float:
        """Accuracy of the signed distance [m]."""
        return 0.1 * self.pitch

    @property
    def corners(self) -> Array:
        """Tips that are finer than the grid [m], shape (corner_count, 3)."""
        return self.surface[len(self.surface) - self.corner_count :]

    def depth(self, points: Array) -> Array:
        """Return the distance (n,) [m] of points (n, 3) [m] from the surface: of no grid, and exact at flat faces."""
        away, nearest = (np.asarray(found) for found in KDTree(self.surface).query(points))
        return self.faces.distance(points, nearest, away, _BESIDE * self.pitch)

    def size(self) -> float:
        """Return the diagonal of the surface's bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.surface, axis=0)))

    def mass_properties(self) -> MassProperties:
        """Return the mass properties, with partial weights of the cells that the surface cuts."""
        share = np.clip(0.5 - self.distance / self.pitch, 0.0, 1.0).reshape(-1)
        kept = share > 0
        points = grid_points(self.distance.shape, self.origin, self.pitch)[kept]
        weights = share[kept] / share[kept].sum()
        com = weights @ points
        centred = points - com
        second = (centred * weights[:, None]).T @ centred + np.eye(3) * self.pitch**2 / 12
        inertia = np.trace(second) * np.eye(3) - second
        return MassProperties(float(share.sum() * self.pitch**3), com, inertia)


def grid_points(shape: tuple[int, ...], origin: Array, pitch: float) -> Array:
    """Return the positions of all grid points [m], shape (X * Y * Z, 3), with the last axis fastest."""
    axes = [origin[k] + pitch * np.arange(shape[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def crossings(field: Array, origin: Array, pitch: float) -> Array:
    """Return the points (S, 3) [m] at which a field changes sign along grid edges, by linear interpolation."""
    found = []
    for axis in range(3):
        low = np.take(field, np.arange(field.shape[axis] - 1), axis)
        high = np.take(field, np.arange(1, field.shape[axis]), axis)
        index = np.argwhere((low > 0) != (high > 0))
        if index.shape[0] == 0:
            continue
        a, b = low[tuple(index.T)], high[tuple(index.T)]
        points = index.astype(float)
        points[:, axis] += a / (a - b)
        found.append(origin + pitch * points)
    return np.concatenate(found) if found else np.zeros((0, 3))


def _distance_to(surface: Array, shape: tuple[int, ...], origin: Array, pitch: float, faces: Faces) -> Array:
    """Return the distance [m] from each grid point to the nearest surface point, shape (X, Y, Z)."""
    from scipy.ndimage import distance_transform_edt

    cells = np.clip(np.rint((surface - origin) / pitch).astype(int), 0, np.array(shape) - 1)
    representative = np.full(shape, -1)
    representative[tuple(cells.T)] = np.arange(surface.shape[0])
    nearest = np.asarray(distance_transform_edt(representative < 0, return_distances=False, return_indices=True))
    points = grid_points(shape, origin, pitch)
    found = representative[tuple(nearest)].reshape(-1)
    away = np.linalg.norm(points - surface[found], axis=1)
    # Above, one point represents a cell; near the surface the exact nearest point is searched instead. A tree search
    # for all grid points would be slow: in the middle of a solid, many points are about equally near.
    near = away < 3 * pitch
    away[near], found[near] = KDTree(surface).query(points[near])
    return faces.distance(points, found, away, _BESIDE * pitch).reshape(shape)


def _interpolate(values: Array, origin: Array, pitch: float, points: Array) -> Array:
    from scipy.ndimage import map_coordinates

    coordinates = ((points - origin) / pitch).T
    return map_coordinates(values, coordinates, order=1, mode="nearest")
