"""Segments for multiple shooting: episodes cut at frames, with first guesses of the states; chains of tied segments."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ....datasets.capture.tracks import Episode
from ...geometry.rotation import quat_turn
from ...optimization.problem import NormalEquations
from ...physics.state import State
from ...physics.world import World
from ...trajectories.initial_state import FLIGHT_MARGIN_M, clearance, separate_frames
from ...trajectories.observations import Observations
from ...trajectories.rolling_start import rolling_items, with_rolling
from ...trajectories.track_noise import Noise

if TYPE_CHECKING:
    pass

SEGMENT_S = 0.03
"""Minimum duration of a segment [s]; segments begin and end at frames."""
RESTING_SIGMAS = 6.0
"""Maximum motion in a segment, in standard deviations of the noise, of a body that may be at rest."""

BESIDE = 2
"""Number of frames on both sides of the first one of a segment in which a ball has to touch to count as rolling."""

_Piece = tuple[int, int, int]
"""Part of an episode: its number, and its first and last frame."""


@dataclass(frozen=True, kw_only=True)
class TiedSegments:
    """Segments of episodes, with the order in which they follow each other."""

    segments: Observations
    """One item for each segment (B); the frame at which the next one begins counts as not seen."""
    following: Tensor
    """Segment that comes next in the same episode, -1 for the last, shape (B,)."""
    end: Tensor
    """Frame at which the next segment begins, or the last one, shape (B,)."""
    ahead: State
    """Alternative first guess of the states, which moves to the next frame in a straight line."""
    driven: Tensor
    """Whether a driven body may touch in the segment, shape (B,)."""
    begins: Tensor
    """Episode of each segment, and its frame at which the segment begins, shape (B, 2)."""

    @staticmethod
    def of(
        world: World,
        episodes: Sequence[Episode],
        spans: Sequence[tuple[float, float]],
        noise: Noise,
        contacts_only: bool,
        segment_s: float = SEGMENT_S,
    ) -> TiedSegments:
        """Cut the span [s] of each episode into segments; see `Shooting.of`."""
        whole = Observations.of(world, episodes, spans)
        pieces = _pieces(world, whole, noise, contacts_only, segment_s)
        items = [k for k, _, _ in pieces]
        windows = [(float(whole.times_s[k, a]) - 1e-9, float(whole.times_s[k, b]) + 1e-9) for k, a, b in pieces]
        segments = Observations.of(world, [episodes[k] for k in items], windows)
        following, end, seen, turned = [], [], segments.seen.clone(), segments.has_orientation.clone()
        for row, k in enumerate(items):
            last = row + 1 == len(items) or pieces[row + 1][:2] != (k, pieces[row][2])
            following.append(-1 if last else row + 1)
            end.append(int((segments.times_s[row] <= windows[row][1]).sum()) - 1)
            if not last:  # the next segment has seen that frame
                seen[row, end[-1] :], turned[row, end[-1] :] = 0.0, 0.0
        starts = [first for _, first, _ in pieces]
        ahead = _with_spins(world, whole, items, starts, segments.state)
        state = _moving(world, whole, items, starts, ahead)
        return TiedSegments(
            segments=replace(segments, seen=seen, has_orientation=turned, state=state),
            following=torch.tensor(following),
            end=torch.tensor(end),
            ahead=ahead,
            driven=_driven(world, whole, pieces),
            begins=torch.tensor([piece[:2] for piece in pieces]),
        )


@dataclass(frozen=True, kw_only=True)
class Chains:
    """Segments (B) in rows (C) of up to M segments: chains of tied ones, several in a row where they fit.

    A tie couples the states of two neighbouring segments only, so that the states of a row are one item of the
    least-squares solver, which eliminates them: systems of one row instead of one of all segments.
    """

    segment: Tensor
    """Segment at each place of each row, 0 where there is none, shape (C, M)."""
    filled: Tensor
    """Whether there is a segment, shape (C, M)."""
    chain: Tensor
    """Row of each segment, shape (B,)."""
    place: Tensor
    """Its place in the row, shape (B,)."""

    @staticmethod
    def of(following: Tensor) -> Chains:
        """Return the chains of segments whose following segment (B,), -1 for none, is the next one."""
        ends = [0, *(k + 1 for k, after in enumerate(following.tolist()) if after < 0)]
        chains = sorted((range(a, b) for a, b in itertools.pairwise(ends)), key=len, reverse=True)
        longest, rows = len(chains[0]), list[list[int]]()
        for chain in chains:
            row = next((row for row in rows if len(row) + len(chain) <= longest), None)
            if row is None:
                rows.append(row := [])
            row.extend(chain)
        segment = torch.zeros(len(rows), longest, dtype=torch.long)
        filled = torch.zeros_like(segment, dtype=torch.bool)
        places = torch.zeros(2, len(following), dtype=torch.long)
        for number, row in enumerate(rows):
            segment[number, : len(row)], filled[number, : len(row)] = torch.tensor(row), True
            places[0, row], places[1, row] = number, torch.arange(len(row))
        return Chains(segment=segment, filled=filled, chain=places[0], place=places[1])

    def by_chain(self, values: Tensor) -> Tensor:
        """Return values (B, ...) of segments by row and place, shape (C, M, ...)."""
        return values[self.segment]

    def by_segment(self, values: Tensor) -> Tensor:
        """Return values (C, M, ...) by segment, shape (B, ...)."""
        return values[self.chain, self.place]

    def summed(self, values: Tensor) -> Tensor:
        """Return the sums (C, ...) of values (B, ...) of segments."""
        return values.new_zeros(len(self.segment), *values.shape[1:]).index_add(0, self.chain, values)

    def normal_equations(
        self, own: tuple[Tensor, Tensor], tie: tuple[Tensor, Tensor], prior: Tensor, cost: Tensor
    ) -> NormalEquations:
        """Return the normal equations of the rows, whose states are those of their segments (M S).

        Args:
            own: Information (B, P + S, P + S) and gradient (B, P + S) of the frames of each segment by parameters and
                its state.
            tie: The same of its tie by parameters, its state and the next one, shapes (B, P + 2 S, P + 2 S) and
                (B, P + 2 S); 0 where no segment follows.
            prior: Information added on the diagonal of each state, shape (S,).
            cost: Cost of each segment, shape (B,).
        """
        size = len(prior)
        count = own[1].shape[1] - size
        here, after = slice(count, count + size), slice(count + size, None)
        chains, length = self.segment.shape
        (matrix, slope), (coupled, pull) = own, tie
        both = slice(None, count + size)
        matrix, slope = matrix + coupled[:, both, both], slope + pull[:, both]
        place = (self.chain, self.place)
        tied = (self.filled[:, 1:], slice(1, None))
        states = matrix.new_zeros(chains, length, size, length, size)
        mixed, state_slope = matrix.new_zeros(chains, length, size, count), slope.new_zeros(chains, length, size)
        diagonal = torch.eye(size).to(matrix).repeat(chains, length, 1, 1)  # where there is no segment
        diagonal[place] = matrix[:, here, here] + torch.diag(prior)
        mixed[place], state_slope[place] = matrix[:, here, :count], slope[:, here]
        into = [self.by_chain(part)[:, :-1] * tied[0].view(chains, -1, *[1] * (part.dim() - 1)) for part in tie]
        diagonal[:, 1:] += into[0][:, :, after, after]
        mixed[:, 1:] += into[0][:, :, after, :count]
        state_slope[:, 1:] += into[1][:, :, after]
        step = torch.arange(length)
        states.movedim(3, 2)[:, step, step] = diagonal
        across = into[0][:, :, here, after]
        states.movedim(3, 2)[:, step[:-1], step[1:]] = across
        states.movedim(3, 2)[:, step[1:], step[:-1]] = across.mT
        return NormalEquations(
            states=states.flatten(3).flatten(1, 2),
            mixed=mixed.flatten(1, 2),
            information=self.summed(matrix[:, :count, :count]),
            state_slope=-state_slope.flatten(1),
            slope=-self.summed(slope[:, :count]),
            cost=self.summed(cost),
        )


def _pieces(world: World, whole: Observations, noise: Noise, contacts_only: bool, segment_s: float) -> list[_Piece]:
    """Return the segments of episodes; with `contacts_only` those near contact, and the first of each episode."""
    cuts = [_cuts(times[:count], segment_s) for times, count in zip(whole.times_s, whole.frames.tolist(), strict=True)]
    pieces = [(k, a, b) for k, places in enumerate(cuts) for a, b in itertools.pairwise(places)]
    if not contacts_only:
        return pieces
    informative = _informative(world, whole, pieces, noise)
    return [piece for piece, near in zip(pieces, informative, strict=True) if near or piece[1] == 0]


def _cuts(times_s: Tensor, segment_s: float) -> list[int]:
    """Return the frames at which segments begin, and the last frame."""
    places = [0]
    for frame in range(1, len(times_s)):
        if float(times_s[frame] - times_s[places[-1]]) >= segment_s:
            places.append(frame)
    if len(places) > 2 and places[-1] != len(times_s) - 1:
        places.pop()  # the last segment absorbs a remainder that is too short
    return [*places, len(times_s) - 1] if places[-1] != len(times_s) - 1 else places


def _informative(world: World, whole: Observations, pieces: Sequence[_Piece], noise: Noise) -> list[bool]:
    """Return which segments (episode, first and last frame) are informative: in contact and moving, or next to such."""
    flying = clearance(world, whole) > FLIGHT_MARGIN_M
    moved = whole.position_m.new_zeros(len(pieces))
    for row, (k, a, b) in enumerate(pieces):
        shift = (whole.position_m[k, b] - whole.position_m[k, a]).abs().amax() / noise.position_m
        turn = quat_turn(whole.quat_wxyz[k, a], whole.quat_wxyz[k, b])
        moved[row] = torch.maximum(shift, turn.abs().amax() / noise.rotation_rad)
    touches = [not bool(flying[k, a : b + 1].all()) for k, a, b in pieces]
    moving = [touch and bool(way > RESTING_SIGMAS) for touch, way in zip(touches, moved, strict=True)]
    padded = [False, *moving, False]
    return [any(padded[row : row + 3]) for row in range(len(pieces))]


def _driven(world: World, whole: Observations, pieces: Sequence[_Piece]) -> Tensor:
    """Return in which segments (B,) a driven body may touch a free one, by the gaps at their frames."""
    if not whole.drives:
        return torch.zeros(len(pieces), dtype=torch.bool)
    apart = separate_frames(replace(world, ground_normal=None), whole)
    return torch.tensor([not bool(apart[k, a : b + 1].all()) for k, a, b in pieces])


def _moving(world: World, whole: Observations, items: list[int], starts: list[int], state: State) -> State:
    """Return first guesses of the states (B) at frames, with velocities from differences within one phase of motion.

    In flight a difference to a neighbouring frame gives the velocity half a frame away, which is corrected for gravity;
    both neighbours are used where both are in flight. In contact the difference to the next frame is used unchanged.
    """
    flying = clearance(world, whole) > FLIGHT_MARGIN_M
    velocity, omega = state.velocity_m_s.clone(), state.omega_body_rad_s.clone()
    for row, (item, frame) in enumerate(zip(items, starts, strict=True)):
        fall = world.gravity[0] if bool(flying[item, frame]) else None
        others = _neighbours(frame, int(whole.frames[item]), flying[item])
        for column, body in enumerate(whole.free):
            rates, turns = [], []
            for other in others:
                span = whole.times_s[item, other] - whole.times_s[item, frame]
                shift = whole.position_m[item, other, column] - whole.position_m[item, frame, column]
                here, there = whole.quat_wxyz[item, frame, column], whole.quat_wxyz[item, other, column]
                rates.append(shift / span - (0.0 if fall is None else 0.5 * span * fall))
                turns.append(quat_turn(here, there) / span)
            velocity[row, body] = torch.stack(rates).mean(0)
            if bool(whole.has_orientation[item, frame, column]):  # else the spin is that of the first guess
                omega[row, body] = torch.stack(turns).mean(0)
    moved = replace(state, velocity_m_s=velocity, omega_body_rad_s=omega)
    return _with_spins(world, whole, items, starts, moved)


def _with_spins(world: World, whole: Observations, items: list[int], starts: list[int], state: State) -> State:
    """Return states (B) at frames, with the spins of balls that roll there, which nothing measured tells."""
    number = torch.arange(whole.times_s.shape[1])
    frame = torch.tensor(starts)[:, None]
    around = (number >= frame - BESIDE) & (number <= frame + BESIDE)
    begun = replace(whole.select(items), state=state)
    rolling = rolling_items(world, begun, around)
    return with_rolling(world, begun, rolling).state if bool(rolling.any()) else state


def _neighbours(frame: int, count: int, flying: Tensor) -> list[int]:
    """Return the frames next to one of `count` frames from which its velocity is taken; flying (T,): by frame."""
    others = [frame + k for k in (-1, 1) if 0 <= frame + k < count]
    if bool(flying[frame]):
        return [k for k in others if bool(flying[k])] or others[:1]
    return [k for k in others if k > frame] or others
