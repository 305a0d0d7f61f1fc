"""The colours of a scanned surface, looked up in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from cgwm.datasets.shapes.meshes import Mesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .distance import sample_surface
from .scans import Scan

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_PITCHES_M = (0.0007, 0.0014, 0.0028)
_SCAN_POINTS, _SURFACE_POINTS = 300_000, 400_000


@dataclass(frozen=True)
class ColourGrid:
    """Colours at the nodes of a grid; only those around a surface are known.

    Args:
        origin: Place of the first node [m], shape (3,).
        pitch: Distance of the nodes [m].
        node: Row in `colours` by node, int32 (x, y, z); row 0 belongs to nodes that no surface is near.
        colours: In [0, 1], shape (row, 3).
    """

    origin: Array
    pitch: float
    node: NDArray[np.int32]
    colours: Floats

    def sample(self, points: Floats) -> Floats:
        """Return colours at points (point, 3), linear between the nodes, shape (point, 3)."""
        place = (points - self.origin.astype(np.float32)) / np.float32(self.pitch)
        low = np.floor(place).astype(np.int32).clip(0, np.array(self.node.shape) - 2)
        share = (place - low).clip(0, 1)
        result = np.zeros((len(points), 3), np.float32)
        for corner in np.ndindex(2, 2, 2):
            weight = np.where(corner, share, 1 - share).prod(axis=1)
            result += weight[:, None] * self.colours[self.node[tuple((low + corner).T)]]
        return result


@dataclass(frozen=True)
class ScanPaint:
    """The colours of a scan's nearest point, coarser where one ray stands for more.

    Args:
        grids: From fine to coarse, each of twice the pitch of the one before.
    """

    grids: tuple[ColourGrid, ...]

    def albedo(self, points: Floats, normals: Floats, footprint: Floats) -> Floats:
        """See `Material`."""
        level = np.log2(np.maximum(footprint, 1e-9) / self.grids[0].pitch).clip(0, len(self.grids) - 1)
        lower = np.minimum(level.astype(np.int32), len(self.grids) - 2)
        blend = (level - lower).astype(np.float32)[:, None]
        result = np.empty((len(points), 3), np.float32)
        for index in np.unique(lower):
            chosen = np.flatnonzero(lower == index)
            fine, coarse = (self.grids[index + step].sample(points[chosen]) for step in (0, 1))
            result[chosen] = fine + blend[chosen] * (coarse - fine)
        return result


def make_scan_paint(scan: Scan) -> ScanPaint:
    """Return the colours of a scan around the surface of its solid."""
    points, colours = scan.colours(_SCAN_POINTS)
    surface = Mesh(scan.solid.vertices, scan.solid.faces)
    near, _, _ = sample_surface(surface, _SURFACE_POINTS, np.random.default_rng(1))
    return ScanPaint(tuple(_grid(points, colours, near, pitch) for pitch in _PITCHES_M))


def _grid(points: Array, colours: Floats, surface: Array, pitch: float) -> ColourGrid:
    """Make a grid around the `surface` points whose nodes have the mean colour of the scan's points about them."""
    origin = surface.min(axis=0) - 2 * pitch
    shape = np.ceil((surface.max(axis=0) - origin) / pitch).astype(int) + 3
    low = np.unique(np.floor((surface - origin) / pitch).astype(np.int64), axis=0)
    corners = (low[:, None] + np.array(list(np.ndindex(2, 2, 2)))).reshape(-1, 3)
    flat = np.unique(np.ravel_multi_index(tuple(corners.T), tuple(shape)))
    nodes = np.stack(np.unravel_index(flat, tuple(shape)), axis=1) * pitch + origin
    # Points of the scan in one cell become their mean first, so that a node sees all of what it stands for.
    _, cell, count = np.unique(
        np.floor((points - origin) / pitch).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    values = np.concatenate([points, colours], axis=1)
    means = np.stack([np.bincount(cell.ravel(), column) / count for column in values.T], axis=1)
    nearest = KDTree(means[:, :3]).query(nodes)[1]
    node = np.zeros(tuple(shape), np.int32)
    node.ravel()[flat] = np.arange(1, len(flat) + 1)
    table = np.concatenate([np.full((1, 3), 0.5), means[nearest, 3:]]).astype(np.float32)
    return ColourGrid(origin, pitch, node, table)
