"""Measured episodes prepared for a diagnosis or fit: noise, outliers, releases, and flight and contact segments."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ..physics.world import World
from ..trajectories.correlated_noise import estimate_noise_model, noise_model_warnings
from ..trajectories.flight_noise import flight_noise, slow_noise, without_outliers
from ..trajectories.innovations import WHITE, NoiseModel
from ..trajectories.observations import Observations
from ..trajectories.segmentation import Segment, cut_episodes, supported_frames, whole_episodes
from ..trajectories.smoothing_filter import SmoothingFilter, smoothing_filter
from ..trajectories.time_errors import time_errors, time_shifts
from ..trajectories.track_noise import Noise, noise_of
from .carried_starts import carried_ends, carried_starts
from .contact_phases import is_round
from .flights.residual_wrench import ResidualWrenches, wrench_windows
from .release_detection import catch_warnings, held_starts, release_warnings, without_caught, without_held
from .segment_states import fit_states
from .segments import Kind, Segments
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.preparation
NAMED = 3
"""Maximum number of episodes, and of times of each, that a warning names."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """Episodes ready for tests: their segments, noise and fitted flights."""

    names: tuple[str, ...]
    """Names of the episodes (E)."""
    groups: tuple[int, ...]
    """Session of each episode (E)."""
    observations: Observations
    """All frames of all episodes (E)."""
    airborne: Tensor
    """Airborne frames (E, T)."""
    supported: Tensor
    """Supported frames (E, T): the body is above the ground and not in free fall."""
    noise: Noise
    """Standard deviations of the tracks (position [m], rotation [rad])."""
    slow: float
    """Factor by which the variance of slow errors of a centroid exceeds that of all errors; 1 where the noise model
    covers it."""
    flight: Segments | None
    """Flight segments with fitted states; None where no episode has any."""
    contact_items: tuple[Segment, ...]
    """The contact segments."""
    outliers: int
    """Number of measurements of positions and turns that are left out as wrong."""
    has_orientation: bool
    """Whether orientations were measured."""
    warnings: tuple[str, ...]
    """Sentences for the user."""
    released_s: Mapping[str, float] = field(default_factory=dict)
    """Time [s] from which an episode that begins in a hand flies freely, by name; earlier frames count as not
    measured."""
    caught: dict[int, int] = field(default_factory=dict)
    """Last free frame of the episodes, by index, that end in a hand or a net."""
    noise_model: NoiseModel = WHITE
    """Correlation of the errors in time."""
    left_out_s: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Times [s] of the frames of flight that are left out as wrong measurements, by name of the episode."""
    time_error_s: float = 0.0
    """Standard deviation of errors of the frames' times [s]; 0 where flights show none."""
    filmed: bool = False
    """Whether the tracks were found in videos: their errors vary slowly, also where no flight is long enough to show
    that."""

    @property
    def least_force_m_s2(self) -> float:
        """Smallest acceleration [m/s2] that all flights together detect; infinite without flight.

        It is `sure` standard errors (see `thresholds.py`); that of the acceleration of a parabola through n points of
        noise s over a time T is s (720 / (n T^4))^1/2.
        """
        information = 0.0
        for item in () if self.flight is None else self.flight.items:
            times = self.observations.times_s[item.episode, item.first : item.last + 1]
            information += len(times) * float(times[-1] - times[0]) ** 4 / (720 * self.noise.position_m**2)
        return LIMITS.sure / math.sqrt(information) if information > 0 else math.inf

    def segments(self, kind: Kind, world: World, items: Sequence[Segment]) -> Segments:
        """Return segments of these episodes, with first guesses of their states."""
        return Segments.of(kind, world, self.observations, items, self.noise, self.noise_model)

    def contact(self, world: World) -> Segments | None:
        """Return the contact segments with states fitted by a world; None where there are none."""
        if not self.contact_items:
            return None
        return fit_states(self.segments("contact", world, self.contact_items))

    def with_slow_noise(
        self,
        world: World,
        noise_model: NoiseModel,
        noise: Noise | None = None,
        flights: Sequence[Segment] = (),
    ) -> Prepared:
        """Return the episodes with a noise model that has a slow part, and their flights whole.

        The slow errors of neighbouring pieces of a flight are not independent, so the flights are cut nowhere; the
        noise model covers slow errors, which then count in no other place.

        Args:
            world: The world to fit the states with.
            noise_model: The noise model.
            noise: Standard deviations of the tracks; those of the episodes by default.
            flights: Whole flights that count; all by default.
        """
        found = replace(self, noise_model=noise_model, noise=noise or self.noise, slow=1.0)
        if self.flight is None:
            return found
        items = flights or whole_flights(self.flight.items)
        return replace(found, flight=fit_states(found.segments("flight", world, items)))

    def with_own(self, world: World) -> Prepared:
        """Return the episodes with the values of their own that a world has for them."""
        seen = self.observations.with_own(world)
        return self if seen is self.observations else replace(self, observations=seen)

    def short_windows(self, world: World) -> ResidualWrenches | None:
        """Return the residual wrenches of short windows of the flights; None without any."""
        if self.flight is None:
            return None
        return wrench_windows(world, self.observations, self.flight.items, self.noise, self.noise_model)

    def pieces(self, world: World, longest_s: float) -> Segments | None:
        """Return the flights cut into equal pieces of at most a length [s], states fitted; None without flights."""
        if self.flight is None:
            return None
        items = [piece for item in self.flight.items for piece in _cut(item, self.observations, longest_s)]
        return fit_states(self.segments("flight", world, items))


def prepare(
    world: World,
    episodes: Sequence[Episode],
    given: tuple[float | None, float | None] = (None, None),
    groups: Sequence[int] | None = None,
) -> Prepared:
    """Return episodes cut into segments, with their measured noise and the fitted states of their flights.

    Args:
        world: The model's world.
        episodes: Name and tracks by body of each episode.
        given: Standard deviations of the tracks (position [m], rotation [rad]) where the user states them; a larger
            one measured in flight is used instead.
        groups: Session of each episode; the same for all by default.
    """
    state = _State.of(world, episodes, given)
    state.segment()
    if world.chains:
        state.fit_flights()  # links do not fall as bodies do, by which the following steps judge
    else:
        _mark_supported_frames(state)
        _measure_times(state)
        _remove_outliers(state)
        _remove_held_starts(state)
        _measure_times(state)
        state.warnings += _time_warnings(state)
        _model_correlated_noise(state)
    left_out = _left_out(state, world, episodes)
    turned = state.oriented
    if _touches_nothing(world):
        state.contact = []  # what does not fly is in a hand or was caught: it says nothing of a law of contact
    elif not turned and not all(is_round(world.bodies[k]) for k in world.tracked):
        state.contact = []
        state.warnings.append("no orientation was measured and the body is not a ball: contacts cannot be examined.")
    released = {episodes[k][0]: float(state.observations.times_s[k, first]) for k, first in state.held.items()}
    starts = {episodes[k][0]: float(state.observations.times_s[k, 0]) for k in state.held}
    return Prepared(
        names=tuple(name for name, _ in episodes),
        groups=tuple(groups or [0] * len(episodes)),
        observations=state.observations,
        airborne=state.airborne,
        supported=state.supported,
        noise=state.noise,
        slow=1.0 if state.noise_model.position.share or world.chains else slow_noise(state.observations, state.flight),
        flight=state.fitted,
        contact_items=tuple(state.contact),
        outliers=state.outliers,
        has_orientation=turned,
        warnings=(*_outlier_warnings(state.outliers, left_out), *state.warnings, *release_warnings(released, starts)),
        released_s=released,
        noise_model=state.noise_model,
        left_out_s=left_out,
        time_error_s=state.time_error_s,
    )


@dataclass(kw_only=True)
class _State:
    """What is known of the episodes so far; each step of :func:`prepare` refines it."""

    world: World
    """The model's world."""
    given: tuple[float | None, float | None]
    """Standard deviations that the user states (position [m], rotation [rad])."""
    noise: Noise
    """Standard deviations in use (position [m], rotation [rad])."""
    observations: Observations
    """All frames of all episodes (E)."""
    oriented: bool
    """Whether any orientation was measured."""
    flight: list[Segment] = field(default_factory=list)
    """Flight segments of the last segmentation."""
    contact: list[Segment] = field(default_factory=list)
    """Contact segments of the last segmentation."""
    airborne: Tensor
    """Airborne frames (E, T)."""
    supported: Tensor
    """Frames (E, T) above the ground in which the body is not in free fall."""
    touched: Tensor
    """Frames (E, T) that are known not to be flight."""
    outliers: int = 0
    """Number of frames removed as wrong measurements."""
    held: dict[int, int] = field(default_factory=dict)
    """First free frame of the episodes, by index, that begin in a hand."""
    caught: dict[int, int] = field(default_factory=dict)
    """Last free frame of the episodes, by index, that end in a hand or a net."""
    noise_model: NoiseModel = WHITE
    """Correlation of the errors in time."""
    time_error_s: float = 0.0
    """Standard deviation of errors of the frames' times [s]; 0 where flights show none."""
    across_m: float = 0.0
    """Standard deviation of errors across the motion [m], beside these."""
    fitted: Segments | None = None
    """The flights with fitted states; None where there are none."""
    warnings: list[str] = field(default_factory=list)
    """Sentences for the user, in their order."""

    @staticmethod
    def of(
        world: World,
        episodes: Sequence[Episode],
        given: tuple[float | None, float | None],
    ) -> _State:
        """Return the episodes from their releases on with a rough estimate of their noise, not yet cut."""
        free = [world.bodies[k].name for k in world.tracked]
        noise = noise_of(given, [tracks[name] for _, tracks in episodes for name in free if name in tracks])
        every = whole_episodes(world, episodes)
        held = {} if world.chains else carried_starts(world, every, noise)
        whole = without_held(every, held)
        caught = {} if world.chains else carried_ends(world, whole, noise)
        warnings = catch_warnings(episodes, whole, caught)
        whole = without_caught(whole, caught)
        nothing = torch.zeros_like(whole.seen[..., 0], dtype=torch.bool)
        return _State(
            world=world,
            given=given,
            noise=noise,
            observations=whole,
            held=held,
            caught=caught,
            warnings=warnings,
            oriented=bool(whole.has_orientation.any()),
            airborne=nothing,
            supported=nothing,
            touched=nothing,
        )

    def segment(self, touched: Tensor | None = None) -> None:
        """Cut the episodes into flight and contact segments, with frames (E, T) that are known not to be flight."""
        self.flight, self.contact, self.airborne = cut_episodes(self.world, self.observations, self.noise, touched)

    def measure_noise(self, flight: Sequence[Segment], warnings: list[str]) -> None:
        """Measure the noise in flight, and choose between it and the given one."""
        self.noise = _agreed(self.given, flight_noise(self.observations, flight), self.noise, warnings)

    def fit_flights(self) -> None:
        """Fit the states of the flights by the model's world."""
        if not self.flight:
            self.fitted = None
            return
        self.fitted = fit_states(
            Segments.of("flight", self.world, self.observations, self.flight, self.noise, self.noise_model)
        )


def whole_flights(items: Sequence[Segment]) -> list[Segment]:
    """Return flight segments with the parts of one flight, which follow each other without a gap, as one."""
    found: list[Segment] = []
    for item in items:
        last = found[-1] if found else None
        if last is not None and last.episode == item.episode and last.last + 1 == item.first:
            found[-1] = Segment(item.episode, last.first, item.last)
        else:
            found.append(item)
    return found


def _mark_supported_frames(state: _State) -> None:
    """Count frames as contact in which a body above the ground is not in free fall; then measure the noise."""
    # without anything that could support the body, drag alone may keep it from falling
    if not _touches_nothing(state.world):
        state.supported = supported_frames(state.world, state.observations, state.flight, state.noise)
    if bool(state.supported.any()):
        state.segment(state.supported)
        state.warnings.append(
            f"{int(state.supported.sum())} frames look airborne by the shape and the ground, but the body is not in "
            "free fall: they count as contact. Check the ground's height, the shape and the position of the marker."
        )
    state.measure_noise(state.flight, state.warnings)


def _touches_nothing(world: World) -> bool:
    """Return whether the world has nothing that its body could touch."""
    return world.ground_normal is None and len(world.bodies) == 1 and not world.surfaces


def _remove_outliers(state: _State) -> None:
    """Mark wrong measurements in flight as not seen, and cut and measure again without them."""
    state.observations, state.outliers, touched = without_outliers(state.observations, state.flight, state.noise)
    state.touched = touched | state.supported
    if state.outliers or bool(state.touched.any()):
        state.segment(state.touched)
        state.measure_noise(state.flight, [])
    state.segment(state.touched)


def _remove_held_starts(state: _State) -> None:
    """Fit the flights, and leave out first frames in which a hand still touches the body, until none is found."""
    state.fit_flights()
    turned: set[int] = set()
    while state.fitted is not None and (found := held_starts(state.fitted, state.observations, turned)):
        # frames in the hand inflated the noise, which then hid other wrong frames
        state.held |= found
        turned |= set(found)
        state.observations = without_held(state.observations, state.held)
        state.measure_noise(cut_episodes(state.world, state.observations, state.noise, state.touched)[0], [])
        flight = cut_episodes(state.world, state.observations, state.noise, state.touched)[0]
        state.observations, more, again = without_outliers(state.observations, flight, state.noise)
        state.outliers, state.touched = state.outliers + more, state.touched | again
        state.segment(state.touched)
        state.fit_flights()


def _left_out(state: _State, world: World, episodes: Sequence[Episode]) -> dict[str, tuple[float, ...]]:
    """Return the times [s] of frames of which a position or turn is left out as wrong, by name of the episode."""
    if not state.outliers:
        return {}
    before = without_caught(without_held(whole_episodes(world, episodes), state.held), state.caught)
    after = state.observations
    pairs = ((before.seen, after.seen), (before.has_orientation, after.has_orientation))
    lost = torch.stack([((old > 0) & (new <= 0)).any(-1) for old, new in pairs]).any(0)
    times = {name: tuple(after.times_s[k, lost[k]].tolist()) for k, (name, _) in enumerate(episodes)}
    return {name: found for name, found in times.items() if found}


def _outlier_warnings(count: int, left_out_s: Mapping[str, tuple[float, ...]]) -> list[str]:
    """Return a warning that says which measurements were left out: the episodes with the most, and their times."""
    if not count:
        return []
    most = sorted(left_out_s, key=lambda name: (-len(left_out_s[name]), name))
    shown = [_times_words(name, left_out_s[name]) for name in most[:NAMED]]
    more = f"; and {len(most) - NAMED} more episodes" if len(most) > NAMED else ""
    return [f"{count} measurements in flight are wrong and were left out: {'; '.join(shown)}{more}."]


def _times_words(name: str, times_s: Sequence[float]) -> str:
    """Return an episode's times in words, without all of many."""
    shown = ", ".join(f"{time:.3f}" for time in times_s[:NAMED])
    return f"{name} at {shown} s" + (f" and {len(times_s) - NAMED} more" if len(times_s) > NAMED else "")


def _measure_times(state: _State) -> None:
    """Measure the errors of the frames' times; where there are any, they are part of the noise from here on."""
    before, (state.time_error_s, state.across_m) = state.time_error_s, time_errors(state.observations, state.flight)
    if not (state.time_error_s or before):
        return
    shift = time_shifts(state.observations, state.time_error_s) if state.time_error_s else None
    state.observations = replace(state.observations, time_shift=shift)
    state.measure_noise(state.flight, [])
    if state.fitted is not None:
        state.fit_flights()


def _time_warnings(state: _State) -> list[str]:
    """Return a warning that says what errors of times do; none where times are right."""
    if not state.time_error_s:
        return []
    return [
        f"the times of the frames are wrong by {1e3 * state.time_error_s:.2g} ms: errors along the motion grow with "
        f"the speed, where those across it are {1e3 * state.across_m:.2g} mm. This is modelled, and makes small forces "
        "harder to detect. Record the times of the exposures, or trigger the shutter by a clock."
    ]


def _model_correlated_noise(state: _State) -> None:
    """Estimate how errors are correlated in time; where they are, cut and fit again with that noise model.

    What a filter bends beside contacts is no noise, so that the noise is estimated again without it.
    """
    state.noise_model, correlated = estimate_noise_model(state.observations, state.flight, state.noise)
    if state.noise_model == WHITE:
        return
    reach = _reach(state.observations, state.noise_model)
    if _is_filtered(state.noise_model):
        smoothed = _filter_of(state, reach)
        if smoothed is not None:
            reach = max(LIMITS.smeared_frames, smoothed.reach)
            if smoothed.low_pass:
                edge = math.ceil(LIMITS.edge_share * reach)
                state.observations = _without_edges(state.observations, state.airborne, edge)
        again, clean = estimate_noise_model(state.observations, _flights_beyond(state, reach), state.noise)
        if again != WHITE:
            state.noise_model, correlated = again, clean
    position, rotation = (max(c or n, g or 0.0) for c, n, g in zip(correlated, state.noise, state.given, strict=True))
    state.noise = Noise(position, rotation)
    state.segment(state.touched | _smeared(state.observations, ~state.airborne, reach))
    state.fit_flights()
    state.warnings.append(noise_model_warnings(state.noise_model))


def _filter_of(state: _State, reach: int) -> SmoothingFilter | None:
    """Return the filter that smoothed positions, from flights without frames within a reach of contacts."""
    flight = _flights_beyond(state, reach)
    without, (std_m, _) = estimate_noise_model(state.observations, flight, state.noise)
    if std_m is None:
        return None
    return smoothing_filter(state.observations, flight, std_m, without.position)


def _is_filtered(noise_model: NoiseModel) -> bool:
    """Return whether a filter made the errors of positions: they are differentiable, and have no white part."""
    return noise_model.position.share > LIMITS.filtered and noise_model.position.order > 1


def _flights_beyond(state: _State, reach: int) -> list[Segment]:
    """Return the flights without frames within a reach of contacts."""
    touched = state.touched | _smeared(state.observations, ~state.airborne, reach)
    return cut_episodes(state.world, state.observations, state.noise, touched)[0]


def _smeared(whole: Observations, contact: Tensor, reach: int) -> Tensor:
    """Return the frames (E, T) within a number of frames of contacts."""
    seen = whole.seen.amax(-1) > 0
    near = torch.nn.functional.max_pool1d((contact & seen).double()[:, None], 2 * reach + 1, 1, reach)
    return near[:, 0] > 0


def _reach(whole: Observations, noise_model: NoiseModel) -> int:
    """Return how many frames a filter that is not known smears contacts over: as far as it correlates errors.

    A filter lets no white noise pass: errors of which a part is white were not made by one, however long others last.
    """
    seen = whole.seen.amax(-1) > 0
    step_s = float(
        np.median(np.concatenate([_steps(times, known) for times, known in zip(whole.times_s, seen, strict=True)]))
    )
    memory_s = max((noise.time_s for noise in noise_model if noise.share > LIMITS.filtered), default=0.0)
    reach_s = min(LIMITS.smeared_times * memory_s, max(LIMITS.smeared_s, LIMITS.filter_frames * step_s))
    return max(LIMITS.smeared_frames, math.ceil(reach_s / step_s))


def _without_edges(whole: Observations, airborne: Tensor, frames: int) -> Observations:
    """Return the episodes without the frames at the ends of a record that a low pass bent, where they are of flight.

    A filter that runs both ways continues a record beyond its ends as it likes, and a body that is let go begins to
    fall within a frame.
    """
    seen, turned = whole.seen.clone(), whole.has_orientation.clone()
    for episode, row in enumerate(whole.seen.amax(-1) > 0):
        known = row.nonzero()[:, 0].tolist()
        if not known:
            continue
        for at, edge in ((known[0], slice(0, known[0] + frames)), (known[-1], slice(known[-1] + 1 - frames, None))):
            if airborne[episode, at]:
                seen[episode, edge], turned[episode, edge] = 0.0, 0.0
    return replace(whole, seen=seen, has_orientation=turned)


def _steps(times_s: Tensor, known: Tensor) -> NDArray[np.float64]:
    """Return the times between known frames [s]."""
    return times_s[known].diff().numpy(force=True).astype(np.float64)


def _agreed(
    given: tuple[float | None, float | None],
    found: tuple[float | None, float | None],
    rough: Noise,
    warnings: list[str],
) -> Noise:
    """Return the noise to use: the given one, or the measured one where that is larger by `LIMITS.noise_disagrees`.

    Args:
        given: Standard deviations that the user states (position [m], rotation [rad]).
        found: Standard deviations measured in flight; None where too few frames are in flight.
        rough: Used where neither is known.
        warnings: Gets a sentence for each kind in which the two disagree.
    """
    chosen = []
    for name, unit, said, seen, otherwise in zip(
        ("position", "rotation"), ("m", "rad"), given, found, rough, strict=True
    ):
        if said is not None and seen is not None and said / seen >= LIMITS.noise_disagrees:
            warnings.append(
                f"the {name} noise is given as {said:.2g} {unit}; neighbouring frames of a flight agree within "
                f"{seen:.2g} {unit}. The given value is used, because slowly varying errors do not show between "
                "neighbouring frames. Effects smaller than it cannot be detected."
            )
            chosen.append(said)
        elif said is not None and seen is not None and said / seen <= 1 / LIMITS.noise_disagrees:
            warnings.append(
                f"the {name} noise is given as {said:.2g} {unit}; in flight it is {seen:.2g} {unit}, which is used."
            )
            chosen.append(seen)
        else:
            chosen.append(said or seen or otherwise)
    return Noise(*chosen)


def _cut(item: Segment, whole: Observations, longest_s: float) -> list[Segment]:
    """Return a flight cut into equal pieces of at most a length [s] and at least six frames."""
    count = item.last - item.first + 1
    times = whole.times_s[item.episode, item.first : item.last + 1]
    number = max(1, min(round(float(times[-1] - times[0]) / longest_s + 0.49), count // 6))
    edges = [item.first + round(k * count / number) for k in range(number + 1)]
    return [replace(item, first=a, last=b - 1) for a, b in itertools.pairwise(edges)]
