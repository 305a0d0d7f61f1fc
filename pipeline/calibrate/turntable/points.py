"""Points of a model from verified matches, where its poses did not come from a mapping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ..consistency_check import consistent_inliers
from ..reconstruction import Array, SfmModel, VerifiedPair

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]
_Feature = tuple[str, tuple[float, float]]
"""A photo, and a pixel in it."""

_PARALLAX_DEG = 1.0
_SEEN_PX = 8.0
"""Largest error of an observation of a new point [px], before the adjustment."""
_RIDGE = 1e-12
"""Keeps parallel rays from an infinitely far point."""


def with_points(model: SfmModel, pairs: Sequence[VerifiedPair]) -> SfmModel:
    """Return a model with points of its own poses: one for each track of matches that agree with them."""
    keys, edges = _tracks(model, pairs)
    graph = sparse.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(keys), len(keys)))
    label = connected_components(graph, directed=False)[1]
    images = list(model.T_cam_world)
    number = np.array([images.index(image) for image, _ in keys], np.int64)
    pixels = np.array([pixel for _, pixel in keys], float).reshape(-1, 2)
    once = np.unique(np.stack([label, number]), axis=1, return_counts=True)
    twice = np.isin(label, once[0][0][once[1] > 1])  # a track that has two features of one photo is no track
    label, number, pixels = label[~twice], number[~twice], pixels[~twice]
    points, seen = _triangulated(model, images, label, number, pixels)
    used = np.unique(label[seen])
    index = np.zeros(len(points), np.int64)
    index[used] = np.arange(len(used))
    observations = {}
    for k, image in enumerate(images):
        mine = seen & (number == k)
        observations[image] = (pixels[mine], index[label[mine]])
    black = np.zeros((len(used), 3), np.uint8)
    return replace(model, points=points[used], colors=black, observations=observations)


def _tracks(model: SfmModel, pairs: Sequence[VerifiedPair]) -> tuple[list[_Feature], Ids]:
    """Return the features that agreeing matches join, and the matches as pairs of their numbers (match, 2)."""
    numbers: dict[_Feature, int] = {}
    edges = [np.zeros((0, 2), np.int64)]
    for pair in pairs:
        if pair.image_a not in model.T_cam_world or pair.image_b not in model.T_cam_world:
            continue
        good = _consistent(model, pair)
        first = [numbers.setdefault((pair.image_a, (float(x), float(y))), len(numbers)) for x, y in pair.xy_a[good]]
        second = [numbers.setdefault((pair.image_b, (float(x), float(y))), len(numbers)) for x, y in pair.xy_b[good]]
        edges.append(np.array([first, second], np.int64).T.reshape(-1, 2))
    return list(numbers), np.concatenate(edges).astype(np.int64)


def _consistent(model: SfmModel, pair: VerifiedPair) -> Mask:
    a, b = model.T_cam_world[pair.image_a], model.T_cam_world[pair.image_b]
    camera_a, camera_b = model.camera(pair.image_a), model.camera(pair.image_b)
    rotation = b[:3, :3] @ a[:3, :3].T
    return consistent_inliers(
        camera_a.rays(pair.xy_a),
        camera_b.rays(pair.xy_b),
        rotation,
        b[:3, 3] - rotation @ a[:3, 3],
        camera_a.focal_px,
    )


def _triangulated(model: SfmModel, images: list[str], label: Ids, number: Ids, pixels: Array) -> tuple[Array, Mask]:
    """Return the points nearest to the rays of each track (track, 3), and which observations (n,) are good ones."""
    centers = np.array([model.center(image) for image in images])
    ways = np.zeros((len(pixels), 3))
    for k, image in enumerate(images):
        mine = number == k
        rays = model.camera(image).rays(pixels[mine])
        ways[mine] = np.column_stack([rays, np.ones(len(rays))]) @ model.T_cam_world[image][:3, :3]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    across = np.eye(3) - ways[:, :, None] * ways[:, None, :]
    size = int(label.max(initial=-1)) + 1
    matrix, right, mean = np.zeros((size, 3, 3)), np.zeros((size, 3)), np.zeros((size, 3))
    np.add.at(matrix, label, across)
    np.add.at(right, label, np.einsum("nij,nj->ni", across, centers[number]))
    np.add.at(mean, label, ways)
    count = np.bincount(label, minlength=size)
    matrix[count == 0] = np.eye(3)
    points = np.asarray(np.linalg.solve(matrix + _RIDGE * np.eye(3), right[..., None])[..., 0], np.float64)
    spread = np.arccos(np.clip(np.linalg.norm(mean, axis=1) / np.maximum(count, 1), -1, 1))
    good = np.zeros(len(pixels), bool)
    for k, image in enumerate(images):
        mine = np.flatnonzero(number == k)
        pose = model.T_cam_world[image]
        local = points[label[mine]] @ pose[:3, :3].T + pose[:3, 3]
        ahead = local[:, 2] > 0
        error = np.full(len(mine), np.inf)
        error[ahead] = np.linalg.norm(model.camera(image).project(local[ahead]) - pixels[mine[ahead]], axis=1)
        good[mine] = error < _SEEN_PX
    good &= spread[label] > 0.5 * np.radians(_PARALLAX_DEG)
    left = np.bincount(label[good], minlength=size)
    return points, good & (left[label] >= 2)
