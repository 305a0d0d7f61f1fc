"""Directions that are evenly spread."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def fibonacci_directions(count: int) -> NDArray[np.float64]:
    """Return `count` nearly evenly spread unit vectors, shape (count, 3)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
