"""The omnibus test of all flights: whether any wrench is left, in windows of several lengths."""

from __future__ import annotations

from collections.abc import Sequence

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
    found = [omnibus(wrenches, scatter) for _, wrenches in windows]
    return min(found, key=lambda one: (one.p_value, -one.statistic), default=None)


def is_significant(found: Omnibus | None) -> bool:
    """Return whether a residual wrench exceeds the noise by both thresholds; False without flight."""
    return found is not None and found.statistic > LIMITS.omnibus_limit and found.p_value < LIMITS.omnibus_p
