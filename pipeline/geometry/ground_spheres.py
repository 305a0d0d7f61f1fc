"""Spheres that lie on the ground, and how a shadow that falls on them dims them; for numpy and torch alike."""

from __future__ import annotations

from typing import Any

import numpy as np

Values = Any
"""An array of numpy, or a tensor; results are of the same kind."""

THIN = 2.0
"""Spheres whose centres are within this many of their scales of the plane belong to the ground."""
NODES = np.sqrt(3) * np.array([-1.0, 0.0, 1.0])
"""Gauss-Hermite nodes along an axis, in scales of a sphere: its weight is seen at three by three of them."""
NODE_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6
"""Their weights."""


def on_plane(means: Values, normal: Values, offset_m: float, scales: Values, largest_m: float) -> Values:
    """Return which spheres (n,) lie on a plane and are no backdrop.

    Args:
        means: Centres [m], shape (n, 3).
        normal: Unit normal of the plane, shape (3,).
        offset_m: Its height along the normal [m].
        scales: Standard deviations of the spheres [m], shape (n,).
        largest_m: Largest scale of a sphere of the ground [m].
    """
    return (abs(means @ normal - offset_m) < THIN * scales) & (scales < largest_m)


def dimmed(cover: Values, factors: Values) -> Values:
    """Return the factors (..., 3) of colours in a shadow of factors (3,) that covers shares (...) of them."""
    return 1 - cover[..., None] * (1 - factors)
