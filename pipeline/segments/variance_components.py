"""The likeliest variance components of flights: white noise, a fast and a slow process, accelerations of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..trajectories.innovations import FALLS, CorrelatedNoise
from .flight_contrasts import Components, FlightContrasts
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
STEPS = 40
"""Maximum number of steps of a climb."""


def variance_components(
    contrasts: FlightContrasts, known: CorrelatedNoise, level: tuple[int, ...]
) -> tuple[CorrelatedNoise, CorrelatedNoise, float, float]:
    """Return the likeliest components, those without accelerations of the flights' own, and twice the gains by both.

    Components without evidence are left out. Where nothing is left and windows show no correlation, neither do flights.
    """
    fast = [_climbed(contrasts, [_coded(known)], (), level, order) for order in FALLS]
    plain, without = max(fast, key=lambda one: one[1])
    starts = [[*_coded(one), np.log(max(one.size, 0.3)), np.log(t)] for one, _ in fast for t in STARTS_S]
    slow, with_slow = _climbed(contrasts, starts, ("slow",), level, plain.order)
    gain = 2 * (with_slow - without)
    best, reached, sway_gain = (slow, with_slow, 0.0) if gain > LIMITS.evidence else (plain, without, 0.0)
    usual = plain if known.share else known
    still = best if best.slow else usual
    if level:
        span = float((contrasts.times_s[:, -1] - contrasts.times_s[:, 0]).median())
        kinds = ("slow", "sway") if best.slow else ("sway",)
        start = [*_coded(best), *([np.log(best.slow), np.log(best.slow_time_s)] if best.slow else [])]
        sway = np.log(4 * max(best.slow, best.size) / span**2)
        swaying, higher = _climbed(contrasts, [[*start, sway + more] for more in (0.0, 1.5)], kinds, level, best.order)
        sway_gain = 2 * (higher - reached)
        if sway_gain > LIMITS.sway_evidence:
            best = swaying
    gain = gain if best.slow else 0.0
    return (best if best.slow or best.sway else usual), still, gain, sway_gain if best.sway else 0.0


def _coded(noise: CorrelatedNoise) -> list[float]:
    """Return the coordinates of white and fast noise: logarithms of two standard deviations and a time."""
    white = noise.size * np.sqrt(max(1 - noise.share, 0.0))
    fast = noise.size * np.sqrt(max(noise.share, 0.0))
    return [np.log(max(white, 0.1)), np.log(max(fast, 0.1)), np.log(np.clip(noise.time_s, 2 * FASTEST_S, FAST_S / 1.5))]


def _climbed(
    contrasts: FlightContrasts,
    starts: Sequence[Sequence[float]],
    kinds: Sequence[str],
    level: tuple[int, ...],
    order: float,
) -> tuple[CorrelatedNoise, float]:
    """Return the likeliest noise model with components of some kinds, and its restricted log-likelihood."""
    std, times = (np.log(LEAST_STD), 6.0), (np.log(FASTEST_S), np.log(FAST_S))
    bounds = [std, std, times]
    if "slow" in kinds:
        bounds += [(-9.0, 12.0), (np.log(SLOW_S[0]), np.log(SLOW_S[1]))]
    if "sway" in kinds:
        bounds.append((-20.0, 20.0))

    def cost(z: Array) -> tuple[float, Array]:
        at = torch.tensor(z, dtype=torch.float64, requires_grad=True)
        try:
            value = -contrasts.likelihood(Components.of(at, kinds, order), level)
        except RuntimeError:  # a covariance that is singular to rounding is not one of measurements
            return 1e12, np.zeros(len(z))
        (slope,) = torch.autograd.grad(value, at)
        return float(value.detach()), slope.numpy().astype(np.float64)

    from scipy.optimize import minimize

    options = {"maxiter": STEPS, "ftol": 1e-7, "gtol": 0.02, "maxls": 12}
    ends = [
        minimize(
            cost, np.clip(start, *np.transpose(bounds)), jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        for start in starts
    ]
    best = min(ends, key=lambda end: end.fun)
    return Components.of(torch.tensor(best.x), kinds, order).noise(level), -float(best.fun)
