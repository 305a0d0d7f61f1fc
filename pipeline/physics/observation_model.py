"""Observation model: measurement effects that map a rollout to the poses as they are recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from .effects.effect import Poses
from .engine import rollout as rolled_out
from .rollout import Rollout, rows_of_times
from .state import State
from .world import World

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Track
    from .kinematic import Drive


def measure(world: World, state: State, times_s: Tensor, driven: Mapping[str, Track | Drive] | None = None) -> Rollout:
    """Simulate a world and return the poses as they would be measured at the recorded times.

    Args:
        world: The world; its effects may change times and poses.
        state: The true state at the true first time.
        times_s: Recorded times [s], shape (T,) or (B, T), or (b, T) of a batch in which b rows repeat.
        driven: The command of each driven body, in true time.

    Returns:
        The rollout at the recorded times; poses as measured, velocities true.

    Raises:
        InputDataError: See :func:`simulate`.
    """
    if any(active.effect.has("times") for active in world.effects):
        times_s = rows_of_times(times_s, len(state.position_m))
    return as_measured(world, rolled_out(world, state, true_times(world, times_s), driven), times_s)


def true_times(world: World, times_s: Tensor) -> Tensor:
    """Return the true times [s] of recorded times (T,) or (B, T), same or batched shape."""
    for active in world.effects:
        if active.effect.has("times"):
            times_s = active.effect.times(active.values, times_s if times_s.ndim == 2 else times_s[None])
    return times_s


def as_measured(world: World, rollout: Rollout, times_s: Tensor) -> Rollout:
    """Return a rollout over true times as it is recorded: at the recorded times, with measured poses."""
    poses = Poses(rollout.position_m, rollout.quat_wxyz, up=world.up)
    for active in world.effects:
        if active.effect.has("observe"):
            poses = active.effect.observe(active.values, poses)
    return replace(rollout, times_s=times_s, position_m=poses.position_m, quat_wxyz=poses.quat_wxyz)
