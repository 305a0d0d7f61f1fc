"""Collision spheres: a few spheres, distilled from a solid, that planes touch where they touch the solid.

Contact with a plane depends on the support function h(n) = max n . x of a solid alone; contact between bodies depends
on its surface. So spheres are chosen first where the error of the support function is largest, then where the surface
is covered worst, each as large as fits inside the solid, and then to fill the interior, so that a deep query still
finds a body there.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree, QhullError
from scipy.spatial.distance import cdist

from ....datasets.shapes.meshes import Mesh
from ....datasets.shapes.ply import Splats, read_splats
from ....schemas import InputDataError, Shape
from ...geometry.directions import fibonacci_directions
from ...geometry.mesh import distance_to_mesh, mesh_volume, read_mesh
from ...geometry.primitives import spheres_volume
from ...geometry.solid_grid import Array, Volume, grid_points
from ...geometry.surface_distance import union_distance

DIRECTIONS = 1500
"""Number of directions in which the support function is matched."""
_CONVEX_EXCESS = 0.05
"""Largest excess of the hull's volume over that of a convex solid: grids measure volumes to 1 %, and the hull of an
L-block exceeds it by a third.
"""
_SUPPORT_TOLERANCE = 1e-3  # of the solid's size
_MEAN_TOLERANCE, _MOST_TOLERANCE = 2e-3, 7.5e-3
"""Mean and largest gap, in units of the solid's size, below which no more spheres are added."""
_SMALLEST_RADIUS = 2e-3
_SUPPORT_SHARE = 0.7
_FILL_SHARE = 0.08
_SAMPLES = 4000
_SEATED_PITCHES = 0.3
"""How near a flat face a sphere lies that is resized until it touches it, in pitches of the grid."""
_SWEEPS = 4
_CORNER_RADIUS_M = 2.5e-4
_BARE_SHARE = 0.4
"""Largest gap between a mesh and its spheres, in units of its size: a plate in eight spheres has 0.33, and a solid that
is thinner than the grid half of its length."""


class Solid(Protocol):
    """A solid to be distilled, such as `Volume`."""

    @property
    def surface(self) -> Array:
        """Return points on the surface [m], shape (S, 3)."""
        ...

    @property
    def normals(self) -> Array:
        """Return outward unit normals at `surface`, shape (S, 3)."""
        ...

    @property
    def tolerance(self) -> float:
        """Accuracy of the signed distance [m]."""
        ...

    def at(self, points: Array) -> Array:
        """Return the signed distance [m] at points (n, 3), positive outside."""
        ...

    def size(self) -> float:
        """Return the length of the bounding box's diagonal [m]."""
        ...


@dataclass(frozen=True)
class CollisionSpheres:
    """Spheres that represent a solid in contact."""

    centers: Array
    """Centres in the body frame [m], shape (n, 3)."""
    radii: Array
    """Collision radii [m], shape (n,)."""
    distance_m: float
    """Largest distance between the union of the spheres and the solid's surface [m], both ways."""
    support_error_m: float
    """Largest difference between the support functions over `DIRECTIONS` directions [m]."""

    def splats(self, radius_factor: float) -> Splats:
        """Return the spheres as Gaussians of scale radius / radius_factor, opaque and grey."""
        count = self.radii.shape[0]
        return Splats(
            means=self.centers,
            scales=self.radii / radius_factor,
            opacities=np.full(count, 0.99),
            colors=np.full((count, 3), 0.5),
        )


def shape_to_spheres(
    shape: Shape, capture_root: Path, max_spheres: int, radius_factor: float = 2.0
) -> tuple[Splats, float]:
    """Return the collision spheres of a shape given in the manifest.

    The first spheres of a box are its corners: 8 small spheres that touch three faces each, so that planes touch them
    where they touch the box; with `max_spheres` = 8 it has no others. A ball is one sphere.

    Args:
        shape: The shape, in the body frame.
        capture_root: Directory that the shape's path is relative to.
        max_spheres: Maximum number of spheres, at least 8.
        radius_factor: Collision radius in units of the Gaussian scale.

    Returns:
        The spheres in the body frame, and the largest distance between their surface and that of the shape [m].

    Raises:
        InputDataError: If the shape's file is missing or not readable, or a mesh is too thin for its length.
    """
    if shape.sphere is not None:
        one = CollisionSpheres(np.zeros((1, 3)), np.array([shape.sphere.radius_m]), 0.0, 0.0)
        return one.splats(radius_factor), 0.0
    if shape.splats is not None:
        spheres = _from_splats(read_splats(capture_root / shape.splats.path), max_spheres, radius_factor)
    elif shape.mesh is not None:
        spheres = _from_mesh(capture_root / shape.mesh.path, max_spheres)
    elif shape.box is not None:
        spheres = _box_spheres(np.array(shape.box.half_extents_m), max_spheres)
    else:
        raise InputDataError(
            "a shape without a kind.",
            "box, sphere, mesh, splats.",
            todo="give the body one of these shapes in capture.toml.",
        )
    return spheres.splats(radius_factor), spheres.distance_m


def distil(solid: Solid, max_spheres: int, first: tuple[Array, Array] | None = None, seed: int = 0) -> CollisionSpheres:
    """Choose spheres inside a solid that match its support function and cover its surface.

    Args:
        solid: The solid.
        max_spheres: Maximum number of spheres.
        first: Centres (k, 3) and radii (k,) of spheres that support the solid [m]; chosen here by default.
        seed: Seed of the choice of surface samples.
    """
    size = solid.size()
    chosen = _Chosen(*(first if first is not None else (np.zeros((0, 3)), np.zeros(0))))
    budget = max_spheres - chosen.count
    fill = int(_FILL_SHARE * budget)
    if first is None:
        _add_support(chosen, solid, int(_SUPPORT_SHARE * (budget - fill)), _SUPPORT_TOLERANCE * size)
    samples = np.random.default_rng(seed).permutation(solid.surface.shape[0])[:_SAMPLES]
    points, normals = solid.surface[samples], solid.normals[samples]
    _add_cover(chosen, solid, points, normals, max_spheres - fill)
    if isinstance(solid, Volume):
        _add_fill(chosen, solid, max_spheres)
    if chosen.count == 0:
        raise InputDataError(
            f"no sphere fits inside a shape of {size:.3g} m: it is thinner than "
            f"{1e3 * solid.tolerance:.2g} mm, to which its volume is resolved.",
            "solid shapes that are not thin for their length.",
            "divide a long thin body into shorter ones, or give it spheres: shape = { splats = { path = ... } }.",
        )
    centers, radii = chosen.arrays()
    if isinstance(solid, Volume):
        centers, radii = _seated(solid, centers, radii)
    return _measured(solid, points, centers, radii)


def _seated(solid: Volume, centers: Array, radii: Array) -> tuple[Array, Array]:
    """Return spheres that lie within a solid, to its tolerance, and touch its flat faces where they are near them.

    Those at edges and corners are moved, the others are resized: on a grid, spheres protrude by up to its pitch, most
    of them in the middle of a face, where a body would rock on them.
    """
    small = radii <= 1.2 * _SMALLEST_RADIUS * solid.size()
    beside = _faces_beside(solid, centers, radii)
    normals, offsets = solid.faces.planes[:, :3], solid.faces.planes[:, 3]
    centers = centers.copy()
    for _ in range(_SWEEPS):
        for k, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
            above = centers @ normal - offset + radii
            moved = small & beside[:, k] & (above > 0) & (above < 2 * radii)
            centers[moved] -= above[moved, None] * normal
    heights = centers @ normals.T - offsets
    room = np.where(beside & (heights < 0), -heights, np.inf).min(1, initial=np.inf)
    depth = np.minimum(solid.depth(centers) + solid.tolerance, room)
    touching = np.abs(room - radii) < _SEATED_PITCHES * solid.pitch
    return centers, np.where(small, radii, np.where(touching, depth, np.minimum(radii, depth)))


def _faces_beside(solid: Volume, centers: Array, radii: Array) -> NDArray[np.bool_]:
    """Return which flat faces spheres may touch, shape (n, F)."""
    count = len(solid.faces.planes)
    points = [solid.surface[solid.faces.of_point == k] for k in range(count)]
    near = [KDTree(one).query(centers)[0] < radii + 2 * solid.pitch for one in points if len(one)]
    found = np.zeros((len(centers), count), bool)
    found[:, [k for k in range(count) if len(points[k])]] = np.stack(near, 1) if near else False
    return found


def _measured(solid: Solid, points: Array, centers: Array, radii: Array) -> CollisionSpheres:
    """Return spheres with their errors against a solid and points on its surface (n, 3)."""
    gap = np.abs(union_distance(centers, radii, points)).max()
    beyond = float((solid.at(centers) + radii).max())
    support = np.abs(support_of_points(solid.surface) - support_of_spheres(centers, radii)).max()
    return CollisionSpheres(centers, radii, float(max(gap, beyond)), float(support))


def support_of_points(points: Array, directions: Array | None = None) -> Array:
    """Return max n . x over points (n, 3) [m], for each direction, shape (D,)."""
    directions = fibonacci_directions(DIRECTIONS) if directions is None else directions
    points = points[_outermost(points)]
    return np.array([(points @ direction).max() for direction in directions])


def _outermost(points: Array) -> NDArray[np.intp]:
    """Return the indices of points that are corners of the convex hull: no other is the farthest in a direction."""
    try:
        return np.sort(ConvexHull(points).vertices).astype(np.intp)
    except QhullError:  # fewer than four, or all in one plane
        return np.arange(len(points))


def support_of_spheres(centers: Array, radii: Array, directions: Array | None = None) -> Array:
    """Return max n . c + r over spheres [m], for each direction, shape (D,)."""
    directions = fibonacci_directions(DIRECTIONS) if directions is None else directions
    return (directions @ centers.T + radii).max(1)


def fills_hull(centers: Array, radii: Array, volume_m3: float) -> bool:
    """Return whether a solid of a volume [m3] fills the convex hull of its spheres, so that its faces are flat.

    Args:
        centers: Centres of the spheres [m], shape (n, 3).
        radii: Their radii [m], shape (n,).
        volume_m3: Volume of the solid [m3].
    """
    directions = fibonacci_directions(DIRECTIONS)
    support = (directions @ centers.T + radii).argmax(1)
    try:
        hull = ConvexHull(centers[support] + radii[support, None] * directions)
    except QhullError:
        return False
    return bool(hull.volume <= (1 + _CONVEX_EXCESS) * volume_m3)


class _Chosen:
    """The spheres chosen so far."""

    def __init__(self, centers: Array, radii: Array) -> None:
        self.centers, self.radii = [*centers], [*radii]

    @property
    def count(self) -> int:
        return len(self.radii)

    def add(self, center: Array, radius: float) -> None:
        self.centers.append(center)
        self.radii.append(radius)

    def arrays(self) -> tuple[Array, Array]:
        return np.array(self.centers).reshape(-1, 3), np.array(self.radii)


def _add_support(chosen: _Chosen, solid: Solid, limit: int, tolerance: float) -> None:
    """Add spheres where the support function is too small, until the error is below `tolerance` [m]."""
    directions = fibonacci_directions(DIRECTIONS)
    corners = solid.surface[_outermost(solid.surface)]
    points = corners[[int(np.argmax(corners @ direction)) for direction in directions]]
    radii = inscribed_radii(solid, points, directions)
    lack = (points * directions).sum(1)
    centers, sizes = chosen.arrays()
    lack = lack - support_of_spheres(centers, sizes, directions) if chosen.count else np.full(lack.shape, np.inf)
    while chosen.count < limit and lack.max() > tolerance:
        worst = int(np.argmax(lack))
        center = points[worst] - radii[worst] * directions[worst]
        chosen.add(center, float(radii[worst]))
        lack = np.minimum(lack, (points * directions).sum(1) - (directions @ center + radii[worst]))


def _add_cover(chosen: _Chosen, solid: Solid, points: Array, normals: Array, limit: int) -> None:
    """Add spheres that touch the surface from inside until the mean and largest gap are within tolerance.

    The gap of a point is its distance from all spheres so far. At first, each added sphere reduces the sum of the gaps
    most; this gain can only fall while others are added (the sum is submodular), so the gain of a candidate is
    recomputed only when its old value is the largest. Later, each is the one that comes nearest to the worst point.
    """
    radii = inscribed_radii(solid, points, normals)
    centers = points - radii[:, None] * normals
    # At a notch or a tip even the smallest sphere may protrude.
    inside = solid.at(centers) + radii <= 2 * solid.tolerance
    radii, centers = radii[inside], centers[inside]
    size = solid.size()
    gap = np.clip(union_distance(*chosen.arrays(), points), 0.0, size).astype(np.float32)
    reach = _gaps(centers, radii, points)
    queue = [(-float(np.maximum(gap - row, 0).sum()), index) for index, row in enumerate(reach)]
    heapq.heapify(queue)
    mean = gap.mean()
    while chosen.count < limit and queue and mean > _MEAN_TOLERANCE * size:
        _, index = heapq.heappop(queue)
        worth = float(np.maximum(gap - reach[index], 0).sum())
        if queue and worth < -queue[0][0]:
            heapq.heappush(queue, (-worth, index))
            continue
        chosen.add(centers[index], float(radii[index]))
        gap = np.minimum(gap, reach[index])
        mean = gap.mean()
    while chosen.count < limit and len(radii) and gap.max() > _MOST_TOLERANCE * size:
        worst = int(np.argmax(gap))
        index = int(np.argmin(reach[:, worst]))
        if reach[index, worst] >= gap[worst]:
            break
        chosen.add(centers[index], float(radii[index]))
        gap = np.minimum(gap, reach[index])


def _gaps(centers: Array, radii: Array, points: Array) -> NDArray[np.float32]:
    """Return the distance of each point from each sphere [m], shape (spheres, points)."""
    result = np.empty((len(radii), len(points)), np.float32)
    for rows in np.array_split(np.arange(len(radii)), max(1, len(radii) // 500)):
        result[rows] = np.maximum(cdist(centers[rows], points) - radii[rows, None], 0)
    return result


def _add_fill(chosen: _Chosen, solid: Volume, limit: int) -> None:
    """Add the largest inscribed spheres around interior points that no sphere contains yet."""
    every_other = solid.distance[::2, ::2, ::2]
    points = grid_points(every_other.shape, solid.origin, 2 * solid.pitch)
    depth = -every_other.reshape(-1)
    kept = depth > 3 * solid.pitch
    points, depth = points[kept], depth[kept]
    bare = union_distance(*chosen.arrays(), points) > 0
    while chosen.count < limit and bare.any():
        deepest = int(np.argmax(np.where(bare, depth, 0.0)))
        chosen.add(points[deepest], float(depth[deepest]))
        bare &= np.linalg.norm(points - points[deepest], axis=1) > depth[deepest]


def inscribed_radii(solid: Solid, points: Array, normals: Array) -> Array:
    """Return the radius of the largest sphere that touches the surface at each point and lies inside, shape (n,).

    It may protrude by the tolerance of the solid.
    """
    size = solid.size()
    steps = size * np.geomspace(_SMALLEST_RADIUS, 0.5, 40)

    def fits(radius: Array) -> NDArray[np.bool_]:
        return -solid.at(points - radius[:, None] * normals) >= radius - solid.tolerance

    radii = np.full(points.shape[0], steps[0])
    for step in steps[1:]:
        radii[fits(np.full(len(points), step))] = step
    low, high = radii, radii * steps[1] / steps[0]
    for _ in range(5):
        middle = 0.5 * (low + high)
        good = fits(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return low


@dataclass(frozen=True)
class _Box:
    """A box centred at the origin, with exact distances."""

    half: Array
    surface: Array
    normals: Array
    tolerance: float = 1e-9

    @staticmethod
    def make(half: Array, samples: int = 20) -> _Box:
        points, normals = [], []
        # At an edge no sphere touches one face without crossing the other.
        inner = half - _SMALLEST_RADIUS * 2 * np.linalg.norm(half)
        ticks = np.linspace(-1, 1, samples)
        for axis in range(3):
            others = [k for k in range(3) if k != axis]
            grid = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), -1).reshape(-1, 2)
            for sign in (-1.0, 1.0):
                face = np.full((grid.shape[0], 3), sign * half[axis])
                face[:, others] = grid * inner[others]
                points.append(face)
                normals.append(np.tile(sign * np.eye(3)[axis], (grid.shape[0], 1)))
        return _Box(half, np.concatenate(points), np.concatenate(normals))

    def at(self, points: Array) -> Array:
        q = np.abs(points) - self.half
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    def size(self) -> float:
        return float(2 * np.linalg.norm(self.half))


def _box_spheres(half: Array, max_spheres: int) -> CollisionSpheres:
    radius = min(_CORNER_RADIUS_M, 0.05 * float(half.min()))
    signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), -1).reshape(-1, 3)
    corners = signs * (half - radius)
    return distil(_Box.make(half), max_spheres, first=(corners, np.full(8, radius)))


def _from_mesh(path: Path, max_spheres: int) -> CollisionSpheres:
    """Return spheres in a mesh.

    Raises:
        InputDataError: If the file is not readable, or the solid is so thin that spheres fit in single places alone.
    """
    mesh = read_mesh(path)
    solid = mesh_volume(mesh)
    spheres = _within(distil(solid, max_spheres), solid, mesh)
    if spheres.distance_m > _BARE_SHARE * solid.size():
        raise InputDataError(
            f"{path}: spheres fit inside the mesh in single places alone, {spheres.distance_m:.2g} m from the farthest "
            f"point of its surface; it is thinner than {1e3 * solid.pitch:.2g} mm, to which its volume is resolved.",
            "solid shapes that are not thin for their length.",
            "divide a long thin body into shorter ones, or give it spheres: shape = { splats = { path = ... } }.",
        )
    return spheres


def _within(spheres: CollisionSpheres, solid: Volume, mesh: Mesh) -> CollisionSpheres:
    """Return the spheres with radii up to the exact distance from a mesh; the smallest ones, at its edges, as they are.

    On a grid, spheres protrude from flat faces by up to its pitch, most of them in the middle of the face: a body would
    lie on a dome, and roll on it without end.
    """
    kept = spheres.radii <= 1.2 * _SMALLEST_RADIUS * solid.size()
    exact = distance_to_mesh(mesh, spheres.centers)
    radii = np.where(kept, spheres.radii, np.minimum(spheres.radii, exact))
    points = solid.surface[:: max(1, len(solid.surface) // _SAMPLES)]
    return _measured(solid, points, spheres.centers, radii)


def _from_splats(splats: Splats, max_spheres: int, radius_factor: float) -> CollisionSpheres:
    centers, radii = np.asarray(splats.means, float), radius_factor * np.asarray(splats.scales, float)
    if radii.shape[0] <= max_spheres:
        return CollisionSpheres(centers, radii, 0.0, 0.0)
    return distil(spheres_volume(centers, radii), max_spheres)
