"""Measured forces of driven bodies, as mean forces on intervals between frames, with their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ....datasets.capture.tracks import Episode, Track
from ...physics.world import World
from ...trajectories.observations import Observations

MOST_INTERVALS = 200
"""Maximum number of intervals of an episode; of more samples, several are averaged."""
SLOW_INTERVALS = 10
"""Maximum number of long intervals of an episode. A hit and the rebounds after it end within one or two of them, so
that mean forces are smooth functions of friction, of losses in joints and of the law of the contact."""
NOISY_CHANGE = 4.0
"""Largest squared change of a force from interval to interval, relative to its expectation from the noise alone, that
counts as noise."""


@dataclass(frozen=True, kw_only=True)
class MeasuredForce:
    """Force that one driven body exerts in an episode; K intervals."""

    episode: Episode
    """Name and tracks."""
    row: int
    """Item of the observations, with the state at its first frame."""
    body: int
    """Index of the driven body."""
    edges_s: np.ndarray
    """Edges of the intervals [s], shape (K + 1,)."""
    force_n: np.ndarray
    """Mean force on each interval, world frame [N], shape (K, 3)."""
    std_n: float
    """Noise of a component of these means [N]."""
    spread_n: np.ndarray
    """Standard deviation of a component by which a mean may differ from that of a rollout [N], shape (K,)."""

    @staticmethod
    def of(episode: Episode, row: int, body: int, track: Track, start_s: float, std_n: float | None) -> MeasuredForce:
        """Average the samples of a track from a start on, each between the middles to its neighbours."""
        late = track.window(start_s)
        force = np.zeros((0, 3)) if late.force_n is None else late.force_n
        each = max(1, -(-(len(late) - 2) // MOST_INTERVALS))
        count = max(0, (len(late) - 2) // each)
        middle = 0.5 * (late.time_s[1:] + late.time_s[:-1])
        means = force[1 : 1 + count * each].reshape(count, each, 3).mean(1)
        std = (std_n or force_noise(force)) / float(np.sqrt(each))
        return MeasuredForce(
            episode=episode,
            row=row,
            body=body,
            edges_s=middle[: count * each + 1 : each],
            force_n=means,
            std_n=std,
            spread_n=np.hypot(std, _jumps(np.concatenate([force[:1], means, force[-1:]]), std)),
        )

    def slow(self, most: int = SLOW_INTERVALS) -> MeasuredForce:
        """Return the mean forces on longer intervals, at most `most`; itself where it has no more.

        What contact exchanges on a long interval follows from the change of momentum, whatever the law of contact.
        """
        each = -(-len(self.force_n) // most)
        count = len(self.force_n) // each
        if each == 1:
            return self
        means = self.force_n[: count * each].reshape(count, each, 3).mean(1)
        std = self.std_n / float(np.sqrt(each))
        return replace(
            self,
            edges_s=self.edges_s[: count * each + 1 : each],
            force_n=means,
            std_n=std,
            spread_n=np.hypot(std, _jumps(np.concatenate([means[:1], means, means[-1:]]), std)),
        )


def _jumps(force_n: np.ndarray, std_n: float) -> np.ndarray:
    """Return the error (K,) of a component [N] that an error in time of an interval makes of mean forces (K + 2, 3).

    The first and the last of these are only neighbours.

    Where the force changes, at a first touch or a release, it tells the time of that, which frames and shapes do not
    give to a part of an interval. Changes within the noise of the means count as none.
    """
    steps = np.square(np.diff(force_n, axis=0)).sum(1)
    change = np.maximum(steps[1:], steps[:-1])
    return np.where(change > NOISY_CHANGE * 6 * std_n**2, np.sqrt(change), 0.0)


def force_noise(force_n: np.ndarray) -> float:
    """Return the noise of a component [N] of forces (T, 3) from their second differences, robust against impacts."""
    bent = np.diff(force_n, 2, axis=0)
    robust = 1.4826 * float(np.median(np.abs(bent))) / np.sqrt(6.0) if bent.size else 0.0
    return max(robust, 1e-4 * float(np.abs(force_n).max(initial=0.0)), 1e-9)


def measured_forces(
    world: World, episodes: Sequence[Episode], observations: Observations, std_n: float | None
) -> list[MeasuredForce]:
    """Return the measured forces of the driven bodies in the episodes of the observations."""
    found = []
    for row, (episode, start) in enumerate(zip(episodes, observations.times_s[:, 0].tolist(), strict=True)):
        for index, body in enumerate(world.bodies):
            track = episode.tracks.get(body.name)
            if body.motion == "driven" and track is not None and track.force_n is not None:
                force = MeasuredForce.of(episode, row, index, track, start, std_n)
                found += [force] if len(force.force_n) else []
    return found
