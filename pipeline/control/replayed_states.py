"""States of a world, one after the other, as a motion for the viewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...datasets.rollouts.replay import Replay
from ..physics.state import State
from .horizon import Array


def replay_of(
    times_s: Array, states: Sequence[State], contact_m: Array | None = None, impulse_n_s: Array | None = None
) -> Replay:
    """Return states (T) at times as a motion, with a contact and its impulse, each (T, 3), where they are recorded."""
    return Replay(
        times_s=times_s,
        position_m=np.stack([state.position_m[0].numpy() for state in states]),
        quat_wxyz=np.stack([state.quat_wxyz[0].numpy() for state in states]),
        contact_m=contact_m,
        impulse_n_s=impulse_n_s,
    )
