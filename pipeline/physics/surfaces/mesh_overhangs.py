"""How far beside a triangle a point may be for which the distance to the mesh still has a minimum on its border.

Almost all triangles near a sphere are beside it, and a plane tells so in a tenth of the time of the nearest place.

Derived. Be p a point at the height b > 0 above the plane of a triangle (below it, turn the normal n) whose foot lies
beside it, d from the nearest place of the triangle, where the offset is o = b n + d. A minimum there needs o . w <= 0
for every way w along the mesh. On an edge, with the way w' into the other triangle and c = -w . w' of the two ways, it
is |d| <= b max(0, -n . w') / c. At a corner, for ways whose parts in the plane are at most an angle g apart, one of
these is within g / 2 of d, so that |d| <= b max(-n . w / |w in the plane|) / cos(g / 2). The overhang of a triangle is
the largest of these bounds over b. No foot is farther beyond any edge than it is from the nearest place.

At borders, and at edges as sharp as that of a groove of less than 90 degrees, nothing bounds d: such an edge is open. A
foot that is not beyond an open edge has d . e <= 0 at its corners, e the outward normal of the edge in the plane: there
e counts as one more way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SLACK = 1e-5
"""What is added to slopes: ten times the sine up to which a way along a mesh counts as leading no closer."""
STEEPEST = 0.2
"""Ways whose part along a triangle's plane is smaller tell nothing."""
MOST_WAYS = 24
"""Number of edges of a corner above which nothing is told."""
STEEP = 0.5
"""Overhang of an edge above which it counts as open."""
NONE = 1e30
"""Overhang where nothing is told: above 20 it is of no use."""


def overhangs(
    corners: Array, normals: Array, outward: Array, ways: tuple[Indices, Indices, Array], counting: NDArray[np.bool_]
) -> Array:
    """Return the overhangs of triangles above and below, and their open edges there as bits of a number, shape (F, 4).

    Args:
        corners: Corners of the triangles (F, 3, 3).
        normals: Their unit normals (F, 3).
        outward: Outward unit normals (F, 3, 3) of their edges within their planes.
        ways: First way of each feature (F, 7), number of its ways (F, 7), and all ways (W, 3).
        counting: Which features count for which triangle, shape (F, 7).
    """
    start, count, every = ways
    found = np.zeros((len(corners), 4))
    for side, up in enumerate((normals, -normals)):
        at_edges = _at_edges(up, start[:, 1:4], count[:, 1:4], every)
        open_ = at_edges > STEEP
        at_corners = _at_corners(corners, up, outward, open_, (start[:, 4:], count[:, 4:], every))
        bounds = np.concatenate((np.where(open_, 0.0, at_edges), at_corners), 1)
        largest = np.where(counting[:, 1:], bounds, 0.0).max(1)
        found[:, side] = np.where(largest < 20.0, largest, NONE)
        found[:, 2 + side] = open_ @ np.array([1, 2, 4])
    return found


def open_edges(normals: Array, start: Indices, count: Indices, ways: Array) -> NDArray[np.bool_]:
    """Return which edges (F, 3) are open above or below; arguments as of `overhangs`."""
    sides = (_at_edges(up, start[:, 1:4], count[:, 1:4], ways) for up in (normals, -normals))
    return np.maximum(*sides) > STEEP


def _at_edges(up: Array, start: Indices, count: Indices, ways: Array) -> Array:
    """Return the bounds (F, 3) at the edges of triangles whose normals are `up`."""
    one, other = ways[start], ways[np.minimum(start + 1, len(ways) - 1)]
    across = -(one * other).sum(-1)
    rise = np.minimum((one * up[:, None]).sum(-1), (other * up[:, None]).sum(-1))
    told = (count == 2) & (across > STEEPEST)
    return np.where(told, (np.maximum(-rise, 0.0) + SLACK) / np.maximum(across, STEEPEST), NONE)


def _at_corners(
    corners: Array, up: Array, outward: Array, open_: NDArray[np.bool_], ways: tuple[Indices, Indices, Array]
) -> Array:
    """Return the bounds (F, 3) at the corners of triangles whose normals are `up`."""
    start, count, every = ways
    number = np.arange(min(int(count.max()), MOST_WAYS))
    there = number < count[..., None]
    way = every[np.minimum(start[..., None] + number, len(every) - 1)]  # (F, 3, K, 3)
    # edge k begins at corner k
    way = np.concatenate((way, outward[:, :, None], np.roll(outward, 1, 1)[:, :, None]), 2)
    there = np.concatenate((there, open_[..., None], np.roll(open_, 1, 1)[..., None]), 2)
    rise = np.einsum("fcka,fa->fck", way, up)
    first = np.roll(corners, -1, 1) - corners
    first /= np.linalg.norm(first, axis=2, keepdims=True)
    second = np.cross(up[:, None], first)
    x, y = (np.einsum("fcka,fca->fck", way, axis) for axis in (first, second))
    flat = np.hypot(x, y)
    told = there & (flat > STEEPEST)
    slope = np.where(told, np.maximum(-rise, 0.0) / np.maximum(flat, STEEPEST), 0.0).max(-1)
    # the first side itself is a way at the angle 0, where those go that tell nothing
    angle = np.sort(np.where(told, np.arctan2(y, x), 0.0), -1)
    gaps = np.diff(angle, axis=-1, append=angle[..., :1] + 2 * np.pi)
    half = np.cos(0.5 * np.minimum(gaps.max(-1), np.pi))
    return np.where((half > 0.05) & (count <= MOST_WAYS), (slope + SLACK) / np.maximum(half, 0.05), NONE)
