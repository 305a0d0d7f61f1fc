"""Colours of spheres at the edges of a body that none of its sides has.

A sphere at an edge shows on two sides at once. In the photos one of them is bright and the other dark, and the fit of
colours mixes bright and dark spheres there so that each side sees its own. In another light they stand out as a fringe
of dark and bright points. Their colours are kept within those that their own side has beside the edge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ....datasets.shapes.ply import Splats
from ...rendering.edge_light import Edges

NEIGHBOURS = 6
"""Spheres of the same side beside the edge with which one is compared."""
REACH = 2.0
"""Largest distance of a colour from the median of theirs, in standard deviations of theirs."""
LEAST_SPREAD = 0.02
"""Least standard deviation of theirs, of a side of one colour: that of the noise of photos."""


def even_edges(splats: Splats) -> Splats:
    """Return a body's spheres, those at its edges with colours that their own sides have.

    Args:
        splats: The spheres, with normals.
    """
    from scipy.spatial import KDTree

    means, normals = np.asarray(splats.means, float), np.asarray(splats.normals, float)
    numbers = (torch.as_tensor(values) for values in (means, np.asarray(splats.scales, float), normals))
    rows = Edges.of(*numbers).rows.numpy()
    beside = np.setdiff1d(np.arange(len(means)), rows)
    if len(rows) == 0 or len(beside) < NEIGHBOURS:
        return splats
    # a turn of the normal counts as much as a way across the body, so that neighbours are of the same side
    places = np.concatenate([means, np.ptp(means, axis=0).max() * normals], 1)
    near = KDTree(places[beside]).query(places[rows], k=NEIGHBOURS)[1]
    colors = np.array(splats.colors, float)
    around = colors[beside[near]]
    middle, spread = np.median(around, axis=1), np.maximum(around.std(1).mean(-1), LEAST_SPREAD)
    away = colors[rows] - middle
    share = REACH * spread / np.maximum(np.abs(away).mean(-1), 1e-9)
    colors[rows] = middle + away * np.minimum(share, 1.0)[:, None]
    return replace(splats, colors=colors)
