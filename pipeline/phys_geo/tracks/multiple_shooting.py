"""Multiple shooting: parameters from motions that are cut into short segments, each with a state of its own.

A rollout over several impacts is a rough function of where it starts, and its derivatives lead nowhere. Over a segment
of some hundredths of a second they lead to the minimum. The segments of an episode are tied: the state in which one
ends and the one with which the next begins may differ by what the contact model itself may miss there, so that one
impact that it cannot follow does not bend the parameters (Bock & Plitt 1984; with ties that give, weak-constraint
assimilation, Tremolet 2006). Gauss-Newton on everything at once: the states at the start of all segments and the
parameters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..physics.dispatch import rollout as rolled_out
from ..physics.dispatch import rollouts_at_once
from ..physics.measured import as_measured, true_times
from ..physics.parameters import Parameter, apply_parameters
from ..physics.rollout import Rollout
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply
from ..physics.world import State, World
from .least_squares import bound_stops, robust_loss
from .observations import Observations
from .trajectory import retract, state_prior
from .warmup import FLIGHT_MARGIN_M, clearance

if TYPE_CHECKING:
    from ...datasets.tracks import Track

SEGMENT_S = 0.03
"""A segment lasts at least so long, and from one frame to another."""
TIE = (5e-5, 5e-4, 1e-3, 1e-2)
"""What the model may miss in a segment of flight: position [m], rotation [rad], velocity [m/s], omega [rad/s]."""
TIE_SHARE = 0.01
"""What it may miss of the velocity that contact gives a body, and of the turning that goes with it."""
ROBUST_SCALE = 4.0
"""Of the robust loss of a frame [sigmas]; that of a tie is twice as wide."""
RESTING_SIGMAS = 6.0
"""A body that moves by less in a segment, in units of the noise, may be at rest."""
STATE_STEPS = (2e-4, 2e-3, 1e-2, 1e-1)
"""Differences in position [m], rotation [rad], velocity [m/s], omega [rad/s] for the Jacobian."""
PARAMETER_STEP = 0.1
"""The same of a parameter, in widths of its prior."""
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Prior:
    """A normal prior of the parameters in fitted coordinates: mean (P,), std (P,); and bounds (P, 2)."""

    mean: Tensor
    std: Tensor
    bounds: Tensor


@dataclass(frozen=True)
class Shot:
    """Where the fit ended.

    shared (P,); covariance (P, P): from the curvature, times the misfit where that is above 1; state: of the first
    frame of each episode (E); cost; costs by accepted step; misfit: mean square of the tied residuals, in their own
    units; chi2: median of a frame's, over what it should be.
    """

    shared: Tensor
    covariance: Tensor
    state: State
    cost: float
    costs: list[float]
    misfit: float
    chi2: float
    converged: bool

    @property
    def scale(self) -> float:
        """By how much the variances in `covariance` have grown over those of the curvature."""
        return max(1.0, self.misfit, self.chi2)


@dataclass(frozen=True)
class Shooting:
    """The segments of episodes as one least-squares problem.

    Attributes:
        world: The world.
        parameters: What is fitted (P).
        segments: One item for each segment (B); frames at which the next one begins are not among those it has seen.
        following: The segment that comes next in the same episode, -1 for the last, shape (B,).
        end: The frame at which the next one begins, or the last one, shape (B,).
        tie: Standard deviation of what may differ where segments meet, shape (B, S).
        noise: Of the tracks (position [m], rotation [rad]), numbers or one for each frame and body (B, T, nf).
        prior: Of the parameters.
        ahead: Another first guess of the states: each moves to the next frame in a straight line.
    """

    world: World
    parameters: Sequence[Parameter]
    segments: Observations
    following: Tensor
    end: Tensor
    tie: Tensor
    noise: tuple[float | Tensor, float | Tensor]
    prior: Prior
    ahead: State

    @staticmethod
    def of(
        world: World,
        parameters: Sequence[Parameter],
        episodes: Sequence[tuple[str, dict[str, Track]]],
        spans: Sequence[tuple[float, float]],
        noise: tuple[float, float],
        prior: Prior,
        contacts_only: bool = False,
    ) -> Shooting:
        """Cut the span [s] of each episode into segments.

        With `contacts_only` those are left out that tell nothing of contact and lie beside none that does: in flight,
        and where all rests; not the first ones, whose states are where episodes begin.
        """
        whole = Observations.of(world, episodes, spans)
        cuts = [_cuts(times[:count]) for times, count in zip(whole.times_s, whole.frames.tolist(), strict=True)]
        pieces = [(k, a, b) for k, places in enumerate(cuts) for a, b in itertools.pairwise(places)]
        if contacts_only:
            telling = _telling(world, whole, pieces, noise)
            pieces = [piece for piece, tells in zip(pieces, telling, strict=True) if tells or piece[1] == 0]
        items = [k for k, _, _ in pieces]
        windows = [(float(whole.times_s[k, a]) - 1e-9, float(whole.times_s[k, b]) + 1e-9) for k, a, b in pieces]
        segments = Observations.of(world, [episodes[k] for k in items], windows)
        following, end, seen, turned = [], [], segments.seen.clone(), segments.turned.clone()
        for row, k in enumerate(items):
            last = row + 1 == len(items) or pieces[row + 1][:2] != (k, pieces[row][2])
            following.append(-1 if last else row + 1)
            end.append(int((segments.times_s[row] <= windows[row][1]).sum()) - 1)
            if not last:  # the next segment has seen that frame
                seen[row, end[-1] :], turned[row, end[-1] :] = 0.0, 0.0
        starts = [first for _, first, _ in pieces]
        ahead = segments.state
        state = _moving(world, whole, items, starts, ahead)
        segments = replace(segments, seen=seen, turned=turned, state=state)
        like = world.gravity
        return Shooting(
            world,
            parameters,
            segments,
            torch.tensor(following),
            torch.tensor(end),
            torch.tensor([value for value in TIE for _ in range(3)] * len(segments.free))
            .to(like)
            .repeat(len(items), 1),
            noise,
            prior,
            ahead,
        )

    def fit(
        self, starts: Sequence[Tensor], iterations: int, best: int, done: Callable[[], object] = lambda: None
    ) -> list[Shot]:
        """Minimise from several parameters (P,) in fitted coordinates, and from both first guesses of the states.

        Where it starts decides in which valley it ends. The best few go on, with ties from what contact then gives.

        Args:
            starts: Where to start.
            iterations: Most steps in each descent.
            best: How many go on.
            done: Called after each descent.

        Returns:
            Where those descents ended that went on, the lowest cost first.
        """
        first = []
        for shared in starts:
            for states in (self.segments.state, self.ahead):
                tied = replace(self, tie=self._allowed(shared, states))
                first.append(tied._minimised(shared, states, iterations))
                done()
        shots = []
        for shot, states in sorted(first, key=lambda one: one[0].cost)[:best]:
            tied = replace(self, tie=self._allowed(shot.shared, states))
            shots.append(tied._minimised(shot.shared, states, iterations)[0])
            done()
        return sorted(shots, key=lambda shot: shot.cost)

    def _minimised(self, shared: Tensor, states: State, iterations: int) -> tuple[Shot, State]:
        linear = self._linearised(shared, states)
        costs, damping, converged = [linear.cost], 1e-3, not math.isfinite(linear.cost)
        for _ in range(iterations):
            if converged:
                break
            diagonal = linear.matrix.diagonal().clamp_min(1e-12)
            step = self._solved(linear, damping * diagonal, shared)
            moved = (shared + step[: len(shared)]).clamp(self.prior.bounds[:, 0], self.prior.bounds[:, 1])
            changed = retract(states, step[len(shared) :].view(len(self.following), -1), self.segments.free)
            cost = self._cost(moved, changed)
            if cost < linear.cost:
                fall = (linear.cost - cost) / max(linear.cost, 1e-300)
                shared, states, damping = moved, changed, max(damping / 5, 1e-8)
                linear = self._linearised(shared, states)
                costs.append(linear.cost)
                converged = fall < TOLERANCE
            else:
                damping *= 6
                converged = damping > 1e8
        return self._shot(linear, shared, states, costs, converged), states

    def _allowed(self, shared: Tensor, states: State) -> Tensor:
        """Return the standard deviations (B, S) of what may differ where segments meet."""
        with torch.no_grad():
            motion = self._motion(self._world(shared[None]), states, torch.zeros_like(self.tie), 1)
        item, columns = torch.arange(len(self.end)), []
        duration = self.segments.times_s[item, self.end] - self.segments.times_s[:, 0]
        for index in self.segments.free:
            fallen = self.world.gravity[0] * duration[:, None]
            change = motion.velocity_m_s[item, self.end, index] - states.velocity_m_s[:, index] - fallen
            missed = TIE_SHARE * change.norm(dim=1)
            body = self.world.bodies[index]
            gyration = (torch.diagonal(body.inertia[0]).mean() / body.mass[0]).sqrt()
            turned = missed / gyration
            parts = (missed * duration / 2, turned * duration / 2, missed, turned)
            columns += [torch.hypot(part, part.new_tensor(least)) for part, least in zip(parts, TIE, strict=True)]
        return torch.nan_to_num(torch.stack(columns, 1), nan=1.0).repeat_interleave(3, 1)

    def _shot(self, linear: _Linear, shared: Tensor, states: State, costs: list[float], converged: bool) -> Shot:
        covariance = torch.linalg.pinv(linear.matrix, hermitian=True)
        count = len(shared)
        names = self.segments.names
        first = [row for row, name in enumerate(names) if row == 0 or names[row - 1] != name]
        shot = Shot(
            shared,
            covariance[:count, :count],
            states.at(first),
            linear.cost,
            costs,
            linear.misfit,
            linear.chi2,
            converged,
        )
        return replace(shot, covariance=shot.scale * shot.covariance)

    def _solved(self, linear: _Linear, damping: Tensor, shared: Tensor) -> Tensor:
        """Return a damped step; a parameter that a bound stops takes no part."""
        count = len(shared)
        slope, free = linear.slope, torch.ones_like(linear.slope)
        free[:count] = (~bound_stops(shared, -slope[:count], self.prior.bounds)).to(slope)
        system = linear.matrix * free[:, None] * free + torch.diag(damping + (1 - free))
        return -torch.linalg.solve(system, slope * free)

    def _rows(self, shared: Tensor, states: State, changes: Tensor, repeats: int) -> Tensor:
        """Return for each item residuals (6 nf T) in sigmas, then how its end differs from the next start (S)."""
        seen, free = self.segments, list(self.segments.free)
        world, times = self._world(shared), seen.times_s.repeat(repeats, 1)
        motion = self._motion(world, states, changes, repeats)
        poses = as_measured(world, motion, times)
        shift = poses.position_m[:, :, free] - seen.position_m.repeat(repeats, 1, 1, 1)
        measured = quat_conjugate(seen.quat_wxyz.repeat(repeats, 1, 1, 1))
        turn = quat_log(quat_multiply(measured, poses.quat_wxyz[:, :, free]))
        weights = [mask / std for mask, std in zip((seen.seen, seen.turned), self.noise, strict=True)]
        rows = torch.cat(
            [v * w.repeat(repeats, 1, 1)[..., None] for v, w in zip((shift, turn), weights, strict=True)], -1
        )
        return torch.cat([rows.flatten(1), self._gap(motion, states, repeats)], 1)

    def _world(self, shared: Tensor) -> World:
        """Return the world with parameters (K, P)."""
        values = [p.decode(shared[:, k]) for k, p in enumerate(self.parameters)]
        return apply_parameters(self.world, self.parameters, torch.stack(values, -1)) if values else self.world

    def _motion(self, world: World, states: State, changes: Tensor, repeats: int) -> Rollout:
        """Return the true motion of the segments in a world (K B) from changed states (K B, S)."""
        seen, base = self.segments, states.repeat(repeats)
        times = seen.times_s.repeat(repeats, 1)
        drives = {name: drive.repeat(repeats) for name, drive in seen.drives.items()}
        return rolled_out(world, retract(base, changes, list(seen.free)), true_times(world, times), drives)

    def _gap(self, motion: Rollout, states: State, repeats: int) -> Tensor:
        """Return how the end of each segment differs from the start of the next (K B, S)."""
        batch, free = len(self.following), list(self.segments.free)
        item = torch.arange(repeats * batch)
        end = self.end.repeat(repeats)
        following = self.following.clamp_min(0).repeat(repeats)
        parts = []
        for body in free:
            target = quat_conjugate(states.quat_wxyz[following, body])
            parts += [
                motion.position_m[item, end, body] - states.position_m[following, body],
                quat_log(quat_multiply(target, motion.quat_wxyz[item, end, body])),
                motion.velocity_m_s[item, end, body] - states.velocity_m_s[following, body],
                motion.omega_body_rad_s[item, end, body] - states.omega_body_rad_s[following, body],
            ]
        return torch.cat(parts, -1)

    def _split(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals of frames (B, T nf, 6) and of ties (B, S), in sigmas."""
        size = self.tie.shape[1]
        tied = (self.following >= 0).to(rows)[:, None]
        return rows[:, :-size].unflatten(1, (-1, 6)), rows[:, -size:] / self.tie * tied

    def _parts(self, frames: Tensor, ties: Tensor, shared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the cost, and the robust weights of frames (B, F) and ties (B,)."""
        loss, weight = robust_loss(frames.square().sum(-1), ROBUST_SCALE)
        tie_loss, tie_weight = robust_loss(ties.square().sum(-1), 2 * ROBUST_SCALE)
        pull = ((shared - self.prior.mean) / self.prior.std).square().sum()
        return loss.sum() + tie_loss.sum() + pull, weight, tie_weight

    def _cost(self, shared: Tensor, states: State) -> float:
        with torch.no_grad():
            nothing = torch.zeros_like(self.tie)
            rows = self._rows(shared.expand(len(nothing), -1), states, nothing, 1)
        cost = float(self._parts(*self._split(rows), shared)[0])
        return cost if math.isfinite(cost) else math.inf

    def _differences(self, shared: Tensor, states: State) -> tuple[Tensor, Tensor]:
        """Return rows (B, m) and their Jacobian (B, m, P + S) by central differences over `STEPS`.

        Not exact derivatives: those of a body that rests on many spheres grow by a third in every step of 1 ms, while
        differences over what the data can tell apart show how the motion answers.
        """
        batch, size = self.tie.shape
        count = len(shared)
        steps = torch.tensor(
            [*[PARAMETER_STEP * float(std) for std in self.prior.std]]
            + [s for s in STATE_STEPS for _ in range(3)] * (size // (3 * len(STATE_STEPS)))
        ).to(shared)
        moves = torch.cat([torch.zeros(1, count + size).to(shared), torch.diag(steps), -torch.diag(steps)])
        values = torch.cat([shared, torch.zeros(size).to(shared)]) + moves.repeat_interleave(batch, 0)
        parts = []
        chunk = max(1, rollouts_at_once(self.world) // batch)
        with torch.no_grad():
            for first in range(0, len(moves), chunk):
                some = values[first * batch : (first + chunk) * batch]
                parts.append(self._rows(some[:, :count], states, some[:, count:], len(some) // batch))
        every = torch.cat(parts).unflatten(0, (len(moves), batch))
        half = len(steps)
        slopes = (every[1 : half + 1] - every[half + 1 :]) / (2 * steps[:, None, None])
        return every[0], torch.nan_to_num(slopes, posinf=0.0, neginf=0.0).movedim(0, -1)

    def _linearised(self, shared: Tensor, states: State) -> _Linear:
        batch, size, count = *self.tie.shape, len(shared)
        rows, jacobian = self._differences(shared, states)
        frames, ties = self._split(rows)
        cost, weight, tie_weight = self._parts(frames, ties, shared)
        total = count + batch * size
        matrix, slope = torch.zeros(total, total).to(shared), torch.zeros(total).to(shared)
        own = state_prior(len(self.segments.free)).to(shared) * 1e-3
        for row in range(batch):
            here = torch.cat([torch.arange(count), torch.arange(size) + count + row * size])
            local = jacobian[row, :-size].unflatten(0, (-1, 6))
            weighted = (weight[row, :, None, None] * local).flatten(0, 1)
            flat = local.flatten(0, 1)
            matrix[here[:, None], here] += weighted.T @ flat
            slope[here] += weighted.T @ frames[row].flatten()
            matrix[here[count:], here[count:]] += own
            after = int(self.following[row])
            if after >= 0:
                there = torch.cat([here, torch.arange(size) + count + after * size])
                leading = torch.cat([jacobian[row, -size:], -torch.eye(size).to(shared)], 1) / self.tie[row][:, None]
                matrix[there[:, None], there] += tie_weight[row] * leading.T @ leading
                slope[there] += tie_weight[row] * leading.T @ ties[row]
        index = torch.arange(count)
        matrix[index, index] += 1 / self.prior.std.square()
        slope[:count] += (shared - self.prior.mean) / self.prior.std.square()
        tied = self.following >= 0
        misfit = float((tie_weight[:, None] * ties.square())[tied].mean()) if bool(tied.any()) else 0.0
        chi2 = frames.square().sum(-1)
        chi2 = chi2[chi2 > 0]
        middle = float(chi2.median()) / 5.35 if len(chi2) else 0.0  # 5.35: median of chi-square, 6 degrees
        return _Linear(matrix, slope, float(cost) if bool(cost.isfinite()) else math.inf, misfit, middle)


@dataclass(frozen=True)
class _Linear:
    """Normal equations of half the cost, and the cost; misfit and chi2 as in `Shot`."""

    matrix: Tensor
    slope: Tensor
    cost: float
    misfit: float
    chi2: float


def _cuts(times_s: Tensor) -> list[int]:
    """Return the frames at which segments begin, and the last frame."""
    places = [0]
    for frame in range(1, len(times_s)):
        if float(times_s[frame] - times_s[places[-1]]) >= SEGMENT_S:
            places.append(frame)
    if len(places) > 2 and places[-1] != len(times_s) - 1:
        places.pop()  # the last segment takes up what is too short for one
    return [*places, len(times_s) - 1] if places[-1] != len(times_s) - 1 else places


def _telling(
    world: World, whole: Observations, pieces: Sequence[tuple[int, int, int]], noise: tuple[float, float]
) -> list[bool]:
    """Return which pieces (episode, first and last frame) tell of contact: in it, or beside it, and not at rest."""
    flying = clearance(world, whole) > FLIGHT_MARGIN_M
    moved = whole.position_m.new_zeros(len(pieces))
    for row, (k, a, b) in enumerate(pieces):
        shift = (whole.position_m[k, b] - whole.position_m[k, a]).abs().amax() / noise[0]
        turn = quat_log(quat_multiply(quat_conjugate(whole.quat_wxyz[k, a]), whole.quat_wxyz[k, b]))
        moved[row] = torch.maximum(shift, turn.abs().amax() / noise[1])
    touches = [not bool(flying[k, a : b + 1].all()) for k, a, b in pieces]
    tells = [touch and bool(way > RESTING_SIGMAS) for touch, way in zip(touches, moved, strict=True)]
    beside = [False, *tells, False]
    near = [any(beside[row : row + 3]) for row in range(len(pieces))]
    return near


def _moving(world: World, whole: Observations, items: list[int], starts: list[int], state: State) -> State:
    """Return first guesses of the states (B) at frames: velocities by differences that do not reach over an impact.

    In flight a difference to the frame before or after it gives the velocity half a frame away, which gravity has
    changed since; both count where both are flight. In contact the difference to the next frame is taken as it is.
    """
    flying = clearance(world, whole) > FLIGHT_MARGIN_M
    velocity, omega = state.velocity_m_s.clone(), state.omega_body_rad_s.clone()
    for row, (item, frame) in enumerate(zip(items, starts, strict=True)):
        others = [frame + k for k in (-1, 1) if 0 <= frame + k < int(whole.frames[item])]
        if bool(flying[item, frame]):
            others = [k for k in others if bool(flying[item, k])] or others[:1]
        else:
            others = [k for k in others if k > frame] or others
        for column, body in enumerate(whole.free):
            rates, turns = [], []
            for other in others:
                span = whole.times_s[item, other] - whole.times_s[item, frame]
                shift = whole.position_m[item, other, column] - whole.position_m[item, frame, column]
                here, there = whole.quat_wxyz[item, frame, column], whole.quat_wxyz[item, other, column]
                rates.append(shift / span - (0.5 * span * world.gravity[0] if bool(flying[item, frame]) else 0.0))
                turns.append(quat_log(quat_multiply(quat_conjugate(here), there)) / span)
            velocity[row, body], omega[row, body] = torch.stack(rates).mean(0), torch.stack(turns).mean(0)
    return replace(state, velocity_m_s=velocity, omega_body_rad_s=omega)
