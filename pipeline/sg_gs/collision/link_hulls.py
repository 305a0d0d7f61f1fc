"""Convex shapes of the links of a hand, as hulls of few balls.

A hand touches flat faces with flat faces: balls that fill a link leave gaps of millimetres between them, through which
an object on the palm sinks. The hull of few balls has none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ....datasets.robots import Articulation, LinkOfRobot
from ...geometry.directions import fibonacci_directions
from .link_spheres import mesh_of_part

Array = NDArray[np.float64]
Balls = tuple[Array, Array]
ROUNDING_M = 0.0003
"""Largest radius of the balls, by which corners are rounded [m]: fingers hold an object by their edges."""
_SHARE = 0.25
"""Largest radius in units of the smallest extent of a shape."""
_DIRECTIONS = 600
_OVER = 2.0
"""Largest way of a corner inwards, in units of the radius."""


def link_hulls(articulation: Articulation, corners: int) -> dict[str, list[Balls]]:
    """Return centres (n, 3) and radii (n,) [m] of the balls of each convex shape of a link, in its frame.

    Each part of a link is a shape: the common hull of several fills the hollows between them, in which an object lies.

    Args:
        articulation: The articulated body.
        corners: Largest number of balls of a shape.
    """
    return {
        link.name: [rounded_hull(mesh_of_part(part).vertices, corners) for part in link.geometry]
        for link in articulation.links
    }


def whole_hull(link: LinkOfRobot, corners: int) -> Balls:
    """Return centres (n, 3) and radii (n,) [m] of the balls whose hull is that of all parts of a link, in its frame."""
    return rounded_hull(np.concatenate([mesh_of_part(part).vertices for part in link.geometry]), corners)


def rounded_hull(points: Array, corners: int) -> Balls:
    """Return balls whose hull is that of points with rounded corners.

    Args:
        points: Points (n, 3) [m].
        corners: Largest number of balls.
    """
    vertices = points[ConvexHull(points).vertices]
    radius = min(ROUNDING_M, _SHARE * float(np.ptp(vertices, axis=0).min()))
    chosen = _supporting(vertices, corners)
    hull = ConvexHull(chosen)
    planes = np.unique(hull.equations.round(9), axis=0)
    centers = []
    for corner in chosen:
        normals = planes[np.abs(planes[:, :3] @ corner + planes[:, 3]) < 1e-6, :3]
        mean = normals.mean(0) / np.linalg.norm(normals.mean(0))
        centers.append(corner - radius * min(_OVER, 1 / max(float((normals @ mean).mean()), 1 / _OVER)) * mean)
    return np.array(centers), np.full(len(centers), radius)


def _supporting(vertices: Array, most: int) -> Array:
    """Return the vertices, at most `most`, whose hull loses least: each is the one that is lacked most."""
    if len(vertices) <= most:
        return vertices
    heights = vertices @ np.asarray(fibonacci_directions(_DIRECTIONS)).T
    wanted, chosen = heights.max(0), [int(heights[:, 0].argmax())]
    while len(chosen) < most:
        lacking = int((wanted - heights[chosen].max(0)).argmax())
        best = int(heights[:, lacking].argmax())
        if best in chosen:
            break
        chosen.append(best)
    return vertices[chosen]
