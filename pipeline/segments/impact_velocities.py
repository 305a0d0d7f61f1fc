"""Impacts measured without any law of contact: a ball's twist before and after, from the flights on both sides.

A flight is told by the model's own flight to a part of the noise of one frame, so that the velocities at the ground,
where the lowest point reaches it, are known far better than two frames tell them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..estimation.trajectory import STATE_SIZE, STATE_STEPS, state_prior
from ..physics.effects.effect import changed_by_effects
from ..physics.rollout import Rollout
from ..physics.rotation import quat_to_matrix
from ..physics.world import World
from .cuts import Segment
from .phases import heights_of, is_round
from .prepared import Prepared
from .segment_states import fit_states
from .segments import Segments

Array = NDArray[np.float64]

CONTACT_S = 0.008
"""So long after it reaches the ground a body may still touch it: frames in that time belong to no flight."""
MIN_FRAMES = 4
"""A flight between two impacts has at least so many frames."""
MISFIT_SIGMAS = 5.0
"""A frame that lies this many standard deviations off a flight's parabola is not of that flight."""
BAD_FLIGHT = 2.5
"""A flight with a larger chi2 / dof is none."""
LONGEST_S = 0.03
"""Between the end of a flight and the begin of the next there is at most so much contact: more is no one impact."""


@dataclass(frozen=True, eq=False)
class Impacts:
    """Impacts (n) of a round body on the ground, world frame.

    episode (n,): place among the episodes; place (n, 3) [m]: where it touches; rotation (n, 3, 3): body to world;
    before, after (n, 6): velocity of the centre of mass [m/s] and angular velocity [rad/s] when the lowest point
    reaches the ground and when it leaves it; covariance_before, covariance_after (n, 6, 6).
    """

    episode: NDArray[np.int64]
    place: Tensor
    rotation: Tensor
    before: Tensor
    after: Tensor
    covariance_before: Tensor
    covariance_after: Tensor

    def __len__(self) -> int:
        return len(self.episode)


def measured_impacts(prepared: Prepared, world: World) -> Impacts | None:
    """Return the impacts of all episodes between two flights; None where there are none.

    Only a ball alone above a ground, whose orientation was measured: where another body touches is not known well.

    Args:
        prepared: The episodes.
        world: In which flights are followed, with the effects that act in flight.
    """
    whole = prepared.whole
    alone = len(whole.free) == 1 and len(world.bodies) == 1 and world.ground_normal is not None
    if not alone or not prepared.turned or prepared.flight is None or not is_round(world.bodies[whole.free[0]]):
        return None
    chains = _chains(prepared, world)
    items = [item for chain in chains for item in chain]
    if not any(len(chain) > 1 for chain in chains):
        return None
    flights = fit_states(prepared.segments("flight", world, items))
    starts, ends, good = _ends(flights)
    pairs, place = [], 0
    for chain in chains:
        pairs += [(place + k, place + k + 1) for k in range(len(chain) - 1)]
        place += len(chain)
    times = [(float(ends.time_s[a]), float(starts.time_s[b])) for a, b in pairs]
    kept = [
        pair
        for pair, (landed, left) in zip(pairs, times, strict=True)
        if good[pair[0]] and good[pair[1]] and -CONTACT_S < left - landed < LONGEST_S
    ]
    if not kept:
        return None
    a, b = (torch.tensor(side) for side in zip(*kept, strict=True))
    return Impacts(
        np.array([items[k].episode for k in a.tolist()]),
        ends.place[a],
        ends.rotation[a],
        ends.twist[a],
        starts.twist[b],
        ends.covariance[a],
        starts.covariance[b],
    )


def _chains(prepared: Prepared, world: World) -> list[list[Segment]]:
    """Return flights that follow each other with one impact between, by hopping from each to the next."""
    assert prepared.flight is not None and world.ground_normal is not None
    whole, body = prepared.whole, world.bodies[prepared.whole.free[0]]
    heights = heights_of(world, body, whole, 0).amin(-1).numpy()
    fall = float(-(world.gravity[0] @ world.ground_normal))
    chains = []
    for episode in range(len(whole.names)):
        seeds = sorted((i.first, i.last) for i in prepared.flight.items if i.episode == episode)
        seen = np.flatnonzero(whole.seen[episode, :, 0].numpy() > 0)
        hops = _Hops(whole.times_s[episode].numpy()[seen], heights[episode][seen], fall, prepared.noise[0])
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
    """Heights (T,) [m] of the lowest point at times (T,) [s]; fall [m/s2] of gravity; noise [m] of a height."""

    times: Array
    heights: Array
    fall: float
    noise: float

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
        a = int(np.searchsorted(self.times, landed + CONTACT_S))
        if a + MIN_FRAMES > len(self.times):
            return None
        t = self.times[a : a + MIN_FRAMES - 1] - landed
        speed = float((t * (self.heights[a : a + len(t)] + 0.5 * self.fall * t**2)).sum() / (t**2).sum())
        b = int(np.searchsorted(self.times, landed + 2 * speed / self.fall)) - 1
        return self._grown(a, b) if b - a + 1 >= MIN_FRAMES else None

    def _grown(self, a: int, b: int) -> tuple[int, int, float] | None:
        """Return the frames of a flight, its last ones till it lands, and when [s] that is; infinite if unseen."""
        landing = math.inf
        for _ in range(4):
            if b - a + 1 < MIN_FRAMES:
                return None
            middle = 0.5 * (self.times[a] + self.times[b])
            t = self.times[a : b + 1] - middle
            line = np.polyfit(t, self.heights[a : b + 1] + 0.5 * self.fall * t**2, 1)
            left = np.abs(self.heights[a : b + 1] + 0.5 * self.fall * t**2 - np.polyval(line, t))
            root = line[0] ** 2 + 2 * self.fall * line[1]
            if root <= 0 or left.max() > MISFIT_SIGMAS * self.noise:
                return (a, b, landing) if math.isfinite(landing) and left.max() <= MISFIT_SIGMAS * self.noise else None
            landing = middle + (line[0] + math.sqrt(root)) / self.fall
            end = int(np.searchsorted(self.times, landing - 1e-4)) - 1
            if end == b:
                break
            b = end
        return a, b, landing if landing < self.times[-1] else math.inf


@dataclass(frozen=True, eq=False)
class _Ends:
    """Ends (n) of flights on the ground: time_s (n,), place (n, 3), rotation (n, 3, 3), twist (n, 6), covariance."""

    time_s: Tensor
    place: Tensor
    rotation: Tensor
    twist: Tensor
    covariance: Tensor


def _ends(flights: Segments) -> tuple[_Ends, _Ends, list[bool]]:
    """Return the flights' begins and ends on the ground, and which of them were flights."""
    size, count = STATE_SIZE, len(flights.items)
    rows, jacobian = flights.residuals([], torch.zeros(0).to(flights.world.gravity))
    assert jacobian is not None
    flat = jacobian.flatten(1, 2)
    prior = torch.diag(state_prior(1)).to(flat)
    spread = torch.linalg.inv(flat.mT @ flat + prior)
    good = (rows.square().sum((1, 2)) < BAD_FLIGHT * flights.dof).tolist()
    steps = torch.tensor([step for step in STATE_STEPS for _ in range(3)]).to(flat)
    moves = torch.cat([torch.zeros(1, size).to(flat), torch.diag(steps), -torch.diag(steps)])
    every = flights.select(list(range(count)) * len(moves)).moved(moves.repeat_interleave(count, 0))
    motion = every.rollout()
    index, last = flights.observations.free[0], torch.tensor(flights.lengths).repeat(len(moves)) - 1
    found = []
    for at, towards in ((torch.zeros_like(last), 1), (last, -1)):
        found.append(_on_ground(every, motion, index, at, towards).unflatten(0, (len(moves), count)))
    ends = []
    for values, at in zip(found, (torch.zeros_like(last), last), strict=True):
        slopes = (values[1 : 1 + size] - values[1 + size :]) / (2 * steps[:, None, None])  # (12, n, 10)
        slopes = slopes[..., 4:].permute(1, 2, 0)
        rotation = quat_to_matrix(motion.quat_wxyz[torch.arange(count), at[:count], index])
        ends.append(_Ends(values[0, :, 0], values[0, :, 1:4], rotation, values[0, :, 4:], slopes @ spread @ slopes.mT))
    return ends[0], ends[1], good


def _on_ground(every: Segments, motion: Rollout, index: int, at: Tensor, towards: int) -> Tensor:
    """Return time, place and twist (n, 10) where motions reach the ground before or after a frame.

    From the frame on (towards -1) or back (towards 1) acceleration is that between the frame and its neighbour inside.
    """
    world, seen = every.world, every.observations
    assert world.ground_normal is not None and world.ground_offset is not None
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
    normal, radius = world.ground_normal, body.radii[:, 0]
    center = motion.position_m[item, at, index]
    gap = center @ normal - world.ground_offset[0] - radius
    moving = own[:, :3] - torch.linalg.cross(own[:, 3:], arm)
    speed, gain = moving @ normal, rate[:, :3] @ normal
    # the root of gap + speed t + gain t^2 / 2 with the body falling at the end, rising at the begin
    root = (speed.square() - 2 * gain * gap).clamp_min(0.0).sqrt()
    t = (-speed + towards * root) / gain
    reached = own + rate * t[:, None]
    place = center + moving * t[:, None] + 0.5 * rate[:, :3] * t[:, None].square() - radius[:, None] * normal
    return torch.cat([(times[item, at] + t)[:, None], place, reached], -1)
