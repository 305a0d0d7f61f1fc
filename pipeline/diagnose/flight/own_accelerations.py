"""Accelerations that differ from episode to episode: errors of each episode's own, or a law of the motion.

A frame that is levelled anew for each episode knows nothing of how the body is thrown: its accelerations across gravity
have no direction that turns with the heading, and do not follow velocity, spin or place. A force does. What is tested
is exact for few episodes, where a law of any form could not be told from values of each episode's own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import chi2_tail, f_tail
from ...segments.flights.residual_wrench import ResidualWrenches
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]

QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


UPWARD = "upward"
"""Name of what accelerations follow that differ along gravity as much as across it, as a lift does."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OwnAccelerations:
    """Accelerations across gravity of pieces of flight (n), in two level axes."""

    score: Array
    """Score of each piece, shape (n, 2)."""
    information: Array
    """Information of each piece, shape (n, 2, 2)."""
    episode: NDArray[np.int64]
    """Index of the episode of each piece, shape (n,)."""
    motion: dict[str, Array]
    """Level vectors (n, 2) that a force could follow, by name; the first is the velocity."""
    upward: tuple[Array, Array] | None = None
    """Score and information (n,) of the acceleration along gravity, which no tilt changes; None where unknown."""

    @staticmethod
    def of(found: ResidualWrenches, level: Sequence[int]) -> OwnAccelerations:
        """Return the accelerations along two level axes of the world from residual wrenches."""
        axes = list(level)
        score = np.einsum("nij,nj->ni", found.information, found.wrench)[:, axes]
        place = np.stack((found.coordinates["x"], found.coordinates["y"], found.coordinates["height"]), 1)
        vectors = {
            "velocity": found.velocity,
            "place": place,
            "spin": found.omega,
            "spin across velocity": np.cross(found.omega, found.velocity),
        }
        return OwnAccelerations(
            score=score,
            information=found.information[:, axes][:, :, axes],
            episode=np.array([item.episode for item in found.segments]),
            motion={name: vector[:, axes] for name, vector in vectors.items()},
            upward=_upward(found, axes),
        )

    def held_out_gains(self, std_m_s2: float) -> Array:
        """Return the fall of chi2 (E,) of pieces that are predicted from the other pieces of their episode.

        The alternative is the mean of the other episodes.

        Args:
            std_m_s2: Standard deviation of an episode's own acceleration [m/s2].
        """
        episodes, gains = np.unique(self.episode), []
        prior = np.eye(2) / std_m_s2**2
        own = self.by_episode()
        for number, episode in enumerate(episodes):
            mean = np.delete(own, number, 0).mean(0) if len(own) > 1 else np.zeros(2)
            mine = np.flatnonzero(self.episode == episode)
            score = self.score[mine] - self.information[mine] @ mean
            matrix, gain = self.information[mine], 0.0
            for k in range(len(mine)):
                value = np.linalg.solve(matrix.sum(0) - matrix[k] + prior, score.sum(0) - score[k])
                gain += float(2 * score[k] @ value - value @ matrix[k] @ value)
            gains.append(gain)
        return np.array(gains)

    def law(self) -> str | None:
        """Return what the episodes' accelerations follow beyond chance; None where nothing is found."""
        values = self.by_episode()
        if len(values) < LIMITS.law_episodes:
            return None
        if self._is_upward(values):
            return UPWARD
        means = {name: self._mean(vector) for name, vector in self.motion.items()}
        found = {name: _followed_p(values, vector) for name, vector in means.items()}
        found["heading"] = _polarised_p(values, means["velocity"])
        name = min(found, key=lambda one: found[one])
        return name if len(found) * found[name] < LIMITS.repeated_p else None

    def _is_upward(self, values: Array) -> bool:
        """Return whether episodes differ along gravity, too, by no less than across it (E, 2) beyond chance.

        A tilt of gravity by an angle a changes it by g a across and by g a^2 / 2 along.
        """
        if self.upward is None:
            return False
        units = [self.episode == episode for episode in np.unique(self.episode)]
        score, information = (np.array([part[own].sum() for own in units]) for part in self.upward)
        if not (information > 0).all():
            return False
        own, count = score / information, len(units)
        mean = float(score.sum() / information.sum())
        if chi2_tail(float((information * (own - mean) ** 2).sum()), count - 1) > LIMITS.repeated_p:
            return False
        level = float(values.var(0, ddof=1).mean())
        return f_tail(level / float(own.var(ddof=1)), 2 * (count - 1), count - 1) > LIMITS.repeated_p

    def by_episode(self) -> Array:
        """Return the acceleration (E, 2) of each episode [m/s2]."""
        found = []
        for episode in np.unique(self.episode):
            mine = self.episode == episode
            matrix = self.information[mine].sum(0)
            found.append(np.linalg.solve(matrix + 1e-9 * np.trace(matrix) * np.eye(2), self.score[mine].sum(0)))
        return np.array(found)

    def _mean(self, vectors: Array) -> Array:
        """Return the mean of vectors (n, 2) in each episode (E, 2)."""
        return np.array([vectors[self.episode == episode].mean(0) for episode in np.unique(self.episode)])


def _upward(found: ResidualWrenches, level: Sequence[int]) -> tuple[Array, Array] | None:
    """Return score and information (n,) of accelerations along the one axis that is not level; None without one."""
    up = [axis for axis in range(3) if axis not in level]
    if len(up) != 1:
        return None
    information = found.information[:, up[0], up[0]]
    return information * found.wrench[:, up[0]], information


def _followed_p(values: Array, vectors: Array) -> float:
    """Return the p-value that vectors turned and scaled alike explain values (E, 2) beside a common one."""
    return follows(values, vectors)[0]


def follows(values: Array, vectors: Array) -> tuple[float, float, float]:
    """Return how values (E, 2) follow vectors (E, 2) that are turned and scaled alike.

    The F-test of a = m + p v + q (v turned by 90 degrees): 2 degrees of freedom against 2 E - 4.

    Returns:
        The p-value, p, and q.
    """
    common = np.tile(np.eye(2), (len(values), 1))
    followed = np.stack((vectors, vectors @ QUARTER_TURN.T), -1).reshape(-1, 2)
    flat, joint = values.reshape(-1), np.hstack((common, followed))
    alone = float(np.linalg.lstsq(common, flat, rcond=None)[1].sum())
    slopes, left = np.linalg.lstsq(joint, flat, rcond=None)[:2]
    below = len(flat) - 4
    if np.linalg.matrix_rank(joint) < 4 or below < 2 or float(left.sum()) <= 0:
        return 1.0, 0.0, 0.0
    ratio = (alone - float(left.sum())) / 2 / (float(left.sum()) / below)
    return f_tail(ratio, 2, below), float(slopes[2]), float(slopes[3])


def _polarised_p(values: Array, velocity: Array) -> float:
    """Return the p-value that values (E, 2) lie along one axis that turns with the heading, as those of no tilt do.

    Mauchly's test of sphericity, exact in two dimensions: with S = sum a a', 2 |S|^1/2 / tr S has the distribution
    x^(E - 1). Values that lie as well along a fixed axis of the world follow no heading.
    """
    size = np.linalg.norm(velocity, axis=1, keepdims=True)
    along = velocity / np.where(size > 0, size, 1.0)
    turned = np.stack(((values * along).sum(1), (values * (along @ QUARTER_TURN.T)).sum(1)), 1)
    by_heading, fixed = _sphericity_p(turned), _sphericity_p(values)
    return by_heading if by_heading < fixed else 1.0


def _sphericity_p(values: Array) -> float:
    """Return the p-value of Mauchly's test that vectors (E, 2) of mean 0 have no preferred axis."""
    square = values.T @ values
    trace = float(np.trace(square))
    if trace <= 0:
        return 1.0
    ratio = 2 * math.sqrt(max(float(np.linalg.det(square)), 0.0)) / trace
    return min(ratio, 1.0) ** (len(values) - 1)
