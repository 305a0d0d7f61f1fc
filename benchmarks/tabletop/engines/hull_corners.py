"""Small spheres at the corners of an object's convex hull: all of it that a plane can touch."""

from __future__ import annotations

import numpy as np
from cgwm.datasets.synthetic.objects import SolidObject
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]

CORNER_RADIUS_M = 2e-4


def corner_spheres(solid: SolidObject) -> Array:
    """Return the centres (corner, 3) [m] of spheres of `CORNER_RADIUS_M` that lie inside the hull at its corners.

    Each corner is moved inwards along the mean of the normals of the faces that meet there.
    """
    hull = ConvexHull(solid.vertices)
    result = []
    for corner in hull.vertices:
        normals = np.unique(hull.equations[(hull.simplices == corner).any(1), :3].round(9), axis=0)
        # the sphere touches the faces, as nearly as one place can: least squares of n . shift = -radius
        shift = np.linalg.lstsq(normals, np.full(len(normals), -CORNER_RADIUS_M), rcond=None)[0]
        result.append(solid.vertices[corner] + shift)
    return np.asarray(result)
