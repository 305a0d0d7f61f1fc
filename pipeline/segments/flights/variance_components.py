"""The likeliest variance components of flights: white noise, a fast and a slow process, accelerations of their own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...optimization.least_squares import Policy, descend
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ...trajectories.innovations import FALLS, CorrelatedNoise
from ..thresholds import SEGMENT_THRESHOLDS
from .contrasts import FlightContrasts
from .restricted_likelihood import Components, RestrictedLikelihood, Scored

LIMITS = SEGMENT_THRESHOLDS.slow_errors

Array = NDArray[np.float64]

FASTEST_S, FAST_S, SLOW_S = 0.002, 0.06, (0.06, 1.0)
"""Shortest and longest time of the fast process [s], and the range of the slow one: a process of more than a second is
a curve in a flight, whose size and time cannot be told apart."""
STARTS_S = (0.1, 0.4)
"""Times of the slow process from which the likelihood is climbed [s]."""
LEAST_STD = 0.02
"""Smallest standard deviation of a component, in units of that of the tracks."""
WHITE_LOGS = (math.log(0.2), math.log(50.0))
"""Range of the logarithm of the standard deviation of independent errors alone, in units of that of the tracks."""
STEPS = 30
"""Maximum number of steps of a climb."""
LONGEST, ENOUGH = 1.5, 0.01
"""Longest step of a coordinate, and gain of the log-likelihood in a step at which a climb ends."""
LEAST_INFORMATION = 0.05
"""Information of a coordinate that is damped at least: that of a component without any influence is 0."""
POLICY = Policy(
    iterations=STEPS, attempts=6, damping=0.1, up=5.0, least_damping=2e-4, absolute=2 * ENOUGH, longest=LONGEST
)


def variance_components(
    contrasts: FlightContrasts, known: CorrelatedNoise, level: tuple[int, ...]
) -> tuple[CorrelatedNoise, CorrelatedNoise, float, float]:
    """Return the likeliest components, those without accelerations of the flights' own, and twice the gains by both.

    Components without evidence are left out, and a fast process for which neither windows nor flights speak.
    """
    likelihood = RestrictedLikelihood(contrasts, level)
    fast = [_climbed(likelihood, [_coded(known)], (), order) for order in FALLS]
    plain, without = max(fast, key=lambda one: one[1])
    starts = [[*_coded(one), math.log(max(one.size, 0.3)), math.log(t)] for one, _ in fast for t in STARTS_S]
    slow, with_slow = _climbed(likelihood, starts, ("slow",), plain.order)
    gain = 2 * (with_slow - without)
    best, reached, sway_gain = (slow, with_slow, 0.0) if gain > LIMITS.evidence else (plain, without, 0.0)
    usual = plain if known.share or 2 * (without - _white(likelihood)) > LIMITS.evidence else known
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


def _white(likelihood: RestrictedLikelihood) -> float:
    """Return the largest restricted log-likelihood of independent errors."""
    from scipy.optimize import minimize_scalar  # seldom needed, and dear to import

    def loss(log_std: float) -> float:
        sizes = Components(white=math.exp(2 * log_std), fast=0.0, time_s=1.0, order=0.5)
        return -likelihood.at(sizes).value

    found: Any = minimize_scalar(loss, bounds=WHITE_LOGS, method="bounded", options={"xatol": 0.02})
    return -float(found.fun)


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

    Damped scoring with average information, whose steps are those of a least-squares problem.
    """
    std, times = (math.log(LEAST_STD), 6.0), (math.log(FASTEST_S), math.log(FAST_S))
    bounds = [std, std, times]
    if "slow" in kinds:
        bounds += [(-9.0, 12.0), (math.log(SLOW_S[0]), math.log(SLOW_S[1]))]
    if "sway" in kinds:
        bounds.append((-20.0, 20.0))
    low, high = np.transpose(bounds)
    best, value = _climb(lambda z: _scored(likelihood, z, kinds, order), np.array(starts), low, high)
    return Components.of(best, kinds, order).noise(likelihood.level), value


def _scored(likelihood: RestrictedLikelihood, z: Array, kinds: Sequence[str], order: float) -> Scored:
    """Return the likelihood at coordinates; none where a covariance is singular to rounding, as of no measurement."""
    try:
        return likelihood.at(Components.of(z, kinds, order))
    except RuntimeError:
        return Scored(-np.inf, np.zeros(len(z)), np.eye(len(z)))


def _climb(scored: Callable[[Array], Scored], starts: Array, low: Array, high: Array) -> tuple[Array, float]:
    """Return the coordinates (k,) of the largest likelihood within bounds, and its logarithm, from starts (n, k)."""
    bounds = Box.within(torch.as_tensor(np.stack([low, high], 1)))
    problem = _Likelihood(scored, bounds.at(torch.zeros(len(starts), dtype=torch.long)))
    end = descend(problem, Point(values=problem.box.clamped(torch.as_tensor(starts))), POLICY)
    best = int(end.cost.argmin())
    return end.point.values[best].numpy(), -0.5 * float(end.cost[best])


class _Likelihood(Problem):
    """Starts (n), each a group without a state, whose cost is -2 log of the likelihood.

    Args:
        scored: The likelihood at coordinates (k,).
        box: Bounds of the coordinates, for each start.
    """

    derivatives_with_costs = True
    least_information = LEAST_INFORMATION

    def __init__(self, scored: Callable[[Array], Scored], box: Box) -> None:
        self._scored, self.box, self.owner = scored, box, torch.arange(len(box.low))

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return average information, slope and -2 log of the likelihood at points."""
        found = [self._scored(z.numpy()) for z in point.values[rows.owner]]
        information, slope = (np.array([getattr(one, name) for one in found]) for name in ("information", "slope"))
        cost = torch.tensor([-2 * one.value for one in found], dtype=torch.float64)
        return NormalEquations.of_parameters(torch.as_tensor(information), torch.as_tensor(slope), cost)
