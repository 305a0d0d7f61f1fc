"""Motion of a chain that measured forces drive: without a contact law, a shape or the path of what pushes.

Between samples the equation of motion of the joints is integrated with the force that was measured,

    M(q) q'' + b(q, q') = J' F - d q' - f s + r,

with damping d by the trapezoidal rule, and dry friction f where the track tells the sense s of a motion, 1 or -1. Where
a joint may stand still its friction takes any value within its bounds: s is 0 there, and r, an unknown mean force on
each interval, has the size of what drives the joint. Elsewhere it has that of what samples do not tell of the impulse
of a force: their noise, the curvature of the force between them, and hits (`impulse_errors`, `hit_errors`). So the
motion is a smooth function of all that is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.tracks import Track
from ....datasets.shapes.interpolation import by_column
from ...physics.chains.chain import Chain
from ...physics.chains.dynamics import Balance, ChainDynamics, ChainMotion
from ...physics.chains.values import with_chain_values
from ...physics.world import World
from .joint_tracks import JointTracks
from .measured_forces import NOISY_CHANGE

STEP_S = 0.004
"""Largest step of the integration [s]."""
LOADED = 5.0
"""Size of a force, in standard deviations of a component, from which on something is touched."""
NEAR_M = 0.002
"""Gap up to which a driven body may have hit a link [m], beside the way by which they came closer between frames."""
UNIFORM = float(np.sqrt(12.0))
"""Width of a uniform distribution in its standard deviations: when a force changes within an interval."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Samples of the force of a driven body in the episodes (E), with cubics between them.

    A sample may be the mean over the time between two, which differs from the force in the middle of that by a part of
    the second difference: m = F + F'' dt^2 / 24 (derived).
    """

    time_s: Tensor
    """Times, each row padded beyond its end, shape (E, S)."""
    force_n: Tensor
    """Forces [N], shape (E, S, 3)."""
    bent_n: Tensor
    """Second differences [N], shape (E, S, 3)."""

    @staticmethod
    def of(tracks: Sequence[Track | None]) -> Samples:
        """Collect the forces of one driven body; where it is not in an episode, it exerts none."""
        longest = max(3, *(len(track) for track in tracks if track is not None))
        time, force, bent = torch.zeros(len(tracks), longest), torch.zeros(len(tracks), longest, 3), []
        time, force = time.double() + torch.arange(longest), force.double()
        for e, track in enumerate(tracks):
            if track is None or track.force_n is None:
                continue
            count = len(track)
            time[e, :count], force[e, :count] = torch.as_tensor(track.time_s), torch.as_tensor(track.force_n)
            time[e, count:] = time[e, count - 1] + torch.arange(1, longest - count + 1)
        bent = torch.zeros_like(force)
        bent[:, 1:-1] = force.diff(2, dim=1)
        return Samples(time_s=time, force_n=force, bent_n=bent)

    def at(self, episode: Tensor, time_s: Tensor, mean: Tensor) -> Tensor:
        """Return the force (B, N, 3) at times (B, N) in episodes (B,), for the part (B,) of a mean that samples are."""
        time = self.time_s[episode].contiguous()
        place = (torch.searchsorted(time, time_s.contiguous(), right=True) - 1).clamp(0, time.shape[1] - 2)
        force = self.force_n[episode] - mean[:, None, None] / 24 * self.bent_n[episode]
        rows = [(place + k).clamp(0, time.shape[1] - 1) for k in (-1, 0, 1, 2)]
        t = [time.gather(1, row) for row in rows]
        f = [force.gather(1, row[..., None].expand(-1, -1, 3)) for row in rows]
        length = (t[2] - t[1])[..., None]
        share = ((time_s - t[1])[..., None] / length).clamp(0.0, 1.0)
        begin = (f[2] - f[0]) / (t[2] - t[0])[..., None] * length
        end = (f[3] - f[1]) / (t[3] - t[1])[..., None] * length
        square, cube = share**2, share**3
        return (
            (2 * cube - 3 * square + 1) * f[1]
            + (cube - 2 * square + share) * begin
            + (3 * square - 2 * cube) * f[2]
            + (cube - square) * end
        )


@dataclass(frozen=True, kw_only=True)
class Pushes:
    """What one driven body exerts in the episodes (E), on the grid of their steps (N)."""

    link: int
    """Place in the chain of the link on which it acts."""
    samples: Samples
    """Its forces."""
    force_n: Tensor
    """Force in the middle of each step, world frame [N], as samples are [N], shape (E, N, 3)."""
    place_m: Tensor
    """Point through which it acts, world frame [m], shape (E, N, 3)."""
    torque_n_m: Tensor
    """Torque about that point [N m], shape (E, N, 3)."""
    offset_n: Tensor
    """Force by which the zero of the sensor may be off, along what it usually measures [N], shape (3,)."""

    def generalised(self, balance: Balance, force: Tensor, episode: Tensor, step: int) -> Tensor:
        """Return the generalised force (B, J) of a force (B, 3) in a step."""
        arm = self.place_m[episode, step] - balance.origin[:, self.link]
        torque = torch.linalg.cross(arm, force) + self.torque_n_m[episode, step]
        return (torch.cat((force, torque), -1)[:, None] @ balance.rows[:, self.link])[:, 0]

    def at_force(self, grid: Grid, tracks: JointTracks) -> Tensor:
        """Return the size of the force (E, T) [N] at frames."""
        return self.force_n[:, _steps(grid, tracks.values.shape[1])].norm(dim=-1)

    def at_frames(self, balance: Balance, tracks: JointTracks, grid: Grid) -> Tensor:
        """Return the generalised force (E, T, J) at frames; balance: at all of them (E T)."""
        episodes, frames = tracks.values.shape[:2]
        step, every = _steps(grid, frames).repeat(episodes), torch.arange(episodes).repeat_interleave(frames)
        arm = self.place_m[every, step] - balance.origin[:, self.link]
        force = self.force_n[every, step]
        torque = torch.linalg.cross(arm, force) + self.torque_n_m[every, step]
        pushed = (torch.cat((force, torque), -1)[:, None] @ balance.rows[:, self.link])[:, 0]
        return pushed.unflatten(0, (episodes, frames))

    def arms(self, balance: Balance, tracks: JointTracks, grid: Grid) -> Tensor:
        """Return the velocity (E, T, 3, J) of the point of the force by speed of each joint, at frames."""
        episodes, frames = tracks.values.shape[:2]
        place = self.place_m[:, _steps(grid, frames)].flatten(0, 1)
        linear, turning = balance.rows[:, self.link].split(3, 1)
        arm = (place - balance.origin[:, self.link])[..., None].expand_as(turning)
        return (linear + torch.linalg.cross(turning, arm, dim=1)).unflatten(0, (episodes, frames))

    def direction(self, episode: int) -> Tensor:
        """Return the unit vector (3,) along the mean force in an episode."""
        mean = self.force_n[episode].mean(0)
        return mean / mean.norm().clamp_min(1e-12)


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Steps of the episodes (E) between frames (T), the same number for an interval in all of them."""

    step_s: Tensor
    """Length of each step, 0 beyond the end of an episode [s], shape (E, N)."""
    middle_s: Tensor
    """Middle of each step [s], shape (E, N)."""
    interval: tuple[int, ...]
    """Interval between frames of each step (N)."""

    @staticmethod
    def of(times_s: Tensor, shown: Tensor) -> Grid:
        """Return the steps between the frame times (E, T) that are shown."""
        length = times_s.diff(dim=1)
        length = torch.where(shown[:, 1:], length, torch.zeros_like(length))
        counts = (length.amax(0) / STEP_S).ceil().clamp_min(1).long().tolist()
        interval = [k for k, count in enumerate(counts) for _ in range(count)]
        step = torch.stack([length[:, k] / counts[k] for k in interval], 1)
        return Grid(step_s=step, middle_s=times_s[:, :1] + step.cumsum(1) - 0.5 * step, interval=tuple(interval))


@dataclass(frozen=True, kw_only=True)
class ForceDriven:
    """A chain on a fixed root in the episodes (E) of a fit, with all that pushes it."""

    world: World
    chain: Chain
    root: Tensor
    """Pose of the root: place [m] and quaternion, shape (7,)."""
    grid: Grid
    pushes: Sequence[Pushes]
    sense: Tensor
    """Sense in which joints move on each interval between frames, 1 or -1; 0 where one may stand still; shape
    (E, T - 1, J)."""

    def motion(
        self, column: dict[str, Tensor], episode: Tensor, start: Sequence[Tensor], more: Tensor, noted: Tensor
    ) -> Tensor:
        """Return the values of the joints (B, T, J) at the frames.

        Args:
            column: Parameters of the chain (B,), by name.
            episode: Episode of each item (B,).
            start: Values and speeds at the first frame, each (B, J).
            more: Generalised force in addition on each interval between frames, shape (B, T - 1, J).
            noted: By how much forces are noted too late [s], the part of a mean that they are, and that of the offset
                of the zero which they lack, shape (B, 3).
        """
        world = with_chain_values(self.world, column)
        dynamics = ChainDynamics(next(c for c in world.chains if c.name == self.chain.name), world.bodies)
        kinds, kind = torch.cat((episode[:, None].to(noted), noted), 1).unique(dim=0, return_inverse=True)
        which = kinds[:, 0].long()
        at_s = self.grid.middle_s[which] + kinds[:, 1:2]
        lead = [
            (one, (one.samples.at(which, at_s, kinds[:, 2]) + kinds[:, 3, None, None] * one.offset_n)[kind])
            for one in self.pushes
        ]
        place, turn = self.root[:3].expand(len(episode), 3), self.root[3:].expand(len(episode), 4)
        still = torch.zeros_like(place)
        now = ChainMotion(place, turn, still, still, *start)
        constant = None if bool(dynamics.hinge.any()) else dynamics.balance(now, world.gravity)
        steps, sense = self.grid.step_s[episode], self.sense[episode]
        found = [now.values]
        for number, interval in enumerate(self.grid.interval):
            h = steps[:, number, None]
            half = replace(now, values=now.values + 0.5 * h * now.speeds)
            balance = dynamics.balance(half, world.gravity) if constant is None else constant
            force = more[:, interval]
            for one, pushed in lead:
                force = force + one.generalised(balance, pushed[:, number], episode, number)
            speeds = _after(dynamics, balance, now.speeds, force, sense[:, interval], h)
            now = replace(now, values=half.values + 0.5 * h * speeds, speeds=speeds)
            if number + 1 == len(self.grid.interval) or self.grid.interval[number + 1] != interval:
                found.append(now.values)
        return torch.stack(found, 1)


def _steps(grid: Grid, frames: int) -> Tensor:
    """Return the first step after each frame (T,); the last one before the last frame."""
    first = [grid.interval.index(k) for k in range(frames - 1)]
    return torch.tensor([*first, len(grid.interval) - 1])


def _after(dynamics: ChainDynamics, balance: Balance, speed: Tensor, force: Tensor, sense: Tensor, h: Tensor) -> Tensor:
    """Return the speeds of the joints (B, J) after a step."""
    lost, dry = 0.5 * h * dynamics.numbers["damping"], dynamics.numbers["friction"] * sense
    kept = (balance.mass @ speed[..., None])[..., 0] - lost * speed + h * (force - dry - balance.bias)
    return torch.linalg.solve(balance.mass + torch.diag_embed(lost.expand_as(speed)), kept)


def between(time_s: NDArray[np.float64], values: NDArray[np.float64], at_s: Tensor) -> Tensor:
    """Return values (S, 3) at times (S,) linearly between them at other times (N,), 0 outside."""
    return torch.as_tensor(by_column(at_s.numpy(), time_s, values, outside=0.0))


def impulse_errors(track: Track, std_n: float, edges_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation (K,) of a component of the mean force between times (K + 1,) [N].

    Samples have noise, and the line between them is not the force: where its second difference is beyond the noise, the
    force changes within an interval, at a time that the samples do not tell.

    Args:
        track: Of the driven body, with its force.
        std_n: Noise of a component of a sample [N].
        edges_s: The times.
    """
    assert track.force_n is not None
    time, force = track.time_s, track.force_n
    bent = np.zeros(len(time))
    bent[1:-1] = np.square(np.diff(force, 2, axis=0)).sum(1)
    bent = np.where(bent > NOISY_CHANGE * 18 * std_n**2, bent, 0.0)  # of noise alone: 6 variances a component
    each = np.maximum(bent[1:], bent[:-1]) / UNIFORM**2
    length = np.diff(time)
    impulse = np.concatenate(([0.0], np.cumsum((std_n**2 + each) * length**2)))
    spent = np.diff(np.interp(edges_s, time, impulse))
    return np.sqrt(np.maximum(spent, 0.0)) / np.maximum(np.diff(edges_s), 1e-9)


def hit_errors(
    track: Track, std_n: float, times_s: NDArray[np.float64], gap_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the change of speed over time (K,) [m/s2] by hits that samples may have missed between frames (K + 1,).

    Something that came closer, and is near, may have hit the link where no force is noted at one end of an interval:
    with a speed up to that with which it came.

    Args:
        track: Of the driven body, with its force.
        std_n: Noise of a component of a sample [N].
        times_s: Times of the frames.
        gap_m: Gap between body and link at these.
    """
    pushed, closer, length = loaded(track, std_n, times_s), np.maximum(-np.diff(gap_m), 0.0), np.diff(times_s)
    before = np.maximum(closer, np.concatenate((closer[:1], closer[:-1])))
    may = (np.minimum(gap_m[1:], gap_m[:-1]) < NEAR_M + before) & ~(pushed[1:] & pushed[:-1])
    rate = np.where(may, before / np.square(np.maximum(length, 1e-9)), 0.0)
    wide = np.concatenate((rate[:1], rate, rate[-1:]))
    return np.maximum(np.maximum(wide[:-2], wide[2:]), rate)  # neighbours tell when in an interval it was


def loaded(track: Track, std_n: float, at_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether a driven body exerts a force at times (K,) beyond its noise, by the nearest sample."""
    assert track.force_n is not None
    size = np.linalg.norm(track.force_n, axis=1)
    nearest = np.abs(track.time_s[None] - at_s[:, None]).argmin(1)
    return size[nearest] > LOADED * std_n
