"""The ground around the bodies as photos show it from above: a grid of mean colours, and what no photo shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ....schemas import Ground
from ...geometry.directions import upright_axes
from ...geometry.solid_grid import Array
from ..photos.views import View

CELLS = 192
"""Cells along a side."""
_REACH = 3.0
"""Half the side, in radii of the bodies around their middle on the ground."""
_EDGE_PX = 3
"""Pixels that are this close to a mask are not used: they mix body and ground."""
_STEEPEST = 0.15
"""Least cosine between a ray and the ground's normal: flatter rays smear a pixel over many cells."""


@dataclass(frozen=True, kw_only=True)
class GroundPhoto:
    """Mean colours of the ground on a grid."""

    axes: Array
    """Two unit vectors in the ground and its normal, world frame, shape (3, 3), as rows."""
    corner: Array
    """Place of the grid's first corner along the first two axes [m], shape (2,)."""
    height: float
    """Of the ground along its normal [m]."""
    cell: float
    """Side of a cell [m]."""
    colors: NDArray[np.float32]
    """Colours, row along the second axis, column along the first, shape (CELLS, CELLS, 3); 0 where nothing is seen."""
    pixels: NDArray[np.float32]
    """Pixels of all photos that show a cell, shape (CELLS, CELLS)."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Cells that a photo shows, shape (CELLS, CELLS)."""
        return self.pixels > 0

    def places(self, points: Array) -> Array:
        """Return the cells (column, row) under world points (n, 3) [m], not rounded: cell k reaches from k to k + 1."""
        return (points @ self.axes[:2].T - self.corner) / self.cell

    def points(self, cells: Array) -> Array:
        """Return the world points [m], shape (n, 3), on the ground at cells (column, row), not rounded."""
        plane = self.corner + self.cell * cells
        return plane @ self.axes[:2] + self.height * self.axes[2]


def photograph_ground(ground: Ground, bodies: Array, views: Sequence[View]) -> GroundPhoto | None:
    """Return the ground around bodies from above; None where no photo shows any of it.

    Args:
        ground: The ground.
        bodies: Points of all bodies, world frame [m], shape (n, 3).
        views: Photos with masks.
    """
    normal = np.array(ground.normal)
    first, second, _ = upright_axes(normal)
    axes = np.stack([first, second, normal])
    plane = bodies @ axes[:2].T
    middle = 0.5 * (plane.min(0) + plane.max(0))
    half = _REACH * float(np.linalg.norm(plane - middle, axis=1).max() + np.ptp(bodies @ normal))
    cell = 2 * half / CELLS
    sums = np.zeros((CELLS * CELLS, 4))
    for view in views:
        points, colors = _on_ground(view, normal, ground.offset_m)
        index = np.floor((points @ axes[:2].T - (middle - half)) / cell).astype(int)
        inside = ((index >= 0) & (index < CELLS)).all(1)
        flat = index[inside, 1] * CELLS + index[inside, 0]
        for k, values in enumerate([*colors[inside].T, np.ones(len(flat))]):
            sums[:, k] += np.bincount(flat, values, CELLS * CELLS)
    if not sums[:, 3].any():
        return None
    mean = sums[:, :3] / np.maximum(sums[:, 3:], 1)
    return GroundPhoto(
        axes=axes,
        corner=middle - half,
        height=ground.offset_m,
        cell=cell,
        colors=mean.reshape(CELLS, CELLS, 3).astype(np.float32),
        pixels=sums[:, 3].reshape(CELLS, CELLS).astype(np.float32),
    )


def near_mask(view: View) -> NDArray[np.bool_]:
    """Return the pixels (H, W) on the masks of a photo or so close that they mix body and ground."""
    assert view.cover is not None
    body = (view.cover.sum(0).cpu().numpy() > 0.01).astype(np.uint8)
    return np.asarray(cv2.dilate(body, np.ones((2 * _EDGE_PX + 1, 2 * _EDGE_PX + 1), np.uint8))) > 0


def _on_ground(view: View, normal: Array, offset_m: float) -> tuple[Array, Array]:
    """Return the points on the ground (n, 3) [m] that a photo's pixels show beside all masks, and their colours."""
    image = view.image.detach().cpu().numpy()
    free = np.ones(image.shape[:2], bool) if view.seen is None else view.seen.cpu().numpy()
    if view.cover is not None:
        free &= ~near_mask(view)
    rows, columns = np.nonzero(free)
    rays, eye = view.rays(columns, rows), view.camera.center
    down = rays @ normal
    met = down < -_STEEPEST
    distance = (offset_m - eye @ normal) / down[met]
    return eye + distance[:, None] * rays[met], image[rows[met], columns[met]].astype(float)
