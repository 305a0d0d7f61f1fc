"""The pieces of a plan in time: those of the plan before that still act, then those that are chosen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHORTEST = 0.25
"""Shortest piece in units of the distance of knots; a shorter one is joined with the next."""


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Targets of the joints, linear between times and constant after the last."""

    times_s: Array
    """Times [s], increasing, shape (M + 1,)."""
    values_m: Array
    """Targets [m], shape (M + 1, joints)."""

    def at(self, times_s: Array | float) -> Array:
        """Return the targets at times (...,) [s], shape (..., joints)."""
        times, values = self.times_s, self.values_m
        if len(times) == 1:
            return np.broadcast_to(values[0], (*np.shape(times_s), values.shape[1])).copy()
        at = np.clip(times_s, times[0], times[-1])
        index = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
        share = (at - times[index]) / (times[index + 1] - times[index])
        return values[index] + share[..., None] * (values[index + 1] - values[index])

    def speeds(self, times_s: Array) -> Array:
        """Return the mean speeds [m/s] between times (n + 1,), shape (n, joints)."""
        return np.diff(self.at(times_s), axis=0) / np.diff(times_s)[:, None]


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What the model predicts of a plan."""

    times_s: Array
    """Times [s], shape (M + 1,)."""
    position_m: Array
    """Position of the object [m], shape (M + 1, 3)."""
    quat_wxyz: Array
    """Its orientation, body to world, shape (M + 1, 4)."""


@dataclass(frozen=True, kw_only=True)
class Horizon:
    """The time of a plan, cut into pieces whose ends lie at multiples of a constant, so that plans can be shifted."""

    times_s: Array
    """Ends of all pieces: state, pieces that are given, pieces that are chosen [s], shape (L + N + 1,)."""
    given: int
    """Number L of pieces during which the plan before acts."""

    @staticmethod
    def of(state_s: float, acts_s: float, length_s: float, knots: int) -> Horizon:
        """Return the pieces of a plan.

        Args:
            state_s: Time of the state that it starts from [s].
            acts_s: Time from which it acts, not earlier [s].
            length_s: Its length [s].
            knots: Number N of pieces that are chosen.
        """
        knot = length_s / knots
        first = math.floor(acts_s / knot + 1e-9) + 1
        if first * knot - acts_s < SHORTEST * knot:
            first += 1
        chosen = (first + np.arange(knots)) * knot
        least = 1e-6 * knot
        before = np.arange(math.floor(state_s / knot) + 1, math.ceil(acts_s / knot)) * knot
        before = before[(before > state_s + SHORTEST * knot) & (before < acts_s - SHORTEST * knot)]
        lead = [state_s, *before, acts_s] if acts_s > state_s + least else [acts_s]
        return Horizon(times_s=np.array([*lead, *chosen]), given=len(lead) - 1)

    @property
    def chosen_s(self) -> Array:
        """Ends of the pieces that are chosen [s], shape (N + 1,)."""
        return self.times_s[self.given :]

    @property
    def lengths_s(self) -> Array:
        """Lengths of the pieces that are chosen [s], shape (N,)."""
        return np.diff(self.chosen_s)
