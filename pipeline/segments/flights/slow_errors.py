"""Slow errors of tracked flights: what differs from flight to flight, and no physical effect explains.

A window of a few frames cannot tell an error that changes within tenths of a second from motion. Whole flights can: a
physical effect does the same in all of them, an error of the tracking does not. The residuals of whole flights are
therefore split into what common effects can follow (all candidates at once, linearised, and the state of each flight)
and the rest, whose variance components are estimated by restricted maximum likelihood (Patterson & Thompson 1971):

    white noise + a fast process + a slow process + an acceleration across gravity of each flight's own

The last is what a frame that is levelled anew for each episode makes of gravity. Effects are then judged by generalised
least squares with these errors (`innovations`): evidence adds up over episodes, not over the frames of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.io.progress import note
from ...physics.world import World
from ...trajectories.innovations import WHITE, CorrelatedNoise, NoiseModel
from ...trajectories.segmentation import Segment
from ...trajectories.track_noise import FLOOR_M, FLOOR_RAD
from ..candidates import Variant
from ..linearization import derivatives
from ..prepare import Prepared, whole_flights
from ..segment_states import fit_states
from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS
from .contrasts import KEPT, LEAST_MOVE, FlightContrasts
from .variance_components import FAST_S, FASTEST_S, variance_components

LIMITS = SEGMENT_THRESHOLDS.slow_errors

Array = NDArray[np.float64]

FLIGHTS = 24
"""Maximum number of flights that the estimate uses, evenly spread."""
LEAST_COUNT = 12
"""Fewest residuals of a flight, beside what states and effects take, that tell whether it is one."""
SPACING, FINER, THINNED = 0.5, 0.7, 3
"""Times between frames, in correlation times; share of it below which the estimate is made again, at most so often."""
SHORTEST = 8
"""Minimum number of frames of a flight."""
COMMON_S = 0.1
"""Length [s] of the intervals in each of which one force may act in all episodes alike."""


@dataclass(frozen=True)
class SlowErrors:
    """The variance components of tracked flights."""

    noise_model: NoiseModel
    """The noise model, with its slow part."""
    without_sway: NoiseModel
    """The likeliest one without accelerations of the flights' own."""
    evidence: float
    """Twice the gain of the log-likelihood by the slow process."""
    sway_evidence: float
    """Twice the gain by accelerations of the flights' own, beside the slow process."""
    flights: tuple[Segment, ...]
    """Whole flights without those that hold something else than flight, see `_sound_flights`."""

    def position_m(self, std_m: float) -> float:
        """Return the standard deviation [m] of the slow errors of positions, from that of the tracks [m]."""
        return self.noise_model.position.slow * std_m

    def tiltless(self) -> SlowErrors | None:
        """Return the errors without accelerations of the flights' own; None where white noise is left."""
        if not (self.without_sway.slow or self.without_sway.correlated):
            return None
        return replace(self, noise_model=self.without_sway, sway_evidence=0.0)

    def sway_m_s2(self, std_m: float) -> float:
        """Return the standard deviation [m/s2] of the flights' own accelerations, from that of the tracks [m]."""
        return self.noise_model.position.sway * std_m


def slow_errors(prepared: Prepared, world: World, variants: Sequence[Variant]) -> SlowErrors | None:
    """Return the variance components of whole flights; None where none is slow. Arguments as of `flight_errors`."""
    found = flight_errors(prepared, world, variants)
    return found if found is not None and found.noise_model.slow else None


def flight_errors(prepared: Prepared, world: World, variants: Sequence[Variant]) -> SlowErrors | None:
    """Return the variance components of whole flights; None where the tracks' noise explains them.

    Where the errors of short windows are correlated, the components are estimated again: a polynomial that follows any
    motion takes away what tells a slow error from none, and effects that are common to all flights take far less.

    Args:
        prepared: The episodes.
        world: The world with the effects found so far.
        variants: The candidates, all of which are allowed for.
    """
    if prepared.flight is None:
        return None
    every = whole_flights(prepared.flight.items)
    items = _long_ones(every)
    if len({item.episode for item in items}) < LIMITS.least_episodes:
        return None
    chosen = np.linspace(0, len(items) - 1, min(len(items), FLIGHTS)).round().astype(int)
    note(f"slow errors of the tracks: {len(chosen)} whole flights")
    found, wrong = _of_flights(prepared, world, variants, [items[k] for k in chosen])
    if found is None:
        return None
    return replace(found, flights=tuple(item for item in every if item not in wrong))


def tell_errors(prepared: Prepared) -> bool:
    """Return whether flights are enough to tell errors of the tracking that last from forces.

    Args:
        prepared: The episodes.
    """
    items = [] if prepared.flight is None else _long_ones(whole_flights(prepared.flight.items))
    seen = prepared.observations.seen[..., 0]
    frames = sum(int((seen[item.episode, item.first : item.last + 1] > 0).sum()) for item in items)
    return len({item.episode for item in items}) >= LIMITS.least_episodes and frames >= LIMITS.least_frames


def _long_ones(flights: Sequence[Segment]) -> list[Segment]:
    """Return the flights with enough frames."""
    return [item for item in flights if item.last - item.first + 1 >= SHORTEST]


def _of_flights(
    prepared: Prepared, world: World, variants: Sequence[Variant], items: Sequence[Segment]
) -> tuple[SlowErrors | None, list[Segment]]:
    """Return the variance components of chosen flights, and those of them that count for nothing.

    The components are None where the tracks' noise explains the flights, and all count.
    """
    fitted = fit_states(prepared.segments("flight", world, items))
    plain = Segments.of("flight", world, replace(prepared.observations, time_shift=None), items, prepared.noise, WHITE)
    plain = plain.with_state(fitted.observations.state)
    parameters, rows, jacobian = derivatives(plain, world, variants)
    jacobian[..., : len(parameters)] *= torch.tensor([p.prior[1] for p in parameters]).to(jacobian)
    sound = _sound_flights(fitted, rows, jacobian)
    wrong = [item for k, item in enumerate(items) if k not in sound]
    chosen, rows, jacobian = fitted.select(sound), rows[sound], jacobian[sound]
    timed = _timed_forces(chosen)
    jacobian = torch.cat((timed, jacobian), -1)
    found, still, evidence, sway_evidence = [], [], 0.0, 0.0
    for kind, known in enumerate(prepared.noise_model):
        level = tuple(_level_axes(world)) if kind == 0 else ()
        parts = _parts(chosen, (rows, jacobian), len(parameters) + timed.shape[-1], kind, known, level)
        floor = (FLOOR_M, FLOOR_RAD)[kind] / prepared.noise[kind]
        if parts is None or max(parts[0].slow, parts[0].size) <= floor:
            parts = known, known, 0.0, 0.0
        found.append(parts[0])
        still.append(parts[1])
        evidence, sway_evidence = max(evidence, parts[2]), max(sway_evidence, parts[3])
    model = NoiseModel(*found)
    if not model.slow and model == prepared.noise_model and not wrong:
        return None, wrong
    return SlowErrors(model, NoiseModel(*still), evidence, sway_evidence, ()), wrong


def _parts(
    flights: Segments,
    linear: tuple[Tensor, Tensor],
    count: int,
    kind: int,
    known: CorrelatedNoise,
    level: tuple[int, ...],
) -> tuple[CorrelatedNoise, CorrelatedNoise, float, float] | None:
    """Return what `variance_components` does of positions (kind 0) or rotations (1); None without enough frames.

    Of frames much closer than errors last, nearly all contrasts are faster than what a filter lets pass, and their law
    is none of the processes'. So the frames are thinned out, again where the errors turn out to be faster, but not so
    far that short flights show nothing.
    """
    parts, spacing_s = None, SPACING * min(known.time_s, FAST_S) if known.share else 0.0
    for _ in range(THINNED if spacing_s else 1):
        contrasts = FlightContrasts.of(flights, *linear, count, kind, spacing_s, level or (0, 1, 2))
        while spacing_s and (contrasts is None or contrasts.count < LIMITS.least_frames):
            spacing_s = spacing_s / 2 if spacing_s > FASTEST_S else 0.0
            contrasts = FlightContrasts.of(flights, *linear, count, kind, spacing_s, level or (0, 1, 2))
        if contrasts is None:
            return parts
        parts = variance_components(contrasts, known, level)
        finer_s = SPACING * parts[1].time_s
        if finer_s > FINER * spacing_s:
            break
        spacing_s = finer_s
    return parts


def _timed_forces(segments: Segments) -> Tensor:
    """Return the derivatives (B, F, 6, P) of residuals by forces that act in one interval of time in all episodes.

    A force that follows the clock, as a gust or a shaking, does the same in all episodes and is no error of tracks.
    """
    seen = segments.observations
    times, bodies = seen.times_s, len(seen.free)
    found = times.new_zeros(*times.shape, 6, 0)
    if len({item.episode for item in segments.items}) >= LIMITS.least_episodes:
        ends = [float(times[k, n - 1]) for k, n in enumerate(segments.lengths)]
        edges = torch.arange(float(times[:, 0].min()), max(ends), COMMON_S).to(times)
        late = (times[..., None] - edges).clamp_min(0.0)
        path = 0.5 * (late.square() - (late - COMMON_S).clamp_min(0.0).square())
        # a residual is the model less the measurement, or the reverse: only the space that they span matters
        path = path / segments.noise.position_m
        found = torch.stack(
            [torch.nn.functional.one_hot(torch.tensor(a), 6).to(path)[:, None] * path[..., None, :] for a in range(3)],
            -1,
        )
        found = found.flatten(-2)
    return found.repeat_interleave(bodies, 1)


def _level_axes(world: World) -> list[int]:
    """Return the axes across gravity, all without gravity."""
    gravity = world.gravity[0].abs()
    return [axis for axis in range(3) if float(gravity[axis]) < float(gravity.max()) or float(gravity.max()) == 0]


def _sound_flights(segments: Segments, rows: Tensor, jacobian: Tensor) -> list[int]:
    """Return the flights (B) without those in which effects of any size leave larger errors than elsewhere.

    Args:
        segments: The flights, with the noise of short windows.
        rows: Residuals (B, F, 6) in sigmas of white noise.
        jacobian: Their derivatives (B, F, 6, P + S) by all effects, of usual size, and states.
    """
    every = list(range(len(rows)))
    if len(segments.observations.free) > 1:
        return every
    square, count = _left(segments, rows, jacobian)
    told = count >= LEAST_COUNT
    if int(told.sum()) < LIMITS.least_episodes:
        return every
    variance = square / count.clamp_min(1.0)
    good = ~told | (variance <= LIMITS.unsound * variance[told].quantile(0.25))
    chosen = torch.nonzero(good)[:, 0].tolist()
    return chosen if len({segments.items[k].episode for k in chosen}) >= LIMITS.least_episodes else every


def _left(segments: Segments, rows: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """Return what each flight's own state and effects leave: sums of squares (B,) and degrees of freedom (B,)."""
    seen = segments.observations
    every = torch.nan_to_num(torch.cat((rows[..., None], jacobian), -1))
    masks = (seen.seen[..., 0], seen.has_orientation[..., 0])
    known = torch.stack(masks, -1).repeat_interleave(3, -1)
    flat = (segments.innovations(every) * known[..., None]).flatten(1, 2)
    left, slopes = flat[..., 0], flat[..., 1:]
    length = slopes.norm(dim=1, keepdim=True)
    basis, size, _ = torch.linalg.svd(slopes * torch.where(length > LEAST_MOVE, 1 / length, 0.0), full_matrices=False)
    kept = size > KEPT * size.amax(1, keepdim=True)
    square = left.square().sum(1) - ((basis * kept[:, None]).mT @ left[..., None]).square().sum((1, 2))
    count = 3.0 * (masks[0].sum(1) + masks[1].sum(1)) - kept.sum(1)
    return square, count
