"""Multiple shooting: parameters from motions that are cut into short segments, each with its own initial state.

A rollout over several impacts is a rough function of its initial state, and its derivatives are useless. Over a segment
of some hundredths of a second they lead to the minimum. The segments of an episode are tied: the final state of one and
the initial state of the next may differ by the expected error of the contact model, so that an impact that it cannot
reproduce does not bias the parameters (Bock & Plitt 1984; with soft ties, weak-constraint assimilation, Tremolet 2006).
The least-squares solver finds everything at once: the initial states of all segments and the parameters.

A pushed body lies at the pusher, whose path it then follows under any friction; one that is off it by the noise of its
track slides by itself and becomes slower by its friction. So descents of pushes begin at the motion that the world
predicts, too: those from measured states end with the body off the pusher, at a higher cost. And their information is
that at the predicted motion: of fitted states, which follow the noise, half are off the pusher.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ....datasets.capture.tracks import Episode
from ...geometry.rotation import quat_conjugate, quat_log, quat_multiply
from ...optimization.least_squares import Descent, Policy, descend
from ...optimization.levenberg_marquardt import robust_loss
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ...physics.chains.state import on_joints
from ...physics.engine import ragged_rollout, rollouts_at_once
from ...physics.engine import rollout as rolled_out
from ...physics.observation_model import as_measured, true_times
from ...physics.parameters import Parameter, apply_parameters
from ...physics.rollout import Rollout
from ...physics.state import State
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.residuals import retract, state_prior
from ...trajectories.track_noise import Noise
from .shooting_segments import SEGMENT_S, Chains, TiedSegments

TIE = (5e-5, 5e-4, 1e-3, 1e-2)
"""Standard deviation of a tie over flight: position [m], rotation [rad], velocity [m/s], angular velocity [rad/s]."""
CARRIED_SHARE = 0.01
"""Model error in contact, as a share of its change of velocity, and of the corresponding change of spin."""
MOVING_SHARE = 0.1
"""The same where contact does more than to carry the body: as a share of its change of velocity without what carries
the body against gravity, and of all of it where a driven body touches. MuJoCo, Drake, DART and Rapier differ from this
engine, with the true shape and numbers, by 2 to 10 % of all of it per interval of 33 ms where a body slides, by 5 to 20
% in impacts and by 5 to 30 % under a fingertip (medians), and by less than 0.3 % at rest."""
ROBUST_SCALE = 4.0
"""Scale of the robust loss of a frame, in standard deviations; the scale of a tie is twice as large."""
STATE_STEPS = (2e-4, 2e-3, 1e-2, 1e-1)
"""Steps of the differences for the Jacobian: position [m], rotation [rad], velocity [m/s], angular velocity
[rad/s]."""
PARAMETER_STEP = 0.1
"""Step of the differences by a parameter, in standard deviations of its prior."""
TOLERANCE = 1e-4
"""Relative decrease of the cost in a step below which a descent has converged."""


@dataclass(frozen=True)
class ShootingPrior:
    """Normal prior of the parameters in fitted coordinates, with bounds."""

    mean: Tensor
    """Mean, shape (P,)."""
    std: Tensor
    """Standard deviation, shape (P,)."""
    bounds: Tensor
    """Lower and upper bound, shape (P, 2)."""

    @staticmethod
    def of(parameters: Sequence[Parameter]) -> ShootingPrior:
        """Return the priors of parameters (P)."""
        return ShootingPrior(
            torch.tensor([p.encode(p.prior[0]) for p in parameters], dtype=torch.float64),
            torch.tensor([p.prior[1] for p in parameters], dtype=torch.float64),
            torch.tensor([p.limits for p in parameters], dtype=torch.float64),
        )


@dataclass(frozen=True, kw_only=True)
class ShootingFit:
    """End of a descent."""

    shared: Tensor
    """Parameters in fitted coordinates, shape (P,)."""
    covariance: Tensor
    """Covariance of the parameters from the curvature, multiplied by `scale`, shape (P, P)."""
    state: State
    """State at the first frame of each episode (E)."""
    cost: float
    """Final cost."""
    costs: list[float]
    """Cost at the start and after each accepted step."""
    misfit: float
    """Mean square of the tied residuals, in standard deviations of the ties."""
    chi2: float
    """Median chi-square of a frame, relative to its expectation."""
    converged: bool
    """Whether the descent ended before its last step."""

    @property
    def scale(self) -> float:
        """Factor of the variances in `covariance` over those of the curvature."""
        return max(1.0, self.misfit, self.chi2)


@dataclass(frozen=True, kw_only=True)
class Shooting:
    """The segments of episodes as one least-squares problem."""

    world: World
    """The world."""
    parameters: Sequence[Parameter]
    """Fitted parameters (P)."""
    segments: Observations
    """One item for each segment (B); the frame at which the next one begins counts as not seen."""
    following: Tensor
    """Segment that comes next in the same episode, -1 for the last, shape (B,)."""
    end: Tensor
    """Frame at which the next segment begins, or the last one, shape (B,)."""
    tie: Tensor
    """Standard deviation of the difference of states where segments meet, shape (B, S)."""
    noise: tuple[float | Tensor, float | Tensor]
    """Noise of the tracks (position [m], rotation [rad]), one value or one for each frame and body (B, T, nf)."""
    prior: ShootingPrior
    """Prior of the parameters."""
    ahead: State
    """Alternative first guess of the states, which moves to the next frame in a straight line."""
    driven: Tensor
    """Whether a driven body may touch in the segment, shape (B,)."""
    begins: Tensor
    """Episode of each segment, and its frame at which the segment begins, shape (B, 2)."""
    whole: Observations | None = None
    """Episodes (E) with the states at their first frames, where bodies are driven; None where none is."""
    expected: bool = False
    """Whether motions count as measured where the states lead: for the information that is expected there."""

    @staticmethod
    def of(
        world: World,
        parameters: Sequence[Parameter],
        episodes: Sequence[Episode],
        spans: Sequence[tuple[float, float]],
        noise: Noise,
        prior: ShootingPrior,
        contacts_only: bool = False,
        segment_s: float = SEGMENT_S,
        whole: Observations | None = None,
    ) -> Shooting:
        """Cut the span [s] of each episode into segments of at least `segment_s`; infinite, it is one.

        With `contacts_only`, segments without information on contact are left out: in flight or at rest, and not next
        to a segment with such information. The first segments stay, because episodes begin with their states. Where
        bodies are driven, the motion is predicted from the first states of the `whole` episodes.
        """
        tied = TiedSegments.of(world, episodes, spans, noise, contacts_only, segment_s)
        like = world.gravity
        return Shooting(
            world=world,
            parameters=parameters,
            segments=tied.segments,
            following=tied.following,
            end=tied.end,
            tie=torch.tensor([value for value in TIE for _ in range(3)] * len(tied.segments.free))
            .to(like)
            .repeat(len(tied.following), 1),
            noise=noise,
            prior=prior,
            ahead=tied.ahead,
            driven=tied.driven,
            begins=tied.begins,
            whole=whole if whole is not None and whole.drives else None,
        )

    def fit(
        self,
        starts: Sequence[Tensor],
        iterations: int,
        best: int,
        continued: int | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> list[ShootingFit]:
        """Minimise the cost from several starts of the parameters and from both first guesses of the states.

        The start decides which minimum is reached. The best few descents are continued, with ties for the contact that
        they found.

        Args:
            starts: Starts of the parameters in fitted coordinates, each of shape (P,).
            iterations: Maximum number of steps in each descent.
            best: Number of descents that are continued.
            continued: Maximum number of steps in each continued descent; `iterations` by default.
            done: Called after each descent.

        Returns:
            Ends of the continued descents, the lowest cost first.
        """
        first = []
        for shared in starts:
            for states in (self.segments.state, self._second_guess(shared)):
                tied = replace(self, tie=self._allowed(shared, states))
                first.append(tied._minimised(shared, states, iterations))
                done()
        shots = []
        for shot, states in sorted(first, key=lambda one: one[0].cost)[:best]:
            tied = replace(self, tie=self._allowed(shot.shared, states))
            shots.append(tied._minimised(shot.shared, states, continued or iterations)[0])
            done()
        return sorted(shots, key=lambda shot: shot.cost)

    def descended(self, shared: Tensor, iterations: int) -> ShootingFit:
        """Minimise the cost of segments without ties from a start of the parameters (P,)."""
        return self._minimised(shared, self.segments.state, iterations)[0]

    def _minimised(self, shared: Tensor, states: State, iterations: int) -> tuple[ShootingFit, State]:
        problem = _TiedProblem(self)
        start = Point(values=shared[None], states=problem.by_chain(states))
        end = descend(problem, start, Policy(iterations=iterations, relative=TOLERANCE))
        states = problem.by_segment(end.point.states)
        return self._shot(end, end.point.values[0], states), states

    def _second_guess(self, shared: Tensor) -> State:
        return self.ahead if self.whole is None else self._predicted(shared, self.whole, self.whole.state)

    def _predicted(self, shared: Tensor, whole: Observations, first: State) -> State:
        """Return the states (B) of segments in the motion that the world predicts from the first states (E)."""
        world = self._world(shared[None])
        with torch.no_grad():
            motion = rolled_out(world, on_joints(world, first), true_times(world, whole.times_s), whole.drives)
        moved = (motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s)
        return State(*(value[self.begins[:, 0], self.begins[:, 1]] for value in moved))

    def _information(self, end: Descent, shared: Tensor, first: State) -> Tensor:
        """Return the information (P, P) on parameters: at the end of a descent, or expected at the predicted motion."""
        if self.whole is None:
            return end.information()[0]
        states = self._predicted(shared, self.whole, first)
        problem = _TiedProblem(replace(self, tie=self._allowed(shared, states), expected=True))
        start = Point(values=shared[None], states=problem.by_chain(states))
        return descend(problem, start, Policy(iterations=0)).information()[0]

    def _allowed(self, shared: Tensor, states: State) -> Tensor:
        """Return the standard deviations (B, S) of the difference of states where segments meet."""
        with torch.no_grad():
            motion = self._motion(shared.expand(len(self.end), -1), states, torch.zeros_like(self.tie), 1)
        item, columns = torch.arange(len(self.end)), []
        duration = self.segments.times_s[item, self.end] - self.segments.times_s[:, 0]
        for index in self.segments.free:
            fallen = self.world.gravity[0] * duration[:, None]
            change = motion.velocity_m_s[item, self.end, index] - states.velocity_m_s[:, index] - fallen
            missed = expected_error(change, fallen, self.driven)
            body = self.world.bodies[index]
            gyration = (torch.diagonal(body.inertia[0]).mean() / body.mass[0]).sqrt()
            turned = missed / gyration
            parts = (missed * duration / 2, turned * duration / 2, missed, turned)
            columns += [torch.hypot(part, part.new_tensor(least)) for part, least in zip(parts, TIE, strict=True)]
        return torch.nan_to_num(torch.stack(columns, 1), nan=1.0).repeat_interleave(3, 1)

    def _shot(self, end: Descent, shared: Tensor, states: State) -> ShootingFit:
        names = self.segments.names
        first = [row for row, name in enumerate(names) if row == 0 or names[row - 1] != name]
        misfit, chi2 = self._misfits(shared, states)
        shot = ShootingFit(
            shared=shared,
            covariance=torch.linalg.pinv(self._information(end, shared, states.at(first)), hermitian=True),
            state=states.at(first),
            cost=float(end.cost[0]) if bool(end.cost[0].isfinite()) else math.inf,
            costs=end.costs,
            misfit=misfit,
            chi2=chi2,
            converged=end.converged,
        )
        return replace(shot, covariance=shot.scale * shot.covariance)

    def _misfits(self, shared: Tensor, states: State) -> tuple[float, float]:
        """Return the mean square of the tied residuals and the median chi-square of a frame, as in `ShootingFit`."""
        frames, ties = self._residuals(shared, states)
        _, _, tie_weight = _losses(frames, ties)
        tied = self.following >= 0
        misfit = float((tie_weight[:, None] * ties.square())[tied].mean()) if bool(tied.any()) else 0.0
        chi2 = frames.square().sum(-1)
        chi2 = chi2[chi2 > 0]
        return misfit, float(chi2.median()) / 5.35 if len(chi2) else 0.0  # median of chi-square, 6 degrees

    def _residuals(self, shared: Tensor, states: State) -> tuple[Tensor, Tensor]:
        """Return residuals of frames (B, T nf, 6) and of ties (B, S), in sigmas."""
        with torch.no_grad():
            nothing = torch.zeros_like(self.tie)
            return self._split(self._rows(shared.expand(len(nothing), -1), states, nothing, 1))

    def _rows(self, shared: Tensor, states: State, changes: Tensor, repeats: int) -> Tensor:
        """Return for each item residuals (6 nf T) in sigmas, then how its end differs from the next start (S)."""
        seen, free = self.segments, list(self.segments.free)
        world, times = self._world(shared), seen.times_s.repeat(repeats, 1)
        motion = self._motion(shared, states, changes, repeats)
        poses = as_measured(world, motion, times)
        shift = poses.position_m[:, :, free] - seen.position_m.repeat(repeats, 1, 1, 1)
        measured = quat_conjugate(seen.quat_wxyz.repeat(repeats, 1, 1, 1))
        turn = quat_log(quat_multiply(measured, poses.quat_wxyz[:, :, free]))
        weights = [mask / std for mask, std in zip((seen.seen, seen.has_orientation), self.noise, strict=True)]
        rows = torch.cat(
            [v * w.repeat(repeats, 1, 1)[..., None] for v, w in zip((shift, turn), weights, strict=True)], -1
        )
        return torch.cat([rows.flatten(1), self._gap(motion, states, repeats)], 1)

    def _world(self, shared: Tensor) -> World:
        """Return the world with parameters (K, P)."""
        values = [p.decode(shared[:, k]) for k, p in enumerate(self.parameters)]
        return apply_parameters(self.world, self.parameters, torch.stack(values, -1)) if values else self.world

    def _motion(self, shared: Tensor, states: State, changes: Tensor, repeats: int) -> Rollout:
        """Return the true motion of the segments by parameters (K B, P) from changed states (K B, S)."""
        seen = self.segments
        world = self._world(shared)
        every = on_joints(world, retract(states.repeat(repeats), changes, list(seen.free)))
        times = seen.times_s.repeat(repeats, 1)
        number = torch.arange(len(times)).view(repeats, -1)

        def roll(items: list[int], frames: int) -> Rollout:
            rows = number[:, items].flatten()
            some_world, some = self._world(shared[rows]), seen.select(items)
            drives = {name: drive.repeat(repeats) for name, drive in some.drives.items()}
            return rolled_out(some_world, every.at(rows), true_times(some_world, times[rows, :frames]), drives)

        return ragged_rollout(times, (self.end + 1).tolist(), repeats, roll)

    def _gap(self, motion: Rollout, states: State, repeats: int) -> Tensor:
        """Return the difference of the end of each segment from the start of the next (K B, S)."""
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
        rows = torch.zeros_like(rows) if self.expected else rows
        return rows[:, :-size].unflatten(1, (-1, 6)), rows[:, -size:] / self.tie * tied

    def _differences(self, shared: Tensor, states: State) -> tuple[Tensor, Tensor]:
        """Return rows (B, m) and their Jacobian (B, m, P + S) by central differences over `STEPS`.

        Exact derivatives are unsuitable: for a body that rests on many spheres they grow by a third in every step of
        1 ms, while differences over distances that the data resolve give the response of the motion.
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

    def normal_equations(self, shared: Tensor, states: State, chains: Chains) -> NormalEquations:
        """Return the normal equations of chains by parameters and the states of their segments."""
        size = self.tie.shape[1]
        rows, jacobian = self._differences(shared, states)
        frames, ties = self._split(rows)
        cost, weight, tie_weight = _losses(frames, ties)
        local = jacobian[:, :-size]
        weighted = (weight[..., None, None] * local.unflatten(1, (-1, 6))).flatten(1, 2).mT
        next_state = -torch.eye(size).to(shared).expand(len(jacobian), -1, -1)
        leading = torch.cat([jacobian[:, -size:], next_state], -1) / self.tie[..., None]
        pulled = (tie_weight * (self.following >= 0))[:, None, None] * leading.mT
        return chains.normal_equations(
            (weighted @ local, (weighted @ rows[:, :-size, None])[..., 0]),
            (pulled @ leading, (pulled @ ties[..., None])[..., 0]),
            state_prior(len(self.segments.free)).to(shared) * 1e-3,
            cost,
        )


def expected_error(change: Tensor, fallen: Tensor, driven: Tensor) -> Tensor:
    """Return the expected error of the contact model in segments (B,) [m/s].

    Args:
        change: Change of velocity by contact (B, 3) [m/s].
        fallen: That by gravity (B, 3) [m/s], which contact takes back from a body that lies still.
        driven: Whether a driven body may touch, shape (B,).
    """
    weight = fallen.square().sum(1, keepdim=True).clamp_min(1e-12)
    carried = -fallen * (-(change * fallen).sum(1, keepdim=True) / weight).clamp(0.0, 1.0)
    moving = torch.where(driven[:, None], change, change - carried)
    return CARRIED_SHARE * change.norm(dim=1) + MOVING_SHARE * moving.norm(dim=1)


class _TiedProblem(Problem):
    """The parameters of a problem as one group, and chains of tied segments, whose states are eliminated."""

    def __init__(self, shooting: Shooting) -> None:
        prior = shooting.prior
        self.shooting, self.chains = shooting, Chains.of(shooting.following)
        self.owner = torch.zeros(len(self.chains.segment), dtype=torch.long)
        self.box = Box.within(prior.bounds, prior.mean, 1 / prior.std.square())

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the robust cost of each row of chains (C,)."""
        del rows
        found = self.shooting._residuals(point.values[0], self.by_segment(point.states))
        return self.chains.summed(_losses(*found)[0])

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations."""
        del rows
        return self.shooting.normal_equations(point.values[0], self.by_segment(point.states), self.chains)

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the states of the chains moved by steps (C, M S)."""
        del values, rows
        change = self.chains.by_segment(step.unflatten(1, (self.chains.segment.shape[1], -1)))
        return self.by_chain(retract(self.by_segment(point.states), change, self.shooting.segments.free))

    def by_chain(self, states: State) -> tuple[Tensor, ...]:
        """Return the states (B) of segments as those of chains."""
        return tuple(self.chains.by_chain(value) for value in states.tensors)

    def by_segment(self, states: tuple[Tensor, ...]) -> State:
        """Return the states of chains as those of segments (B)."""
        return State(*(self.chains.by_segment(value) for value in states))


def _losses(frames: Tensor, ties: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return costs (B,) of residuals of frames (B, F, 6) and ties (B, S), and robust weights (B, F) and (B,)."""
    loss, weight = robust_loss(frames.square().sum(-1), ROBUST_SCALE)
    tie_loss, tie_weight = robust_loss(ties.square().sum(-1), 2 * ROBUST_SCALE)
    return loss.sum(-1) + tie_loss, weight, tie_weight
