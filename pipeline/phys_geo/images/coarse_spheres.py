"""Coarse visual spheres for small images: the spheres in each cell of a grid are merged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ....datasets.models.model import Model
from ....datasets.shapes.ply import Splats

CELLS_PER_RADIUS = 4.0
"""Mean radius of the body over the side of a cell, which is then finer than a pixel of the small images."""


def coarse_model(model: Model) -> Model:
    """Return the model with fewer visual spheres in its bodies, for the search on small images."""
    bodies = {}
    for name, splats in model.body_splats.items():
        radius = float(np.linalg.norm(splats.means - splats.means.mean(0), axis=1).mean())
        bodies[name] = merged(splats, radius / CELLS_PER_RADIUS) if radius > 0 else splats
    return replace(model, body_splats=bodies)


def merged(splats: Splats, cell_m: float) -> Splats:
    """Merge the spheres of each cell of a grid into one with their mean position and colour and their total variance.

    The variance of a sphere is the mean variance of its parts plus a third of the mean squared distance of their
    centres from the mean (the isotropic Gaussian with the mixture's second moment; derived); weights are opacity times
    cross-section.

    Args:
        splats: The spheres.
        cell_m: Side of a cell [m].
    """
    cells = np.floor(splats.means / cell_m).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    count = int(cell.max()) + 1
    weight = splats.opacities * splats.scales**2
    total = np.bincount(cell, weight, count)

    def mean(values: np.ndarray) -> np.ndarray:
        columns = np.atleast_2d(values.T)
        return np.stack([np.bincount(cell, weight * column, count) / total for column in columns], -1)

    means = mean(splats.means)
    scatter = np.square(splats.means - means[cell]).sum(1)
    scales = np.sqrt(mean(splats.scales**2 + scatter / 3)[:, 0])
    return Splats(means, scales, mean(splats.opacities)[:, 0], mean(splats.colors))
