"""Bounces of a ball: the heights on both sides of each impact, from tracks with or without orientation.

No contact law, no spin and no known height of the ground is needed to find them: a bounce is where a falling height
turns into a rising one. The frame of the turn and its neighbours may lie within the contact and are left out. The
flight after the last bounce ends where a body that rises so high has fallen back: what it does then (small bounces,
rolling) is no flight, and would be taken for noise and for the height of the ground.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.segmentation import GroundPlane, heights_of
from ..contact_phases import is_round
from ..thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.bounce

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class BounceSide:
    """Frames (n) of the flight before or after a bounce."""

    time_s: Array
    """Times from the bounce, shape (n,) [s]; negative before it."""
    height_m: Array
    """Height of the lowest point over the ground, shape (n,) [m]."""
    position_m: Array
    """Position, shape (n, 3) [m]."""

    def without(self, contact: tuple[float, float]) -> BounceSide:
        """Return the frames outside of a time span [s]."""
        kept = (self.time_s < contact[0]) | (self.time_s > contact[1])
        return BounceSide(time_s=self.time_s[kept], height_m=self.height_m[kept], position_m=self.position_m[kept])

    def thinned(self, most: int) -> BounceSide:
        """Return at most that many frames, evenly spread."""
        rows = np.unique(np.linspace(0, len(self) - 1, most).round().astype(int))
        return BounceSide(time_s=self.time_s[rows], height_m=self.height_m[rows], position_m=self.position_m[rows])

    def __len__(self) -> int:
        return len(self.time_s)


@dataclass(frozen=True, kw_only=True)
class Bounce:
    """One impact of a ball between two flights."""

    episode: int
    """Index of the episode."""
    before: BounceSide
    """The flight that ends in the impact."""
    after: BounceSide
    """The flight that begins with it."""

    def without(self, contact: tuple[float, float]) -> Bounce | None:
        """Return the bounce without the frames of a time span [s]; None if too few remain."""
        before, after = self.before.without(contact), self.after.without(contact)
        if min(len(before), len(after)) < LIMITS.least_frames:
            return None
        return Bounce(episode=self.episode, before=before, after=after)


def bounces_of(world: World, whole: Observations) -> list[Bounce]:
    """Return the bounces of all episodes on the ground.

    Only for a single ball above a ground: the contact points of other bodies are not known well.

    Args:
        world: For the ground and the ball.
        whole: Whole episodes.
    """
    alone = len(whole.free) == 1 and len(world.bodies) == 1 and world.ground_normal is not None
    if not alone or not is_round(world.bodies[whole.free[0]]):
        return []
    heights = heights_of(world, world.bodies[whole.free[0]], whole, 0).amin(-1).numpy()
    found, gravity = [], gravity_into_ground(world)
    for episode in range(len(whole.names)):
        seen = np.flatnonzero(whole.seen[episode, :, 0].numpy() > 0)
        frames = BounceSide(
            time_s=whole.times_s[episode].numpy()[seen],
            height_m=heights[episode][seen],
            position_m=whole.position_m[episode, :, 0].numpy()[seen],
        )
        found += list(bounces_in(episode, frames, gravity))
    return found


def gravity_into_ground(world: World) -> float:
    """Return the acceleration of gravity [m/s2] into the ground."""
    return float(-(torch.atleast_2d(world.gravity)[0] @ GroundPlane.of(world).normal))


def bounces_in(episode: int, frames: BounceSide, gravity_m_s2: float) -> Iterator[Bounce]:
    """Yield the bounces among the frames of an episode (its index) above the ground, under gravity into the ground."""
    turns = _turns(frames)
    for place, turn in enumerate(turns):
        first = turns[place - 1] + 1 if place else 0
        last = turns[place + 1] if place + 1 < len(turns) else len(frames)
        at = frames.time_s[turn]
        sides = []
        for rows in (slice(first, turn), slice(turn + 1, last)):
            time = frames.time_s[rows] - at
            near = (np.abs(time) > LIMITS.apart_s) & (np.abs(time) < LIMITS.longest_s)
            # frames near the neighbouring bounces may lie within their contacts
            for other in (turns[place - 1 : place] if place else []) + turns[place + 1 : place + 2]:
                near &= np.abs(frames.time_s[rows] - frames.time_s[other]) > LIMITS.apart_s
            if last == len(frames):
                near &= time < _lasts_s(frames.height_m[turn:last], gravity_m_s2) - LIMITS.apart_s
            sides.append(
                BounceSide(
                    time_s=time[near], height_m=frames.height_m[rows][near], position_m=frames.position_m[rows][near]
                )
            )
        if min(len(side) for side in sides) >= LIMITS.least_frames:
            yield Bounce(episode=episode, before=sides[0], after=sides[1])


def _lasts_s(height_m: Array, gravity_m_s2: float) -> float:
    """Return the duration [s] of a flight that begins at the first of its heights and reaches the highest."""
    rise = float(height_m.max() - height_m[0])
    return 2 * float(np.sqrt(2 * rise / gravity_m_s2)) if gravity_m_s2 > 0 else np.inf


def _turns(frames: BounceSide) -> list[int]:
    """Return the frames of least height at which a fall turns into a rise near the ground."""
    h, t = frames.height_m, frames.time_s
    found = []
    for k in range(2, len(h) - 2):
        if not (h[k] < h[k - 1] and h[k] <= h[k + 1]):
            continue
        # the frame of the turn may belong to either side
        falls, rises = (h[k - 1] - h[k - 2]) / (t[k - 1] - t[k - 2]), (h[k + 2] - h[k + 1]) / (t[k + 2] - t[k + 1])
        step = max(t[k] - t[k - 1], t[k + 1] - t[k])
        near = abs(h[k]) < LIMITS.near_m - falls * step
        if near and falls < -LIMITS.slowest_m_s and rises > LIMITS.least_rise * -falls:
            found.append(k)
    return found
