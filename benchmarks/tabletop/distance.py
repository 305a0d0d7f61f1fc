"""How far two surfaces lie apart, measured by points that are sampled on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from cgwm.datasets.shapes.meshes import Mesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]

_EDGE_M = 0.002  # triangles are cut until no edge is longer, so that a few nearest centroids hold the nearest triangle
_NEAREST = 24
_CHUNK = 50_000


@dataclass(frozen=True)
class Distance:
    """Distances of one surface's points to another surface [m]: their mean, 99th percentile and maximum."""

    mean_m: float
    p99_m: float
    max_m: float


def surface_distance(a: Mesh, b: Mesh, count: int = 60_000, seed: int = 0) -> Distance:
    """Return how far points of surface `a`, drawn evenly over its area, lie from surface `b`."""
    points, _, _ = sample_surface(a, count, np.random.default_rng(seed))
    distance = distance_to_mesh(points, b)
    return Distance(float(distance.mean()), float(np.percentile(distance, 99)), float(distance.max()))


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], Array]:
    """Draw points evenly over the area of a surface.

    Returns:
        Points [m], shape (count, 3), their triangles (count,) and barycentric coordinates in them (count, 3).
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # Stratified: every strip of the cumulated area holds one point.
    place = (np.arange(count) + rng.random(count)) / count * area.sum()
    face = np.searchsorted(np.cumsum(area), place).clip(max=len(area) - 1)
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1).astype(np.float64)
    return np.einsum("nk,nkx->nx", weights, mesh.vertices[mesh.faces[face]]), face, weights


def distance_to_mesh(points: Array, mesh: Mesh) -> Array:
    """Return the distances of points (point, 3) to the nearest triangle of a mesh [m], shape (point,)."""
    corners = _cut(mesh.vertices[mesh.faces])
    tree = KDTree(corners.mean(axis=1))
    result = np.empty(len(points))
    for start in range(0, len(points), _CHUNK):
        part = np.s_[start : start + _CHUNK]
        near = tree.query(points[part], k=min(_NEAREST, len(corners)))[1].reshape(len(points[part]), -1)
        best = np.full(len(near), np.inf)
        for column in near.T:
            best = np.minimum(best, _to_triangles(points[part], corners[column]))
        result[part] = best
    return result


def _cut(corners: Array) -> Array:
    """Halve triangles (triangle, 3, 3) at their longest edge until none has an edge above _EDGE_M."""
    done = []
    while len(corners):
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        long = edges.max(axis=1) > _EDGE_M
        done.append(corners[~long])
        corners, first = corners[long], edges[long].argmax(axis=1)
        index = np.arange(len(corners))
        a, b, c = (corners[index, (first + step) % 3] for step in range(3))
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate(halves).astype(np.float64)
    return np.concatenate(done)


def _to_triangles(points: Array, corners: Array) -> Array:
    """Return the distance of each point (point, 3) to its own triangle (point, 3, 3) [m]."""
    best = np.full(len(points), np.inf)
    for k in range(3):
        start, end = corners[:, k], corners[:, (k + 1) % 3]
        along = end - start
        share = np.einsum("ij,ij->i", points - start, along) / np.einsum("ij,ij->i", along, along).clip(1e-18)
        nearest = start + share.clip(0, 1)[:, None] * along
        best = np.minimum(best, np.linalg.norm(points - nearest, axis=1))
    edge_a, edge_b, from_a = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb = (np.einsum("ij,ij->i", u, v) for u, v in ((edge_a, edge_a), (edge_a, edge_b), (edge_b, edge_b)))
    pa, pb = (np.einsum("ij,ij->i", from_a, edge) for edge in (edge_a, edge_b))
    determinant = (aa * bb - ab * ab).clip(1e-30)
    s, t = (bb * pa - ab * pb) / determinant, (aa * pb - ab * pa) / determinant
    foot = corners[:, 0] + s[:, None] * edge_a + t[:, None] * edge_b
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    return np.where(inside, np.minimum(best, np.linalg.norm(points - foot, axis=1)), best)
