"""Where the spheres of a fit begin: bodies inside their solids, the background on the ground and on SfM points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import KDTree

from ...schemas import Ground
from .spheres import Spheres
from .views import View
from .volume import Array, Volume, grid_points

_SURFACE_SHARE = 0.9
_COVER_FACTOR = 1.05  # collision radius in units of the spacing: neighbours overlap without a gap
_FAR_FACTOR = 12.0
_SHELL_SHARE = 0.12


def body_seeds(solid: Volume, max_spheres: int, radius_factor: float, seed: int) -> tuple[Array, Array, int]:
    """Return spheres whose union, at the collision radius, is a solid: an even layer inside its surface, and a filling.

    Args:
        solid: The solid.
        max_spheres: Largest number of spheres.
        radius_factor: Collision radius in units of the scale.
        seed: Seed.

    Returns:
        Centres [m] in the solid's frame, shape (n, 3), scales [m], shape (n,), and how many of them, at the
        beginning, are on the surface.
    """
    count = max(8, int(_SURFACE_SHARE * max_spheres))
    rng = np.random.default_rng(seed)
    candidates = rng.permutation(solid.surface.shape[0])[: 15 * count]
    chosen, spacing = farthest_points(solid.surface[candidates], count)
    index = candidates[chosen]
    radius = _COVER_FACTOR * spacing
    centers = solid.surface[index] - radius * solid.normals[index]
    # Where the solid is thinner than two radii, its middle is as deep as a centre can lie.
    depth = -solid.at(centers)
    centers += np.where(depth < 0.5 * radius, 0.5, 0.0)[:, None] * radius * solid.normals[index]
    radii = np.full(len(index), radius)
    inner, inner_radii = _filling(solid, centers, radii, max_spheres - len(index))
    scales = np.concatenate([radii, inner_radii]) / radius_factor
    return np.concatenate([centers, inner]), scales, len(index)


def farthest_points(points: Array, count: int) -> tuple[np.ndarray, float]:
    """Choose points that are evenly spread: each the farthest from those before.

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
    """Return spheres for the inside, the largest first, that stay a layer's thickness below the surface."""
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
    # A Gaussian shines 1.7 times farther than its collision radius: shrunk, it stays behind the layer.
    return points[found], 0.8 * depth[found]


def scene_seeds(
    views: Sequence[View], ground: Ground | None, points: Array | None, max_spheres: int, seed: int
) -> tuple[Array, Array]:
    """Return spheres for what is not a body: ground, SfM points, and a shell far away.

    Ground that the photos show is covered by spheres as wide as a few pixels of the nearest photo; elsewhere SfM
    points stand for the surfaces; rays that meet neither end on a shell.

    Args:
        views: The photos; pixels of bodies are left out.
        ground: The ground, or None.
        points: SfM points, world frame, shape (n, 3), or None.
        max_spheres: Largest number of spheres.
        seed: Seed.

    Returns:
        Centres, world frame [m], shape (m, 3), and scales [m], shape (m,).
    """
    rng = np.random.default_rng(seed)
    cameras = np.stack([view.camera.center for view in views])
    rays, origins, footprints = _background_rays(views, rng)
    parts: list[tuple[Array, Array]] = []
    shell = rays, origins
    shell_budget = int(_SHELL_SHARE * max_spheres)
    rest = max_spheres - shell_budget
    if points is not None and len(points):
        near = points[np.linalg.norm(points - np.median(points, 0), axis=1) < 50 * _spread(points)]
        share = rest if ground is None else rest // 4
        if ground is not None:
            near = near[near @ np.array(ground.normal) - ground.offset_m > 0.02 * _spread(cameras)]
        if len(near) > 3:
            parts.append(_with_neighbour_scales(near, share, rng))
    if ground is not None:
        normal = np.array(ground.normal)
        down = rays @ normal
        height = ground.offset_m - origins @ normal
        distance = np.where(down < -1e-3, height / np.minimum(down, -1e-3), np.inf)
        hits = (distance > 0) & (distance < _FAR_FACTOR * _spread(cameras))
        shell = rays[~hits], origins[~hits]
        met = origins[hits] + distance[hits, None] * rays[hits]
        used = sum(len(part[0]) for part in parts)
        parts.append(_even_cover(met, distance[hits] * footprints[hits], normal, rest - used))
    parts.append(_shell(*shell, cameras, points, shell_budget))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _background_rays(views: Sequence[View], rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return unit rays, origins and angular pixel widths [rad] of pixels that show no body; about 2000 a view."""
    rays, origins, footprints = [], [], []
    for view in views:
        width, height = view.size
        K, T = view.K.double().cpu().numpy(), view.viewmat.double().cpu().numpy()
        u, v = rng.integers(0, width, 2000), rng.integers(0, height, 2000)
        if view.cover is not None:
            free = view.cover.sum(0).cpu().numpy()[v, u] < 0.05
            u, v = u[free], v[free]
        local = np.stack([(u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(u))], 1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        rays.append(local @ T[:3, :3])
        origins.append(np.tile(view.camera.center, (len(u), 1)))
        footprints.append(np.full(len(u), 1 / K[0, 0]))
    return np.concatenate(rays), np.concatenate(origins), np.concatenate(footprints)


def _even_cover(points: Array, footprints: Array, normal: Array, budget: int) -> tuple[Array, Array]:
    """Cover points on a plane with cells that are as wide as `k` pixel footprints; k as small as the budget allows."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    plane = np.stack([points @ first, points @ np.cross(normal, first)], 1)
    best: tuple[Array, Array] | None = None
    low, high = 0.5, 200.0
    for _ in range(14):
        k = float(np.sqrt(low * high))
        centers, sides = _cells(plane, k * footprints)
        if len(centers) <= budget:
            best, high = (centers, sides), k
        else:
            low = k
    if best is None:
        return points[:0], footprints[:0]
    height = float(np.median(points @ normal))
    centers = best[0][:, :1] * first + best[0][:, 1:] * np.cross(normal, first) + height * normal
    return centers, 0.6 * best[1]


def _cells(plane: Array, widths: Array) -> tuple[Array, Array]:
    """Return centres and sides of the quadtree cells that hold the points, each no wider than its finest point asks."""
    level = np.floor(np.log2(np.maximum(widths, 1e-9))).astype(int)
    centers, sides = [], []
    taken = np.zeros(len(plane), dtype=bool)
    for value in np.unique(level):
        side = 2.0**value
        mine = (level == value) & ~taken
        if not mine.any():
            continue
        cells = np.unique(np.floor(plane[mine] / side).astype(np.int64), axis=0)
        key = {tuple(cell) for cell in cells}
        later = np.flatnonzero((level > value) & ~taken)
        inside = np.array([tuple(cell) in key for cell in np.floor(plane[later] / side).astype(np.int64)], dtype=bool)
        taken[later[inside]] = True
        centers.append((cells + 0.5) * side)
        sides.append(np.full(len(cells), side))
    return np.concatenate(centers), np.concatenate(sides)


def _with_neighbour_scales(points: Array, budget: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return at most `budget` of the points, each as wide as half the distance to its third neighbour."""
    kept = points[rng.permutation(len(points))[:budget]]
    away, _ = KDTree(kept).query(kept, k=min(4, len(kept)))
    scale = 0.5 * away[:, -1]
    return kept, np.clip(scale, 1e-3 * np.median(scale) + 1e-9, 5 * np.median(scale) + 1e-9)


def _shell(rays: Array, origins: Array, cameras: Array, points: Array | None, budget: int) -> tuple[Array, Array]:
    """Return spheres where rays meet a shell around everything, evenly spread and overlapping."""
    if len(rays) == 0 or budget < 1:
        return np.zeros((0, 3)), np.zeros(0)
    center = cameras.mean(0)
    radius = _FAR_FACTOR * _spread(cameras)
    if points is not None and len(points):
        radius = max(radius, 2 * float(np.percentile(np.linalg.norm(points - center, axis=1), 99)))
    offset = origins - center
    along = (rays * offset).sum(1)
    distance = -along + np.sqrt(along**2 - (offset**2).sum(1) + radius**2)
    met = origins + distance[:, None] * rays
    index, spacing = farthest_points(met[:20000], budget)
    return met[index], np.full(len(index), max(0.7 * spacing, 1e-3 * radius))


def _spread(points: Array) -> float:
    """Return the root-mean-square distance from the mean [m]."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())) or 1.0


def to_spheres(centers: Array, scales: Array, opacity: float, device: torch.device) -> Spheres:
    """Return grey spheres of one opacity as tensors."""
    count = len(scales)
    return Spheres(
        torch.as_tensor(centers, dtype=torch.float32, device=device),
        torch.as_tensor(scales, dtype=torch.float32, device=device),
        torch.full((count,), opacity, device=device),
        torch.full((count, 3), 0.5, device=device),
    )
