"""Episodes cut into segments: flight long, contact short.

The information about a force grows with the fourth power of the time that it acts, so flights are cut as little as
possible; a rollout through contact is a rough function of its start, so contacts are cut short (Bock & Plitt 1984).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..estimation.observations import Observations
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply
from ..physics.world import World
from .phases import clear_frames

if TYPE_CHECKING:
    from ...datasets.tracks import Track

FLIGHT_S = 0.60
"""A flight is cut into equal parts of at most this length."""
MIN_FLIGHT_S = 0.06
"""A shorter flight between two contacts tells no acceleration: it belongs to the contact."""
CONTACT_S = 0.10
"""A contact segment is at most this long."""
MIN_FRAMES = 6
"""A segment has at least so many frames: a state takes what two of them measure."""
LEAD_S = 0.03
"""A contact begins and ends with so much flight, which tells the velocities before and after."""
GAP = 2.5
"""No segment spans a gap of more than so many median frame intervals."""
STILL_SIGMAS = 4.0
"""Nothing moves where the means of both halves of a segment differ by less than this many of their standard errors."""
KEPT_RESTS = 2


@dataclass(frozen=True)
class Segment:
    """Frames `first` to `last` (included) of an episode, by its place among the episodes."""

    episode: int
    first: int
    last: int


def whole_episodes(world: World, episodes: Sequence[tuple[str, dict[str, Track]]]) -> Observations:
    """Return all frames of all episodes as one batch."""
    return Observations.of(world, episodes, [(-torch.inf, torch.inf)] * len(episodes))


def cut_episodes(
    world: World, whole: Observations, noise: tuple[float, float], touched: Tensor | None = None
) -> tuple[list[Segment], list[Segment], Tensor]:
    """Cut whole episodes into flight and contact segments.

    Args:
        world: The world, for shape and ground.
        whole: The episodes (E).
        noise: Of the tracks (position [m], rotation [rad]).
        touched: Frames (E, T) that are known not to be flight.

    Returns:
        The flight segments, the contact segments, and which frames (E, T) are surely in flight.
    """
    clear = clear_frames(world, whole, noise)
    if touched is not None:
        clear &= ~touched
    flight: list[Segment] = []
    contact: list[Segment] = []
    for episode, times in enumerate(whole.times_s):
        seen = torch.nonzero(whole.seen[episode].amax(-1) > 0)[:, 0]
        begin, end = (int(seen[0]), int(seen[-1]) + 1) if len(seen) else (0, 0)
        for start, stop in _stretches(times[begin:end]):
            first, last = begin + start, begin + stop
            step = float(times[first : last + 1].diff().median()) if last > first else 1.0
            runs = _runs(clear[episode, first : last + 1].tolist())
            flies = [
                is_clear and b - a + 1 >= MIN_FRAMES and float(times[first + b] - times[first + a]) >= MIN_FLIGHT_S
                for is_clear, a, b in runs
            ]
            for fly, group in itertools.groupby(zip(flies, runs, strict=True), key=lambda pair: pair[0]):
                spans = [run for _, run in group]
                a, b = first + spans[0][1], first + spans[-1][2]
                if fly:
                    flight += [Segment(episode, *part) for part in _parts(a, b, step, FLIGHT_S, share=False)]
                elif not all(is_clear for is_clear, _, _ in spans):
                    lead = max(1, round(LEAD_S / step))
                    a, b = max(first, a - lead), min(last, b + lead)
                    contact += [Segment(episode, *part) for part in _parts(a, b, step, CONTACT_S, share=True)]
    return flight, without_rest(whole, contact, noise), clear


def without_rest(whole: Observations, items: Sequence[Segment], noise: tuple[float, float]) -> list[Segment]:
    """Return the segments less those in which nothing moves, but for the first ones in a row: they tell no more."""
    kept, resting = [], {}
    for item in items:
        frames = slice(item.first, item.last + 1)
        still = True
        for values, mask, sigma in (
            (whole.position_m[item.episode, frames], whole.seen[item.episode, frames], noise[0]),
            (_turns(whole, item), whole.turned[item.episode, frames], noise[1]),
        ):
            half = len(values) // 2
            parts = [
                (values[p] * mask[p, :, None]).sum(0) / mask[p, :, None].sum(0).clamp_min(1.0)
                for p in (slice(0, half), slice(half, None))
            ]
            limit = STILL_SIGMAS * sigma * (2 / half) ** 0.5
            still &= bool(((parts[1] - parts[0]).abs() < limit).all())
        resting[item.episode] = resting.get(item.episode, 0) + 1 if still else 0
        if resting[item.episode] <= KEPT_RESTS:
            kept.append(item)
    return kept


def _turns(whole: Observations, item: Segment) -> Tensor:
    """Return the rotation vectors (T, nf, 3) from the first frame of a segment to each."""
    quat = whole.quat_wxyz[item.episode, item.first : item.last + 1]
    return quat_log(quat_multiply(quat_conjugate(quat[:1]), quat))


def _stretches(times: Tensor) -> list[tuple[int, int]]:
    """Return first and last frames of the parts of an episode without a gap."""
    if len(times) < 2:
        return []
    steps = times.diff()
    cuts = (steps > GAP * steps.median()).nonzero()[:, 0].tolist()
    edges = [-1, *cuts, len(times) - 1]
    return [(a + 1, b) for a, b in itertools.pairwise(edges)]


def _runs(flags: Sequence[bool]) -> list[tuple[bool, int, int]]:
    """Return (flag, first, last) of each run of equal flags."""
    found, start = [], 0
    for flag, group in itertools.groupby(flags):
        count = len(list(group))
        found.append((flag, start, start + count - 1))
        start += count
    return found


def _parts(first: int, last: int, step_s: float, longest_s: float, share: bool) -> list[tuple[int, int]]:
    """Cut frames into equal parts of at most a length [s]; with `share`, one ends in the frame that begins the next.

    A contact may lie between two frames: shared ends lose none.
    """
    count = last - first + 1
    if count < MIN_FRAMES:
        return []
    most = max(MIN_FRAMES, round(longest_s / step_s) + 1)
    number = max(1, min(-(-count // most), count // MIN_FRAMES))
    edges = [first + round(k * (count - (1 if share else 0)) / number) for k in range(number + 1)]
    if share:
        return list(itertools.pairwise(edges))
    return [(a, b - 1) for a, b in itertools.pairwise(edges)]
