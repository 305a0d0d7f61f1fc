"""Visual hulls: the largest solid that all silhouettes allow.

A point lies in the hull if it is inside the mask of every view that contains it. The hull is a continuous field, the
minimum over the views of the signed distance from the mask's border, so its surface is not bound to the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ....schemas import Ground, InputDataError
from ...geometry.directions import fibonacci_directions
from ...geometry.solid_grid import Array, Volume, crossings, grid_points
from ..photos.silhouette import Silhouette

_COARSE = 40
_FINEST = 128
_PITCH_PX = 0.6
_BORDER_SMOOTHING_PX = 0.7
_BORDER_BIAS_PX = 0.5
_TIP_DIRECTIONS = 500
_BLOCK = 1024
"""Number of points that are compared at a time."""
_MIN_VIEWS = 3
_TRUNCATION_PX = 4.0
"""Truncation distance of a depth map behind its surface, in pixel widths; in front of the surface space is empty."""
_LEAST_COSINE = 0.25
"""Minimum cosine of the viewing angle; at more grazing angles depth changes too fast within a pixel."""


def carve(silhouettes: Sequence[Silhouette], ground: Ground | None, name: str = "body") -> Volume:
    """Carve the visual hull of a body, world frame, by masks and by depth maps where views have them.

    Views with an empty mask are omitted; space beyond the border of a picture is unknown there and not carved.

    Args:
        silhouettes: The views.
        ground: Half space that the body does not enter; it bounds the underside, which no view sees.
        name: Name of the body, for errors.

    Raises:
        InputDataError: If fewer than 3 views show the body, or no point is inside all masks.
    """
    views = [view for view in silhouettes if view.mask.any()]
    if len(views) < _MIN_VIEWS:
        raise InputDataError(
            f"body '{name}': its mask is not empty in {len(views)} of {len(silhouettes)} photos.",
            f"at least {_MIN_VIEWS}; 20 or more from all sides give a good shape.",
            "add masks, or give the body a shape in capture.toml.",
        )
    fields = [signed_distance_px(view.mask) for view in views]
    center, radius = _bounds(views)
    pitch = 2 * radius / (_COARSE - 1)
    origin = center - radius
    shape = (_COARSE,) * 3
    coarse = _field(grid_points(shape, origin, pitch), views, fields, ground).reshape(shape)
    inside = largest_component(coarse > -pitch)
    if inside is None or not (coarse > 0).any():
        raise InputDataError(
            f"body '{name}': no point lies inside the masks of all {len(views)} photos that show it.",
            todo="check that masks and cameras belong together: 'cgwm validate' reprojects them.",
        )
    field, origin, pitch = _refined(coarse, inside, origin, pitch, views, fields, ground)
    solid = largest_component(field > 0)
    if solid is None:
        raise InputDataError(
            f"body '{name}': the masks leave nothing larger than {1e3 * pitch:.2g} mm.",
            todo="check that the masks show the whole body, and fit the cameras: 'cgwm validate' reprojects them.",
        )
    field = np.where(solid, field, np.minimum(field, -1e-3 * pitch))
    surface = crossings(field, origin, pitch)
    tips = _tips(surface, pitch, lambda points: _field(points, views, fields, ground))
    return Volume.from_inside(solid, origin, pitch, np.concatenate([surface, tips]), len(tips))


def _tips(surface: Array, pitch: float, field: Callable[[Array], Array]) -> Array:
    """Return points of the hull beyond the grid's surface in directions in which it extends farthest, (k, 3).

    A corner lies between grid points and is cut off by their spacing, but it touches a plane first in contact.
    """
    directions = fibonacci_directions(_TIP_DIRECTIONS)
    extreme = np.unique(_farthest(surface, directions))
    ticks = np.linspace(-1.2, 1.2, 11) * pitch
    offsets = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    points = (surface[extreme, None] + offsets).reshape(-1, 3)
    points = points[field(points) > 0]
    if len(points) == 0:
        return np.zeros((0, 3))
    return points[np.unique(_farthest(points, directions))]


def _farthest(points: Array, directions: Array) -> NDArray[np.intp]:
    """Return the index of the point that is farthest along each direction, the first of equals, shape (directions,).

    The points come in blocks whose products with all directions stay in the processor's cache: a sixth of the time of
    one pass over all points for each direction.
    """
    farthest, most = np.zeros(len(directions), dtype=np.intp), np.full(len(directions), -np.inf)
    for first in range(0, len(points), _BLOCK):
        along = directions @ points[first : first + _BLOCK].T
        place = along.argmax(1)
        value = np.take_along_axis(along, place[:, None], 1)[:, 0]
        farther = value > most
        farthest[farther], most[farther] = first + place[farther], value[farther]
    return farthest


def _refined(
    coarse: Array,
    inside: NDArray[np.bool_],
    origin: Array,
    pitch: float,
    views: Sequence[Silhouette],
    fields: Sequence[Array],
    ground: Ground | None,
) -> tuple[Array, Array, float]:
    """Crop the grid to the body and refine it, twice; only points near the surface are evaluated again."""
    from scipy.ndimage import map_coordinates  # dear to import, and seldom needed

    # A grid finer than the pixels would hold nothing more.
    pixel = float(np.median([view.pixel_at(origin + 0.5 * pitch * np.array(coarse.shape)) for view in views]))
    for level in range(2):
        kept = np.argwhere(inside)
        low, high = np.maximum(kept.min(0) - 2, 0), np.minimum(kept.max(0) + 2, np.array(inside.shape) - 1)
        extent = float((high - low).max()) * pitch
        finest = max(extent / (_FINEST - 1), min(_PITCH_PX * pixel, 0.9 * pitch))
        fine_pitch = finest if level == 1 else float(np.sqrt(finest * pitch))
        fine_origin = origin + low * pitch
        shape = tuple(int(n) for n in np.floor((high - low) * pitch / fine_pitch + 0.5).astype(int) + 1)
        points = grid_points(shape, fine_origin, fine_pitch)
        values = map_coordinates(coarse, ((points - origin) / pitch).T, order=1, mode="nearest")
        near = np.abs(values) < 1.5 * pitch
        values[near] = _field(points[near], views, fields, ground)
        coarse, origin, pitch = values.reshape(shape), fine_origin, fine_pitch
        found = largest_component(coarse > -pitch)
        inside = inside if found is None else found
    return coarse, origin, pitch


def signed_distance_px(mask: NDArray[np.bool_]) -> Array:
    """Return the distance from the mask's border at pixel centres [px], positive inside, shape (H, W)."""
    image = mask.astype(np.uint8)
    inner = cv2.distanceTransform(np.pad(image, 1, mode="edge"), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outer = cv2.distanceTransform(np.pad(1 - image, 1, mode="edge"), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    signed = np.where(mask, inner[1:-1, 1:-1] - 0.5, 0.5 - outer[1:-1, 1:-1])
    # The border runs in steps between pixel centres; a little smoothing removes them from slanted edges. The minimum of
    # many such distances, each uncertain by a fraction of a pixel, is too small, mainly at edges and corners, which are
    # on the outlines of many views: the bias was measured there, on known solids with calibrated cameras. With
    # exact cameras a smooth body becomes larger by a third of a pixel.
    return np.asarray(cv2.GaussianBlur(signed, (0, 0), _BORDER_SMOOTHING_PX), np.float64) + _BORDER_BIAS_PX


def _field(points: Array, views: Sequence[Silhouette], fields: Sequence[Array], ground: Ground | None) -> Array:
    """Return the approximate signed distance of points (n, 3) from the hull [m], positive inside, shape (n,)."""
    from scipy.ndimage import map_coordinates  # dear to import, and seldom needed

    result = np.full(points.shape[0], np.inf)
    seen = np.zeros(points.shape[0], dtype=np.int32)
    fused = _FusedDepth(points.shape[0])
    for view, field in zip(views, fields, strict=True):
        local = points @ view.T_cam_world[:3, :3].T + view.T_cam_world[:3, 3]
        depth = np.where(local[:, 2] > 0, local[:, 2], np.inf)
        u = view.K[0, 0] * local[:, 0] / depth + view.K[0, 2]
        v = view.K[1, 1] * local[:, 1] / depth + view.K[1, 2]
        visible = (local[:, 2] > 0) & (u > 0) & (v > 0) & (u < field.shape[1]) & (v < field.shape[0])
        signed = map_coordinates(field, [v[visible] - 0.5, u[visible] - 0.5], order=1, mode="nearest")
        metres = signed * depth[visible] / np.sqrt(view.K[0, 0] * view.K[1, 1])
        result[visible] = np.minimum(result[visible], metres)
        seen[visible] += 1
        if view.surface is not None:
            fused.add(view, view.surface, visible, u[visible], v[visible], depth[visible])
    far = np.abs(result[np.isfinite(result)]).max(initial=1.0)
    result = np.where(seen >= min(_MIN_VIEWS, len(views)), result, -far)
    result = np.minimum(result, fused.depth_behind_m())
    if ground is not None:
        result = np.minimum(result, points @ np.array(ground.normal) - ground.offset_m)
    return result


class _FusedDepth:
    """Mean depth of points behind the surfaces that depth maps show, positive inside the body.

    Truncated signed distances, averaged over the maps with the cosine of the viewing angle as weight (Curless and
    Levoy 1996, "A volumetric method for building complex models from range images"): noise averages out, whereas the
    minimum of many noisy depths would erode thin walls.
    """

    def __init__(self, count: int) -> None:
        self._sum, self._weight = np.zeros(count), np.zeros(count)
        self._most = np.inf

    def add(
        self,
        view: Silhouette,
        depth_map: tuple[NDArray[np.float32], Array],
        index: NDArray[np.bool_],
        u: Array,
        v: Array,
        depth: Array,
    ) -> None:
        """Add the depth map of a view.

        Args:
            view: The view.
            depth_map: Its `Silhouette.surface`.
            index: Whether each point lies inside the image, shape (count,).
            u: Column of each such point [px].
            v: Row of each such point [px].
            depth: Depth of each such point along the optical axis [m].
        """
        rows, columns = v.astype(int), u.astype(int)
        surface, cosine = depth_map[0][rows, columns], depth_map[1][rows, columns]
        reach = _TRUNCATION_PX * depth / view.K[0, 0]
        below = (depth - surface) * cosine
        counts = (surface > 0) & view.mask[rows, columns] & (cosine > _LEAST_COSINE) & (below < reach)
        weight = np.where(counts, cosine, 0.0)
        self._sum[index] += weight * np.maximum(below, -reach)
        self._weight[index] += weight
        self._most = min(self._most, float(reach.min(initial=np.inf)))

    def depth_behind_m(self) -> Array:
        """Return the mean [m], shape (count,); infinite where no map shows a surface near the point."""
        known = self._weight > 0
        mean = self._sum / np.where(known, self._weight, 1.0)
        return np.where(known & (mean < 0.9 * self._most), mean, np.inf)


def _bounds(views: Sequence[Silhouette]) -> tuple[Array, float]:
    """Return centre [m] and radius [m] of a ball that contains the body, world frame."""
    system, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        rotation = view.T_cam_world[:3, :3]
        camera = -rotation.T @ view.T_cam_world[:3, 3]
        v, u = (index.mean() + 0.5 for index in np.nonzero(view.mask))
        ray = rotation.T @ np.linalg.solve(view.K, [u, v, 1.0])
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        system += across
        right += across @ camera
    center: Array = np.linalg.solve(system, right)
    radii = []
    for view in views:
        local = view.T_cam_world[:3, :3] @ center + view.T_cam_world[:3, 3]
        v, u = np.nonzero(view.mask)
        offset = np.hypot(
            (u + 0.5 - view.K[0, 2]) / view.K[0, 0] - local[0] / local[2],
            (v + 0.5 - view.K[1, 2]) / view.K[1, 1] - local[1] / local[2],
        )
        radii.append(offset.max() * abs(local[2]))
    return center, 1.25 * float(max(radii))


def largest_component(inside: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Return the largest connected part of a grid, or None if nothing is inside."""
    from scipy.ndimage import label  # dear to import, and seldom needed

    labels, count = label(inside)  # type: ignore[misc]
    if count == 0:
        return None
    sizes = np.bincount(labels.reshape(-1))
    sizes[0] = 0
    return labels == int(np.argmax(sizes))
