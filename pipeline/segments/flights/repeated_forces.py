"""The part of a residual wrench that repeats from episode to episode, as a law of any smooth form would predict it.

A physical effect, in a library or in none, does the same in all episodes at the same place, speed, heading, spin or
time; an error of the tracking does not. The residual wrench of an episode's windows is predicted from the other
episodes, as a constant in bins along a coordinate, in world axes or along and across the path (and the spin). What this
predicts is common to the episodes; what it does not predict is each episode's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import student_tail
from ..thresholds import SEGMENT_THRESHOLDS
from .residual_wrench import ResidualWrenches

LIMITS = SEGMENT_THRESHOLDS.slow_errors

Array = NDArray[np.float64]

BINS = {"constant": (1,), "time": (4, 12), "heading": (4, 8)}
"""Numbers of bins that are tried along a coordinate: more where a law may change fast."""
USUAL_BINS = (4,)
"""The same along other coordinates."""
PRIOR_STD = 5.0
"""Standard deviation of the wrench in a bin [m/s2, rad/s2] before any data: ties bins that few windows visit to 0."""


@dataclass(frozen=True, kw_only=True)
class RepeatedForce:
    """Prediction of held-out episodes by a wrench that depends on one coordinate."""

    coordinate: str
    """The coordinate, or "constant"."""
    frame: str
    """Axes in which the wrench is constant: "world" or "path"."""
    gains: tuple[float, ...]
    """Fall of chi2 of each held-out episode."""
    tried: int = 1
    """Number of laws of which it is the best."""

    @property
    def gain(self) -> float:
        """Fall of chi2 of all held-out episodes."""
        return float(np.sum(self.gains))

    @property
    def p_value(self) -> float:
        """Probability of at least this mean gain per episode by chance, over all laws that were tried."""
        if len(self.gains) < 2 or self.gain <= 0:
            return 1.0
        error = float(np.std(self.gains, ddof=1)) / math.sqrt(len(self.gains))
        t = float(np.mean(self.gains)) / max(error, 1e-12)
        return min(1.0, self.tried * student_tail(t, len(self.gains) - 1))


def repeated_force(found: ResidualWrenches) -> RepeatedForce | None:
    """Return the law that predicts held-out episodes best; None for fewer than three episodes.

    A constant force is the simplest one, and stands where none is better beyond chance.
    """
    episodes = np.array([item.episode for item in found.segments])
    if len(np.unique(episodes)) < 3:
        return None
    laws = []
    for frame, (score, information) in {"world": _in_world(found), "path": _on_path(found)}.items():
        for coordinate, values in {"constant": np.zeros(len(episodes)), **found.coordinates}.items():
            if coordinate == "episode":
                continue
            for count in BINS.get(coordinate, USUAL_BINS):
                groups = np.searchsorted(np.quantile(values, np.arange(1, count) / count), values)
                gains = _held_out(groups, episodes, score, information)
                laws.append(RepeatedForce(coordinate=coordinate, frame=frame, gains=gains))
    best = max(laws, key=lambda law: law.gain)
    constant = laws[0]
    if not _is_better(best, constant):
        best = constant
    return RepeatedForce(coordinate=best.coordinate, frame=best.frame, gains=best.gains, tried=len(laws))


def _is_better(law: RepeatedForce, other: RepeatedForce) -> bool:
    """Return whether a law predicts held-out episodes better than another one beyond chance: a paired t-test."""
    more = np.subtract(law.gains, other.gains)
    error = float(np.std(more, ddof=1)) / math.sqrt(len(more))
    return student_tail(float(more.mean()) / max(error, 1e-12), len(more) - 1) < LIMITS.better_law


def _held_out(
    groups: NDArray[np.int64], episodes: NDArray[np.int64], score: Array, information: Array
) -> tuple[float, ...]:
    """Return the fall of chi2 of each episode by the wrench of each group (n,) that the other episodes have."""
    count, prior = int(groups.max()) + 1, np.eye(6) / PRIOR_STD**2
    found = []
    for episode in np.unique(episodes):
        own = episodes == episode
        slope, matrix = np.zeros((count, 6)), np.tile(prior, (count, 1, 1))
        np.add.at(slope, groups[~own], score[~own])
        np.add.at(matrix, groups[~own], information[~own])
        wrench = np.linalg.solve(matrix, slope[..., None])[groups[own], :, 0]
        gain = 2 * (score[own] * wrench).sum() - np.einsum("ni,nij,nj->", wrench, information[own], wrench)
        found.append(float(gain))
    return tuple(found)


def _in_world(found: ResidualWrenches) -> tuple[Array, Array]:
    """Return score (n, 6) and information (n, 6, 6) of the wrenches in world axes."""
    return np.einsum("nij,nj->ni", found.information, found.wrench), found.information


def _on_path(found: ResidualWrenches) -> tuple[Array, Array]:
    """Return the same along and across the velocity (forces) and the spin (torques)."""
    axes = np.zeros((len(found.wrench), 6, 6))
    axes[:, :3, :3], axes[:, 3:, 3:] = _frames(found.velocity), _frames(found.omega)
    score, information = _in_world(found)
    return np.einsum("nij,nj->ni", axes, score), np.einsum("nij,njk,nlk->nil", axes, information, axes)


def _frames(along: Array) -> Array:
    """Return right-handed axes (n, 3, 3) in rows: along vectors (n, 3), horizontally across them, and the third."""
    first = along / np.linalg.norm(along, axis=1, keepdims=True).clip(1e-9)
    across = np.cross([0.0, 0.0, 1.0], first)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(size > 1e-6, across / size.clip(1e-9), [1.0, 0.0, 0.0])
    return np.stack((first, across, np.cross(first, across)), 1)
