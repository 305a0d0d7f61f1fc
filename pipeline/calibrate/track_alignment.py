"""Places of a model's points in its photos, aligned to one photo of each: finer than features, and more of them.

A feature is found in every photo by itself, to a few tenths of a pixel, and its place shifts with the direction of
view. Here the patch around a point in one photo, its reference, is laid over the other photos: an affine map, a gain
and an offset of brightness are estimated by least squares (Baker and Matthews, "Lucas-Kanade 20 years on", 2004, the
inverse compositional algorithm), beginning with what the model says of the map. A patch is found likewise in photos in
which no feature of the point was matched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.sight_rays import projection_jacobian
from .patch_alignment import RADIUS, laid_over, smoothed, templates
from .reconstruction import Array, SfmModel, distort

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]
Gray = Mapping[str, NDArray]
"""Brightness of each photo, shape (height, width)."""

_LEAST_LIKE = (0.9, 0.95)
"""Least correlation of a patch that was matched, and of one that was not."""
_FAR_PX = 2.0
"""Most by which a patch may move from where it was matched, or where the model has it [px]."""
_SETTLED_PX = 0.05
_CERTAIN_PX = 0.1
"""Most standard deviation of a place [px]. Along an edge a patch stays where the model has it, and would confirm it."""
_VIEW_COS = 0.64
"""Least cosine between the mean direction from which a point is seen and one from which it is looked for: 50 deg."""
_LEAST_VIEWS = 3
"""Least number of photos of a point that is looked for in others."""
_RIDGE = 1e-10
"""Keeps the map of a plane that is seen from the side invertible."""


@dataclass(frozen=True)
class _Sightings:
    """Points in photos, one after the other."""

    photo: Ids
    """Number of the photo, shape (n,)."""
    point: Ids
    """Index of the point, shape (n,)."""
    xy_px: Array
    """Pixel, shape (n, 2)."""
    matched: Mask
    """Whether a feature was matched there, or the model alone has it there."""


def aligned(model: SfmModel, photos: Gray, further: bool) -> SfmModel:
    """Return a model with the places of its points aligned to the reference of each.

    The reference is the photo nearest to the mean direction from which a point is seen. A matched place whose patch is
    not alike stays as it is.

    Args:
        model: The model; its poses and points are the same after.
        photos: Brightness by photo.
        further: Look for points in photos in which no feature of them was matched.
    """
    images = list(model.T_cam_world)
    seen = _matched(model, images)
    if further:
        seen = _joined(seen, _unmatched(model, images, seen))
    place, found = _aligned(model, images, [photos[image] for image in images], seen)
    kept = found | seen.matched
    observations = {}
    for k, image in enumerate(images):
        mine = kept & (seen.photo == k)
        observations[image] = (place[mine], seen.point[mine])
    return replace(model, observations=observations)


def _matched(model: SfmModel, images: Sequence[str]) -> _Sightings:
    counts = [len(model.observations[image][1]) for image in images]
    return _Sightings(
        np.repeat(np.arange(len(images)), counts),
        np.concatenate([model.observations[image][1] for image in images]),
        np.concatenate([model.observations[image][0] for image in images]),
        np.ones(sum(counts), bool),
    )


def _joined(a: _Sightings, b: _Sightings) -> _Sightings:
    return _Sightings(
        np.concatenate([a.photo, b.photo]),
        np.concatenate([a.point, b.point]),
        np.concatenate([a.xy_px, b.xy_px]),
        np.concatenate([a.matched, b.matched]),
    )


def _unmatched(model: SfmModel, images: Sequence[str], seen: _Sightings) -> _Sightings:
    """Return where the model has its points in photos from a direction like theirs in which they were not matched."""
    views, many = np.zeros(len(model.points), np.int64), _mean_views(model, images, seen)
    np.add.at(views, seen.point, 1)
    photo, point, place = [], [], []
    for k, image in enumerate(images):
        pose, camera = model.T_cam_world[image], model.camera(image)
        local = model.points @ pose[:3, :3].T + pose[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = camera.project(local)
        inside = (pixel > RADIUS).all(1) & (pixel < np.array([camera.width, camera.height]) - RADIUS).all(1)
        alike = (_views(model.center(image), model.points) * many).sum(1) > _VIEW_COS
        wanted = inside & alike & (local[:, 2] > 0) & (views >= _LEAST_VIEWS)
        wanted[seen.point[seen.photo == k]] = False
        index = np.flatnonzero(wanted)
        photo.append(np.full(len(index), k))
        point.append(index)
        place.append(pixel[index])
    index = np.concatenate(point)
    return _Sightings(np.concatenate(photo), index, np.concatenate(place), np.zeros(len(index), bool))


def _views(centers: Array, points: Array) -> Array:
    """Return the unit vectors from points (n, 3) to a centre (3,), or to one (n, 3) each."""
    ways = centers - points
    return ways / np.linalg.norm(ways, axis=-1, keepdims=True)


def _mean_views(model: SfmModel, images: Sequence[str], seen: _Sightings) -> Array:
    """Return the mean direction to the photos of each point, shape (point, 3)."""
    centers = np.array([model.center(image) for image in images])
    mean = np.zeros_like(model.points)
    own = seen.matched
    np.add.at(mean, seen.point[own], _views(centers[seen.photo[own]], model.points[seen.point[own]]))
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), np.finfo(float).tiny)


def _references(model: SfmModel, images: Sequence[str], seen: _Sightings, mean: Array) -> Ids:
    """Return the sighting that is the reference of each point, shape (point,)."""
    centers = np.array([model.center(image) for image in images])
    like = (_views(centers[seen.photo], model.points[seen.point]) * mean[seen.point]).sum(1)
    order = np.lexsort((-np.where(seen.matched, like, -2.0), seen.point))
    first = order[np.r_[True, np.diff(seen.point[order]) != 0]]
    reference = np.zeros(len(model.points), np.int64)
    reference[seen.point[first]] = first
    return reference


def _tangents(normals: Array) -> Array:
    """Return two unit vectors across each normal (point, 3), shape (point, 3, 2)."""
    aside = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, aside)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), np.finfo(float).tiny)
    return np.asarray(np.stack([first, np.cross(normals, first)], -1), np.float64)


def _plane_maps(model: SfmModel, images: Sequence[str], seen: _Sightings, mean: Array) -> Array:
    """Return the derivative of each pixel by the place on a plane across the mean view of its point, (n, 2, 2)."""
    across, maps = _tangents(mean), np.zeros((len(seen.point), 2, 2))
    for k, image in enumerate(images):
        mine = seen.photo == k
        pose, camera = model.T_cam_world[image], model.camera(image)
        local = model.points[seen.point[mine]] @ pose[:3, :3].T + pose[:3, 3]
        bending = distort(local[:, :2] / local[:, 2:], camera.distortion)[1]
        by_world = bending @ projection_jacobian(local) @ pose[:3, :3]
        maps[mine] = np.array([camera.fx, camera.fy])[:, None] * (by_world @ across[seen.point[mine]])
    return maps


def _aligned(model: SfmModel, images: Sequence[str], photos: Sequence[NDArray], seen: _Sightings) -> tuple[Array, Mask]:
    """Return the place of each sighting [px], shape (n, 2), and whether it was found there."""
    mean = _mean_views(model, images, seen)
    reference, maps = _references(model, images, seen, mean), _plane_maps(model, images, seen, mean)
    pictures = smoothed(photos)
    patches = templates(pictures, seen.photo[reference], seen.xy_px[reference])
    others = np.flatnonzero(reference[seen.point] != np.arange(len(seen.point)))
    own = _Sightings(seen.photo[others], seen.point[others], seen.xy_px[others], seen.matched[others])
    begun = maps[others] @ np.linalg.inv(maps[reference[own.point]] + _RIDGE * np.eye(2))
    places, like, step = laid_over(pictures, patches, own.photo, own.point, own.xy_px, begun)
    moved = np.linalg.norm(places - own.xy_px, axis=1)
    certain = patches.spread_px[own.point] * np.sqrt(np.maximum(1.0 - like**2, 0.0)) < _CERTAIN_PX
    found = (like > np.where(own.matched, *_LEAST_LIKE)) & (moved < _FAR_PX) & (step < _SETTLED_PX) & certain
    result, good = seen.xy_px.copy(), np.ones(len(seen.point), bool)
    result[others[found]], good[others] = places[found], found
    return result, good
