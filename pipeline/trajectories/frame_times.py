"""Times of frames: a regular clock where stated times scatter about one."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode, Track
from .thresholds import TRACK_THRESHOLDS
from .track_noise import WINDOW, polynomial_residuals, spread

Array = NDArray[np.float64]
LIMITS = TRACK_THRESHOLDS.track_noise

IN_PHASE, NEAR = 200, (0.8, 1.25)
"""Number of frames from which the rate of a clock is found, and the rates that are tried, in usual ones."""
MOST_DOUBLINGS = 40
"""Maximum number of times that the frames from which it is known are doubled."""


def with_regular_times(episodes: Sequence[Episode], bodies: Collection[str]) -> tuple[list[Episode], tuple[str, ...]]:
    """Return episodes at the times of a regular clock where the motion follows it better than the times stated.

    Times of arrival, and times rounded to milliseconds, scatter about those of the exposures: an error of the position
    along the velocity, which reaches many times that of the tracking.

    Args:
        episodes: The episodes.
        bodies: Names of the bodies whose motion decides.

    Returns:
        The episodes, and a warning where their times are others now.
    """
    clocks = [{body: _clock(t.time_s) for body, t in tracks.items() if body in bodies} for _, tracks in episodes]
    every = [tracks[body] for (_, tracks), own in zip(episodes, clocks, strict=True) for body in own]
    found = [clock for own in clocks for clock in own.values() if clock is not None]
    if not every or len(found) < len(every):
        return list(episodes), ()
    pairs = [(track.time_s, clock) for track, clock in zip(every, found, strict=True)]
    jitter_s = float(np.sqrt(np.mean(np.concatenate([stated - clock for stated, clock in pairs]) ** 2)))
    step_s = float(np.median(np.concatenate([np.diff(clock) for _, clock in pairs])))
    if jitter_s < LIMITS.least_jitter * step_s:
        return list(episodes), ()
    errors = [_fast_errors(track, times) for track, pair in zip(every, pairs, strict=True) for times in pair]
    stated, regular = spread(errors[::2]), spread(errors[1::2])
    if not regular < LIMITS.regular_times * stated:
        return list(episodes), ()
    warning = (
        f"the times of the frames scatter by {1e3 * jitter_s:.2g} ms about a regular clock of {1 / step_s:.4g} Hz, and "
        f"fast motion follows the clock {stated / regular:.1f} times better: its times are used. Record the times of "
        "the exposures, or write frame number / frame rate as time_s."
    )
    moved = [Episode(name, _at_clock(tracks, own)) for (name, tracks), own in zip(episodes, clocks, strict=True)]
    return moved, (warning,)


def episodes_at_clock(
    capture: Capture, names: Sequence[str], bodies: Collection[str]
) -> tuple[list[Episode], tuple[str, ...]]:
    """Return episodes of a capture as :func:`with_regular_times` does, by name."""
    return with_regular_times([Episode(name, capture.tracks(name)) for name in names], bodies)


def _at_clock(tracks: Mapping[str, Track], clocks: Mapping[str, Array | None]) -> dict[str, Track]:
    """Return tracks with the times of the clocks of some bodies, which others that were recorded with them get, too.

    What has times of its own, as a robot that logs its commands, keeps them.
    """
    found = dict(tracks)
    for body, track in tracks.items():
        clock = next((c for other, c in clocks.items() if np.array_equal(tracks[other].time_s, track.time_s)), None)
        found[body] = track if clock is None else replace(track, time_s=clock)
    return found


def _clock(time_s: Array) -> Array | None:
    """Return the times (T,) [s] of a regular clock, with frames left out, nearest to given ones; None without one.

    Its rate is the one at which the first frames are most in phase: of single steps, a late frame makes one too long
    and the next too short, and rounding each to whole frames would miscount them. The fit is then extended.
    """
    if len(time_s) <= WINDOW:
        return None
    known = min(len(time_s), IN_PHASE)
    some, usual_s = time_s[:known], float(np.median(np.diff(time_s)))
    rates = np.arange(NEAR[0] / usual_s, NEAR[1] / usual_s, 0.25 / float(some[-1] - some[0]))
    phases = np.exp(2j * np.pi * rates[:, None] * (some - some[0])).sum(1)
    best = int(np.abs(phases).argmax())
    step, first = 1 / rates[best], some[0] + float(np.angle(phases[best])) / (2 * np.pi * rates[best])
    for _ in range(MOST_DOUBLINGS):
        frame = np.rint((time_s - first) / step)
        step, first = np.polyfit(frame[:known], time_s[:known], 1)
        if known == len(time_s):
            break
        known = min(2 * known, len(time_s))
    frame = np.rint((time_s - first) / step)
    clock = first + step * frame
    return clock if np.diff(frame).min() >= 1 else None


def _fast_errors(track: Track, times_s: np.ndarray) -> np.ndarray:
    """Return what parabolas leave of the positions (n,) [m] of a track in the faster half of its windows.

    Args:
        track: The track.
        times_s: Times of its frames (T,) [s].
    """
    rows = np.arange(0, len(times_s) - WINDOW + 1)[:, None] + np.arange(WINDOW)
    places = track.position_m[rows]
    moved = np.linalg.norm(places[:, -1] - places[:, 0], axis=1)
    fast = moved >= np.median(moved)
    t = times_s[rows] - times_s[rows].mean(1, keepdims=True)
    return polynomial_residuals(t[fast], places[fast], 2).ravel()
