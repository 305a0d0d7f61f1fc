"""Segments of episodes as a batch, each with its state: their residuals under a world, and the Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, overload

import torch
from torch import Tensor

from ..geometry.rotation import continuous_turns, quat_exp, quat_multiply
from ..physics.chains.state import on_joints
from ..physics.contact_law import ContactLaw
from ..physics.engine import rollout as rolled_out
from ..physics.engine import rollouts_at_once
from ..physics.observation_model import measure, true_times
from ..physics.parameters import Parameter, apply_parameters
from ..physics.rollout import Rollout
from ..physics.state import State
from ..physics.world import World
from ..trajectories.innovations import WHITE, NoiseModel, body_innovations
from ..trajectories.observations import Observations, with_spins
from ..trajectories.residuals import STATE_SIZE, TrajectoryResiduals, retract
from ..trajectories.segmentation import Segment
from ..trajectories.time_errors import without_time_errors
from ..trajectories.track_noise import Noise

Kind = Literal["flight", "contact"]

FLIGHT_STEP_S, FLIGHT_STEP_NOISE_M = 0.0025, 2e-4
"""Maximum step [s] in flight, where nothing is stiff, and the noise [m] down to which it suffices: the error of a drag
of 1 / s is 0.1 %, about 0.1 mm, which with a noise of 0.05 mm looks like a separate effect."""
LEAST_STEP_S = 2.5e-4
"""Minimum step [s] in flight."""
START_FRAMES = (2, 4, 7)
"""Numbers of frames of the straight lines from which a contact segment's state is searched (pitfall P2)."""
PARAMETER_STEP = 0.04
"""Difference step by parameters in contact, in widths of their priors: a fifth of a relevant change."""
CONTACT_STEP_S = 0.002
"""Maximum step [s] in contact, which is also at most half the contact time: the law does not depend on the step."""


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Segments (B) of one kind as a batch."""

    kind: Kind
    """Kind of the segments: flight or contact."""
    world: World
    """World in which they are rolled out."""
    items: tuple[Segment, ...]
    """Episode and frames of each segment (B)."""
    observations: Observations
    """Frames of the segments, padded, with the best known state of each."""
    noise: Noise
    """Standard deviations of the tracks (position [m], rotation [rad])."""
    noise_model: NoiseModel = WHITE
    """Correlation of the errors in time."""
    in_short_steps: bool = False
    """Whether flights take the shortest steps, not those that are exact below the noise of a frame."""

    @staticmethod
    def of(
        kind: Kind,
        world: World,
        whole: Observations,
        items: Sequence[Segment],
        noise: Noise,
        memory: NoiseModel = WHITE,
    ) -> Segments:
        """Cut whole episodes; the states are first guesses, see :func:`fit_states`."""
        cut = _windows(whole, items)
        found = Segments(
            kind=kind,
            world=world_for(kind, world, noise.position_m),
            items=tuple(items),
            observations=cut,
            noise=noise,
            noise_model=memory,
        )
        return found.with_state(line_state(found, START_FRAMES[1]))

    @property
    def lengths(self) -> list[int]:
        """Number of frames of each segment."""
        return [item.last - item.first + 1 for item in self.items]

    @property
    def dof(self) -> Tensor:
        """Degrees of freedom (B,) of each segment: measured coordinates less those used up by its state.

        A coordinate that is the same in all frames was not measured.
        """
        seen = self.observations
        moved, turned = seen.seen.sum(1), seen.has_orientation.sum(1)
        axes = seen.measured_axes.sum(-1)
        free = axes * (moved - 2).clamp_min(0) + 3 * (turned - 2).clamp_min(0)
        if seen.carried is None:
            return free.sum(-1)
        lost = (seen.seen[:, :, 0] * seen.carried.square().sum((-1, -2))).sum(1)
        return free.sum(-1) - lost * (1 - 2 / moved[:, 0].clamp_min(2.0))

    def select(self, items: Sequence[int]) -> Segments:
        """Return some of the segments."""
        picked = tuple(self.items[i] for i in items)
        return replace(self, items=picked, observations=self.observations.select(items))

    def with_state(self, state: State) -> Segments:
        """Return the segments with other states, in which links are on their joints."""
        return replace(self, observations=replace(self.observations, state=on_joints(self.world, state)))

    def in_world(self, world: World) -> Segments:
        """Return the segments in another world, with the step that their kind needs."""
        return replace(self, world=world_for(self.kind, world, 0.0 if self.in_short_steps else self.noise.position_m))

    def in_states(self, states: Sequence[State]) -> Segments:
        """Return the segments once in each of several states (B), as one batch."""
        every = self.select(list(range(len(self.items))) * len(states))
        return every.with_state(State.joined(*states))

    def chunks(self, directions: int) -> list[list[int]]:
        """Return the indices of the segments in equal parts; each fits one batch with `directions` variations."""
        count = len(self.items)
        number = max(1, -(-count * directions // rollouts_at_once(self.world)))
        size = -(-count // number)
        return [list(range(k, min(k + size, count))) for k in range(0, count, size)]

    @overload
    def residuals(
        self, parameters: Sequence[Parameter], values: Tensor, jacobian: Literal[True] = True
    ) -> tuple[Tensor, Tensor]: ...

    @overload
    def residuals(
        self, parameters: Sequence[Parameter], values: Tensor, jacobian: Literal[False]
    ) -> tuple[Tensor, None]: ...

    def residuals(
        self, parameters: Sequence[Parameter], values: Tensor, jacobian: bool = True
    ) -> tuple[Tensor, Tensor | None]:
        """Return residuals (B, T nf, 6) in sigmas and, if wanted, their Jacobian (B, T nf, 6, P + S).

        With correlated noise they are the innovations, see `correlated_noise`; beside errors of the frames' times, less
        what these explain, see `time_errors`.

        The Jacobian is one of differences: in contact they smooth the roughness of a step, and in flight, which is
        smooth, they cost a sixth of exact derivatives and agree with them to 1e-4.

        Args:
            parameters: Parameters of the world that are differentiated.
            values: In fitted coordinates, shape (P,), or (B, P) for values of each segment.
            jacobian: Whether it is wanted; columns of parameters first, then of the state change.
        """
        size = STATE_SIZE * len(self.observations.free)
        steps = [_difference(p) for p in parameters]
        parts = []
        for places in self.chunks((1 + (self.kind == "contact")) * size + len(parameters) + 1 if jacobian else 1):
            some = self.observations.select(places)
            problem = replace(self._problem(parameters, some), parameter_steps=steps)
            shared = values if values.ndim == 1 else values[places]
            rows, slopes = problem(shared, torch.zeros(len(places), size).to(self.world.gravity), jacobian)
            fresh = None if slopes is None else self._innovations(some, slopes)
            parts.append((self._innovations(some, rows), fresh))
        rows = torch.cat([r for r, _ in parts])
        return rows, torch.cat([j for _, j in parts if j is not None]) if jacobian else None

    def _problem(self, parameters: Sequence[Parameter], seen: Observations) -> TrajectoryResiduals:
        """Return the residuals of some of the segments."""
        smooth = self.kind == "flight"
        return TrajectoryResiduals(self.world, parameters, seen, *self.noise, differences=True, smooth=smooth)

    def varied(self, parameters: Sequence[Parameter], values: Tensor, changes: Tensor) -> Tensor:
        """Return residuals (K, B, T nf, 6), as `residuals` does, of K variations of each segment.

        Args:
            parameters: Parameters of the world (P).
            values: Their values in fitted coordinates, shape (K, B, P).
            changes: Changes of the states, shape (K, B, S).
        """
        parts = []
        for places in self.chunks(len(values)):
            some = self.observations.select(places)
            rows = self._problem(parameters, some).varied(values[:, places], changes[:, places])
            parts.append(self._innovations(some, rows.movedim(0, -1)).movedim(-1, 0))
        return torch.cat(parts, 1)

    def innovations(self, rows: Tensor) -> Tensor:
        """Return rows (B, T nf, 6, ...) as innovations: less what the correlated errors of earlier frames predict."""
        return self._innovations(self.observations, rows)

    def _innovations(self, seen: Observations, rows: Tensor) -> Tensor:
        """Return rows (B, T nf, 6, ...) of some of the segments as innovations, less what errors of times explain."""
        masks = torch.stack((seen.seen, seen.has_orientation), -1)
        if seen.carried is not None:
            rows = _off_carriers(rows, seen.carried)
        found = body_innovations(rows, seen.times_s, masks, self.noise_model)
        if seen.time_shift is None:
            return found
        shifts = seen.time_shift * masks.repeat_interleave(3, -1)
        shifts = shifts / torch.tensor(self.noise).repeat_interleave(3).to(shifts)
        return without_time_errors(found, shifts, seen.times_s, masks, self.noise_model)

    def slopes(self, parameters: Sequence[Parameter], values: Tensor, columns: Sequence[int], rows: Tensor) -> Tensor:
        """Return derivatives (B, T nf, 6, K) of the residuals by parameters alone, by one-sided differences.

        Args:
            parameters: Parameters of the world (P).
            values: Where each derivative is taken, in fitted coordinates, shape (K, P); all leave the same residuals.
            columns: Place of the parameter by which each is taken (K).
            rows: The residuals there.
        """
        steps = torch.tensor([_difference(parameters[column])[1] for column in columns]).to(values)
        every = self.in_states([self.observations.state] * len(columns))
        moved = values.scatter_add(1, torch.tensor(columns)[:, None].to(values.device), steps[:, None])
        moved = moved.repeat_interleave(len(self.items), 0)
        high = every.residuals(parameters, moved, jacobian=False)[0].unflatten(0, (len(columns), -1))
        slopes = (high - rows) / steps[:, None, None, None]
        return torch.nan_to_num(slopes, posinf=0.0, neginf=0.0).movedim(0, -1)

    def rollout(self, record_contacts: bool = False) -> Rollout:
        """Return the true motion of the segments from their states."""
        seen = self.observations
        world = seen.world(self.world)
        with torch.no_grad():
            return rolled_out(world, seen.state, true_times(world, seen.times_s), seen.drives, record_contacts)

    def positions(self, parameters: Sequence[Parameter] = (), values: Tensor | None = None) -> Tensor:
        """Return the positions (B, T, nf, 3) [m] of the free bodies as they would be measured.

        Args:
            parameters: Parameters of the world that are set.
            values: Their values in fitted coordinates, (B, P).
        """
        seen = self.observations
        world = seen.world(self.world)
        if parameters and values is not None:
            decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(parameters)], -1)
            world = apply_parameters(world, parameters, decoded)
        with torch.no_grad():
            return measure(world, seen.state, seen.times_s, seen.drives).position_m[:, :, list(seen.free)]

    def moved(self, change: Tensor) -> Segments:
        """Return the segments with their states moved by changes (B, S)."""
        return self.with_state(retract(self.observations.state, change, self.observations.free))


def _difference(parameter: Parameter) -> tuple[float, float]:
    """Return how far down and up a parameter is moved for its derivative; only up, as many may not be below 0."""
    return 0.0, PARAMETER_STEP * parameter.prior[1]


def world_for(kind: Kind, world: World, noise_m: float) -> World:
    """Return the world in which segments of a kind are rolled out: flight needs no contact and takes longer steps.

    Args:
        kind: Of the segments.
        world: The world.
        noise_m: Standard deviation of the measured positions: steps are short enough to be exact below it.
    """
    if kind == "contact":
        half = 0.5 * float(world.contact.contact_time_s.min()) if isinstance(world.contact, ContactLaw) else 0.0
        return replace(world, step_s=max(world.step_s, min(CONTACT_STEP_S, half)))
    step = max(LEAST_STEP_S, FLIGHT_STEP_S * min(1.0, noise_m / FLIGHT_STEP_NOISE_M))
    return replace(world, touching=False, step_s=step)


def _windows(whole: Observations, items: Sequence[Segment]) -> Observations:
    """Return the frames of segments as a batch, padded to the longest; states are still those of whole episodes."""
    rows = torch.tensor([item.episode for item in items])
    lengths = torch.tensor([item.last - item.first + 1 for item in items])
    first = torch.tensor([item.first for item in items])
    offset = torch.arange(int(lengths.max()))
    place = first[:, None] + torch.minimum(offset, lengths[:, None] - 1)
    inside = (offset < lengths[:, None]).to(whole.times_s)
    times = whole.times_s[rows[:, None], place]
    step = (times[:, -1] - times[:, 0]) / (lengths - 1)
    times = times + step[:, None] * (offset - lengths[:, None] + 1).clamp_min(0)
    picked = {
        key: getattr(whole, key)[rows[:, None], place] for key in ("position_m", "quat_wxyz", "seen", "has_orientation")
    }
    picked |= {key: picked[key] * inside[..., None] for key in ("seen", "has_orientation")}
    drives = {name: drive.select(rows) for name, drive in whole.drives.items()}
    state = whole.state.at(rows)
    names = tuple(whole.names[item.episode] for item in items)
    picked["measured_axes"] = whole.measured_axes[rows]
    if whole.spin_rad_s is not None:
        spin = whole.spin_rad_s[rows[:, None], place]
        picked["spin_rad_s"] = torch.where(inside[..., None, None] > 0, spin, torch.nan)
    if whole.time_shift is not None:
        picked["time_shift"] = whole.time_shift[rows[:, None], place]
    if whole.carried is not None:
        picked["carried"] = whole.carried[rows[:, None], place]
    own = {name: value[rows] for name, value in whole.own_values.items()}
    return replace(whole, names=names, times_s=times, drives=drives, state=state, own_values=own, **picked)


def _off_carriers(rows: Tensor, carried: Tensor) -> Tensor:
    """Return rows (B, T, 6, ...) without the parts of positions along carrying directions (B, T, 3, 3)."""
    moved, turned = rows.split(3, 2)
    flat = moved.flatten(3) if moved.ndim > 3 else moved[..., None]
    left = flat - carried.mT @ (carried @ flat)
    return torch.cat((left.view_as(moved), turned), 2)


def line_state(segments: Segments, frames: int) -> State:
    """Return states at the first frames from straight lines through some frames; in flight with gravity."""
    seen, world = segments.observations, segments.world
    state = seen.state
    fields = [value.clone() for value in state.tensors]
    t = (seen.times_s - seen.times_s[:, :1])[:, :frames]
    fall = 0.5 * t.square()[..., None] * world.gravity[:, None] if segments.kind == "flight" else torch.zeros(1)
    for column, body in enumerate(seen.free):
        moved, turned = seen.seen[:, :frames, column], seen.has_orientation[:, :frames, column]
        fields[0][:, body], fields[2][:, body] = _line(t, seen.position_m[:, :frames, column] - fall, moved)
        at = turned.argmax(1)  # the first measured orientation
        item = torch.arange(len(at))
        base = seen.quat_wxyz[item, at, column]
        turn = continuous_turns(t, seen.quat_wxyz[:, :frames, column], turned, at)
        angle, omega = _line(t, turn, turned)
        known = (turned.sum(1) >= 2)[:, None]
        fields[1][:, body] = torch.where(known, quat_multiply(base, quat_exp(angle)), base)
        fields[3][:, body] = torch.where(known, omega, torch.zeros_like(omega))
    return with_spins(State(*fields), seen)


def _line(t: Tensor, values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return value at 0 and slope, each (B, 3), of weighted straight lines through values (B, n, 3) at t (B, n)."""
    total = weight.sum(1).clamp_min(1.0)[:, None]
    mean = (weight[..., None] * values).sum(1) / total
    middle = (weight * t).sum(1)[:, None] / total
    away = weight * (t - middle)
    slope = (away[..., None] * values).sum(1) / away.square().sum(1).clamp_min(1e-12)[:, None]
    return mean - middle * slope, slope
