"""Triangle mesh of a union of spheres, by surface nets.

Source: S. Gibson, "Constrained elastic surface nets" (MERL TR 1999-24), without the relaxation: one vertex for each
cell that the surface crosses, at the mean of the crossings of its edges; one quadrilateral for each crossed grid edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .solid_grid import Array, grid_points
from .surface_distance import union_distance

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
    field = union_distance(centers, radii, grid_points(shape, origin, pitch).reshape(-1, 3)).reshape(shape)
    return _surface_net(field, origin, pitch)


def _surface_net(field: Array, origin: Array, pitch: float) -> tuple[Array, NDArray[np.int64]]:
    inside = field < 0
    cells = tuple(n - 1 for n in field.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    for a in range(8):
        for b in range(a + 1, 8):
            if (_CORNERS[a] != _CORNERS[b]).sum() != 1:
                continue  # no edge of the cell
            first, second = _at(field, _CORNERS[a]), _at(field, _CORNERS[b])
            crossed = (first < 0) != (second < 0)
            share = np.where(crossed, first / np.where(crossed, first - second, 1.0), 0.0)
            total += crossed[..., None] * (_CORNERS[a] + share[..., None] * (_CORNERS[b] - _CORNERS[a]))
            count += crossed
    number = np.full(cells, -1, np.int64)
    used = count > 0
    number[used] = np.arange(int(used.sum()))
    vertices = origin + pitch * (np.argwhere(used) + total[used] / count[used][:, None])
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
