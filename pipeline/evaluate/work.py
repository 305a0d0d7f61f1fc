"""The work of an evaluation, estimated from counts."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager

from ...datasets.capture.tracks import Episode
from ..physics.rollout_cost import durations, frame_count, rollout_part
from ..physics.world import World
from ..runtime.work_budget import Part, motion_doubt, within_budget
from ..trajectories.state_uncertainty import DAMPINGS, MAX_ITEMS
from .prediction import SAMPLES, STATE_FIT_ITERATIONS

LESS = "evaluate shorter episodes ([episodes] start_s and end_s in capture.toml), or a model with a longer step_s."
_STATE_SIZE = 12


def evaluation_parts(world: World, episodes: Sequence[Episode], state_fits: int) -> list[Part]:
    """Return the parts of the work of predicting episodes with a model.

    Args:
        world: The model's world.
        episodes: Names and tracks.
        state_fits: Maximum number of episodes whose state is fitted to all frames.
    """
    spans, frames = durations(episodes), frame_count(episodes)
    free = max(len(world.tracked), 1)
    each = STATE_FIT_ITERATIONS * (_STATE_SIZE * free + len(DAMPINGS))
    parts = [rollout_part("predictions", world, spans, 2 + SAMPLES[1], MAX_ITEMS, frames)]
    if state_fits:
        parts.append(rollout_part("state fits", world, spans[:state_fits], each, MAX_ITEMS, frames))
    return parts


def checked_work(world: World, episodes: Sequence[Episode], state_fits: int) -> AbstractContextManager[None]:
    """Return a context that refuses predictions that this machine cannot finish, see :func:`within_budget`."""
    parts = evaluation_parts(world, episodes, state_fits)
    return within_budget(parts, LESS, doubt=motion_doubt(durations(episodes)))
