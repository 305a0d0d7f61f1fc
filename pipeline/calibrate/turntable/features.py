"""Features of photos of what turns before a camera that stands: which are of the surroundings, and contradict it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Mask = NDArray[np.bool_]

_ALIKE = 0.9
"""Least correlation of descriptors of one feature."""
_SAME_PLACE_PX = 1.5
"""Distance of features of two photos that are at the same place [px]."""
_STANDING_IN = 2
"""Least number of other photos in which a feature of the surroundings is found again: beside a slim object they are
seen in few. Outlines stand, too, and are no places on the object."""


def standing_features(places: Sequence[NDArray[Any]], descriptors: Sequence[NDArray[Any]]) -> list[Mask]:
    """Return which features of each photo are at the same place in many others, with a like descriptor.

    Args:
        places: Pixels of the features of each photo, shape (feature, 2).
        descriptors: Their descriptors, shape (feature, 128), each of the same length.

    Returns:
        Shape (feature,) for each photo.
    """
    trees = [KDTree(place) if len(place) else None for place in places]
    units = [_unit(np.asarray(one, np.float32)) for one in descriptors]
    found = []
    for k, place in enumerate(places):
        count = np.zeros(len(place), np.int64)
        for other, tree in enumerate(trees):
            if other == k or tree is None or not len(place):
                continue
            near = np.asarray(tree.query(place, distance_upper_bound=_SAME_PLACE_PX)[1])
            there = np.flatnonzero(near < len(places[other]))
            alike = np.einsum("ij,ij->i", units[k][there], units[other][near[there]]) > _ALIKE
            count[there[alike]] += 1
        found.append(count >= _STANDING_IN)
    return found


def _unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)
