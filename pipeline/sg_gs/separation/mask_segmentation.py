"""Segmentation of bodies in photos, from their approximate positions in space.

Each photo is cut into body and background by GrabCut (Rother, Kolmogorov, Blake 2004: colour models of both, and a
minimal cut along the edges), first in a wide band around the spheres of the body. The masks together carve a solid that
is more exact than each of them, because it excludes what only one photo assigned to the body. Its projection into each
photo initialises a second cut in a narrow band.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ....datasets.capture.cameras import Camera
from ....datasets.capture.capture import Capture
from ....schemas import Ground
from ...foreground.graph_cut import Band, Mask, cut, dilated, eroded
from ...foreground.plain_background import cut_out
from ...geometry.solid_grid import Array, crossings, grid_points
from ...geometry.spheres import Spheres
from ...rendering.render import render
from ..photos.views import View, with_labels
from ..solid.visual_hull import carve, largest_component, signed_distance_px

_SIZE = 800
"""Maximum longer side of the reduced photos [px]; masks are resized to the original size afterwards."""
_RENDERED = 240
_NARROW = 3.0
"""Half width of the second band, in units of the grid spacing of the solid."""
_GRID = 72
_OUTVOTED = 0.05
"""Share of the photos that may exclude a point of the body and are outvoted."""
_MIN_VIEWS = 3


@dataclass(frozen=True)
class Blob:
    """Approximate position of a body."""

    index: int
    """Index of the body in the manifest."""
    members: NDArray[np.int64]
    """Indices of the spheres of the body, shape (n,)."""
    corners: Array | None
    """Corners of a box that contains the body [m], world frame, shape (8, 3), or None."""


@dataclass(frozen=True)
class Outlined:
    """Photos with masks, and figures of the masks of each body."""

    train: list[View]
    """The photos to fit, with masks."""
    test: list[View]
    """The held-out photos, with masks."""
    shares: list[float]
    """Mean share of the pixels, by body."""
    agreements: list[float]
    """Mean IoU of the masks and the solid carved by them, by body."""


def outline(
    capture: Capture,
    train: Sequence[View],
    test: Sequence[View],
    spheres: Spheres,
    pitch: float,
    blobs: Sequence[Blob],
    ground: Ground | None,
) -> Outlined:
    """Add masks of bodies to photos, and keep the labels that these have.

    Args:
        capture: The capture with the photos.
        train: The photos that carve the solids.
        test: Other photos to segment.
        spheres: The whole scene, world frame.
        pitch: Accuracy of the spheres as borders of a body [m].
        blobs: The bodies.
        ground: The ground below the bodies, which they do not enter, or None.
    """
    views = [*train, *test]
    pictures = [_Picture.read(capture, view) for view in views]
    fitted = slice(len(train))
    bands = [_wide_bands(picture, spheres, pitch, blobs, ground) for picture in pictures]
    labels = [picture.given.copy() for picture in pictures]
    shares, agreements = [], []
    for k, blob in enumerate(blobs):
        near = spheres.means.numpy()[blob.members]
        hidden = [
            np.any([picture.given > 0, *(band.inside for band in own[:k] + own[k + 1 :])], axis=0)
            for picture, own in zip(pictures, bands, strict=True)
        ]
        excluded = [other | _beyond(blob, picture) for picture, other in zip(pictures, hidden, strict=True)]
        cuts = list(zip(pictures, bands, excluded, strict=True))
        first = [cut(picture.image, own[k].without(other)) for picture, own, other in cuts[fitted]]
        solid = _Solid.left_by(pictures[fitted], first, hidden[fitted], near, pitch, ground)
        masks = [cut(picture.image, solid.band(picture.camera).without(other)) for picture, _, other in cuts]
        left = _Solid.left_by(pictures[fitted], masks[fitted], hidden[fitted], near, pitch, ground)
        agreements.append(_agreement(left, pictures[fitted], masks[fitted], hidden[fitted]))
        shares.append(float(np.mean([mask.mean() for mask in masks[fitted]])))
        for known, mask in zip(labels, masks, strict=True):
            known[mask & (known == 0)] = blob.index + 1
    bodies = len(capture.manifest.bodies)
    found = [with_labels(view, known, bodies) for view, known in zip(views, labels, strict=True)]
    return Outlined(found[fitted], found[len(train) :], shares, agreements)


def outline_before_plain(capture: Capture, train: Sequence[View], test: Sequence[View], index: int) -> Outlined | None:
    """Add masks of the one body that all photos show before a plain background; None where one does not.

    Args:
        capture: The capture with the photos.
        train: The photos that carve the solid.
        test: Other photos to segment.
        index: Index of the body in the manifest.
    """
    views, fitted = [*train, *test], slice(len(train))
    pictures = [_Picture.read(capture, view) for view in views]
    masks = []
    for picture in pictures:
        mask = cut_out(picture.image)
        if mask is None:
            return None
        masks.append(mask)
    labels = [np.where(mask, index + 1, 0).astype(np.uint8) for mask in masks]
    bodies = len(capture.manifest.bodies)
    found = [with_labels(view, own, bodies) for view, own in zip(views, labels, strict=True)]
    silhouettes = [view.silhouette(index) for view in found[fitted]]
    hull = carve([one for one in silhouettes if one is not None], None, capture.manifest.bodies[index].name)
    nothing = [np.zeros(mask.shape, bool) for mask in masks]
    agreement = _agreement(_Solid(hull.surface, hull.pitch), pictures[fitted], masks[fitted], nothing[fitted])
    share = float(np.mean([mask.mean() for mask in masks[fitted]]))
    return Outlined(found[fitted], found[len(train) :], [share], [agreement])


@dataclass(frozen=True)
class _Picture:
    """A photo without distortion."""

    image: NDArray[np.uint8]
    """RGB, shape (H, W, 3)."""
    camera: Camera
    """Camera of the photo."""
    given: NDArray[np.uint8]
    """Labels given with the capture, shape (H, W)."""

    @staticmethod
    def read(capture: Capture, view: View) -> _Picture:
        image, camera = capture.photo_camera(view.name).undistorted(capture.photo(view.name))
        scale = min(1.0, _SIZE / max(camera.width, camera.height))
        width, height = round(scale * camera.width), round(scale * camera.height)
        if scale < 1:
            image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        given = np.zeros((height, width), np.uint8)
        if view.labels is not None:
            given = np.asarray(cv2.resize(view.labels, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
        return _Picture(image, camera.resized(width, height), given)


def _wide_bands(
    picture: _Picture, spheres: Spheres, pitch: float, blobs: Sequence[Blob], ground: Ground | None
) -> list[Band]:
    """Return a band around the spheres of each body, extended down to the ground."""
    seen = _rendered(picture.camera, spheres, blobs)
    bands = []
    for k, blob in enumerate(blobs):
        core = seen[..., k] > 0.5
        start, width = core, 0.0
        points = spheres.means.numpy()[blob.members]
        metre = _pixels_per_metre(picture.camera, points)
        if metre is not None:
            width = pitch * metre
            if ground is not None:
                columns = _marked(picture.camera, _columns(points, pitch, ground))
                start = core | eroded(dilated(columns, 0.7 * width), 0.7 * width)
        bands.append(Band.about(start, core, width))
    return bands


@torch.no_grad()
def _rendered(camera: Camera, spheres: Spheres, blobs: Sequence[Blob]) -> Array:
    """Return the rendered share of each body in each pixel, in [0, 1], shape (H, W, bodies)."""
    scale = min(1.0, _RENDERED / max(camera.width, camera.height))
    small = camera.resized(round(scale * camera.width), round(scale * camera.height))
    label = torch.zeros(len(spheres), len(blobs))
    for k, blob in enumerate(blobs):
        label[blob.members, k] = 1.0
    pose = torch.as_tensor(small.T_cam_world[None], dtype=torch.float32)
    K = torch.as_tensor(small.K[None], dtype=torch.float32)
    parts = (spheres.means, spheres.scales, spheres.opacities, label, pose, K)
    seen = render(*parts, small.width, small.height).features[0].numpy()
    large = cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large, np.float32).reshape(camera.height, camera.width, len(blobs))


def _columns(points: Array, pitch: float, ground: Ground) -> Array:
    """Return points below given ones (n, 3), down to the ground, half a pitch apart."""
    normal = np.array(ground.normal)
    heights = np.maximum(points @ normal - ground.offset_m, 0)
    steps = np.arange(0, heights.max() + 0.5 * pitch, 0.5 * pitch)
    down = np.minimum(steps[None], heights[:, None])
    return (points[:, None] - down[..., None] * normal).reshape(-1, 3)


def _beyond(blob: Blob, picture: _Picture) -> Mask:
    """Return the pixels outside the projection of the body's box."""
    shape = picture.given.shape
    if blob.corners is None:
        return np.zeros(shape, bool)
    pixel, depth = picture.camera.project(blob.corners)
    if (depth <= 0).any():  # The camera is in the box, or close to it.
        return np.zeros(shape, bool)
    within = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(within, cv2.convexHull(np.round(pixel).astype(np.int32)), 1)
    return within == 0


@dataclass(frozen=True)
class _Solid:
    """A solid carved by several masks."""

    surface: Array
    """Points on the surface [m], world frame, shape (n, 3)."""
    pitch: float
    """Spacing of the points [m]."""

    @staticmethod
    def left_by(
        pictures: Sequence[_Picture],
        masks: Sequence[Mask],
        hidden: Sequence[Mask],
        near: Array,
        margin: float,
        ground: Ground | None,
    ) -> _Solid:
        """Carve a grid around points near the body (n, 3) and a margin [m], down to the ground.

        Unlike `visual_hull.carve`, this tolerates a few outvoted masks and does not carve where another body may hide
        this one.
        """
        low, high = near.min(0) - 1.5 * margin, near.max(0) + 1.5 * margin
        if ground is not None:
            feet = near - (near @ np.array(ground.normal) - ground.offset_m)[:, None] * np.array(ground.normal)
            low, high = np.minimum(low, feet.min(0)), np.maximum(high, feet.max(0))
        pitch = float((high - low).max()) / (_GRID - 1)
        shape = tuple(int(n) for n in np.ceil((high - low) / pitch).astype(int) + 1)
        points = grid_points(shape, low, pitch)
        distances = np.full((len(pictures), len(points)), np.inf, np.float32)
        for row, picture, mask, other in zip(distances, pictures, masks, hidden, strict=True):
            if mask.any():
                _look_up(row, points, mask, other, picture.camera)
        rank = min(math.ceil(_OUTVOTED * len(pictures)), len(pictures) - 1)
        field = np.partition(distances, rank, axis=0)[rank].astype(float)
        field[np.isfinite(distances).sum(0) < _MIN_VIEWS] = -pitch
        if ground is not None:
            field = np.minimum(field, points @ np.array(ground.normal) - ground.offset_m + 1e-3 * pitch)
        field = _largest_part(np.pad(field.reshape(shape), 1, constant_values=-pitch), pitch)
        return _Solid(crossings(field, low - pitch, pitch), pitch)

    def seen_by(self, camera: Camera) -> Mask:
        """Return the mask of the solid in a photo."""
        metre = _pixels_per_metre(camera, self.surface)
        if metre is None:
            return np.zeros((camera.height, camera.width), bool)
        # The points lie on the surface: discs close the gaps between them and are eroded again at the border.
        radius = 0.9 * self.pitch * metre + 0.5
        return eroded(dilated(_marked(camera, self.surface), radius), radius)

    def band(self, camera: Camera) -> Band:
        """Return a narrow band around the border of the solid in a photo."""
        mask = self.seen_by(camera)
        width = _NARROW * self.pitch * (_pixels_per_metre(camera, self.surface) or 0.0)
        return Band.about(mask, mask, width)


def _look_up(row: Array, points: Array, mask: Mask, hidden: Mask, camera: Camera) -> None:
    """Write the depth of points (n, 3) inside a mask [m] into `row` (n,), where the photo may show them."""
    from scipy.ndimage import map_coordinates  # dear to import, and seldom needed

    signed = signed_distance_px(mask)
    pixel, depth = camera.project(points)
    seen = (depth > 0) & (pixel > 0).all(1) & (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
    seen[seen] = ~hidden[tuple(pixel[seen].astype(int).T[::-1])]
    u, v = pixel[seen].T - 0.5
    row[seen] = map_coordinates(signed, [v, u], order=1, mode="nearest") * depth[seen] / camera.K[0, 0]


def _largest_part(field: Array, pitch: float) -> Array:
    """Return a field (X, Y, Z) that is positive only in its largest connected part."""
    part = largest_component(field > 0)
    return field if part is None else np.where(part, field, np.minimum(field, -1e-3 * pitch))


def _agreement(solid: _Solid, pictures: Sequence[_Picture], masks: Sequence[Mask], hidden: Sequence[Mask]) -> float:
    """Return the mean IoU of masks and the solid in the same photos; photos that show neither are omitted."""
    values = []
    for picture, mask, other in zip(pictures, masks, hidden, strict=True):
        seen = solid.seen_by(picture.camera) & ~other
        if (seen | mask).any():
            values.append(float((seen & mask).sum() / (seen | mask).sum()))
    return float(np.mean(values)) if values else 0.0


def _pixels_per_metre(camera: Camera, points: Array) -> float | None:
    """Return the size of a metre [px] at the depth of points (n, 3), or None if they are behind the camera."""
    depth = points @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    middle = float(np.median(depth)) if len(depth) else 0.0
    return camera.K[0, 0] / middle if middle > 0 else None


def _marked(camera: Camera, points: Array) -> Mask:
    """Return the pixels in which points (n, 3) lie."""
    seen, column, row = camera.pixels_of(points)
    mask = np.zeros((camera.height, camera.width), bool)
    mask[row[seen], column[seen]] = True
    return mask
