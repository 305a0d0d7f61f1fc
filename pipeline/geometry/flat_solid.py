"""A solid whose surface is put on planes where its faces are flat, with the edges and corners in which these meet."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .solid_grid import Array, Faces, Volume, crossings, grid_points

_REACH = 2.0
"""How much farther than the nearest part of the old surface a face lies that still bounds a place, in pitches."""
_RIM = 4.0
"""Width of the rim of a face, whose points belong to it though hulls round edges off, in pitches."""
_TAPER = 4.0
"""Width over which a plane goes over into a surface that is not flat, in pitches."""
_BETWEEN = 12.0
"""How near another face those points of a face lie that tell whether the edge between them is convex, in pitches."""
_MARGIN = 2.0
"""How much deeper than the largest move the solid is built anew, in pitches."""
_ALONG_EDGE = 0.5
"""Cosine between a normal and an edge below which a point may lie on the edge; the end of an edge has 1."""
_ON_PLANE = 1e-6
_ON_SURFACE = 0.02
"""Largest distances from a plane, and of an edge from the surface, in pitches."""


def flattened(solid: Volume, face: NDArray[np.intp], planes: Array) -> Volume:
    """Return a solid whose surface lies on planes.

    Where several planes meet, the solid is what lies below all of them at convex edges, below any at concave ones.

    Args:
        solid: The solid.
        face: Number of the plane of each point of its surface, -1 for none, shape (S,).
        planes: Unit outward normal and offset [m] of each, n . x = h, shape (F, 4).
    """
    bounds = _Bounds(solid, _with_rims(solid, face, planes), planes)
    points = grid_points(solid.distance.shape, solid.origin, solid.pitch)
    field = solid.distance.reshape(-1).copy()
    most = _off_plane(solid.surface[face >= 0], planes[face[face >= 0]]).max(initial=0.0)
    near = np.abs(field) < most + _MARGIN * solid.pitch
    field[near] = bounds.height(points[near])
    field = field.reshape(solid.distance.shape)
    inside = field < 0
    from scipy.ndimage import label  # dear to import, and seldom needed

    parts, count = label(inside)  # type: ignore[misc]
    if count > 1:
        inside = parts == 1 + int(np.argmax(np.bincount(parts.reshape(-1))[1:]))
        field = np.where(inside, field, np.maximum(field, 1e-3 * solid.pitch))
    surface = crossings(field, solid.origin, solid.pitch)
    on = bounds.faces_of(surface)
    surface, on = _without_chamfers(surface, on, bounds, solid.pitch)
    corners = np.concatenate([bounds.meetings(surface), bounds.kept_tips()])
    on = np.concatenate([on, np.full(len(corners), -1)])
    faces = Faces(planes, on)
    return Volume.from_inside(
        inside, solid.origin, solid.pitch, np.concatenate([surface, corners]), len(corners), faces
    )


@dataclass(frozen=True)
class _Bounds:
    """The old surface, which of its points lie on which plane, and the planes."""

    solid: Volume
    face: NDArray[np.intp]
    planes: Array

    @cached_property
    def _away(self) -> Array:
        """Distance [m] of the grid from the points of each face, and last from those of none, (F + 1, X, Y, Z)."""
        from scipy.ndimage import distance_transform_edt  # dear to import, and seldom needed

        cells = np.rint((self.solid.surface - self.solid.origin) / self.solid.pitch).astype(int)
        cells = np.clip(cells, 0, np.array(self.solid.distance.shape) - 1)
        # infinite distances would not be numbers any more between grid points
        found = np.full((len(self.planes) + 1, *self.solid.distance.shape), 1e6 * self.solid.pitch, np.float32)
        for k in (*range(len(self.planes)), -1):
            empty = np.ones(self.solid.distance.shape, bool)
            empty[tuple(cells[self.face == k].T)] = False
            if not empty.all():
                found[k] = self.solid.pitch * np.asarray(distance_transform_edt(empty))
        return found

    def _distances(self, points: Array) -> Array:
        """Return the distance [m] of points (n, 3) from the points of each face, and from those of none, (n, F + 1)."""
        from scipy.ndimage import map_coordinates  # dear to import, and seldom needed

        place = ((points - self.solid.origin) / self.solid.pitch).T
        return np.stack([map_coordinates(one, place, order=1, mode="nearest") for one in self._away], 1)

    @cached_property
    def _concave(self) -> NDArray[np.bool_]:
        """Whether planes meet in a concave edge, (F, F): the points of one face lie above the plane of the other."""
        points = [self.solid.surface[self.face == k] for k in range(len(self.planes))]
        trees = [KDTree(one) if len(one) else None for one in points]
        found = np.eye(len(self.planes), dtype=bool)
        for a, b in combinations(range(len(points)), 2):
            found[a, b] = found[b, a] = self._above(points[a], trees[b], b) and self._above(points[b], trees[a], a)
        return found

    def _above(self, points: Array, other: KDTree | None, number: int) -> bool:
        if other is None or not len(points):
            return False
        beside = points[other.query(points)[0] < _BETWEEN * self.solid.pitch]
        return bool(len(beside)) and float(np.median(beside @ self.planes[number, :3] - self.planes[number, 3])) > 0

    def local(self, points: Array) -> NDArray[np.bool_]:
        """Return which planes bound the solid near points (n, 3), shape (n, F)."""
        return self._local(self._distances(points))

    def _local(self, away: Array) -> NDArray[np.bool_]:
        return away[:, :-1] <= away.min(1, keepdims=True) + _REACH * self.solid.pitch

    def height(self, points: Array) -> Array:
        """Return the height [m] of points (n, 3) over the new surface, negative inside."""
        above = points @ self.planes[:, :3].T - self.planes[:, 3]
        away = self._distances(points)
        local = self._local(away)
        # a plane counts as the lowest of those that it meets in concave edges; of all the highest bounds the solid
        groups = np.where(local[:, None] & self._concave, above[:, None], np.inf).min(2)
        flat = np.where(local, groups, -np.inf).max(1)
        old = self.solid.at(points)
        share = self._flat_share(away) * local.any(1)
        return np.where(share > 0, share * np.where(share > 0, flat, 0.0) + (1 - share) * old, old)

    def _flat_share(self, away: Array) -> Array:
        """Return 1 far from surface that is not flat, 0 at it, (n,), given the distances (n, F + 1) [m] of places."""
        beside = np.sqrt(np.maximum(away[:, -1] ** 2 - away.min(1) ** 2, 0))
        return (beside / (_TAPER * self.solid.pitch)).clip(0, 1)

    def faces_of(self, points: Array) -> NDArray[np.intp]:
        """Return the plane on which points (n, 3) of the new surface lie, -1 for none, shape (n,)."""
        away = np.where(self.local(points), np.abs(points @ self.planes[:, :3].T - self.planes[:, 3]), np.inf)
        best = away.argmin(1)
        return np.where(away[np.arange(len(points)), best] < _ON_PLANE * self.solid.pitch, best, -1)

    def meetings(self, surface: Array) -> Array:
        """Return points (m, 3) [m] of the edges and corners in which planes meet, about a pitch apart."""
        local = self.local(surface)
        found = [np.zeros((0, 3))]
        for count in (2, 3):
            for chosen in combinations(range(len(self.planes)), count):
                start = surface[local[:, list(chosen)].all(1)]
                if len(start):
                    found.append(self._on_surface(_projected(start, self.planes[list(chosen)]), start))
        points = np.concatenate(found)
        cells = np.round((points - self.solid.origin) / (0.5 * self.solid.pitch)).astype(int)
        # corners come last, and are kept for sure
        return points[::-1][np.unique(cells[::-1], axis=0, return_index=True)[1]]

    def _on_surface(self, points: Array, start: Array) -> Array:
        pitch = self.solid.pitch
        points = points[np.linalg.norm(points - start, axis=1) < _RIM * pitch]
        return points[np.abs(self.height(points)) < _ON_SURFACE * pitch] if len(points) else points

    def kept_tips(self) -> Array:
        """Return the tips of the old surface where it is not all flat, lowered onto the planes beside, shape (k, 3)."""
        tips = self.solid.corners
        if not len(tips):
            return tips
        away = self._distances(tips)
        share = self._flat_share(away)
        rest = share < 1
        tips, local = tips[rest], self._local(away[rest]) & (share[rest] > 0)[:, None]
        local &= ~(local[:, None] & self._concave & ~np.eye(len(self.planes), dtype=bool)).any(2)
        for k, plane in enumerate(self.planes):
            above = np.maximum(tips @ plane[:3] - plane[3], 0.0) * local[:, k]
            tips = tips - above[:, None] * plane[:3]
        return tips


def _with_rims(solid: Volume, face: NDArray[np.intp], planes: Array) -> NDArray[np.intp]:
    """Return the faces (S,) of the points of a surface, each grown by its rim: of several, the nearest plane counts.

    What lies between two faces is their edge, however much a hull rounds it off, unless it faces along the edge: that
    is where the edge ends, at a surface that is not flat.
    """
    bare, grown = np.flatnonzero(face < 0), face.copy()
    least, beside = np.full(len(bare), np.inf), np.zeros(len(bare), int)
    rims = np.zeros((len(bare), len(planes)), bool)
    for k, plane in enumerate(planes):
        points = solid.surface[face == k]
        if not len(points) or not len(bare):
            continue
        away, nearest = (np.asarray(found) for found in KDTree(points).query(solid.surface[bare]))
        height = _off_plane(solid.surface[bare], plane)
        rims[:, k] = away < _RIM * solid.pitch
        lower = rims[:, k] & (height < least)
        # the rim moves as far as what lies beside it, but for what hulls round off
        beside[lower] = height[lower] < _off_plane(points[nearest[lower]], plane) + solid.pitch
        grown[bare[lower]], least[lower] = k, height[lower]
    grown[bare[(beside == 0) & ~_between(rims, solid.normals[bare], planes[:, :3])]] = -1
    return grown


def _between(rims: NDArray[np.bool_], normals: Array, faces: Array) -> NDArray[np.bool_]:
    """Return which points (n,) lie in the edge or corner between faces.

    Args:
        rims: Whether each point lies in the rim of each face, shape (n, F).
        normals: Unit normals of the points, shape (n, 3).
        faces: Unit normals of the faces, shape (F, 3).
    """
    found = rims.sum(1) > 2
    for a, b in combinations(range(len(faces)), 2):
        along = np.cross(faces[a], faces[b])
        length = float(np.linalg.norm(along))
        both = rims[:, a] & rims[:, b]
        found |= both & (np.abs(normals @ along) < _ALONG_EDGE * length)
    return found


def _off_plane(points: Array, planes: Array) -> Array:
    """Return the distance (n,) [m] of points (n, 3) from a plane (4,), or from one (n, 4) each."""
    return np.abs((points * planes[..., :3]).sum(-1) - planes[..., 3])


def _without_chamfers(
    surface: Array, on: NDArray[np.intp], bounds: _Bounds, pitch: float
) -> tuple[Array, NDArray[np.intp]]:
    """Return the points of a surface, and their faces, without those between two planes that grid cells cut off."""
    off = np.flatnonzero((on < 0) & (bounds.local(surface).sum(1) > 1))
    cut = off[np.abs(bounds.height(surface[off])) > 1e-3 * pitch]
    kept = np.setdiff1d(np.arange(len(surface)), cut)
    return surface[kept], on[kept]


def _projected(points: Array, planes: Array) -> Array:
    """Return the nearest points (n, 3) in which planes (k, 4) meet; the points where these are nearly parallel."""
    normals = planes[:, :3]
    if np.linalg.cond(normals @ normals.T) > 100.0:
        return points
    return points - (points @ normals.T - planes[:, 3]) @ np.linalg.pinv(normals).T
