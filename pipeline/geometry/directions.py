"""Evenly distributed directions, and axes about a direction."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def fibonacci_directions(count: int) -> NDArray[np.float64]:
    """Return `count` nearly evenly distributed unit vectors, shape (count, 3)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def upright_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return right-handed axes as rows (3, 3), the last one the unit vector `up` (3,)."""
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up]).astype(np.float64)
