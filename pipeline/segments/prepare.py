"""Measured episodes made ready for a diagnosis: noise, outliers, and segments of flight and of contact."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..estimation.noise import estimate_noise
from ..estimation.observations import Observations
from ..physics.world import World
from .carried import carried_frames
from .cuts import Segment, cut_episodes, whole_episodes
from .lasting import FORGETFUL, Memory, memory_of, told_memory
from .noise import flight_noise, slow_noise, without_outliers
from .phases import is_round
from .releases import held_starts, told, without_held
from .segment_states import fit_states
from .segments import Kind, Segments

if TYPE_CHECKING:
    from ...datasets.tracks import Track

NOISE_DISAGREES = 1.3
"""A given noise that differs from the measured one by this factor is not believed."""

SURE = 4.0
"""A force is shown where it is so many of its standard errors."""
SMEARED = 3
"""Frames beside a contact that count as contact where errors last: a filter of seven frames smears impacts so far."""


@dataclass(frozen=True)
class Prepared:
    """Episodes ready for tests.

    names (E); groups (E): session of each episode; whole (E): all frames; clear (E, T): frames surely in flight;
    carried (E, T): frames above the ground in which nothing falls; noise:
    position [m], rotation [rad]; memory: how long errors last; slow: by what factor the variance of slow errors of a
    centroid exceeds that of all, where that was not told by the memory;
    flight: segments with fitted states, None where there are none; contact_items: the contact segments; outliers:
    frames left out; turned: whether orientations were measured; warnings; released_s: of episodes that begin in a hand,
    by name, the time [s] from which they fly freely: what comes before counts as not measured.
    """

    names: tuple[str, ...]
    groups: tuple[int, ...]
    whole: Observations
    clear: Tensor
    carried: Tensor
    noise: tuple[float, float]
    slow: float
    flight: Segments | None
    contact_items: tuple[Segment, ...]
    outliers: int
    turned: bool
    warnings: tuple[str, ...]
    released_s: Mapping[str, float] = field(default_factory=dict)
    memory: Memory = FORGETFUL

    @property
    def least_force_m_s2(self) -> float:
        """The acceleration that all flights together show, `SURE` of its standard errors; infinite without flight.

        A parabola through n points of noise s over a time T tells it within s (720 / (n T^4))^1/2.
        """
        information = 0.0
        for item in () if self.flight is None else self.flight.items:
            times = self.whole.times_s[item.episode, item.first : item.last + 1]
            information += len(times) * float(times[-1] - times[0]) ** 4 / (720 * self.noise[0] ** 2)
        return SURE / math.sqrt(information) if information > 0 else math.inf

    def segments(self, kind: Kind, world: World, items: Sequence[Segment]) -> Segments:
        """Return segments of these episodes, with first guesses of their states."""
        return Segments.of(kind, world, self.whole, items, self.noise, self.memory)

    def contact(self, world: World) -> Segments | None:
        """Return the contact segments with states fitted by a world; None where there are none."""
        if not self.contact_items:
            return None
        return fit_states(self.segments("contact", world, self.contact_items))

    def pieces(self, world: World, longest_s: float) -> Segments | None:
        """Return the flights cut into equal pieces of at most a length [s], states fitted; None for none."""
        if self.flight is None:
            return None
        items = [piece for item in self.flight.items for piece in _cut(item, self.whole, longest_s)]
        return fit_states(self.segments("flight", world, items))


def prepare(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    given: tuple[float | None, float | None] = (None, None),
    groups: Sequence[int] | None = None,
) -> Prepared:
    """Cut episodes, measure their noise, and fit the states of their flights.

    Args:
        world: The model's world.
        episodes: Name and tracks by body of each.
        given: Noise of the tracks, where it is known; where the flights show more, that wins.
        groups: Session of each episode; all the same by default.
    """
    warnings: list[str] = []
    free = [world.bodies[k].name for k in world.free]
    rough = estimate_noise([tracks[name] for _, tracks in episodes for name in free if name in tracks])
    noise = (given[0] or rough[0], given[1] or rough[1])
    whole = whole_episodes(world, episodes)
    turned = bool(whole.turned.any())
    flight, contact, clear = cut_episodes(world, whole, noise)
    # with nothing to stand on, what does not fall falls as fast as its drag lets it
    alone = world.ground_normal is None and len(world.bodies) == 1
    carried = torch.zeros_like(clear) if alone else carried_frames(world, whole, flight, noise)
    if bool(carried.any()):
        flight, contact, clear = cut_episodes(world, whole, noise, carried)
        warnings.append(
            f"{int(carried.sum())} frames look like flight by the shape and the ground, but nothing falls in them: "
            "they count as contact. Check the ground's height, the shape and where the marker is."
        )
    noise = _agreed(given, flight_noise(whole, flight), noise, warnings)
    whole, outliers, touched = without_outliers(whole, flight, noise)
    touched |= carried
    if outliers or bool(touched.any()):
        flight, contact, clear = cut_episodes(world, whole, noise, touched)
        noise = _agreed(given, flight_noise(whole, flight), noise, [])
    flight, contact, clear = cut_episodes(world, whole, noise, touched)
    fitted = _flown(world, whole, flight, noise)
    held: dict[int, int] = {}
    while fitted is not None and (found := held_starts(fitted, whole)):
        # the noise was measured with the hand in it, and hid other wrong frames
        held |= found
        whole = without_held(whole, held)
        noise = _agreed(given, flight_noise(whole, cut_episodes(world, whole, noise, touched)[0]), noise, [])
        whole, more, again = without_outliers(whole, cut_episodes(world, whole, noise, touched)[0], noise)
        outliers, touched = outliers + more, touched | again
        flight, contact, clear = cut_episodes(world, whole, noise, touched)
        fitted = _flown(world, whole, flight, noise)
    if outliers:
        warnings.append(f"{outliers} frames of flight are no measurement of any motion and were left out.")
    memory, lasting = memory_of(whole, flight)
    if memory != FORGETFUL:
        # what is given counts where it is more, as everywhere
        noise = max(lasting[0] or noise[0], given[0] or 0.0), max(lasting[1] or noise[1], given[1] or 0.0)
        flight, contact, clear = cut_episodes(world, whole, noise, touched | _smeared(whole, ~clear))
        fitted = _flown(world, whole, flight, noise, memory)
        warnings.append(told_memory(memory))
    if not turned and not all(is_round(world.bodies[k]) for k in world.free):
        contact = []
        warnings.append("no orientation was measured and the body is no ball: contacts cannot be looked at.")
    released = {episodes[k][0]: float(whole.times_s[k, first]) for k, first in held.items()}
    warnings += told(released, {episodes[k][0]: float(whole.times_s[k, 0]) for k in held})
    return Prepared(
        tuple(name for name, _ in episodes),
        tuple(groups or [0] * len(episodes)),
        whole,
        clear,
        carried,
        noise,
        1.0 if memory.position.share else slow_noise(whole, flight),
        fitted,
        tuple(contact),
        outliers,
        turned,
        tuple(warnings),
        released,
        memory,
    )


def _flown(
    world: World, whole: Observations, items: Sequence[Segment], noise: tuple[float, float], memory: Memory = FORGETFUL
) -> Segments | None:
    """Return flights with states fitted by a world; None for none."""
    return fit_states(Segments.of("flight", world, whole, items, noise, memory)) if items else None


def _smeared(whole: Observations, contact: Tensor) -> Tensor:
    """Return the frames (E, T) into which a filter smears contacts."""
    seen = whole.seen.amax(-1) > 0
    near = torch.nn.functional.max_pool1d((contact & seen).double()[:, None], 2 * SMEARED + 1, 1, SMEARED)
    return near[:, 0] > 0


def _agreed(
    given: tuple[float | None, float | None],
    found: tuple[float | None, float | None],
    rough: tuple[float, float],
    warnings: list[str],
) -> tuple[float, float]:
    """Return the noise to work with: what was given, unless the flights show more; else what they show."""
    chosen = []
    for name, unit, said, seen, otherwise in zip(
        ("position", "rotation"), ("m", "rad"), given, found, rough, strict=True
    ):
        if said is not None and seen is not None and said / seen >= NOISE_DISAGREES:
            warnings.append(
                f"the {name} noise is given as {said:.2g} {unit}; neighbouring frames of a flight agree within "
                f"{seen:.2g} {unit}. What is given counts, as errors that last are not seen there: effects below it "
                "stay unseen."
            )
            chosen.append(said)
        elif said is not None and seen is not None and said / seen <= 1 / NOISE_DISAGREES:
            warnings.append(
                f"the {name} noise is given as {said:.2g} {unit}; in flight it is {seen:.2g} {unit}, which is used."
            )
            chosen.append(seen)
        else:
            chosen.append(said or seen or otherwise)
    return chosen[0], chosen[1]


def _cut(item: Segment, whole: Observations, longest_s: float) -> list[Segment]:
    count = item.last - item.first + 1
    times = whole.times_s[item.episode, item.first : item.last + 1]
    number = max(1, min(round(float(times[-1] - times[0]) / longest_s + 0.49), count // 6))
    edges = [item.first + round(k * count / number) for k in range(number + 1)]
    return [replace(item, first=a, last=b - 1) for a, b in itertools.pairwise(edges)]
