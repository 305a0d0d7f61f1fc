"""Triangle mesh of a union of spheres, by surface nets.

Source: S. Gibson, "Constrained elastic surface nets" (MERL TR 1999-24), without the relaxation: one vertex for each
cell that the surface crosses, at the mean of the crossings of its edges; one quadrilateral for each crossed grid edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .solid_grid import Array

RESOLUTION = 64
"""Default number of cells along the longest side."""
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def union_mesh(centers: Array, radii: Array, resolution: int = RESOLUTION) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (V, 3) [m] and triangles (F, 3), anticlockwise from outside, of a union of spheres.

    Args:
        centers: Centres of the spheres [m], shape (N, 3).
        radii: Radii of the spheres [m], shape (N,).
        resolution: Number of cells along the longest side.
    """
    low, high = (centers - radii[:, None]).min(0), (centers + radii[:, None]).max(0)
    pitch = float((high - low).max()) / resolution
    shape = tuple(int(n) for n in np.ceil((high - low) / pitch).astype(int) + 3)
    origin = low - pitch
    return _surface_net(_near_field(centers, radii, shape, origin, pitch), origin, pitch)


def _near_field(centers: Array, radii: Array, shape: tuple[int, ...], origin: Array, pitch: float) -> Array:
    """Return min |p - c| - r over spheres at the points of a grid where it is below 2 pitch, and 2 pitch elsewhere.

    The ends of an edge that crosses the surface are within a pitch of it, so each sphere counts near itself alone.
    """
    field = np.full(shape, 2 * pitch)
    for center, radius in zip(centers, radii, strict=True):
        reach = radius + 2 * pitch
        first = np.floor((center - reach - origin) / pitch).astype(int).clip(0)
        last = np.ceil((center + reach - origin) / pitch).astype(int) + 1
        near = tuple(map(slice, first, np.minimum(last, shape)))
        x, y, z = (o + pitch * np.arange(n.start, n.stop) - c for o, n, c in zip(origin, near, center, strict=True))
        away = np.sqrt((x**2)[:, None, None] + (y**2)[:, None] + z**2) - radius
        np.minimum(field[near], away, out=field[near])
    return field


def _surface_net(field: Array, origin: Array, pitch: float) -> tuple[Array, NDArray[np.int64]]:
    inside = field < 0
    within = [_at(inside, corner) for corner in _CORNERS]
    used = np.logical_or.reduce(within) & ~np.logical_and.reduce(within)
    place, values = np.argwhere(used), [_at(field, corner)[used] for corner in _CORNERS]
    total, count = np.zeros((len(place), 3)), np.zeros(len(place))
    for a in range(8):
        for b in range(a + 1, 8):
            if (_CORNERS[a] != _CORNERS[b]).sum() != 1:
                continue  # no edge of the cell
            crossed = (values[a] < 0) != (values[b] < 0)
            share = np.where(crossed, values[a] / np.where(crossed, values[a] - values[b], 1.0), 0.0)
            total += crossed[:, None] * (_CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a]))
            count += crossed
    number = np.full(used.shape, -1, np.int64)
    number[used] = np.arange(len(place))
    vertices = origin + pitch * (place + total / count[:, None])
    return vertices, np.concatenate([_quads(inside, number, axis) for axis in range(3)])


def _at(field: Array, corner: NDArray[np.int64]) -> Array:
    """Return the values of a field at one corner of every cell."""
    return field[tuple(slice(c, n - 1 + c) for c, n in zip(corner, field.shape, strict=True))]


def _quads(inside: NDArray[np.bool_], number: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Return two triangles (2 n, 3) for each of n grid edges along an axis that the surface crosses."""
    along = np.moveaxis(inside, axis, 0)
    edges = np.argwhere(along[:-1] != along[1:])
    out = along[:-1][tuple(edges.T)]  # inside first: the surface looks along the axis
    cell = np.moveaxis(number, axis, 0)
    i, j, k = edges.T
    # the four cells around the edge, anticlockwise about the axis (moveaxis keeps the cyclic order but for y)
    ring = np.stack([cell[i, j - 1, k - 1], cell[i, j, k - 1], cell[i, j, k], cell[i, j - 1, k]], 1)
    flipped = ~out if axis != 1 else out
    ring[flipped] = ring[flipped][:, ::-1]
    return np.concatenate([ring[:, [0, 1, 2]], ring[:, [0, 2, 3]]])
