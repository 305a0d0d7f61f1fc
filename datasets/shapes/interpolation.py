"""Linear interpolation of several numbers at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def by_column(
    at: NDArray[np.floating] | float,
    knots: NDArray[np.float64],
    values: NDArray[np.floating],
    outside: float | None = None,
) -> NDArray[np.float64]:
    """Return what values (K, C) at increasing knots (K,) are between them, each column linearly.

    Args:
        at: Places (...) of the same unit as the knots.
        knots: Shape (K,).
        values: Shape (K, C).
        outside: Value before the first knot and after the last; None: those there hold on.

    Returns:
        Shape (..., C).
    """
    return np.stack([np.interp(at, knots, column, left=outside, right=outside) for column in values.T], -1)
