"""Refinement of a visual hull by the photo-consistency of its surface.

Silhouettes bound a flat or hollow surface only where some view grazes it; elsewhere the hull bulges. So patches of the
surface are moved along the normal to where the photos agree on them (normalised cross-correlation, as in multi-view
stereo), and the hull is carved down to there. The hull stays where the surface has no texture. Edges and corners stay
too: every point of a hull is on the outline of some photo, but a point on the outlines of many photos is on the body,
and patches that reach around an edge would suggest otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional

from ...geometry.solid_grid import Array, Volume, crossings, grid_points
from ..photos.views import View
from .visual_hull import signed_distance_px

_POINTS = 3000
_PATCH = 7
_OFFSETS = 28
_DEEPEST = 0.05
_OUTWARD = 0.005
_VIEWS = 8
_LEAST_COSINE = 0.35
_NOISE = 0.015
_NEIGHBOURS = 16
_LEAST_PEAK = 0.4
_LEAST_CONTRAST = 0.12
_PRIOR = 0.02
_PASSES = 2
_RIM_PX = 1.2
_RIM_SHARE, _RIM_LEAST = 0.2, 4
"""Share and number of photos above which a point within `_RIM_PX` of their outlines is on the body and stays."""


@dataclass(frozen=True)
class Refinement:
    """Summary of a refinement."""

    moved_mean_m: float
    """Mean displacement of the surface, inwards negative [m]."""
    moved_most_m: float
    """Largest inward displacement [m], as a negative number."""
    confident: float
    """Share of the surface samples whose position the photos determine."""


def refine(solid: Volume, views: Sequence[View], body: int, seed: int) -> tuple[Volume, Refinement]:
    """Carve a hull down to where the photos agree on its surface.

    Args:
        solid: The hull, world frame.
        views: The photos, with masks.
        body: Index of the body in the manifest.
        seed: Seed of the choice of samples.

    Returns:
        The refined solid and a summary of the changes.
    """
    record = Refinement(0.0, 0.0, 0.0)
    for attempt in range(_PASSES):
        solid, last = _pass(solid, views, body, seed + attempt)
        record = Refinement(
            record.moved_mean_m + last.moved_mean_m,
            min(record.moved_most_m, last.moved_most_m),
            last.confident,
        )
    return solid, record


def _pass(solid: Volume, views: Sequence[View], body: int, seed: int) -> tuple[Volume, Refinement]:
    rng = np.random.default_rng(seed)
    index = rng.permutation(solid.surface.shape[0])[:_POINTS]
    points, normals = solid.surface[index], smooth_normals(solid, index)
    size = solid.size()
    offsets = np.linspace(-_DEEPEST * size, _OUTWARD * size, _OFFSETS)
    scores, pairs = agreement(solid, points, normals, offsets, views, body)
    near: Array = np.asarray(KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))[1])
    alike = np.einsum("id,ijd->ij", normals, normals[near]) > 0.85
    weight = alike * pairs[near]
    pooled = (weight[..., None] * scores[near]).sum(1) / np.maximum(weight.sum(1), 1e-9)[:, None]
    shift, confidence = _peaks(pooled, offsets)
    confidence *= weight.sum(1) > 0
    pinned = _outlined(points, views, body) > max(_RIM_SHARE * len(views), _RIM_LEAST)
    shift, confidence = np.where(pinned, 0.0, shift), np.where(pinned, 1.0, confidence)
    shift = np.where(pinned, 0.0, _smoothed(shift, confidence, near, alike))
    record = Refinement(float(shift.mean()), float(shift.min()), float((confidence > 0).mean()))
    return _deformed(solid, points, shift), record


def _outlined(points: Array, views: Sequence[View], body: int) -> Array:
    """Return the number of photos in which each point (n, 3) lies on the outline of the body, shape (n,)."""
    count = np.zeros(len(points))
    for view in views:
        silhouette = view.silhouette(body)
        if silhouette is None or not silhouette.mask.any():
            continue
        distance = signed_distance_px(silhouette.mask)
        seen, column, row = view.camera.pixels_of(points)
        count[seen] += np.abs(distance[row[seen], column[seen]]) < _RIM_PX
    return count


def smooth_normals(solid: Volume, index: Array) -> Array:
    """Return normals averaged over a neighbourhood of two pitches, because those of the hull are rough."""
    _, near = KDTree(solid.surface).query(solid.surface[index], k=12)
    normals = solid.normals[near]
    alike = np.einsum("id,ijd->ij", solid.normals[index], normals) > 0.7
    mean = (alike[..., None] * normals).sum(1)
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)


def agreement(
    solid: Volume, points: Array, normals: Array, offsets: Array, views: Sequence[View], body: int
) -> tuple[Array, Array]:
    """Return the mean pairwise correlation of patches by point and offset, (n, K), and the number of pairs (n,)."""
    cosine, footprint = _visibility(solid, points, normals, views, body)
    ranked = np.argsort(-cosine, axis=1)[:, :_VIEWS]
    chosen = np.zeros_like(cosine, dtype=bool)
    np.put_along_axis(chosen, ranked, True, axis=1)
    chosen &= cosine > _LEAST_COSINE
    spacing = np.median(footprint[chosen]) if chosen.any() else solid.pitch
    tangent, other = tangents(normals)
    steps = spacing * (np.arange(_PATCH) - _PATCH // 2)
    a, b = (grid.reshape(-1) for grid in np.meshgrid(steps, steps, indexing="ij"))
    patch = tangent[:, None] * a[:, None] + other[:, None] * b[:, None]
    count = len(points)
    total = torch.zeros(count, len(offsets), _PATCH**2)
    squares = torch.zeros(count, len(offsets))
    for number, view in enumerate(views):
        mine = np.flatnonzero(chosen[:, number])
        if len(mine) == 0:
            continue
        where = points[mine, None, None] + offsets[:, None, None] * normals[mine, None, None] + patch[mine, None]
        values = _normalised(_look_up(view, where))
        total[mine] += values
        squares[mine] += values.square().sum(-1)
    seen = torch.as_tensor(chosen.sum(1), dtype=torch.float32)
    pairs = seen * (seen - 1)
    scores = (total.square().sum(-1) - squares) / pairs.clamp_min(1.0)[:, None]
    return scores.double().numpy(), pairs.double().numpy()


def _visibility(solid: Volume, points: Array, normals: Array, views: Sequence[View], body: int) -> tuple[Array, Array]:
    """Return cosine of the viewing angle (-1 where hidden) and width of a pixel [m], by point and view."""
    cosine = np.full((len(points), len(views)), -1.0)
    footprint = np.zeros_like(cosine)
    reach = 0.5 * solid.size()
    steps = np.linspace(0.03, 1.0, 24) * reach
    for number, view in enumerate(views):
        toward = view.camera.center - points
        distance = np.linalg.norm(toward, axis=1)
        toward /= distance[:, None]
        facing = np.einsum("id,id->i", toward, normals)
        footprint[:, number] = distance / view.camera.K[0, 0]
        front = np.flatnonzero(facing > _LEAST_COSINE)
        path = points[front, None] + steps[:, None] * toward[front, None]
        free = solid.at(path.reshape(-1, 3)).reshape(len(front), len(steps)).min(1) > -2 * solid.pitch
        pixel, depth = view.camera.project(points[front])
        column, row = (np.floor(np.nan_to_num(pixel[:, k], nan=-1)).astype(int) for k in range(2))
        inside = (
            np.asarray(depth > 0)
            & (column >= 0)
            & (row >= 0)
            & (column < view.camera.width)
            & (row < view.camera.height)
        )
        labels = view.labels
        if labels is not None:
            inside[inside] = labels[row[inside], column[inside]] == body + 1
        cosine[front, number] = np.where(free & inside, facing[front], -1.0)
    return cosine, footprint


def _look_up(view: View, where: Array) -> Tensor:
    """Return grey values at points (..., 3) [m], world frame, by linear interpolation."""
    flat = where.reshape(-1, 3)
    pixel, _ = view.camera.project(flat)
    scale = np.array([2 / view.camera.width, 2 / view.camera.height])
    grid = torch.as_tensor(np.nan_to_num(pixel * scale - 1, nan=2.0), dtype=torch.float32)
    values = functional.grid_sample(
        view.grey[None, None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return values.reshape(where.shape[:-1])


def _normalised(patches: Tensor) -> Tensor:
    """Return patches (..., P) with zero mean and, where they exceed the noise, unit norm."""
    centred = patches - patches.mean(-1, keepdim=True)
    return centred / (centred.square().sum(-1, keepdim=True) + patches.shape[-1] * _NOISE**2).sqrt()


def _peaks(scores: Array, offsets: Array) -> tuple[Array, Array]:
    """Return the best offset (n,) [m], interpolated by a parabola, and a confidence (n,), 0 where ambiguous."""
    best = np.clip(scores.argmax(1), 1, len(offsets) - 2)
    rows = np.arange(len(scores))
    low, mid, high = scores[rows, best - 1], scores[rows, best], scores[rows, best + 1]
    bend = low - 2 * mid + high
    part = np.where(bend < -1e-9, 0.5 * (low - high) / np.minimum(bend, -1e-9), 0.0).clip(-1, 1)
    shift = offsets[best] + part * (offsets[1] - offsets[0])
    contrast = mid - np.median(scores, axis=1)
    clear = (mid > _LEAST_PEAK) & (contrast > _LEAST_CONTRAST) & (scores.argmax(1) == best)
    return np.minimum(shift, 0.0), np.where(clear, contrast, 0.0)


def _smoothed(shift: Array, confidence: Array, near: Array, alike: Array) -> Array:
    """Return shifts that are smoothed over their neighbours and tend to 0 without evidence."""
    # A sample that contradicts the median of its neighbours is an outlier.
    known = np.where(alike & (confidence[near] > 0), shift[near], np.nan)
    with np.errstate(all="ignore"):
        middle = np.nanmedian(np.where(np.isfinite(known).any(axis=1, keepdims=True), known, 0.0), axis=1)
    trust = confidence * (np.abs(shift - middle) < 0.25 * np.abs(shift).max() + 1e-12)
    result = np.where(trust > 0, shift, middle)
    for _ in range(12):
        around = (alike * result[near]).sum(1) / alike.sum(1)
        result = (trust * shift + 0.5 * around) / (trust + 0.5 + _PRIOR)
    return result


def tangents(normals: Array) -> tuple[Array, Array]:
    """Return two unit vectors (n, 3) orthogonal to unit normals (n, 3) and to each other."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


def _deformed(solid: Volume, points: Array, shift: Array) -> Volume:
    """Return the solid with its surface moved along the normals by `shift` [m], given at some points."""
    where = grid_points(solid.distance.shape, solid.origin, solid.pitch)
    distance: Array = solid.distance.reshape(-1)
    touched: Array = np.abs(distance) < 2 * _DEEPEST * solid.size()
    field = distance.copy()
    field[touched] -= _interpolated(points, shift, where[touched], solid.pitch)
    field = field.reshape(solid.distance.shape)
    surface = crossings(field, solid.origin, solid.pitch)
    # A tip lies where silhouettes meet: it stays unless the photos show the surface elsewhere.
    tips = solid.corners
    if len(tips):
        moved = _interpolated(points, shift, tips, solid.pitch)
        tips = np.compress(moved > -0.5 * solid.pitch, tips, axis=0)
    return Volume.from_inside(field < 0, solid.origin, solid.pitch, np.concatenate([surface, tips]), len(tips))


def _interpolated(points: Array, values: Array, where: Array, softening: float) -> Array:
    """Return values at points (n, 3), interpolated from the nearest four given ones with weights 1 / distance."""
    away, near = KDTree(points).query(where, k=min(4, len(points)))
    weight = 1 / (away + softening)
    return (weight * values[near]).sum(1) / weight.sum(1)
