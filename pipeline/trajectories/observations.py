"""Measured motion as a batch: windows of episodes on their own time grids, padded to one length."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode, Track
from ...schemas import InputDataError
from ..geometry.rotation import continuous_turns, matrix_to_quat
from ..physics.chains.state import on_joints
from ..physics.kinematic import Drive
from ..physics.parameters import with_own
from ..physics.state import State
from ..physics.world import World
from .track_noise import moves

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Track

START_FRAMES = 4
"""Number of frames of the straight line that is the first guess of an item's state."""
LONGEST_STEP_S = 0.2
"""Maximum median time between frames [s]: slower tracks show no flight, and times in milliseconds look slower."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """A batch of measured windows (B items, T frames, nf free bodies)."""

    names: tuple[str, ...]
    """Episode of each item (B)."""
    times_s: Tensor
    """Frame times, padded beyond an item's end, shape (B, T) [s]."""
    position_m: Tensor
    """Positions of the free bodies' frames, world, shape (B, T, nf, 3)."""
    quat_wxyz: Tensor
    """Orientations of the free bodies' frames, body to world, shape (B, T, nf, 4)."""
    seen: Tensor
    """1 where the position was measured, 0 elsewhere, shape (B, T, nf)."""
    has_orientation: Tensor
    """1 where the orientation was measured, 0 elsewhere, shape (B, T, nf)."""
    drives: dict[str, Drive]
    """Commands by kinematic body."""
    state: State
    """First guess of the states of all bodies (B, nb) at the first frames."""
    free: tuple[int, ...]
    """Indices of the free bodies (nf)."""
    measured_axes: Tensor
    """1 for measured coordinates, which are those that change anywhere in the track, shape (B, nf, 3)."""
    own_values: dict[str, Tensor] = field(default_factory=dict)
    """Group-specific values (B,) of effects' parameters, by `effect.parameter`."""
    spin_rad_s: Tensor | None = None
    """Measured spins of free bodies whose orientation was not measured, along the world's axes, shape (B, T, nf, 3)
    [rad/s]; NaN where there is none, and None without any."""
    time_shift: Tensor | None = None
    """How far one standard deviation of the error of a frame's time moves positions [m] and turns rotations [rad, body
    axes], shape (B, T, nf, 6); None where times are right."""
    carried: Tensor | None = None
    """Of one free body, orthonormal directions along which surfaces carry it, in which positions do not count, as rows,
    zero where there are fewer than three, shape (B, T, 3, 3); None where all directions count."""

    def with_own(self, world: World) -> Observations:
        """Return the items with the group-specific parameters that a world has for their episodes."""
        own = _own(world, self.names)
        return replace(self, own_values=own) if own or self.own_values else self

    def world(self, world: World, repeats: int = 1) -> World:
        """Return a world with the items' group-specific parameters, for the batch repeated `repeats` times."""
        return with_own(world, self.own_values, repeats)

    @property
    def first_spin(self) -> tuple[Tensor, Tensor] | None:
        """Mean measured spin (B, nf, 3) of the first frames [rad/s], and where it is known (B, nf); None without any.

        It is in the body's frame, which without orientations is that of the world at the first frame.
        """
        if self.spin_rad_s is None:
            return None
        mean = self.spin_rad_s[:, :START_FRAMES].nanmean(1)
        return torch.nan_to_num(mean), mean.isfinite().all(-1)

    @property
    def frames(self) -> Tensor:
        """Number of measured frames of each item (B,)."""
        return (self.seen.amax(-1) > 0).sum(-1)

    @property
    def ends(self) -> Tensor:
        """Number of frames of each item up to its last measured one (B,), at least 2."""
        measured = (self.seen.amax(-1) > 0) | (self.has_orientation.amax(-1) > 0)
        return (measured * torch.arange(1, measured.shape[1] + 1)).amax(-1).clamp(min(2, measured.shape[1]))

    @staticmethod
    def of(world: World, episodes: Sequence[Episode], windows: Sequence[tuple[float, float]]) -> Observations:
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
            if body.name in world.driven
        }
        free = tuple(world.tracked)
        partial = Observations(
            names=tuple(row.name for row in rows),
            times_s=times,
            position_m=position,
            quat_wxyz=quat,
            seen=seen,
            has_orientation=turned,
            drives=drives,
            state=_resting(world, len(rows)),
            free=free,
            measured_axes=torch.as_tensor(np.stack([row.axes for row in rows])).to(like),
            own_values=_own(world, [row.name for row in rows]),
            spin_rad_s=_measured_spins(padded, like),
        )
        return replace(partial, state=on_joints(world, first_state(world, partial)))

    def select(self, items: Sequence[int]) -> Observations:
        """Return some items of the batch."""
        if list(items) == list(range(len(self.names))):
            return self
        index = torch.as_tensor(list(items))
        picked = {
            key: getattr(self, key)[index] for key in ("times_s", "position_m", "quat_wxyz", "seen", "has_orientation")
        }
        drives = {name: drive.select(index) for name, drive in self.drives.items()}
        names = tuple(self.names[i] for i in items)
        picked["measured_axes"] = self.measured_axes[index]
        if self.spin_rad_s is not None:
            picked["spin_rad_s"] = self.spin_rad_s[index]
        if self.time_shift is not None:
            picked["time_shift"] = self.time_shift[index]
        if self.carried is not None:
            picked["carried"] = self.carried[index]
        own = {name: value[index] for name, value in self.own_values.items()}
        return replace(self, names=names, drives=drives, state=self.state.at(index), own_values=own, **picked)


def _own(world: World, names: Sequence[str]) -> dict[str, Tensor]:
    """Return group-specific values (B,) of episodes by parameter; the world's common value where there is none."""
    numbers = sorted({number for values in world.own_values.values() for number in values})
    common = {f"{a.effect.name}.{key}": float(value[0]) for a in world.effects for key, value in a.values.items()}
    return {
        number: torch.tensor([world.own_values.get(name, {}).get(number, common[number]) for name in names]).to(
            world.gravity
        )
        for number in numbers
        if number in common
    }


@dataclass(frozen=True, kw_only=True)
class _Row:
    """One window of one episode as arrays (T frames, nf free bodies)."""

    name: str
    """Name of the episode."""
    times: np.ndarray
    """Frame times, shape (T,) [s]."""
    position: np.ndarray
    """Positions, world, shape (T, nf, 3) [m]."""
    quat: np.ndarray
    """Orientations, body to world, w first, shape (T, nf, 4)."""
    seen: np.ndarray
    """1 where the position was measured, shape (T, nf)."""
    turned: np.ndarray
    """1 where the orientation was measured, shape (T, nf)."""
    axes: np.ndarray
    """1 for measured coordinates, shape (nf, 3)."""
    spin: np.ndarray
    """Measured spins where the orientation was not measured, shape (T, nf, 3) [rad/s]; else NaN."""

    @staticmethod
    def of(world: World, name: str, tracks: dict[str, Track], window: tuple[float, float]) -> _Row:
        """Cut a window [s] from the tracks of an episode, on the union of their frame times."""
        bodies = [world.bodies[index].name for index in world.tracked]
        cut = {body: tracks[body].window(*window) for body in bodies if body in tracks}
        times = np.unique(np.concatenate([track.time_s for track in cut.values()]))
        shape = (len(times), len(bodies))
        rate = np.full((*shape, 3), np.nan)
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
                elif (spin := cut[body].omega_body_rad_s) is not None:
                    rate[at, column] = spin
        return _Row(
            name=name, times=times, position=position, quat=quat, seen=seen, turned=turned, axes=axes, spin=rate
        )

    def padded(self, length: int) -> _Row:
        """Return the window extended to a length: the last values repeated, marked as not measured."""
        extra = length - len(self.times)
        step = np.diff(self.times).mean() if len(self.times) > 1 else 1.0
        times = np.concatenate((self.times, self.times[-1] + step * np.arange(1, extra + 1)))

        def pad(values: np.ndarray) -> np.ndarray:
            return np.concatenate((values, np.repeat(values[-1:], extra, 0)))

        zero = np.zeros((extra, self.seen.shape[1]))
        return _Row(
            name=self.name,
            times=times,
            position=pad(self.position),
            quat=pad(self.quat),
            seen=np.concatenate((self.seen, zero)),
            turned=np.concatenate((self.turned, zero)),
            axes=self.axes,
            spin=np.concatenate((self.spin, np.full((extra, *self.spin.shape[1:]), np.nan))),
        )


def _measured_spins(rows: Sequence[_Row], like: Tensor) -> Tensor | None:
    """Return the measured spins (B, T, nf, 3) of padded windows; None without any."""
    spins = np.stack([row.spin for row in rows])
    return None if np.isnan(spins).all() else torch.as_tensor(spins).to(like)


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
            if bool(observations.has_orientation[item, at, column].all()):
                measured = observations.quat_wxyz[item, at, column]
                turn = continuous_turns(t, measured)
                quat[item, body], omega[item, body] = measured[0], straight_line(t, turn)[1]
    return with_spins(State(position, quat, velocity, omega), observations)


def with_spins(state: State, observations: Observations) -> State:
    """Return states at the first frames (B) with the measured spins of bodies whose orientation was not measured."""
    if observations.first_spin is None:
        return state
    (spin, known), free = observations.first_spin, list(observations.free)
    omega = state.omega_body_rad_s.clone()
    omega[:, free] = torch.where(known[..., None], spin, omega[:, free])
    return replace(state, omega_body_rad_s=omega)


def straight_line(t: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return value at 0 and slope (3,) of the straight line through values (n, 3) at t (n,), by least squares.

    In closed form: LAPACK's solution sometimes differs in the last bit from one call to the next.
    """
    middle, mean = t.mean(), values.mean(0)
    away = (t - middle)[:, None]
    slope = (away * (values - mean)).sum(0) / away.square().sum()
    return mean - slope * middle, slope


def _resting(world: World, batch: int) -> State:
    """Return all bodies unrotated and at rest: fixed ones at their place, the others at the origin of the world."""
    like = world.gravity
    zero = torch.zeros(batch, len(world.bodies), 3).to(like)
    position, quat = zero.clone(), matrix_to_quat(torch.eye(3).to(like)).expand(batch, len(world.bodies), 4).clone()
    rooted = {chain.root for chain in world.chains if chain.base == "fixed"}
    for index, body in enumerate(world.bodies):
        if (body.motion == "fixed" or body.name in rooted) and body.place is not None:
            position[:, index], quat[:, index] = body.place[:, :3], body.place[:, 3:]
    return State(position, quat, zero, zero)


def track_episodes(capture: Capture, split: str) -> list[Episode]:
    """Return the episodes of a split that have tracks of a free body.

    Raises:
        InputDataError: If none has.
    """
    free = {body.name for body in capture.manifest.bodies if body.motion in ("free", "link")}
    episodes = [Episode(name, capture.tracks(name)) for name in capture.episodes(split)]
    usable = [episode for episode in episodes if free & set(episode.tracks)]
    if not usable:
        raise InputDataError(
            f"{capture.root}: none of the {len(episodes)} episodes of split '{split}' has a track of a free body.",
            "tracks/<episode>.csv with rows for a body whose motion is 'free'.",
            "add tracks, or fit from the videos: --supervise images.",
        )
    refuse_slow_times(usable, free, str(capture.root))
    return usable


_MILLISECONDS = "if these are milliseconds, they do not match the column time_s."
_FOR_PUSHES = (
    "track the body during the motion, or write time_s in seconds if these are milliseconds; of pushes with the poses "
    "before and after alone, benchmarks/pushes.py fits friction and face_exponent (docs/real-data.md)."
)


def refuse_slow_times(episodes: Sequence[Episode], bodies: Collection[str], where: str) -> None:
    """Refuse tracks whose frames are too far apart to show a flight.

    Args:
        episodes: The episodes.
        bodies: Names of the bodies whose tracks are looked at.
        where: The capture, for messages, which name the slowest of its episodes.

    Raises:
        InputDataError: If they are: times are probably in milliseconds.
    """
    steps = {name: [np.diff(tracks[body].time_s) for body in bodies if body in tracks] for name, tracks in episodes}
    steps = {name: np.concatenate(found) for name, found in steps.items() if found}
    step = float(np.median(np.concatenate(list(steps.values())))) if steps else 0.0
    if step > LONGEST_STEP_S:
        slowest = max(steps, key=lambda name: float(np.median(steps[name])))
        ends = all(len(found) <= len(bodies) for found in steps.values())
        raise InputDataError(
            f"{where}/tracks/{slowest}.csv: the tracks have a frame every {step:.3g} s; "
            + ("two poses do not show the motion." if ends else _MILLISECONDS),
            f"at most {LONGEST_STEP_S:g} s.",
            _FOR_PUSHES if ends else "write time_s in seconds.",
        )
