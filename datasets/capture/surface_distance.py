"""Distance of tracked bodies from the fixed surfaces of a capture, by boxes around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...schemas.surfaces import Surface
from ..shapes.turns import matrix_of

Array = NDArray[np.float64]


def surface_distance(surfaces: Sequence[Surface], position_m: Array) -> Array:
    """Return a lower bound of the distance from each point to the nearest surface [m], 0 within its box, shape (T,).

    A mesh may be anywhere, since its file is not read here: its distance counts as 0.

    Args:
        surfaces: The surfaces.
        position_m: Points, world frame [m], shape (T, 3).
    """
    found = np.full(len(position_m), np.inf)
    for surface in surfaces:
        turn = matrix_of(np.asarray(surface.pose.quat_wxyz))
        local = (position_m - np.asarray(surface.pose.position_m)) @ turn
        found = np.minimum(found, _distance(surface, local))
    return found


def _distance(surface: Surface, local: Array) -> Array:
    """Return the distance of points (T, 3) in the frame of a surface from its box."""
    if surface.half_space is not None:
        return local[:, 2].clip(0.0)
    if surface.height_field is not None:
        half = 0.5 * np.asarray(surface.height_field.size_m)
        over = local[:, 2] - surface.height_field.height_m
        return np.linalg.norm(np.c_[np.abs(local[:, :2]) - half, over].clip(0.0), axis=1)
    if surface.box is not None:
        size = surface.box.half_extents_m
    elif surface.rectangle is not None:
        size = (*surface.rectangle.half_extents_m, 0.0)
    elif surface.cylinder is not None:
        size = (surface.cylinder.radius_m,) * 2 + (surface.cylinder.half_length_m,)
    else:
        return np.zeros(len(local))
    return np.linalg.norm((np.abs(local) - np.asarray(size)).clip(0.0), axis=1)
