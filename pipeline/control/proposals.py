"""Proposals of pushes: the finger goes around the object to a place of its outline, and pushes from there.

Small changes of a plan do not lead to the other side of the object, so the sampling solver compares such pushes, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...datasets.shapes.interpolation import by_column
from .horizon import Array
from .task_world import outline

if TYPE_CHECKING:
    from .objective import PushObjective

GAP_M = 0.012
"""Distance from the outline at which a push begins [m]."""
SAFE_M = 0.002
"""Smallest distance from the outline of a way that is clear [m]."""
SWING_RAD = 0.35
"""Standard deviation of the direction of a push from the outline's normal [rad]."""
LENGTHS_M = (0.01, 0.02, 0.04, 0.08, 0.16)
"""Lengths of pushes, each varied by up to 40 % [m]."""
SPEEDS = (0.2, 0.7)
"""Speeds of pushes, from and to, in units of the limit."""
ARC_RAD = 0.35
"""Largest angle between two corners of a way around the object [rad]."""


@dataclass(frozen=True, kw_only=True)
class PushProposals:
    """Random pushes for one objective."""

    objective: PushObjective
    """The objective."""

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Return speeds (up to `count`, N, 2) [m/s] of random pushes."""
        where = self.objective.task_world
        state = self.objective.state
        pose = (state.position_m[0, where.object].numpy(), state.quat_wxyz[0, where.object].numpy())
        centers, radii = outline(where, *pose)
        if not len(radii):
            return np.zeros((0, *self.objective.shape))
        ways = Ways(centers, radii, pose[0][:2])
        places, normals = outline_places(centers, radii, rng, count)
        swing = rng.normal(0.0, SWING_RAD, len(places))
        lengths = rng.choice(LENGTHS_M, len(places)) * rng.uniform(0.6, 1.4, len(places))
        speeds = self.objective.bound * rng.uniform(*SPEEDS, len(places))
        found = [
            self.speeds(ways, place, normal, -_turned(normal, angle) * (GAP_M + length), speed)
            for place, normal, angle, length, speed in zip(places, normals, swing, lengths, speeds, strict=True)
        ]
        return np.array(found).reshape(-1, *self.objective.shape)

    def speeds(self, ways: Ways, place: Array, normal: Array, push: Array, speed: float) -> Array:
        """Return the speeds (N, 2) of a way to a place and a push from there."""
        objective = self.objective
        horizon = objective.horizon
        given = (objective.given_m_s * np.diff(horizon.times_s)[: horizon.given, None]).sum(0)
        finger = objective.state.position_m[0, objective.task_world.finger, :2].numpy() + given
        begin = place + GAP_M * normal
        way = np.array([finger, *ways.around(finger, begin), begin])
        # each joint has its own limit, so a way along an axis is as fast as one across
        legs = np.abs(np.diff(way, axis=0)).max(1) / (0.95 * objective.bound)
        times = np.concatenate(([0.0], np.cumsum(legs)))
        times = np.append(times, times[-1] + np.linalg.norm(push) / speed)
        corners = np.concatenate((way, (begin + push)[None]))
        grid = horizon.chosen_s - horizon.chosen_s[0]
        places = by_column(grid, times, corners)
        return np.clip(np.diff(places, axis=0) / np.diff(grid)[:, None], -objective.bound, objective.bound)


@dataclass(frozen=True)
class Ways:
    """Ways around discs."""

    centers: Array
    """Centres (n, 2) [m]."""
    radii: Array
    """Radii (n,) [m]."""
    middle: Array
    """Point that ways go around [m], shape (2,)."""

    def around(self, start: Array, end: Array) -> list[Array]:
        """Return corners of a way from start to end: none where the straight line is clear, else those of an arc."""
        if self._clear(start, end):
            return []
        ring = float((np.linalg.norm(self.centers - self.middle, axis=1) + self.radii).max()) + GAP_M
        first, last = (math.atan2(*(point - self.middle)[::-1]) for point in (start, end))
        angle = (last - first + math.pi) % (2 * math.pi) - math.pi
        count = max(2, int(abs(angle) / ARC_RAD) + 2)
        return [self.middle + ring * _direction(first + share * angle) for share in np.linspace(0, 1, count)]

    def _clear(self, start: Array, end: Array) -> bool:
        line = end - start
        share = ((self.centers - start) @ line / max(line @ line, 1e-12)).clip(0, 1)
        nearest = start + share[:, None] * line
        return bool((np.linalg.norm(nearest - self.centers, axis=1) > self.radii + SAFE_M).all())


def outline_places(centers: Array, radii: Array, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Return up to `count` random places (n, 2) of the outline of discs, and its outward normals (n, 2)."""
    chosen = rng.integers(len(radii), size=8 * count)
    normals = _direction(rng.uniform(-math.pi, math.pi, 8 * count))
    places = centers[chosen] + (radii[chosen] + 1e-4)[:, None] * normals
    apart = np.linalg.norm(places[:, None] - centers[None], axis=-1) >= radii[None] - 1e-9
    free = apart.all(1)
    return places[free][:count], normals[free][:count]


def _direction(angle: Array | float) -> Array:
    return np.stack((np.cos(angle), np.sin(angle)), -1)


def _turned(vector: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
