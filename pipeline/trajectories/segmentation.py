"""Segmentation of episodes: long flight segments, short contact segments, and supported frames.

The information about a force grows with the fourth power of the time for which it acts, so flights are cut as little as
possible; a rollout through contact is a rough function of its start, so contacts are cut short (Bock & Plitt 1984).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ..geometry.rotation import continuous_turns, quat_to_matrix
from ..physics.body import Body
from ..physics.world import World
from .initial_state import FLIGHT_MARGIN_M, clearance
from .observations import Observations
from .thresholds import TRACK_THRESHOLDS
from .track_noise import Noise

Array = NDArray[np.float64]
LIMITS = TRACK_THRESHOLDS.segmentation


@dataclass(frozen=True)
class Segment:
    """Consecutive frames of an episode."""

    episode: int
    """Index of the episode."""
    first: int
    """First frame."""
    last: int
    """Last frame, included."""


def whole_episodes(world: World, episodes: Sequence[Episode]) -> Observations:
    """Return all frames of all episodes as one batch."""
    return Observations.of(world, episodes, [(-torch.inf, torch.inf)] * len(episodes))


def cut_episodes(
    world: World, whole: Observations, noise: Noise, touched: Tensor | None = None
) -> tuple[list[Segment], list[Segment], Tensor]:
    """Cut whole episodes into flight and contact segments.

    Args:
        world: The world, for shape and ground.
        whole: The episodes (E).
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
        touched: Frames (E, T) that are known not to be flight.

    Returns:
        The flight segments, the contact segments, and the airborne frames (E, T).
    """
    # a wrong measurement in the middle of a flight does not end it
    clear = clear_frames(world, replace(whole, seen=_between(whole.seen)), noise)
    if touched is not None:
        clear &= ~touched
    flight: list[Segment] = []
    contact: list[Segment] = []
    for episode, times in enumerate(whole.times_s):
        seen = torch.nonzero(whole.seen[episode].amax(-1) > 0)[:, 0]
        begin, end = (int(seen[0]), int(seen[-1]) + 1) if len(seen) else (0, 0)
        for start, stop in _stretches(times[begin:end]):
            first, last = begin + start, begin + stop
            flies, touches = _cut_stretch(episode, times, clear[episode], first, last)
            flight += flies
            contact += touches
    return flight, without_rest(whole, contact, noise), clear


def _between(seen: Tensor) -> Tensor:
    """Return 1 for all frames from the first to the last seen one of a body (E, T, nf), 0 elsewhere."""
    return torch.minimum(seen.cummax(1).values, seen.flip(1).cummax(1).values.flip(1))


def _cut_stretch(
    episode: int, times: Tensor, clear: Tensor, first: int, last: int
) -> tuple[list[Segment], list[Segment]]:
    """Return the flight and the contact segments of frames `first` to `last` of an episode, which have no gap.

    Args:
        episode: Its index.
        times: All its frame times (T,) [s].
        clear: Airborne frames (T,).
        first: First frame.
        last: Last frame, included.
    """
    flight: list[Segment] = []
    contact: list[Segment] = []
    step = float(times[first : last + 1].diff().median()) if last > first else 1.0
    runs = _runs(clear[first : last + 1].tolist())
    flies = [
        is_clear
        and b - a + 1 >= LIMITS.least_frames
        and float(times[first + b] - times[first + a]) >= LIMITS.least_flight_s
        for is_clear, a, b in runs
    ]
    for fly, group in itertools.groupby(zip(flies, runs, strict=True), key=lambda pair: pair[0]):
        spans = [run for _, run in group]
        a, b = first + spans[0][1], first + spans[-1][2]
        if fly:
            flight += [Segment(episode, *part) for part in _parts(a, b, step, LIMITS.flight_s, share=False)]
        elif not all(is_clear for is_clear, _, _ in spans):
            lead = max(1, round(LIMITS.lead_s / step))
            a, b = max(first, a - lead), min(last, b + lead)
            contact += [Segment(episode, *part) for part in _parts(a, b, step, LIMITS.contact_s, share=True)]
    return flight, contact


def without_rest(whole: Observations, items: Sequence[Segment], noise: Noise) -> list[Segment]:
    """Return the segments without those in which nothing moves, except the first in a row: more add no information."""
    kept, resting = [], {}
    for item in items:
        resting[item.episode] = resting.get(item.episode, 0) + 1 if _rests(whole, item, noise) else 0
        if resting[item.episode] <= LIMITS.kept_rests:
            kept.append(item)
    return kept


def _rests(whole: Observations, item: Segment, noise: Noise) -> bool:
    """Return whether no body moves or turns in a segment by more than the noise."""
    frames = slice(item.first, item.last + 1)
    seen, turned = whole.seen[item.episode, frames], whole.has_orientation[item.episode, frames]
    stays = _steady(whole.position_m[item.episode, frames], seen, noise.position_m)
    return stays and _steady(_turns(whole, item), turned, noise.rotation_rad)


def _steady(values: Tensor, mask: Tensor, sigma: float) -> bool:
    """Return whether values (T, nf, 3) with a mask (T, nf) have the same mean in both halves, to their noise."""
    half = len(values) // 2
    parts = [
        (values[p] * mask[p, :, None]).sum(0) / mask[p, :, None].sum(0).clamp_min(1.0)
        for p in (slice(0, half), slice(half, None))
    ]
    limit = LIMITS.still * sigma * (2 / half) ** 0.5
    return bool(((parts[1] - parts[0]).abs() < limit).all())


def _turns(whole: Observations, item: Segment) -> Tensor:
    """Return the rotation vectors (T, nf, 3) from the first frame of a segment to each."""
    frames = slice(item.first, item.last + 1)
    quat = whole.quat_wxyz[item.episode, frames].movedim(1, 0)
    known = whole.has_orientation[item.episode, frames].movedim(1, 0)
    times = whole.times_s[item.episode, frames].expand(len(quat), -1)
    return continuous_turns(times, quat, known).movedim(0, 1)


def _stretches(times: Tensor) -> list[tuple[int, int]]:
    """Return first and last frames of the parts of an episode without a gap."""
    if len(times) < 2:
        return []
    steps = times.diff()
    longest = max(LIMITS.gap * float(steps.median()), LIMITS.gap_s)
    cuts = (steps > longest).nonzero()[:, 0].tolist()
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

    A contact may happen between two frames: shared ends lose none.
    """
    count = last - first + 1
    if count < LIMITS.least_frames:
        return []
    most = max(LIMITS.least_frames, round(longest_s / step_s) + 1)
    number = max(1, min(-(-count // most), count // LIMITS.least_frames))
    edges = [first + round(k * (count - (1 if share else 0)) / number) for k in range(number + 1)]
    if share:
        return list(itertools.pairwise(edges))
    return [(a, b - 1) for a, b in itertools.pairwise(edges)]


def size_of(body: Body) -> float:
    """Return the radius [m] of the ball about the body frame's origin that holds the body's spheres."""
    return float((body.centers[0].square().sum(-1).sqrt() + body.radii[0]).max())


def _lever_of(body: Body) -> float:
    """Return how far a turn by one radian may move the lowest points of a body's spheres [m]: 0 for a ball.

    A turn moves the centres of spheres, not their surfaces about these.
    """
    return float(body.centers[0].norm(dim=-1).max())


def clear_frames(world: World, observations: Observations, noise: Noise) -> Tensor:
    """Return the airborne frames (B, T): surely without contact, also between two frames.

    Args:
        world: The world; without a ground, kinematic or further free bodies all frames are flight.
        observations: Whole episodes, or windows of them.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    clear = observations.seen.amax(-1) > 0
    if world.ground_normal is not None and world.ground_offset is not None:
        for column, index in enumerate(observations.free):
            heights = heights_of(world, world.bodies[index], observations, column)
            error = np.hypot(noise.position_m, noise.rotation_rad * _lever_of(world.bodies[index]))
            margin = FLIGHT_MARGIN_M + LIMITS.height_sigmas * float(error)
            clear &= _apart(heights, margin)
    clear &= clear_of_surfaces(world, observations, noise)
    for a in range(len(observations.free)):
        for b in range(a):
            if world.chains and world.chain_of(observations.free[a]) == world.chain_of(observations.free[b]) >= 0:
                continue  # links of one jointed body do not touch each other
            reach = size_of(world.bodies[observations.free[a]]) + size_of(world.bodies[observations.free[b]])
            gap = (observations.position_m[:, :, a] - observations.position_m[:, :, b]).norm(dim=-1) - reach
            clear &= _apart(gap[..., None], FLIGHT_MARGIN_M + LIMITS.height_sigmas * noise.position_m)
    return clear


def clear_of_surfaces(world: World, observations: Observations, noise: Noise) -> Tensor:
    """Return the frames (B, T) surely without contact with fixed surfaces and bodies that are not free, as there."""
    others = clearance(replace(world, ground_normal=None), observations)
    if not bool(torch.isfinite(others).any()):
        return torch.ones_like(others, dtype=torch.bool)
    return _apart(others[..., None], FLIGHT_MARGIN_M + LIMITS.height_sigmas * noise.position_m)


class GroundPlane(NamedTuple):
    """The ground plane of a world."""

    normal: Tensor
    """Unit normal (3,), world frame."""
    offset: Tensor
    """Height along the normal (B,) [m]."""

    @staticmethod
    def of(world: World) -> GroundPlane:
        """Return the ground plane of a world.

        Raises:
            ValueError: If the world has no ground.
        """
        if world.ground_normal is None or world.ground_offset is None:
            raise ValueError("this world has no ground plane")
        return GroundPlane(world.ground_normal, world.ground_offset)


def heights_of(world: World, body: Body, observations: Observations, column: int) -> Tensor:
    """Return the heights (B, T, N) [m] of a body's spheres; of its bounding ball where no orientation was measured."""
    normal, offset = GroundPlane.of(world)
    origin = observations.position_m[:, :, column] @ normal - offset[0]
    chosen = slice(None) if body.on_plane is None else body.on_plane
    along = quat_to_matrix(observations.quat_wxyz[:, :, column]).transpose(-1, -2) @ normal
    own = origin[..., None] + along @ body.centers[0, chosen].T - body.radii[0, chosen]
    ball = (origin - size_of(body))[..., None]
    return torch.where(observations.has_orientation[:, :, column, None] > 0, own, torch.minimum(own, ball))


def _apart(gaps: Tensor, margin: float) -> Tensor:
    """Return the frames (B, T) whose gaps (B, T, N) all exceed the margin and a share of their last and next move.

    Gaps to surfaces are infinite beyond some distance; moves to and from there are not known, and do not count.
    """
    moves = gaps.diff(dim=1).abs().nan_to_num(nan=0.0, posinf=0.0)
    edge = torch.zeros_like(gaps[:, :1])
    move = torch.maximum(torch.cat((edge, moves), 1), torch.cat((moves, edge), 1))
    return (gaps > margin + LIMITS.move_share * move).all(-1)


def supported_frames(world: World, whole: Observations, flight: Sequence[Segment], noise: Noise) -> Tensor:
    """Return the supported frames (E, T) of flight segments: a body's acceleration is far from gravity.

    A ground at another height than stated, a marker away from the body's middle or a hand make a body slide or rest
    above the ground. The acceleration is that of a parabola through the measured heights, with its standard error.
    A bounce that smoothing lifted off the ground has free falls on its sides, of which nothing is supported.

    Args:
        world: For gravity.
        whole: The episodes (E).
        flight: Segments that are clear of the ground.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    found = torch.zeros_like(whole.seen[..., 0], dtype=torch.bool)
    gravity = world.gravity[0]
    strength = float(gravity.norm())
    if strength == 0:
        return found
    for item in flight:
        frames = slice(item.first, item.last + 1)
        for column in range(len(whole.free)):
            seen = whole.seen[item.episode, frames, column] > 0
            t = whole.times_s[item.episode, frames][seen].numpy()
            along = (whole.position_m[item.episode, frames, column][seen] @ gravity / strength).numpy()
            held = torch.as_tensor(_not_falling(t, along, strength, noise.position_m))
            places = item.first + torch.nonzero(seen)[:, 0]
            if bool(held.all()) and len(held):
                found[item.episode, frames] = True
            elif bool(held.any()):
                found[item.episode, places[held]] = True
    return found


def _not_falling(t: Array, along: Array, strength: float, sigma: float) -> NDArray[np.bool_]:
    """Return which frames (n,) are not part of a free fall: none, all, or those between two falls.

    Args:
        t: Their times (n,) [s].
        along: Position along gravity (n,) [m].
        strength: Gravity [m/s2].
        sigma: Standard deviation of the position [m].
    """
    held = np.zeros(len(t), bool)
    low, (off, _) = _low_point(t, along, strength, sigma), _off_gravity(t, along, strength, sigma)
    if low is None and not off:
        return held
    held[:] = True
    at = _kink(t, along, strength) if low is None else low
    sides = [slice(0, max(at - LIMITS.kink_frames, 0)), slice(at + LIMITS.kink_frames + 1, len(t))]
    falls = [_off_gravity(t[side], along[side], strength, sigma) for side in sides]
    if not off or any(sure and not differs for differs, sure in falls):
        for side, (_, sure) in zip(sides, falls, strict=True):
            if sure or not off:
                held[side] = _not_falling(t[side], along[side], strength, sigma)
    return held


def _low_point(t: Array, along: Array, strength: float, sigma: float) -> int | None:
    """Return the frame of a bounce among frames (n,); None without one.

    A free fall is lowest at one of its ends. A bounce is lower than frames before and after it by the height of the
    shortest flight, whichever they are.
    """
    if len(t) < 2 * LIMITS.least_frames:
        return None
    # two wrong frames in a row make no bounce
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(along, 5), axis=1)
    before, after = np.minimum.accumulate(smooth), np.minimum.accumulate(smooth[::-1])[::-1]
    depth = smooth - np.maximum(before, after)
    at = int(depth.argmax())
    least = max(strength * LIMITS.least_flight_s**2 / 8, LIMITS.lift_sigmas * sigma)
    return at + 2 if float(depth[at]) > least else None


def _off_gravity(t: Array, along: Array, strength: float, sigma: float) -> tuple[bool, bool]:
    """Return whether the acceleration of frames (n,) surely differs from gravity, and whether it could be seen to."""
    if len(t) < 4:
        return False, False
    powers = np.vander(t - t.mean(), 3)
    solution = np.linalg.lstsq(powers, along, rcond=None)[0]
    error = 2 * sigma * float(np.sqrt(np.linalg.inv(powers.T @ powers)[0, 0]))
    fall = 2 * float(solution[0])
    away, least = abs(fall - strength), LIMITS.most_lift * strength
    off = away > least and away > LIMITS.lift_sigmas * error
    if off and fall > LIMITS.least_fall * strength:
        # an even fall is a flight under a force that nobody has named, not a support
        off = float((along - powers @ solution).std()) > LIMITS.height_sigmas * sigma
    return off, len(t) >= LIMITS.least_frames and LIMITS.lift_sigmas * error < least


def _kink(t: Array, along: Array, strength: float) -> int:
    """Return the frame at which two free falls that follow each other fit frames (n,) best."""
    time = t - t.mean()
    fall = along - along.mean() - 0.5 * strength * time**2

    def misfits(x: Array, y: Array) -> Array:
        """Return the sum of squares about a straight line through the first 1, ..., n of n points."""
        n = np.arange(1, len(x) + 1)
        mean_x, mean_y = np.cumsum(x) / n, np.cumsum(y) / n
        xx, xy, yy = (
            np.cumsum(a) - n * b for a, b in ((x * x, mean_x**2), (x * y, mean_x * mean_y), (y * y, mean_y**2))
        )
        return yy - np.divide(xy**2, xx, out=np.zeros_like(xx), where=xx > 1e-15)

    return int((misfits(time, fall)[:-1] + misfits(time[::-1], fall[::-1])[-2::-1]).argmin()) + 1
