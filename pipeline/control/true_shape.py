"""Whether the true body of a plant is about that of the model: in the same units, and in the same frame."""

from __future__ import annotations

import numpy as np

from ...schemas import InputDataError
from .horizon import Array

MOST_RATIO, MOST_AWAY = 2.0, 0.25
"""Largest ratio of the sizes of true body and model, and largest distance of their middles in units of that size."""


def box_of_balls(centers: Array, radii: Array) -> Array:
    """Return the smallest and largest coordinates (2, 3) of balls [m]."""
    return np.stack(((centers - radii[:, None]).min(0), (centers + radii[:, None]).max(0)))


def require_same_body(where: str, model: Array, true: Array) -> None:
    """Check that a true body has about the size and the place of the model's object.

    Args:
        where: What gives the true body, for messages.
        model: Smallest and largest coordinates of the model's object in its frame [m], shape (2, 3).
        true: Those of the true body in its frame [m], shape (2, 3).

    Raises:
        InputDataError: If it has not: in other units, or in a frame of its own.
    """
    ours, theirs = (float(np.linalg.norm(np.ptp(box, axis=0))) for box in (model, true))
    away = float(np.linalg.norm(model.mean(0) - true.mean(0)))
    if not 1 / MOST_RATIO < theirs / ours < MOST_RATIO:
        raise InputDataError(
            f"{where}: the true object measures {theirs:.3g} m, that of the model {ours:.3g} m.",
            "the object that the model has, in metres.",
            "scale it, or name that of this model.",
        )
    if away > MOST_AWAY * ours:
        raise InputDataError(
            f"{where}: the middle of the true object lies {away:.3g} m from that of the model's, in their frames.",
            f"up to {MOST_AWAY * ours:.3g} m: both have the same frame.",
            "move its shapes by what the frames differ.",
        )
