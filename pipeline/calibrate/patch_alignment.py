"""Patches of photos laid over others: affine map, gain and offset of brightness, by least squares.

Source: Baker and Matthews, "Lucas-Kanade 20 years on" (2004), the inverse compositional algorithm: what a change does
to the patch of the reference is known once and for all, and only that patch is differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .reconstruction import Array

Ids = NDArray[np.int64]
Pictures = Sequence[NDArray[np.float32]]
"""Brightness of the photos, each (height, width)."""

RADIUS = 6
"""Half a side of a patch [px]."""
_GRID = np.stack(np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1.0)] * 2), -1).reshape(-1, 2)
_WEIGHT = np.exp(-0.5 * (_GRID**2).sum(1) / (0.6 * RADIUS) ** 2)
_SMOOTH_PX = 0.8
"""Width of the filter before patches are compared [px], so that noise of single pixels has no say."""
_STEPS, _STILL_PX, _LOST_PX = 25, 0.01, 8.0
_RIDGE = 1e-4
"""Relative weight that keeps numbers that a patch does not tell, as along an edge, where they are."""
_CHUNK = 200  # patches: OpenCV takes images of at most 32767 rows


def smoothed(pictures: Sequence[NDArray]) -> list[NDArray[np.float32]]:
    """Return pictures as patches are compared in them."""
    return [np.asarray(cv2.GaussianBlur(one.astype(np.float32), (0, 0), _SMOOTH_PX), np.float32) for one in pictures]


def _sampled(pictures: Pictures, photo: Ids, xy_px: Array) -> Array:
    """Return the values of pictures at pixels (n, grid, 2), shape (n, grid)."""
    values = np.zeros(xy_px.shape[:2])
    for k in np.unique(photo):
        mine = np.flatnonzero(photo == k)
        for start in range(0, len(mine), _CHUNK):
            some = mine[start : start + _CHUNK]
            x, y = np.moveaxis((xy_px[some] - 0.5).astype(np.float32), -1, 0)
            values[some] = cv2.remap(pictures[k], x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return values


@dataclass(frozen=True)
class Templates:
    """Patches of the references, and what an affine map, a gain and an offset do to them."""

    values: Array
    """Shape (point, grid)."""
    weighted: Array
    """Weighted derivatives, shape (point, grid, 8)."""
    inverse: Array
    """Inverse of their normal matrix, shape (point, 8, 8)."""
    spread_px: Array
    """Standard deviation of the place of a patch along the direction that it tells least, if what lies there differs by
    as much as the patch itself varies [px], shape (point,)."""


def templates(pictures: Pictures, photo: Ids, xy_px: Array) -> Templates:
    """Return the patches of smoothed pictures around pixels (point, 2)."""
    places = xy_px[:, None] + _GRID
    values = _sampled(pictures, photo, places)
    # differences over one pixel: those of a filter over three are too small for fine texture, and steps too long
    dx, dy = (
        _sampled(pictures, photo, places + half) - _sampled(pictures, photo, places - half)
        for half in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
    )
    x, y = _GRID.T
    by = np.stack([dx, dy, dx * x, dx * y, dy * x, dy * y, values, np.ones_like(values)], -1)
    weighted = by * _WEIGHT[:, None]
    normal = np.einsum("pga,pgb->pab", weighted, by)
    size = 1.0 / np.sqrt(np.maximum(np.einsum("paa->pa", normal), np.finfo(float).tiny))
    scaled = normal * size[:, :, None] * size[:, None] + _RIDGE * np.eye(8)
    inverse = np.linalg.inv(scaled) * size[:, :, None] * size[:, None]
    weight = _WEIGHT / _WEIGHT.sum()
    variance = ((values - (values @ weight)[:, None]) ** 2) @ weight
    spread = np.sqrt(np.linalg.eigvalsh(inverse[:, :2, :2])[:, 1] * variance)
    return Templates(values=values, weighted=weighted, inverse=inverse, spread_px=spread)


def laid_over(
    pictures: Pictures, references: Templates, photo: Ids, point: Ids, xy_px: Array, maps: Array
) -> tuple[Array, Array, Array]:
    """Return where patches lie in other photos, how alike they are there, and how far the last step went.

    Args:
        pictures: The smoothed photos.
        references: The patches.
        photo: Number of the photo, shape (n,).
        point: Which patch, shape (n,).
        xy_px: Where to begin, shape (n, 2).
        maps: Derivative of the pixel by that of the reference to begin with, shape (n, 2, 2).

    Returns:
        Pixels (n, 2), correlations (n,), and the last steps [px] (n,).
    """
    places, maps, step = xy_px.copy(), maps.copy(), np.full(len(point), np.inf)
    busy = np.arange(len(point))
    for _ in range(_STEPS):
        own = point[busy]
        values = _sampled(pictures, photo[busy], places[busy][:, None] + _GRID @ np.swapaxes(maps[busy], 1, 2))
        slope = np.einsum("nga,ng->na", references.weighted[own], values - references.values[own])
        change = np.einsum("nab,nb->na", references.inverse[own], slope)
        change[:, :6] /= 1.0 + change[:, 6:7].clip(-0.9)  # the derivatives are those of a patch without the gain
        back = np.linalg.inv(np.eye(2) + change[:, 2:6].reshape(-1, 2, 2) + 1e-12)
        shift = -np.einsum("nab,nbc,nc->na", maps[busy], back, change[:, :2])
        places[busy], maps[busy] = places[busy] + shift, maps[busy] @ back
        step[busy] = np.linalg.norm(shift, axis=1)
        busy = busy[np.isfinite(step[busy]) & (step[busy] > _STILL_PX) & (step[busy] < _LOST_PX)]
        if not len(busy):
            break
    values = _sampled(pictures, photo, np.nan_to_num(places)[:, None] + _GRID @ np.swapaxes(maps, 1, 2))
    return places, _correlations(values, references.values[point]), step


def _correlations(a: Array, b: Array) -> Array:
    """Return the weighted correlation of each pair of patches, shape (n,)."""
    weight = _WEIGHT / _WEIGHT.sum()
    a, b = a - (a @ weight)[:, None], b - (b @ weight)[:, None]
    return (a * b) @ weight / np.sqrt(np.maximum(((a**2) @ weight) * ((b**2) @ weight), np.finfo(float).tiny))
