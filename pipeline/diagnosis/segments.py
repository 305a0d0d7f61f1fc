"""Episodes cut into segments, each with a state of its own that is fitted to it: flight long, contact short.

The information about a force grows with the fourth power of the time that it acts, so flights are cut as little as
possible; a rollout through contact is a rough function of its start, so contacts are cut short (Bock & Plitt 1984).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from ..estimation.observations import Observations
from ..estimation.trajectory import STATE_SIZE, TrajectoryResiduals, retract, state_prior
from ..physics.contact import ContactLaw
from ..physics.dispatch import rollout as rolled_out
from ..physics.driven import Drive
from ..physics.measured import measure, true_times
from ..physics.parameters import Parameter, apply_parameters
from ..physics.rollout import Rollout
from ..physics.rotation import quat_conjugate, quat_exp, quat_log, quat_multiply
from ..physics.world import State, World
from .phases import clear_frames

if TYPE_CHECKING:
    from ...datasets.tracks import Track

Kind = Literal["flight", "contact"]

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
FLIGHT_STEP_S = 0.0025
"""Largest step in flight, where nothing is stiff; the error of a drag of 1 / s is 0.1 %."""
MAX_ROWS = 4096
"""Rollouts in one batch: more run out of the processor's cache."""
STILL_SIGMAS = 4.0
"""Nothing moves where the means of both halves of a segment differ by less than this many of their standard errors."""
KEPT_RESTS = 2
START_FRAMES = (2, 4, 7)
"""A contact segment's state is searched from straight lines through so many frames (pitfall P2)."""
PARAMETER_STEP = 0.04
"""Differences by parameters in contact, in widths of their priors: a fifth of what matters."""
CONTACT_STEP_S = 0.002
"""Largest step in contact, and at most half the contact time: the law does not depend on the step."""
BAD_FIT = 1.5
"""A segment that fits worse than this [chi2 / dof] is fitted again from other starts."""
FALL, MAX_DAMPING = 0.02, 1e3
"""A descent ends when chi2 falls by less, or no step but a tiny one lowers it."""
ITERATIONS = {"flight": 5, "contact": 8}


@dataclass(frozen=True)
class Segment:
    """Frames `first` to `last` (included) of an episode, by its place among the episodes."""

    episode: int
    first: int
    last: int


@dataclass(frozen=True)
class Segments:
    """Segments of one kind as a batch.

    kind; world: in which they are rolled out; items (B); observations (B): their frames, padded, with the state that
    is the best known; noise: standard deviations of the tracks (position [m], rotation [rad]).
    """

    kind: Kind
    world: World
    items: tuple[Segment, ...]
    observations: Observations
    noise: tuple[float, float]

    @staticmethod
    def of(kind: Kind, world: World, whole: Observations, items: Sequence[Segment], noise: tuple[float, float]):
        """Cut whole episodes; the states are first guesses, see :func:`fit_states`."""
        cut = _windows(whole, items)
        found = Segments(kind, world_for(kind, world), tuple(items), cut, noise)
        return replace(found, observations=replace(cut, state=line_state(found, START_FRAMES[1])))

    @property
    def lengths(self) -> list[int]:
        """Number of frames of each segment."""
        return [item.last - item.first + 1 for item in self.items]

    @property
    def dof(self) -> Tensor:
        """Degrees of freedom (B,) of each segment: its numbers measured, less those of its state that they show."""
        seen = self.observations
        moved, turned = seen.seen.sum(1), seen.turned.sum(1)
        free = 3 * (moved - 2).clamp_min(0) + 3 * (turned - 2).clamp_min(0)
        return free.sum(-1)

    def select(self, items: Sequence[int]) -> Segments:
        """Return some of the segments."""
        picked = tuple(self.items[i] for i in items)
        return replace(self, items=picked, observations=self.observations.select(items))

    def chunks(self, directions: int) -> list[list[int]]:
        """Return the places of the segments in parts that fit one batch with so many directions."""
        size = max(1, MAX_ROWS // max(1, directions))
        places = list(range(len(self.items)))
        return [places[k : k + size] for k in range(0, len(places), size)]

    def residuals(
        self, parameters: Sequence[Parameter], values: Tensor, jacobian: bool = True
    ) -> tuple[Tensor, Tensor | None]:
        """Return residuals (B, T nf, 6) in sigmas and, if wanted, their Jacobian (B, T nf, 6, P + S).

        It is one of differences: in contact they see past the roughness of a step, and in flight, which is smooth,
        they cost a third of exact derivatives and agree with them to 1e-4.

        Args:
            parameters: Which numbers of the world are differentiated.
            values: In fitted coordinates, shape (P,), or (B, P) for values of each segment.
            jacobian: Whether it is wanted; columns of parameters first, then of the state change.
        """
        size = STATE_SIZE * len(self.observations.free)
        steps = [_difference(p) for p in parameters]
        parts = []
        for places in self.chunks(2 * size + len(parameters) + 1 if jacobian else 1):
            some = self.observations.select(places)
            problem = TrajectoryResiduals(self.world, parameters, some, *self.noise, True, steps)
            shared = values if values.ndim == 1 else values[places]
            parts.append(problem(shared, torch.zeros(len(places), size).to(self.world.gravity), jacobian))
        rows = torch.cat([r for r, _ in parts])
        return rows, torch.cat([j for _, j in parts if j is not None]) if jacobian else None

    def rollout(self, record_contacts: bool = False) -> Rollout:
        """Return the true motion of the segments from their states."""
        world, seen = self.world, self.observations
        with torch.no_grad():
            return rolled_out(world, seen.state, true_times(world, seen.times_s), seen.drives, record_contacts)

    def positions(self, parameters: Sequence[Parameter] = (), values: Tensor | None = None) -> Tensor:
        """Return the positions (B, T, nf, 3) [m] of the free bodies as they would be measured.

        Args:
            parameters: Numbers of the world that are set.
            values: Their values in fitted coordinates, (B, P).
        """
        world, seen = self.world, self.observations
        if parameters and values is not None:
            decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(parameters)], -1)
            world = apply_parameters(world, parameters, decoded)
        with torch.no_grad():
            return measure(world, seen.state, seen.times_s, seen.drives).position_m[:, :, list(seen.free)]

    def moved(self, change: Tensor) -> Segments:
        """Return the segments with their states moved by changes (B, S)."""
        seen = self.observations
        return replace(self, observations=replace(seen, state=retract(seen.state, change, seen.free)))


def _difference(parameter: Parameter) -> tuple[float, float]:
    """Return how far down and up a parameter is moved for its derivative; up alone, as many may not be below 0."""
    return 0.0, PARAMETER_STEP * parameter.prior[1]


def world_for(kind: Kind, world: World) -> World:
    """Return the world in which segments of a kind are rolled out: flight needs no contact and takes longer steps."""
    if kind == "contact":
        half = 0.5 * float(world.contact.contact_time_s.min()) if isinstance(world.contact, ContactLaw) else 0.0
        return replace(world, step_s=max(world.step_s, min(CONTACT_STEP_S, half)))
    return replace(world, touching=False, step_s=max(world.step_s, FLIGHT_STEP_S))


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
        count = int((whole.seen[episode].amax(-1) > 0).sum())
        for first, last in _stretches(times[:count]):
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
    return flight, _without_rest(whole, contact, noise), clear


def _without_rest(whole: Observations, items: Sequence[Segment], noise: tuple[float, float]) -> list[Segment]:
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
    picked = {key: getattr(whole, key)[rows[:, None], place] for key in ("position_m", "quat_wxyz", "seen", "turned")}
    picked |= {key: picked[key] * inside[..., None] for key in ("seen", "turned")}
    drives = {
        name: Drive(*(getattr(drive, key)[rows] for key in drive.__dataclass_fields__))
        for name, drive in whole.drives.items()
    }
    state = State(*(getattr(whole.state, key)[rows] for key in whole.state.__dataclass_fields__))
    names = tuple(whole.names[item.episode] for item in items)
    return replace(whole, names=names, times_s=times, drives=drives, state=state, **picked)


def line_state(segments: Segments, frames: int) -> State:
    """Return states at the first frames from straight lines through so many frames; in flight with gravity."""
    seen, world = segments.observations, segments.world
    state = seen.state
    fields = [getattr(state, key).clone() for key in state.__dataclass_fields__]
    t = (seen.times_s - seen.times_s[:, :1])[:, :frames]
    fall = 0.5 * t.square()[..., None] * world.gravity[:, None] if segments.kind == "flight" else torch.zeros(1)
    for column, body in enumerate(seen.free):
        moved, turned = seen.seen[:, :frames, column], seen.turned[:, :frames, column]
        fields[0][:, body], fields[2][:, body] = _line(t, seen.position_m[:, :frames, column] - fall, moved)
        at = turned.argmax(1)  # the first measured orientation
        item = torch.arange(len(at))
        base = seen.quat_wxyz[item, at, column]
        turn = quat_log(quat_multiply(quat_conjugate(base[:, None]), seen.quat_wxyz[:, :frames, column]))
        angle, omega = _line(t, turn, turned)
        known = (turned.sum(1) >= 2)[:, None]
        fields[1][:, body] = torch.where(known, quat_multiply(base, quat_exp(angle)), base)
        fields[3][:, body] = torch.where(known, omega, torch.zeros_like(omega))
    return State(*fields)


def _line(t: Tensor, values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return value at 0 and slope, each (B, 3), of weighted straight lines through values (B, n, 3) at t (B, n)."""
    total = weight.sum(1).clamp_min(1.0)[:, None]
    mean = (weight[..., None] * values).sum(1) / total
    middle = (weight * t).sum(1)[:, None] / total
    away = weight * (t - middle)
    slope = (away[..., None] * values).sum(1) / away.square().sum(1).clamp_min(1e-12)[:, None]
    return mean - middle * slope, slope


def fit_states(
    segments: Segments,
    parameters: Sequence[Parameter] = (),
    values: Tensor | None = None,
    iterations: int | None = None,
    search: bool = True,
) -> Segments:
    """Fit the state of each segment by Levenberg-Marquardt, each with a damping of its own.

    Args:
        segments: With states to start from.
        parameters: Numbers of the world that are set, not fitted.
        values: Their values in fitted coordinates, (P,) or (B, P).
        iterations: Most steps.
        search: Whether to start from straight lines through several numbers of frames too, and keep the best; those
            that still fit badly are fitted from every one of them.
    """
    given = torch.zeros(0).to(segments.world.gravity) if values is None else values
    count = ITERATIONS[segments.kind] if iterations is None else iterations
    starts = [segments, *_line_starts(segments)] if search and segments.kind == "contact" else [segments]
    best, cost = segments, costs_of(segments, parameters, given)
    for trial in starts[1:]:
        best, cost = _better(best, cost, trial, costs_of(trial, parameters, given))
    best, cost = _descended(best, parameters, given, count)
    share = cost / segments.dof.clamp_min(1.0)
    # where the law misses everything by far more than the noise, only the worst can be at the wrong minimum
    bad = torch.nonzero(share > BAD_FIT * share.nanmedian().clamp_min(1.0))[:, 0].tolist()
    if len(starts) > 1 and bad:  # all starts of all of them in one batch
        several = _joined([trial.select(bad) for trial in starts])
        chosen = given if given.ndim == 1 else given[bad].repeat(len(starts), 1)
        several, found = _descended(several, parameters, chosen, count)
        for k in range(len(starts)):
            part = list(range(k * len(bad), (k + 1) * len(bad)))
            best, cost = _better(best, cost, _placed(best, bad, several.select(part)), _put(cost, bad, found[part]))
    return best


def costs_of(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Tensor:
    """Return the sum of squares (B,) of the residuals, in sigmas; infinite where a rollout diverged."""
    return _costs(segments.residuals(parameters, values, jacobian=False)[0])


def _descended(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor, iterations: int
) -> tuple[Segments, Tensor]:
    """Return the segments with their states at a minimum near by, and the costs (B,) there."""
    prior = torch.diag(state_prior(len(segments.observations.free))).to(segments.world.gravity)
    rows, jacobian = segments.residuals(parameters, values)
    cost = _costs(rows)
    damping = torch.full_like(cost, 1e-4)
    active = list(range(len(segments.items)))
    for _ in range(iterations):
        assert jacobian is not None
        flat = torch.nan_to_num(jacobian[..., len(parameters) :].flatten(1, 2), posinf=0.0, neginf=0.0)
        error = torch.nan_to_num(rows.flatten(1), posinf=0.0, neginf=0.0)
        normal = flat.transpose(1, 2) @ flat + prior
        slope = (flat.transpose(1, 2) @ error[..., None]).squeeze(-1)
        own = damping[active][:, None] * normal.diagonal(dim1=1, dim2=2)
        step = -torch.linalg.solve(normal + torch.diag_embed(own), slope)
        some = segments.select(active)
        trial = some.moved(step)
        new_rows, slopes = trial.residuals(parameters, values if values.ndim == 1 else values[active])
        assert slopes is not None
        fall = cost[active] - _costs(new_rows)
        better = fall > 0
        segments = _placed(segments, active, _merged(better, trial, some))
        cost = _put(cost, active, torch.where(better, _costs(new_rows), cost[active]))
        damping = _put(damping, active, torch.where(better, damping[active] / 8, damping[active] * 10))
        goes_on = torch.where(better, fall > FALL, damping[active] < MAX_DAMPING)
        rows = torch.where(better[:, None, None], new_rows, rows)[goes_on]
        jacobian = torch.where(better[:, None, None, None], slopes, jacobian)[goes_on]
        active = [item for item, more in zip(active, goes_on.tolist(), strict=True) if more]
        if not active:
            break
    return segments, cost


def _joined(parts: Sequence[Segments]) -> Segments:
    """Return selections of the same segments as one batch."""
    first = parts[0]
    repeated = first.select(list(range(len(first.items))) * len(parts))
    fields = [torch.cat([getattr(p.observations.state, key) for p in parts]) for key in State.__dataclass_fields__]
    return replace(repeated, observations=replace(repeated.observations, state=State(*fields)))


def _line_starts(segments: Segments) -> list[Segments]:
    """Return the segments with states from straight lines through several numbers of frames."""
    seen = segments.observations
    return [replace(segments, observations=replace(seen, state=line_state(segments, n))) for n in START_FRAMES]


def _costs(rows: Tensor) -> Tensor:
    return torch.nan_to_num(rows.square().sum((1, 2)), nan=torch.inf, posinf=torch.inf)


def _better(a: Segments, cost_a: Tensor, b: Segments, cost_b: Tensor) -> tuple[Segments, Tensor]:
    """Return of each segment the state with the lower cost, and that cost."""
    return _merged(cost_b < cost_a, b, a), torch.minimum(cost_a, cost_b)


def _merged(choice: Tensor, first: Segments, second: Segments) -> Segments:
    """Return the segments with the states of the first where chosen (B,), of the second elsewhere."""
    a, b = first.observations.state, second.observations.state
    mask = choice[:, None, None]
    fields = [torch.where(mask, getattr(a, key), getattr(b, key)) for key in a.__dataclass_fields__]
    return replace(second, observations=replace(second.observations, state=State(*fields)))


def better_of(a: Segments, b: Segments, parameters: Sequence[Parameter], values: Tensor) -> Segments:
    """Return of each segment the one of two states that fits better."""
    costs = [costs_of(part, parameters, values) for part in (a, b)]
    return _better(a, costs[0], b, costs[1])[0]


def _placed(segments: Segments, places: Sequence[int], some: Segments) -> Segments:
    """Return the segments with the states of some of them replaced."""
    old, new = segments.observations.state, some.observations.state
    fields = [_put(getattr(old, key), places, getattr(new, key)) for key in old.__dataclass_fields__]
    return replace(segments, observations=replace(segments.observations, state=State(*fields)))


def _put(values: Tensor, places: Sequence[int], some: Tensor) -> Tensor:
    return values.index_copy(0, torch.tensor(places), some)
