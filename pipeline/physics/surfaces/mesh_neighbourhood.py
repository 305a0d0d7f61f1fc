"""Which triangles of a mesh a sphere may touch, by the cell of a grid in which its centre is.

Around a point near a mesh there are many triangles within reach, and nearly all of them are beside it (see
`mesh_overhangs.py`): the few that are not are found once for all points of a cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .mesh_overhangs import SLACK
from .mesh_topology import Topology

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CELLS = 1 << 20
"""Largest number of cells."""
PAIRS = 3_000_000
"""Largest number of cells and triangles whose boxes overlap, and number of them for each triangle that is allowed."""
PAIRS_EACH = 30
_CHUNK = 200_000
"""Number of triangles and cells that are compared at once."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Neighbourhood:
    """A grid of centres of spheres, in the frame of the surface."""

    reach_m: float
    """How far from the centre of a sphere, at most, its triangles are told."""
    low: Array
    """Lowest corner of the grid [m], shape (3,)."""
    cell_m: float
    """Side of a cell [m]."""
    cells: Indices
    """Numbers of cells along the axes, shape (3,)."""
    starts: Indices
    """First entry of each cell, shape (cells + 1,)."""
    triangles: Indices
    """Triangles by cell."""

    @staticmethod
    def of(topology: Topology, reach_m: float) -> Neighbourhood:
        """Find them for the triangles of a mesh."""
        prisms = topology.prisms
        overhang, wide = prisms[:, 12:14].max(1), (prisms[:, 14:] > 0).any(1)
        wide |= overhang > 1.0
        pad = np.where(wide, 1.0, overhang)[:, None] + SLACK
        lift = np.where(wide[:, None], 0.0, np.abs(prisms[:, :3]))
        low = topology.corners.min(1) - reach_m * (pad + lift)
        high = topology.corners.max(1) + reach_m * (pad + lift)
        origin, extent = low.min(0), np.ptp(np.concatenate((low, high)), axis=0)
        cell_m = max(0.25 * reach_m, float(np.cbrt(extent.prod() / CELLS)))
        while True:
            first, last = (np.floor((x - origin) / cell_m).astype(np.int64) for x in (low, high))
            spans = last - first + 1
            sizes = spans.prod(1)
            if sizes.sum() <= max(PAIRS, PAIRS_EACH * len(sizes)):
                break
            cell_m *= 1.25
        cells = last.max(0) + 1
        found = [
            _kept(topology, part, first, spans, sizes, origin=origin, cell_m=cell_m, reach_m=reach_m)
            for part in np.array_split(np.arange(len(sizes)), max(1, int(sizes.sum()) // _CHUNK))
        ]
        triangle, place = (np.concatenate(parts) for parts in zip(*found, strict=True))
        flat = (place[:, 0] * cells[1] + place[:, 1]) * cells[2] + place[:, 2]
        order = np.argsort(flat, kind="stable")
        starts = np.concatenate(([0], np.cumsum(np.bincount(flat, minlength=int(cells.prod())))))
        return Neighbourhood(
            reach_m=reach_m, low=origin, cell_m=cell_m, cells=cells, starts=starts, triangles=triangle[order]
        )

    def numbers(self) -> Array:
        """Return the numbers that the kernel reads."""
        return np.concatenate((self.low, [self.cell_m, self.reach_m]))


def _kept(
    topology: Topology,
    part: Indices,
    first: Indices,
    spans: Indices,
    sizes: Indices,
    *,
    origin: Array,
    cell_m: float,
    reach_m: float,
) -> tuple[Indices, Indices]:
    """Return triangles (N,) of a part and cells (N, 3) of whose points they are not beside."""
    half, slack = 0.5 * cell_m, SLACK * reach_m
    row = np.repeat(np.arange(len(part)), sizes[part])
    within = np.arange(len(row)) - (np.cumsum(sizes[part]) - sizes[part])[row]
    _, wide, tall = spans[part].T[:, row]
    place = np.stack((within // (wide * tall), within // tall % wide, within % tall), 1) + first[part[row]]
    # the planes first: most cells of a box about a tilted triangle are far from its plane
    normal, corner = topology.prisms[part, :3], topology.corners[part, 0]
    lift = ((origin + half - corner) * normal).sum(1)
    height = cell_m * (place * normal[row]).sum(1) + lift[row]
    margin = half * np.abs(normal).sum(1)[row]
    near = abs(height) - margin < reach_m
    triangle, place, height, margin = part[row[near]], place[near], height[near], margin[near]
    prism, corners = topology.prisms[triangle], topology.corners[triangle]
    arm = origin + (place + 0.5) * cell_m - corners[:, 0]
    above, below = height + margin >= 0, height - margin <= 0
    overhang = np.maximum(np.where(above, prism[:, 12], 0.0), np.where(below, prism[:, 13], 0.0))
    bad = np.where(above, prism[:, 14], 0).astype(np.int64) | np.where(below, prism[:, 15], 0).astype(np.int64)
    most = overhang * np.minimum(abs(height) + margin, reach_m) + slack
    beyond, inside = np.zeros(len(arm), np.bool_), np.ones(len(arm), np.bool_)
    for side in range(3):
        out, margin = _along(arm - (corners[:, side] - corners[:, 0]), prism[:, 3 + 3 * side : 6 + 3 * side], half)
        told = (bad >> side & 1) == 0
        beyond |= told & (out - margin > most)
        inside &= told | (out + margin < -slack)
    kept = ~(beyond & inside)
    return triangle[kept], place[kept]


def _along(arm: Array, direction: Array, half: float) -> tuple[Array, Array]:
    """Return how far the middles of boxes are along directions (N,), and by how much their points differ from that."""
    return (arm * direction).sum(1), half * np.abs(direction).sum(1)
