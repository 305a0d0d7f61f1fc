"""How contacts are drawn: a point each, coloured by its slip mode, and an arrow along its impulse.

An impulse is that on body a since the frame before; an arrow's length is proportional to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STICKING_RGB = (0, 114, 240)
SLIDING_RGB = (255, 126, 0)
"""Two colours that differ for colour-blind eyes, too."""


@dataclass(frozen=True, eq=False)
class ContactMarks:
    """The contacts of one frame, N of them, world frame.

    Attributes:
        points_m: Contact points [m], shape (N, 3).
        tips_m: Where the arrows of their impulses end [m], shape (N, 3).
        sliding: Whether the friction is at its limit, shape (N,).
    """

    points_m: Array
    tips_m: Array
    sliding: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def colors(self) -> NDArray[np.uint8]:
        """RGB by slip mode, shape (N, 3)."""
        return np.where(self.sliding[:, None], SLIDING_RGB, STICKING_RGB).astype(np.uint8)

    @property
    def segments_m(self) -> Array:
        """The arrows, from contact point to tip [m], shape (N, 2, 3)."""
        return np.stack([self.points_m, self.tips_m], axis=1).astype(np.float64)


def contact_marks(contacts: Mapping[str, NDArray[np.generic]], arrow_m_per_n_s: float) -> ContactMarks:
    """Return the marks of one frame's contacts, as :meth:`cgwm.datasets.loader.RolloutReader.contacts` gives them.

    Args:
        contacts: pos_world [m] (N, 3), impulse_world [N s] (N, 3), mode (N,), 1 = sliding.
        arrow_m_per_n_s: Length of an arrow for each unit of impulse.
    """
    points = np.asarray(contacts["pos_world"], np.float64).reshape(-1, 3)
    impulses = np.asarray(contacts["impulse_world"], np.float64).reshape(-1, 3)
    return ContactMarks(points, points + arrow_m_per_n_s * impulses, np.asarray(contacts["mode"]) == 1)


def arrow_scale(largest_impulse_n_s: float, longest_m: float) -> float:
    """Return the length of an arrow for each unit of impulse [m/(N s)], so that the largest one has `longest_m`."""
    return longest_m / largest_impulse_n_s if largest_impulse_n_s > 0 else 0.0
