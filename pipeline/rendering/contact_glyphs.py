"""Contact glyphs: a point per contact, coloured by its slip mode, and an arrow along its impulse.

The impulse is that on body a since the previous frame; the length of the arrow is proportional to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STICKING_RGB = (0, 114, 240)
"""Colour of sticking contacts, distinct from that of sliding ones for colour-blind readers too."""
SLIDING_RGB = (255, 126, 0)
"""Colour of sliding contacts."""


@dataclass(frozen=True, eq=False)
class ContactMarks:
    """Glyphs of the N contacts of one frame, world frame."""

    points_m: Array
    """Contact points [m], shape (N, 3)."""
    tips_m: Array
    """Tips of the impulse arrows [m], shape (N, 3)."""
    sliding: NDArray[np.bool_]
    """Whether the friction is at its limit, shape (N,)."""

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def colors(self) -> NDArray[np.uint8]:
        """RGB colours by slip mode, shape (N, 3)."""
        return np.where(self.sliding[:, None], SLIDING_RGB, STICKING_RGB).astype(np.uint8)

    @property
    def segments_m(self) -> Array:
        """Arrows from contact point to tip, world frame [m], shape (N, 2, 3)."""
        return np.stack([self.points_m, self.tips_m], axis=1).astype(np.float64)


def contact_marks(contacts: Mapping[str, NDArray[np.generic]], arrow_m_per_n_s: float) -> ContactMarks:
    """Return the glyphs of one frame's contacts, given as by `RolloutReader.contacts` of `datasets.rollouts`.

    Args:
        contacts: pos_world [m] (N, 3), impulse_world [N s] (N, 3), mode (N,), 1 = sliding.
        arrow_m_per_n_s: Length of an arrow for each unit of impulse.
    """
    points = np.asarray(contacts["pos_world"], np.float64).reshape(-1, 3)
    impulses = np.asarray(contacts["impulse_world"], np.float64).reshape(-1, 3)
    return ContactMarks(points, points + arrow_m_per_n_s * impulses, np.asarray(contacts["mode"]) == 1)


def arrow_scale(largest_impulse_n_s: float, longest_m: float) -> float:
    """Return the length of an arrow per unit of impulse [m/(N s)] for which the largest one has `longest_m`."""
    return longest_m / largest_impulse_n_s if largest_impulse_n_s > 0 else 0.0
