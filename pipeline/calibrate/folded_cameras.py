"""Photos from the place of another photo: an object that looks alike from several sides folds its cameras.

What repeats when the object is turned matches perfectly, and no pair of photos contradicts a model in which the cameras
of the equal sides lie upon each other. They are then in pairs, or in threes or fours, far closer than any next one.
"""

from __future__ import annotations

import numpy as np

from .reconstruction import Array, SfmModel

_MOST_SIDES = 4
"""Most sides that are looked for."""
_CLOSE = 0.3
"""Distance to the photos of the equal sides, of that to the next photo, below which they are from the same place."""
_SHARE = 0.5
"""Share of photos with such others above which a warning is given."""
_LEAST_PLACES = 4
"""Least number of places: fewer have no next ones to compare with."""


def folded_sides(model: SfmModel, photos: list[str]) -> int:
    """Return from how many photos each place was taken, as the model has it, where most photos share theirs; else 1.

    Photos that follow each other by name do not count: they were taken in a burst.

    Args:
        model: The model.
        photos: Names of the photos in it, in their order.
    """
    centers = np.array([model.center(name) for name in photos]).reshape(-1, 3)
    sides = [many for many in range(2, _MOST_SIDES + 1) if len(photos) >= many * _LEAST_PLACES]
    return next((many for many in sides if _share(centers, many) > _SHARE), 1)


def _share(centers: Array, many: int) -> float:
    """Return the share of photos whose place is also that of `many` - 1 others, none before or behind them."""
    distances = np.linalg.norm(centers[:, None] - centers, axis=2)
    order = np.argsort(distances, axis=1, kind="stable")
    near = np.take_along_axis(distances, order, axis=1)
    others = np.abs(order[:, 1:many] - np.arange(len(centers))[:, None])
    return float(((near[:, many - 1] < _CLOSE * near[:, many]) & (others > 1).all(axis=1)).mean())
