"""States of a world, one after the other, as a motion for the viewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...datasets.rollouts.replay import Replay
from ..physics.world import State
from .horizon import Array


def replay_of(
    times_s: Array, states: Sequence[State], contact_m: Array | None = None, impulse_n_s: Array | None = None
) -> Replay:
    """Return states (T) at times as a motion, with a contact and its impulse, each (T, 3); without them, with none."""
    none = np.zeros((len(states), 3))
    return Replay(
        times_s=times_s,
        position_m=np.stack([state.position_m[0].numpy() for state in states]),
        quat_wxyz=np.stack([state.quat_wxyz[0].numpy() for state in states]),
        contact_m=none if contact_m is None else contact_m,
        impulse_n_s=none if impulse_n_s is None else impulse_n_s,
    )
