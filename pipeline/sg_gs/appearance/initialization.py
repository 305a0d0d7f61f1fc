"""Initial spheres of a fit: bodies inside their solids, the background on the ground and on SfM points."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ....schemas import Ground
from ...geometry.directions import fibonacci_directions, upright_axes
from ...geometry.solid_grid import Array, Volume, grid_points
from ...geometry.spheres import Spheres
from ..collision.collision_spheres import inscribed_radii
from ..photos.views import COVERED, View, focus_of
from .losses import scene_weight

_SURFACE_SHARE = 0.9
_COVER_FACTOR = 1.05  # collision radius in units of the spacing: neighbours overlap without a gap
_FAR_FACTOR = 12.0
_SHELL_SHARE = 0.3
_SHELL_SHARE_GROUND = 0.08
_COARSE_SHELL = 80
_PIXELS = 600_000
_LEVELS = 12
_CELL_SCALE = 0.55
_THINNEST = 0.35  # of the radius elsewhere: smaller spheres would leave gaps


def body_seeds(
    solid: Volume, max_spheres: int, radius_factor: float, seed: int, depth: float = 1.0
) -> tuple[Array, Array, int]:
    """Return spheres whose union, at the collision radius, fills a solid: a layer inside its surface, and a filling.

    Args:
        solid: The solid.
        max_spheres: Maximum number of spheres.
        radius_factor: Collision radius in units of the scale.
        seed: Seed.
        depth: How far centres of the layer lie below the surface, in collision radii; below 1 the layer stands out.

    Returns:
        Centres [m] in the frame of the solid, shape (n, 3), scales [m], shape (n,), and the number of spheres at the
        surface, which are the first ones.
    """
    count = max(8, int(_SURFACE_SHARE * max_spheres))
    rng = np.random.default_rng(seed)
    candidates = rng.permutation(solid.surface.shape[0])[: 15 * count]
    chosen, spacing = farthest_points(solid.surface[candidates], count)
    index = candidates[chosen]
    radius = _COVER_FACTOR * spacing
    centers = solid.surface[index] - radius * solid.normals[index]
    radii = np.full(len(index), radius)
    # Where the solid is thinner than two radii, its middle is as deep as a centre can lie.
    thin = np.flatnonzero(-solid.at(centers) < 0.5 * radius)
    surface, normals = solid.surface[index[thin]], solid.normals[index[thin]]
    radii[thin] = inscribed_radii(solid, surface, normals).clip(_THINNEST * radius, radius)
    centers[thin] = surface - radii[thin, None] * normals
    inner, inner_radii = _filling(solid, centers, radii, max_spheres - len(index))
    scales = np.concatenate([radii, inner_radii]) / radius_factor
    centers = centers + (1 - depth) * radii[:, None] * solid.normals[index]
    return np.concatenate([centers, inner]), scales, len(index)


def farthest_points(points: Array, count: int) -> tuple[np.ndarray, float]:
    """Choose evenly spread points, each the farthest from those chosen before.

    Returns:
        Indices (min(count, n),), and the distance of the last one from its nearest neighbour [m].
    """
    count = min(count, points.shape[0])
    work = points.astype(np.float32)
    chosen = np.zeros(count, dtype=np.int64)
    nearest = np.full(points.shape[0], np.inf, dtype=np.float32)
    for k in range(1, count):
        difference = work - work[chosen[k - 1]]
        np.minimum(nearest, np.einsum("ij,ij->i", difference, difference), out=nearest)
        chosen[k] = int(np.argmax(nearest))
    return chosen, float(np.sqrt(nearest[chosen[-1]])) if count > 1 else 0.0


def _filling(solid: Volume, centers: Array, radii: Array, limit: int) -> tuple[Array, Array]:
    """Return spheres for the interior, the largest first, that stay a layer's thickness below the surface."""
    points = grid_points(solid.distance.shape, solid.origin, solid.pitch)
    depth = -solid.distance.reshape(-1)
    layer = float(radii[0])
    kept = depth > layer
    points, depth = points[kept], depth[kept]
    away, _ = KDTree(centers).query(points)
    bare = away > layer
    found: list[int] = []
    while len(found) < limit and bare.any():
        deepest = int(np.argmax(np.where(bare, depth, 0.0)))
        found.append(deepest)
        bare &= np.linalg.norm(points - points[deepest], axis=1) > 0.8 * depth[deepest]
    # A Gaussian is visible to 1.7 times its collision radius: shrunk, it stays behind the layer.
    return points[found], 0.8 * depth[found]


def scene_seeds(
    views: Sequence[View], ground: Ground | None, points: Array | None, max_spheres: int, seed: int
) -> tuple[Array, Array]:
    """Return spheres for the background: on the ground, on SfM points, and on a distant shell.

    Ground that the photos show is covered by cells, small where its picture has detail; elsewhere SfM points represent
    the surfaces. Without either, random points do, but not around a body that masks show: spheres in front of one
    camera would hide the body from its neighbours. Rays that meet nothing end on a shell, which is closed, so that no
    view looks out of the world.

    Args:
        views: The photos; pixels of bodies are left out.
        ground: The ground, or None.
        points: SfM points, world frame, shape (n, 3), or None.
        max_spheres: Maximum number of spheres.
        seed: Seed.

    Returns:
        Centres, world frame [m], shape (m, 3), and scales [m], shape (m,).
    """
    rng = np.random.default_rng(seed)
    cameras = np.stack([view.camera.center for view in views])
    spread = _spread(cameras)
    sample = _background_pixels(views, rng)
    shell_budget = int((_SHELL_SHARE_GROUND if ground is not None else _SHELL_SHARE) * max_spheres)
    rest = max_spheres - shell_budget
    parts: list[tuple[Array, Array]] = []
    points = None if points is None else points[~_on_bodies(points, views)]
    standing = _off_ground_points(views, ground, points, rest, rng)
    if standing is not None and len(standing) > 3:
        kept = standing[rng.permutation(len(standing))[: rest if ground is None else rest // 4]]
        lying = [] if ground is None or points is None else [points[_lying(points, ground, spread)]]
        parts.append((kept, _neighbour_scales(kept, np.concatenate([kept, *lying]))))
    if ground is not None:
        hits, met = _on_ground(sample, ground, _FAR_FACTOR * spread)
        used = sum(len(part[0]) for part in parts)
        parts.append(_ground_cover(met, sample.colors[hits], np.array(ground.normal), rest - used))
        sample = sample.chosen(~hits)
    parts.append(_shell(sample, cameras, points, shell_budget))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _off_ground_points(
    views: Sequence[View], ground: Ground | None, points: Array | None, count: int, rng: np.random.Generator
) -> Array | None:
    """Return points (n, 3) on the surfaces above the ground, or None where nothing is known about them.

    Args:
        views: The photos.
        ground: The ground, or None.
        points: SfM points that lie on no body, shape (m, 3), or None.
        count: Number of random points where there is neither a ground nor a point nor a mask of a body.
        rng: Generator of the random points.
    """
    if points is None:
        return _random_points(views, count, rng) if ground is None and not shows_bodies(views) else None
    if ground is None:
        return points
    return points[~_lying(points, ground, _spread(np.stack([view.camera.center for view in views])))]


def _lying(points: Array, ground: Ground, spread: float) -> NDArray[np.bool_]:
    """Return which points (n, 3) are no higher above the ground than a share of the cameras' spread [m]."""
    return points @ np.array(ground.normal) - ground.offset_m <= 0.02 * spread


def shows_bodies(views: Sequence[View]) -> bool:
    """Return whether a mask shows a body."""
    return any(view.cover is not None and bool((view.cover > COVERED).any()) for view in views)


def _on_bodies(points: Array, views: Sequence[View]) -> Array:
    """Return whether each point lies on a body (in the masks of most views that contain it), shape (n,)."""
    inside, seen = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        if view.cover is None:
            continue
        width, height = view.size
        visible, column, row = view.camera.resized(width, height).pixels_of(points)
        cover = view.cover.sum(0).cpu().numpy()
        inside += visible & (cover[row, column] > COVERED)
        seen += visible
    return inside > 0.6 * np.maximum(seen, 1)


def _random_points(views: Sequence[View], count: int, rng: np.random.Generator) -> Array:
    """Return random points in a ball around the focus of the cameras (count, 3), used where nothing else is known."""
    focus = focus_of(views)
    radius = float(np.median([np.linalg.norm(view.camera.center - focus) for view in views]))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return focus + 1.5 * radius * rng.random((count, 1)) ** (1 / 3) * directions


def points_of_depth(views: Sequence[View], count: int, seed: int) -> Array | None:
    """Return points of the background from the depth maps [m], world frame, (n, 3), or None without depth maps."""
    rng = np.random.default_rng(seed)
    known = [view for view in views if view.depth is not None]
    parts = []
    for view in known:
        depth = view.depth.cpu().numpy()  # type: ignore[union-attr]
        v, u = np.nonzero(depth * (scene_weight(view) > 0.95).cpu().numpy())
        chosen = rng.permutation(len(u))[: 1 + count // len(known)]
        v, u = v[chosen], u[chosen]
        K, z = view.K.double().cpu().numpy(), depth[v, u].astype(float)
        local = np.stack([z * (u + 0.5 - K[0, 2]) / K[0, 0], z * (v + 0.5 - K[1, 2]) / K[1, 1], z], 1)
        pose = view.camera.T_world_cam
        parts.append(local @ pose[:3, :3].T + pose[:3, 3])
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    return points if len(points) else None


@dataclass(frozen=True)
class _Pixels:
    """Pixels of the background, world frame."""

    rays: Array
    """Unit vectors along the rays, shape (n, 3)."""
    origins: Array
    """Origins of the rays [m], shape (n, 3)."""
    colors: Array
    """Colours, shape (n, 3)."""

    def chosen(self, mask: Array) -> _Pixels:
        return _Pixels(self.rays[mask], self.origins[mask], self.colors[mask])


def _background_pixels(views: Sequence[View], rng: np.random.Generator) -> _Pixels:
    each = max(1000, _PIXELS // len(views))
    rays, origins, colors = [], [], []
    for view in views:
        width, height = view.size
        u, v = rng.integers(0, width, each), rng.integers(0, height, each)
        if view.cover is not None:
            free = view.cover.sum(0).cpu().numpy()[v, u] < 0.05
            u, v = u[free], v[free]
        if view.seen is not None:
            shown = view.seen.cpu().numpy()[v, u]
            u, v = u[shown], v[shown]
        rays.append(view.rays(u, v))
        origins.append(np.tile(view.camera.center, (len(u), 1)))
        colors.append(view.image.cpu().numpy()[v, u])
    return _Pixels(np.concatenate(rays), np.concatenate(origins), np.concatenate(colors).astype(float))


def _on_ground(sample: _Pixels, ground: Ground, farthest: float) -> tuple[Array, Array]:
    """Return whether each ray meets the ground within `farthest` [m], and the points where it does, (hits, 3)."""
    normal = np.array(ground.normal)
    down = np.minimum(sample.rays @ normal, -1e-6)
    distance = (ground.offset_m - sample.origins @ normal) / down
    hits = (sample.rays @ normal < -1e-3) & (distance > 0) & (distance < farthest)
    return hits, sample.origins[hits] + distance[hits, None] * sample.rays[hits]


def _ground_cover(points: Array, colors: Array, normal: Array, budget: int) -> tuple[Array, Array]:
    """Cover a plane with the leaves of a quadtree that is split repeatedly where colours differ most.

    Each sample is a pixel, so the sum of squared deviations in a cell is its error in the pictures: far ground, which
    few pixels show, automatically gets few cells.
    """
    if len(points) == 0 or budget < 1:
        return np.zeros((0, 3)), np.zeros(0)
    first, second, _ = upright_axes(normal)
    plane = np.stack([points @ first, points @ second], 1)
    corner = plane.min(0)
    side = float(np.ptp(plane, axis=0).max()) * 1.001
    leaves = _quadtree((plane - corner) / side, colors, budget)
    width = side * 0.5 ** leaves[:, 0]
    middle = corner + (leaves[:, 1:] + 0.5) * width[:, None]
    height = float(np.median(points @ normal))
    return middle[:, :1] * first + middle[:, 1:] * second + height * normal, _CELL_SCALE * width


def _quadtree(unit: Array, colors: Array, budget: int) -> Array:
    """Return the leaves (level, column, row) of a greedy quadtree over points in the unit square."""
    errors = [_cell_errors(unit, colors, 0)]
    heap = [(-errors[0][(0, 0)], 0, 0, 0)]
    done: list[tuple[int, int, int]] = []
    while heap and len(heap) + len(done) < budget:
        _, level, column, row = heapq.heappop(heap)
        if level + 1 == _LEVELS:
            done.append((level, column, row))
            continue
        if level + 1 == len(errors):
            errors.append(_cell_errors(unit, colors, level + 1))
        for child in ((2 * column + i, 2 * row + j) for i in (0, 1) for j in (0, 1)):
            if child in errors[level + 1]:
                heapq.heappush(heap, (-errors[level + 1][child], level + 1, *child))
    return np.array([*done, *((level, column, row) for _, level, column, row in heap)][:budget], float)


def _cell_errors(unit: Array, colors: Array, level: int) -> dict[tuple[int, int], float]:
    """Return the sum of squared deviations of the colours in each cell (column, row) of a level of the quadtree."""
    cell = np.minimum((unit * 2**level).astype(np.int64), 2**level - 1)
    keys, index = _numbered(cell[:, 0] * 2**level + cell[:, 1], 4**level)
    sums = np.stack([np.bincount(index, colors[:, k]) for k in range(3)], 1)
    error = np.bincount(index, (colors**2).sum(1)) - (sums**2).sum(1) / np.bincount(index)
    return {divmod(key, 2**level): e for key, e in zip(keys.tolist(), error.tolist(), strict=True)}


def _numbered(keys: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the different keys in order, and the index of each key among them; the keys are below a size."""
    if size > 8 * len(keys):
        return np.unique(keys, return_inverse=True)
    there = np.bincount(keys, minlength=size) > 0  # without sorting, which takes most of the time of a quadtree
    return np.flatnonzero(there), (np.cumsum(there) - 1)[keys]


def _neighbour_scales(points: Array, among: Array) -> Array:
    """Return scales (n,) of half the distance of points (n, 3) to the third neighbour among points (m, 3), with them.

    A few stray points are far from each other, but not from what else there is: as large as their distances they would
    be a haze before what cameras elsewhere see.
    """
    scale = 0.5 * KDTree(among).query(points, k=min(4, len(among)))[0][:, -1]
    usual = float(np.median(scale))
    return np.clip(scale, 1e-3 * usual + 1e-9, 5 * usual + 1e-9)


def _shell(sample: _Pixels, cameras: Array, points: Array | None, budget: int) -> tuple[Array, Array]:
    """Return spheres on a shell around the scene: a closed coarse layer, and a finer one where rays meet it."""
    center = cameras.mean(0)
    radius = _FAR_FACTOR * _spread(cameras)
    if points is not None and len(points):
        radius = max(radius, 2 * float(np.percentile(np.linalg.norm(points - center, axis=1), 99)))
    coarse = min(_COARSE_SHELL, budget)
    closed = center + 1.5 * radius * fibonacci_directions(coarse)
    closed_scales = np.full(coarse, 1.5 * radius * np.sqrt(4 * np.pi / coarse) * _CELL_SCALE)
    if len(sample.rays) == 0 or budget - coarse < 2:
        return closed, closed_scales
    offset = sample.origins - center
    along = (sample.rays * offset).sum(1)
    distance = -along + np.sqrt(along**2 - (offset**2).sum(1) + radius**2)
    met = (sample.origins + distance[:, None] * sample.rays)[:20000]
    index, spacing = farthest_points(met, budget - coarse)
    scales = np.full(len(index), max(0.7 * spacing, 1e-3 * radius))
    return np.concatenate([met[index], closed]), np.concatenate([scales, closed_scales])


def _spread(points: Array) -> float:
    """Return the root-mean-square distance from the mean [m]."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())) or 1.0


def to_spheres(centers: Array, scales: Array, opacity: float, device: torch.device) -> Spheres:
    """Return grey spheres of equal opacity as tensors."""
    count = len(scales)
    return Spheres(
        torch.as_tensor(centers, dtype=torch.float32, device=device),
        torch.as_tensor(scales, dtype=torch.float32, device=device),
        torch.full((count,), opacity, device=device),
        torch.full((count, 3), 0.5, device=device),
    )
