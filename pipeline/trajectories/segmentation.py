"""Frames that look like flight and are none: the body is above the ground, and yet it does not fall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..estimation.observations import Observations
from ..physics.world import World
from .cuts import Segment

MOST_LIFT = 0.5
"""Share of gravity: where so much of it does not act, something carries the body. No effect in the air is so strong."""
SURE_SIGMAS = 5.0


def carried_frames(world: World, whole: Observations, flight: Sequence[Segment], noise: tuple[float, float]) -> Tensor:
    """Return frames (E, T) of flight segments in which a body's acceleration is far from gravity.

    A ground that is not where it was said to be, a marker beside the body's middle or a hand make a body slide or rest
    above the ground. The acceleration is that of a parabola through the measured heights, with its standard error.

    Args:
        world: For gravity.
        whole: The episodes (E).
        flight: Segments that are clear of the ground.
        noise: Of the tracks (position [m], rotation [rad]).
    """
    found = torch.zeros_like(whole.seen[..., 0], dtype=torch.bool)
    gravity = world.gravity[0]
    strength = float(gravity.norm())
    if strength == 0:
        return found
    for item in flight:
        frames = slice(item.first, item.last + 1)
        for column in range(len(whole.free)):
            seen = whole.seen[item.episode, frames, column] > 0
            if int(seen.sum()) < 4:
                continue
            t = whole.times_s[item.episode, frames][seen].numpy()
            along = (whole.position_m[item.episode, frames, column][seen] @ gravity / strength).numpy()
            powers = np.vander(t - t.mean(), 3)
            solution = np.linalg.lstsq(powers, along, rcond=None)[0]
            error = 2 * noise[0] * float(np.sqrt(np.linalg.inv(powers.T @ powers)[0, 0]))
            off = abs(2 * float(solution[0]) - strength)
            if off > MOST_LIFT * strength and off > SURE_SIGMAS * error:
                found[item.episode, frames] = True
    return found
