"""The likeliest variance components of flights: white noise, a fast and a slow process, accelerations of their own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..trajectories.innovations import FALLS, CorrelatedNoise
from .flight_contrasts import FlightContrasts
from .restricted_likelihood import Components, RestrictedLikelihood, Scored
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.slow_errors

Array = NDArray[np.float64]

FASTEST_S, FAST_S, SLOW_S = 0.002, 0.06, (0.06, 1.0)
"""Shortest and longest time of the fast process [s], and the range of the slow one: a process of more than a second is
a curve in a flight, whose size and time cannot be told apart."""
STARTS_S = (0.1, 0.4)
"""Times of the slow process from which the likelihood is climbed [s]."""
LEAST_STD = 0.02
"""Smallest standard deviation of a component, in units of that of the tracks."""
STEPS = 30
"""Maximum number of steps of a climb."""
LONGEST, ENOUGH = 1.5, 0.01
"""Longest step of a coordinate, and expected gain of the log-likelihood at which a climb ends."""
LEAST_INFORMATION = 0.05
"""Information of a coordinate that is damped at least: that of a component without any influence is 0."""


def variance_components(
    contrasts: FlightContrasts, known: CorrelatedNoise, level: tuple[int, ...]
) -> tuple[CorrelatedNoise, CorrelatedNoise, float, float]:
    """Return the likeliest components, those without accelerations of the flights' own, and twice the gains by both.

    Components without evidence are left out. Where nothing is left and windows show no correlation, neither do flights.
    """
    likelihood = RestrictedLikelihood(contrasts, level)
    fast = [_climbed(likelihood, [_coded(known)], (), order) for order in FALLS]
    plain, without = max(fast, key=lambda one: one[1])
    starts = [[*_coded(one), math.log(max(one.size, 0.3)), math.log(t)] for one, _ in fast for t in STARTS_S]
    slow, with_slow = _climbed(likelihood, starts, ("slow",), plain.order)
    gain = 2 * (with_slow - without)
    best, reached, sway_gain = (slow, with_slow, 0.0) if gain > LIMITS.evidence else (plain, without, 0.0)
    usual = plain if known.share else known
    still = best if best.slow else usual
    if level:
        span = float((contrasts.times_s[:, -1] - contrasts.times_s[:, 0]).median())
        kinds = ("slow", "sway") if best.slow else ("sway",)
        start = [*_coded(best), *([math.log(best.slow), math.log(best.slow_time_s)] if best.slow else [])]
        sway = math.log(4 * max(best.slow, best.size) / span**2)
        swaying, higher = _climbed(likelihood, [[*start, sway + more] for more in (0.0, 1.5)], kinds, best.order)
        sway_gain = 2 * (higher - reached)
        if sway_gain > LIMITS.sway_evidence:
            best = swaying
    gain = gain if best.slow else 0.0
    return (best if best.slow or best.sway else usual), still, gain, sway_gain if best.sway else 0.0


def _coded(noise: CorrelatedNoise) -> list[float]:
    """Return the coordinates of white and fast noise: logarithms of two standard deviations and a time."""
    white = noise.size * math.sqrt(max(1 - noise.share, 0.0))
    fast = noise.size * math.sqrt(max(noise.share, 0.0))
    return [
        math.log(max(white, 0.1)),
        math.log(max(fast, 0.1)),
        math.log(min(max(noise.time_s, 2 * FASTEST_S), FAST_S / 1.5)),
    ]


def _climbed(
    likelihood: RestrictedLikelihood, starts: Sequence[Sequence[float]], kinds: Sequence[str], order: float
) -> tuple[CorrelatedNoise, float]:
    """Return the likeliest noise model with components of some kinds, and its restricted log-likelihood.

    Scoring with average information, damped; it is no least-squares problem, and is not of `optimization`.
    """
    std, times = (math.log(LEAST_STD), 6.0), (math.log(FASTEST_S), math.log(FAST_S))
    bounds = [std, std, times]
    if "slow" in kinds:
        bounds += [(-9.0, 12.0), (math.log(SLOW_S[0]), math.log(SLOW_S[1]))]
    if "sway" in kinds:
        bounds.append((-20.0, 20.0))
    low, high = np.transpose(bounds)
    ends = [_climb(lambda z: _scored(likelihood, z, kinds, order), np.array(start), low, high) for start in starts]
    best, value = max(ends, key=lambda end: end[1])
    return Components.of(best, kinds, order).noise(likelihood.level), value


def _scored(likelihood: RestrictedLikelihood, z: Array, kinds: Sequence[str], order: float) -> Scored:
    """Return the likelihood at coordinates; none where a covariance is singular to rounding, as of no measurement."""
    try:
        return likelihood.at(Components.of(z, kinds, order))
    except RuntimeError:
        return Scored(-np.inf, np.zeros(len(z)), np.eye(len(z)))


def _climb(scored: Callable[[Array], Scored], start: Array, low: Array, high: Array) -> tuple[Array, float]:
    """Return the coordinates of the largest likelihood within bounds, and its logarithm."""
    z = start.clip(low, high)
    at, damping = scored(z), 0.1
    for _ in range(STEPS):
        free = ((z > low) | (at.slope > 0)) & ((z < high) | (at.slope < 0))
        slope = np.where(free, at.slope, 0.0)
        matrix = at.information * np.outer(free, free)
        own = np.maximum(np.diag(matrix), LEAST_INFORMATION)
        step = np.linalg.solve(matrix + np.diag(damping * own + np.where(free, 1e-9, 1.0)), slope)
        step *= min(1.0, LONGEST / max(np.abs(step).max(), 1e-9))
        if 0.5 * float(slope @ step) < ENOUGH:
            break
        moved = (z + step).clip(low, high)
        there = scored(moved)
        if there.value > at.value:
            z, at, damping = moved, there, damping / 5
        else:
            damping = max(5 * damping, 1e-3)
    return z, at.value
