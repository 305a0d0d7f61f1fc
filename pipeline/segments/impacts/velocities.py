"""Impacts measured without a contact law: twists of a ball before and after, from the flights on both sides.

The model's own flight averages over all frames of a flight, so that the velocities at the ground, which the lowest
point reaches between frames, are known far better than from two frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.rotation import quat_to_matrix
from ...physics.body import Body
from ...physics.effects.effect import changed_by_effects
from ...physics.rollout import Rollout
from ...physics.world import World
from ...trajectories.residuals import STATE_SIZE, STATE_STEPS, state_prior
from ...trajectories.segmentation import GroundPlane, Segment, heights_of
from ..contact_phases import is_round
from ..prepare import Prepared
from ..segment_states import fit_states
from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.impact_data

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Impacts:
    """Impacts (n) of a round body on the ground, world frame."""

    episode: NDArray[np.int64]
    """Index of the episode, shape (n,)."""
    place: Tensor
    """Point of contact, shape (n, 3) [m]."""
    rotation: Tensor
    """Rotation from body to world, shape (n, 3, 3)."""
    before: Tensor
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s] when the lowest point reaches the ground, shape
    (n, 6)."""
    after: Tensor
    """The same when the lowest point leaves the ground, shape (n, 6)."""
    covariance_before: Tensor
    """Covariance of `before`, shape (n, 6, 6)."""
    covariance_after: Tensor
    """Covariance of `after`, shape (n, 6, 6)."""
    reach_m: Tensor | None = None
    """Distance of the centre of mass from the ground of bodies that fall flat on a face, shape (n,) [m]; None for a
    ball."""

    def __len__(self) -> int:
        return len(self.episode)

    def select(self, places: NDArray[np.int64]) -> Impacts:
        """Return some of the impacts (k,), by their places."""
        own = {one.name: value[places] for one in fields(self) if (value := getattr(self, one.name)) is not None}
        return replace(self, **own)


def measured_impacts(prepared: Prepared, world: World) -> Impacts | None:
    """Return the impacts of all episodes between two flights; None where there are none.

    Only for a single ball above a ground whose orientation was measured: contact points of other bodies are not known
    well.

    Args:
        prepared: The episodes.
        world: In which flights are followed, with the effects that act in flight.
    """
    if prepared.flight is None or not _measurable(prepared, world):
        return None
    chains = _chains(prepared, world, prepared.flight)
    items = [item for chain in chains for item in chain]
    if not any(len(chain) > 1 for chain in chains):
        return None
    flights = fit_states(prepared.segments("flight", world, items))
    starts, ends, good = ends_of(flights)
    return between_flights(items, impacts_between(chains, starts, ends, good), starts, ends)


def between_flights(
    items: Sequence[Segment], kept: Sequence[tuple[int, int]], starts: Ends, ends: Ends
) -> Impacts | None:
    """Return the impacts between pairs of flights; None without any.

    Args:
        items: The flights (n).
        kept: The flights before and after each impact.
        starts: Starts of all flights.
        ends: Their ends.
    """
    if not kept:
        return None
    a, b = (torch.tensor(side) for side in zip(*kept, strict=True))
    return Impacts(
        episode=np.array([items[k].episode for k in a.tolist()]),
        place=ends.place[a],
        rotation=ends.rotation[a],
        before=ends.twist[a],
        after=starts.twist[b],
        covariance_before=ends.covariance[a],
        covariance_after=starts.covariance[b],
    )


def impacts_between(
    chains: Sequence[Sequence[Segment]], starts: Ends, ends: Ends, good: Sequence[bool]
) -> list[tuple[int, int]]:
    """Return the pairs of neighbouring flights with one short impact between them, both of which fit.

    Args:
        chains: Chains of flights.
        starts: Starts of all flights.
        ends: Their ends.
        good: Which of them fit.
    """
    return [
        (before, after)
        for before, after in _neighbours(chains)
        if good[before]
        and good[after]
        and -LIMITS.contact_s < float(starts.time_s[after]) - float(ends.time_s[before]) < LIMITS.longest_s
    ]


def falling_body(prepared: Prepared, world: World) -> Body | None:
    """Return the body of a scene with a single one above a ground, whose orientation was measured; None in others."""
    free = prepared.observations.free
    alone = len(free) == 1 and len(world.bodies) == 1 and world.ground_normal is not None
    return world.bodies[free[0]] if alone and prepared.has_orientation else None


def _measurable(prepared: Prepared, world: World) -> bool:
    """Return whether the scene is a single ball above a ground with measured orientation."""
    body = falling_body(prepared, world)
    return body is not None and is_round(body)


def _neighbours(chains: Sequence[Sequence[Segment]]) -> list[tuple[int, int]]:
    """Return the indices of neighbouring flights of each chain, counted through all chains."""
    pairs, place = [], 0
    for chain in chains:
        pairs += [(place + k, place + k + 1) for k in range(len(chain) - 1)]
        place += len(chain)
    return pairs


def _chains(prepared: Prepared, world: World, flights: Segments) -> list[list[Segment]]:
    """Return chains of flights with one impact between neighbours, by hopping from each to the next.

    Args:
        prepared: The episodes.
        world: For the ground and gravity.
        flights: The flight segments that chains start from.
    """
    whole, body = prepared.observations, world.bodies[prepared.observations.free[0]]
    heights = heights_of(world, body, whole, 0).amin(-1).numpy()
    fall = float(-(world.gravity[0] @ GroundPlane.of(world).normal))
    chains = []
    for episode in range(len(whole.names)):
        seeds = sorted((i.first, i.last) for i in flights.items if i.episode == episode)
        seen = np.flatnonzero(whole.seen[episode, :, 0].numpy() > 0)
        hops = _Hops(whole.times_s[episode].numpy()[seen], heights[episode][seen], fall, prepared.noise.position_m)
        done = -1
        for first, last in seeds:
            a, b = np.searchsorted(seen, [first, last])
            if a <= done:
                continue
            chain = hops.chain(int(a), int(b))
            if chain:
                chains.append([Segment(episode, int(seen[i]), int(seen[j])) for i, j in chain])
                done = max(done, chain[-1][1])
    return chains


@dataclass(frozen=True, eq=False)
class _Hops:
    """Heights of the lowest point of a body over an episode."""

    times: Array
    """Frame times, shape (T,) [s]."""
    heights: Array
    """Heights, shape (T,) [m]."""
    fall: float
    """Acceleration of gravity into the ground [m/s2]."""
    noise: float
    """Standard deviation of a height [m]."""

    def chain(self, first: int, last: int) -> list[tuple[int, int]]:
        """Return first and last frames of a flight and of those that follow it, impact by impact."""
        flight = self._grown(first, last)
        chain = []
        while flight is not None:
            a, b, landing = flight
            chain.append((a, b))
            flight = self._next(landing) if math.isfinite(landing) else None
        return chain

    def _next(self, landed: float) -> tuple[int, int, float] | None:
        """Return frames and end of the flight that follows a landing."""
        a = int(np.searchsorted(self.times, landed + LIMITS.contact_s))
        if a + LIMITS.min_frames > len(self.times):
            return None
        t = self.times[a : a + LIMITS.min_frames - 1] - landed
        speed = float((t * (self.heights[a : a + len(t)] + 0.5 * self.fall * t**2)).sum() / (t**2).sum())
        b = int(np.searchsorted(self.times, landed + 2 * speed / self.fall)) - 1
        return self._grown(a, b) if b - a + 1 >= LIMITS.min_frames else None

    def _grown(self, a: int, b: int) -> tuple[int, int, float] | None:
        """Return the frames of a flight, extended to its landing, and the landing time [s]; infinite if unseen."""
        landing = math.inf
        for _ in range(4):
            if b - a + 1 < LIMITS.min_frames:
                return None
            middle = 0.5 * (self.times[a] + self.times[b])
            t = self.times[a : b + 1] - middle
            line = np.polyfit(t, self.heights[a : b + 1] + 0.5 * self.fall * t**2, 1)
            left = np.abs(self.heights[a : b + 1] + 0.5 * self.fall * t**2 - np.polyval(line, t))
            root = line[0] ** 2 + 2 * self.fall * line[1]
            fits = left.max() <= LIMITS.misfit_sigmas * self.noise
            if root <= 0 or not fits:
                return (a, b, landing) if math.isfinite(landing) and fits else None
            landing = middle + (line[0] + math.sqrt(root)) / self.fall
            end = int(np.searchsorted(self.times, landing - 1e-4)) - 1
            if end == b:
                break
            b = end
        return a, b, landing if landing < self.times[-1] else math.inf


@dataclass(frozen=True, eq=False, kw_only=True)
class Ends:
    """Ends (n) of flights on the ground, world frame."""

    time_s: Tensor
    """Time at which the lowest point is on the ground, shape (n,)."""
    place: Tensor
    """Point of contact, shape (n, 3) [m]."""
    rotation: Tensor
    """Rotation from body to world, shape (n, 3, 3)."""
    twist: Tensor
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s], shape (n, 6)."""
    covariance: Tensor
    """Covariance of the twist, shape (n, 6, 6)."""


def ends_of(flights: Segments, reach_m: Tensor | None = None) -> tuple[Ends, Ends, list[bool]]:
    """Return the starts and ends of flights on the ground, and which of them fit.

    Args:
        flights: Flights (n) with fitted states.
        reach_m: Distance of the centre of mass from the ground at both ends, shape (n,); None for a ball's radius.
    """
    size, count = STATE_SIZE, len(flights.items)
    rows, jacobian = flights.residuals([], torch.zeros(0).to(flights.world.gravity))
    flat = jacobian.flatten(1, 2)
    prior = torch.diag(state_prior(1)).to(flat)
    spread = torch.linalg.inv(flat.mT @ flat + prior)
    good = (rows.square().sum((1, 2)) < LIMITS.bad_flight * flights.dof).tolist()
    steps = torch.tensor([step for step in STATE_STEPS for _ in range(3)]).to(flat)
    moves = torch.cat([torch.zeros(1, size).to(flat), torch.diag(steps), -torch.diag(steps)])
    every = flights.select(list(range(count)) * len(moves)).moved(moves.repeat_interleave(count, 0))
    motion = every.rollout()
    index, last = flights.observations.free[0], torch.tensor(flights.lengths).repeat(len(moves)) - 1
    found = []
    for at, towards in ((torch.zeros_like(last), 1), (last, -1)):
        reach = None if reach_m is None else reach_m.repeat(len(moves))
        found.append(_on_ground(every, motion, index, at, towards, reach).unflatten(0, (len(moves), count)))
    ends = []
    for values, at in zip(found, (torch.zeros_like(last), last), strict=True):
        slopes = (values[1 : 1 + size] - values[1 + size :]) / (2 * steps[:, None, None])  # (12, n, 10)
        slopes = slopes[..., 4:].permute(1, 2, 0)
        rotation = quat_to_matrix(motion.quat_wxyz[torch.arange(count), at[:count], index])
        ends.append(
            Ends(
                time_s=values[0, :, 0],
                place=values[0, :, 1:4],
                rotation=rotation,
                twist=values[0, :, 4:],
                covariance=slopes @ spread @ slopes.mT,
            )
        )
    return ends[0], ends[1], good


def _on_ground(
    every: Segments, motion: Rollout, index: int, at: Tensor, towards: int, reach_m: Tensor | None = None
) -> Tensor:
    """Return time, place and twist (n, 10) where motions reach the ground before or after a frame.

    From the frame on (towards -1) or back (towards 1) the acceleration is that between the frame and its inner
    neighbour.
    """
    world, seen = every.world, every.observations
    normal, offset = GroundPlane.of(world)
    item, near = torch.arange(len(at)), at + towards
    body = changed_by_effects(world).bodies[index]

    def twist(frame: Tensor) -> tuple[Tensor, Tensor]:
        turn = quat_to_matrix(motion.quat_wxyz[item, frame, index])
        omega = (turn @ motion.omega_body_rad_s[item, frame, index][..., None])[..., 0]
        arm = (turn @ body.com[..., None])[..., 0]
        velocity = motion.velocity_m_s[item, frame, index] + torch.linalg.cross(omega, arm)
        return torch.cat([velocity, omega], -1), arm

    (own, arm), (other, _) = twist(at), twist(near)
    times = seen.times_s
    rate = (other - own) / (times[item, near] - times[item, at])[:, None]
    radius = body.radii[:, 0] if reach_m is None else reach_m
    center = motion.position_m[item, at, index] + (0.0 if reach_m is None else arm)
    gap = center @ normal - offset[0] - radius
    moving = own[:, :3] if reach_m is not None else own[:, :3] - torch.linalg.cross(own[:, 3:], arm)
    speed, gain = moving @ normal, rate[:, :3] @ normal
    # the root of gap + speed t + gain t^2 / 2 with the body falling at the end, rising at the start
    root = (speed.square() - 2 * gain * gap).clamp_min(0.0).sqrt()
    t = (-speed + towards * root) / gain
    reached = own + rate * t[:, None]
    place = center + moving * t[:, None] + 0.5 * rate[:, :3] * t[:, None].square() - radius[:, None] * normal
    return torch.cat([(times[item, at] + t)[:, None], place, reached], -1)
