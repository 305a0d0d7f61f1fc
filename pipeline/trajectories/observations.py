"""Measured motions as a batch: windows of episodes on their own time grids, padded to one length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..physics.driven import Drive
from ..physics.parameters import with_own
from ..physics.rotation import matrix_to_quat, quat_conjugate, quat_log, quat_multiply
from ..physics.world import State, World
from .noise import moves

if TYPE_CHECKING:
    from ...datasets.tracks import Track

START_FRAMES = 4
"""The first guess of an item's state is a straight line through this many frames."""


@dataclass(frozen=True)
class Observations:
    """A batch of measured windows.

    names (B): episode of each item; times_s (B, T): frame times, padded beyond an item's end; position_m
    (B, T, nf, 3) and quat_wxyz (B, T, nf, 4) of the free bodies' frames; seen, turned (B, T, nf): 1 where the position,
    the orientation was measured, 0 elsewhere; drives: commands by driven body; state (B, nb): first guess of the
    states at times_s[:, 0]; free (nf): indices of the free bodies; measured_axes
    (B, nf, 3): 1 for coordinates that were measured, which are those that ever change in the track; own: values (B,) of
    effects' parameters that each item has for its own, by `effect.parameter`.
    """

    names: tuple[str, ...]
    times_s: Tensor
    position_m: Tensor
    quat_wxyz: Tensor
    seen: Tensor
    turned: Tensor
    drives: dict[str, Drive]
    state: State
    free: tuple[int, ...]
    measured_axes: Tensor
    own: dict[str, Tensor] = field(default_factory=dict)

    def with_own(self, world: World) -> Observations:
        """Return the items with the own numbers that a world has of their episodes."""
        return replace(self, own=_own(world, self.names))

    def world(self, world: World, repeats: int = 1) -> World:
        """Return a world with the items' own numbers, for the batch repeated so many times."""
        return with_own(world, self.own, repeats)

    @property
    def frames(self) -> Tensor:
        """Number of measured frames of each item (B,)."""
        return (self.seen.amax(-1) > 0).sum(-1)

    @staticmethod
    def of(
        world: World, episodes: Sequence[tuple[str, dict[str, Track]]], windows: Sequence[tuple[float, float]]
    ) -> Observations:
        """Collect one window (start, end) [s] from each of the given episodes, which may repeat."""
        rows = [_Row.of(world, name, tracks, window) for (name, tracks), window in zip(episodes, windows, strict=True)]
        longest = max(len(row.times) for row in rows)
        padded = [row.padded(longest) for row in rows]
        like = world.gravity
        times, position, quat, seen, turned = (
            torch.as_tensor(np.stack([getattr(row, key) for row in padded])).to(like)
            for key in ("times", "position", "quat", "seen", "turned")
        )
        drives = {
            body.name: Drive.of([tracks[body.name] for _, tracks in episodes], like)
            for body in world.bodies
            if body.motion == "driven"
        }
        free = tuple(world.free)
        partial = Observations(
            tuple(row.name for row in rows),
            times,
            position,
            quat,
            seen,
            turned,
            drives,
            _resting(world, len(rows)),
            free,
            torch.as_tensor(np.stack([row.axes for row in rows])).to(like),
            _own(world, [row.name for row in rows]),
        )
        return replace(partial, state=first_state(world, partial))

    def select(self, items: Sequence[int]) -> Observations:
        """Return some items of the batch."""
        index = torch.as_tensor(list(items))
        picked = {key: getattr(self, key)[index] for key in ("times_s", "position_m", "quat_wxyz", "seen", "turned")}
        drives = {name: drive.select(index) for name, drive in self.drives.items()}
        names = tuple(self.names[i] for i in items)
        picked["measured_axes"] = self.measured_axes[index]
        own = {name: value[index] for name, value in self.own.items()}
        return replace(self, names=names, drives=drives, state=self.state.at(index), own=own, **picked)


def _own(world: World, names: Sequence[str]) -> dict[str, Tensor]:
    """Return the own values (B,) of episodes by parameter; those that have none have the world's."""
    numbers = sorted({number for values in world.own.values() for number in values})
    common = {f"{a.effect.name}.{key}": float(value[0]) for a in world.effects for key, value in a.values.items()}
    return {
        number: torch.tensor([world.own.get(name, {}).get(number, common[number]) for name in names]).to(world.gravity)
        for number in numbers
        if number in common
    }


@dataclass(frozen=True)
class _Row:
    name: str
    times: np.ndarray
    position: np.ndarray
    quat: np.ndarray
    seen: np.ndarray
    turned: np.ndarray
    axes: np.ndarray

    @staticmethod
    def of(world: World, name: str, tracks: dict[str, Track], window: tuple[float, float]) -> _Row:
        bodies = [world.bodies[index].name for index in world.free]
        cut = {body: tracks[body].window(*window) for body in bodies if body in tracks}
        times = np.unique(np.concatenate([track.time_s for track in cut.values()]))
        shape = (len(times), len(bodies))
        position, quat = np.zeros((*shape, 3)), np.tile([1.0, 0, 0, 0], (*shape, 1))
        seen, turned, axes = np.zeros(shape), np.zeros(shape), np.ones((len(bodies), 3))
        for column, body in enumerate(bodies):
            if body in cut:
                at = np.searchsorted(times, cut[body].time_s)
                position[at, column], seen[at, column] = cut[body].position_m, 1.0
                axes[column] = moves(tracks[body].position_m)
                measured = cut[body].quat_wxyz
                if measured is not None:
                    quat[at, column], turned[at, column] = measured, 1.0
        return _Row(name, times, position, quat, seen, turned, axes)

    def padded(self, length: int) -> _Row:
        extra = length - len(self.times)
        step = np.diff(self.times).mean() if len(self.times) > 1 else 1.0
        times = np.concatenate((self.times, self.times[-1] + step * np.arange(1, extra + 1)))

        def pad(values: np.ndarray) -> np.ndarray:
            return np.concatenate((values, np.repeat(values[-1:], extra, 0)))

        zero = np.zeros((extra, self.seen.shape[1]))
        return _Row(
            self.name,
            times,
            pad(self.position),
            pad(self.quat),
            np.concatenate((self.seen, zero)),
            np.concatenate((self.turned, zero)),
            self.axes,
        )


def first_state(world: World, observations: Observations) -> State:
    """Return states at the first frames: a straight line through each item's first few measured frames."""
    state = observations.state
    position, quat = state.position_m.clone(), state.quat_wxyz.clone()
    velocity, omega = state.velocity_m_s.clone(), state.omega_body_rad_s.clone()
    for column, body in enumerate(observations.free):
        for item in range(len(observations.names)):
            at = torch.nonzero(observations.seen[item, :, column])[:START_FRAMES, 0]
            if len(at) < 2:
                continue
            t = observations.times_s[item, at] - observations.times_s[item, 0]
            position[item, body], velocity[item, body] = straight_line(t, observations.position_m[item, at, column])
            if bool(observations.turned[item, at, column].all()):
                measured = observations.quat_wxyz[item, at, column]
                turn = quat_log(quat_multiply(quat_conjugate(measured[:1]), measured))
                quat[item, body], omega[item, body] = measured[0], straight_line(t, turn)[1]
    return State(position, quat, velocity, omega)


def straight_line(t: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return value at 0 and slope (3,) of the straight line through values (n, 3) at t (n,), by least squares.

    By its formula: LAPACK's solution now and then differs in the last bit from one call to the next.
    """
    middle, mean = t.mean(), values.mean(0)
    away = (t - middle)[:, None]
    slope = (away * (values - mean)).sum(0) / away.square().sum()
    return mean - slope * middle, slope


def _resting(world: World, batch: int) -> State:
    """Return all bodies unturned and at rest: fixed ones where they stand, the others at the origin of the world."""
    like = world.gravity
    zero = torch.zeros(batch, len(world.bodies), 3).to(like)
    position, quat = zero.clone(), matrix_to_quat(torch.eye(3).to(like)).expand(batch, len(world.bodies), 4).clone()
    for index, body in enumerate(world.bodies):
        if body.motion == "fixed" and body.place is not None:
            position[:, index], quat[:, index] = body.place[:, :3], body.place[:, 3:]
    return State(position, quat, zero, zero)
