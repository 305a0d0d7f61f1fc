"""The omnibus test of all flights: whether any wrench is left, in windows of several lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ...physics.world import World
from ...segments.flights.residual_wrench import Omnibus, ResidualWrenches, omnibus, residual_wrenches, sound_windows
from ...segments.prepare import Prepared
from ...segments.segments import Segments
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict


def flight_windows(prepared: Prepared, world: World) -> list[tuple[Segments, ResidualWrenches]]:
    """Cut the flights into windows of each length of the omnibus test and estimate residual wrenches of sound ones."""
    cut = [windows for longest_s in LIMITS.omnibus_s if (windows := prepared.pieces(world, longest_s)) is not None]
    return [sound_windows(windows, residual_wrenches(windows)) for windows in cut]


def worst_omnibus(windows: Sequence[tuple[Segments, ResidualWrenches]], scatter: float) -> Omnibus | None:
    """Return the omnibus statistic with the smallest p-value over all window lengths; None without flight."""
    found = [omnibus(wrenches, scatter, _noise_dof(segments)) for segments, wrenches in windows]
    return min(found, key=lambda one: (one.p_value, -one.statistic), default=None)


def _noise_dof(segments: Segments) -> float:
    """Return the degrees of freedom from which the size of correlated noise is known; inf where none is correlated.

    A process whose correlation falls to 1/e within a time has about one independent sample of its variance in this
    time: flights of some seconds know errors that last for tenths of a second to some tens of percent.
    """
    seen, times = segments.observations.seen.amax(-1) > 0, segments.observations.times_s
    span_s = times.masked_fill(~seen, -torch.inf).amax(1) - times.masked_fill(~seen, torch.inf).amin(1)
    total_s = float(span_s.clamp_min(0.0).nan_to_num(0.0, 0.0, 0.0).sum())
    return min((3 * total_s / one.time_s for one in segments.noise_model if one.share), default=math.inf)


def is_significant(found: Omnibus | None) -> bool:
    """Return whether a residual wrench exceeds the noise by both thresholds; False without flight."""
    return found is not None and found.statistic > LIMITS.omnibus_limit and found.p_value < LIMITS.omnibus_p
