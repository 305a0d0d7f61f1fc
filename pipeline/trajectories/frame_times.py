"""Times of frames: a regular clock where stated times scatter about one, and errors of times that are left.

A time that is wrong by e moves a body of velocity v by e v: its error lies along the motion and grows with the speed.
With independent errors of times of standard deviation s beside those of the tracking, of standard deviation q along
each axis, the covariance of a position is q^2 I + s^2 v v^T. Both are estimated from what cubics leave of short windows
of flight, along the motion and across it, by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.capture.tracks import Episode, Track
from .observations import Observations
from .segmentation import Segment
from .thresholds import TRACK_THRESHOLDS
from .track_noise import MAD_TO_STD, WINDOW, polynomial_residuals, spread

Array = NDArray[np.float64]
LIMITS = TRACK_THRESHOLDS.track_noise

IN_PHASE, NEAR = 200, (0.8, 1.25)
"""Number of frames from which the rate of a clock is found, and the rates that are tried, in usual ones."""
MOST_DOUBLINGS = 40
"""Maximum number of times that the frames from which it is known are doubled."""
CUBIC_FRAMES, DEGREE = 9, 3
"""Frames of a window of flight, and degree of the polynomial that follows it."""
TRIED_S = np.concatenate(([0.0], np.geomspace(1e-6, 5e-3, 75)))
"""Standard deviations of errors of times [s] that are tried."""
FACTORS = np.geomspace(0.4, 2.5, 45)
"""Standard deviations across the motion that are tried, in units of a robust one."""
BINS = 50
"""Number of groups of frames of nearly one speed, whose sums the likelihood needs."""
FAR = 5.0
"""Standard deviations from which a residual counts as a wrong measurement."""


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
    every = [track for _, tracks in episodes for name, track in tracks.items() if name in bodies]
    clocks = [_clock(track.time_s) for track in every]
    if not every or any(clock is None for clock in clocks):
        return list(episodes), ()
    pairs = [(track.time_s, clock) for track, clock in zip(every, clocks, strict=True) if clock is not None]
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
    return [Episode(name, _at_clock(tracks, bodies)) for name, tracks in episodes], (warning,)


def _at_clock(tracks: Mapping[str, Track], bodies: Collection[str]) -> dict[str, Track]:
    """Return tracks of which those of some bodies, and others that were recorded with them, have the times of a clock.

    What has times of its own, as a robot that logs its commands, keeps them.
    """
    clocks = [(track.time_s, _clock(track.time_s)) for body, track in tracks.items() if body in bodies]
    found = dict(tracks)
    for body, track in tracks.items():
        clock = next((clock for stated, clock in clocks if np.array_equal(stated, track.time_s)), None)
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


def time_errors(whole: Observations, flight: Sequence[Segment]) -> tuple[float, float]:
    """Return the standard deviation [s] of errors of the frames' times that flights show, 0 for none.

    Args:
        whole: The episodes (E).
        flight: Their flight segments.

    Returns:
        The standard deviation, and that of the tracking beside it [m].
    """
    parts = [part for item in flight for part in _flight_residuals(whole, item)]
    if sum(len(speed) for speed, _, _ in parts) < LIMITS.enough:
        return 0.0, 0.0
    speed, along, across = (np.concatenate(every) for every in zip(*parts, strict=True))
    time_s, std_m, evidence = _likeliest(speed, along, across)
    seen = evidence > LIMITS.sure_both and time_s * float(np.median(speed)) > LIMITS.seen_jitter * std_m
    return (time_s, std_m) if seen else (0.0, std_m)


def _flight_residuals(whole: Observations, item: Segment) -> Iterator[tuple[Array, Array, Array]]:
    """Yield speeds (n,) [m/s], residuals along the motion (n,) and across it (n, 2) [m] of windows of a flight."""
    for column in range(len(whole.free)):
        frames = torch.arange(item.first, item.last + 1)
        frames = frames[whole.seen[item.episode, frames, column] > 0]
        number = len(frames) // CUBIC_FRAMES
        if not number or float(whole.measured_axes[item.episode, column].min()) == 0:
            continue
        rows = frames[: number * CUBIC_FRAMES].reshape(number, CUBIC_FRAMES)
        t = whole.times_s[item.episode, rows].numpy().astype(np.float64)
        places = whole.position_m[item.episode, rows, column].numpy().astype(np.float64)
        t = t - t.mean(1, keepdims=True)
        left = polynomial_residuals(t, places, DEGREE)
        velocity = np.gradient(places - left / np.sqrt(CUBIC_FRAMES / (CUBIC_FRAMES - DEGREE - 1)), axis=1)
        velocity = velocity / np.gradient(t, axis=1)[..., None]
        speed = np.linalg.norm(velocity, axis=-1)
        forward = velocity / np.maximum(speed, 1e-12)[..., None]
        along = (left * forward).sum(-1)
        rest = left - along[..., None] * forward
        yield speed.ravel(), along.ravel(), np.linalg.norm(rest, axis=-1).ravel() / np.sqrt(2)


def _likeliest(speed: Array, along: Array, across: Array) -> tuple[float, float, float]:
    """Return the likeliest standard deviations of times [s] and of the tracking [m], and the evidence for the former.

    Args:
        speed: Speeds (n,) [m/s].
        along: Residuals along the motion (n,) [m].
        across: Root of the mean square of the two across it (n,) [m].

    Returns:
        Both, and twice the gain of the log-likelihood by errors of times.
    """
    rough = max(MAD_TO_STD * float(np.median(np.abs(across))), 1e-9)
    good = across < FAR * rough
    kept = (CUBIC_FRAMES - DEGREE - 1) / CUBIC_FRAMES  # degrees of freedom of a frame of a window
    for _ in range(2):
        tried = (rough * FACTORS)[:, None] ** 2, TRIED_S[None] ** 2
        loss = 2 * (good.sum() * np.log(tried[0]) + (across[good] ** 2).sum() / tried[0]) + 0 * tried[1]
        for some in np.array_split(np.flatnonzero(good)[np.argsort(speed[good])], BINS):  # of nearly one speed each
            if len(some):
                total = tried[0] + tried[1] * (speed[some] ** 2).mean()
                loss += len(some) * np.log(total) + (along[some] ** 2).sum() / total
        row, column = np.unravel_index(int(loss.argmin()), loss.shape)
        std_m, time_s = float(rough * FACTORS[row]), float(TRIED_S[column])
        good = (across < FAR * std_m) & (np.abs(along) < FAR * np.hypot(std_m, time_s * speed))
    return time_s, std_m, kept * float(loss[:, 0].min() - loss.min())
