"""A motion of the bodies of a model that was recorded elsewhere, as the viewer shows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Replay:
    """A motion of B bodies over T frames, with one contact at most."""

    times_s: Array
    """Times of the frames [s], shape (T,)."""
    position_m: Array
    """Body frame origins [m], world frame, shape (T, B, 3)."""
    quat_wxyz: Array
    """Orientations T_world_body, shape (T, B, 4)."""
    contact_m: Array | None = None
    """Place of the contact [m], shape (T, 3); None: contacts were not recorded."""
    impulse_n_s: Array | None = None
    """Its impulse since the frame before [N s], shape (T, 3); zero for no contact."""
