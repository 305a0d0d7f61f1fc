"""Contact parameters from the measured forces of driven bodies, after the motion has told what it can.

In slow pushing friction leaves the track unchanged: the pushed body goes where the pusher goes, and only the force that
this takes depends on the friction. The estimate from the motion, with its covariance, is the prior here; the residuals
are those of `force_residuals`. The solver combines the two (for independent errors: the product of two normal
densities).

The force also depends on where the pusher touches, and so on the start of each episode, which its first frames tell to
their noise alone: the starts are estimated with the parameters, with what the first frames say of them as their prior,
and eliminated from the information.

The forces of short intervals have minima far from the truth, where contact sets in or ends at another time than was
measured. So the descent begins with mean forces on long intervals: what contact exchanges there follows from the change
of momentum, whatever its law. From their minimum the short intervals go on. Where the two differ by more than chance
(Hausman, 1978), contact does not follow its law: the estimate is that of the long intervals, and its interval holds
both. Where no parameters make the short intervals follow the model to within their noise, they do not count at all.

Losses in joints are known to decades before. Descents begin at what the forces ask for (`loss_start.py`), too, and
where they end in two minima that are both probable, the interval holds both. Where forces leave a loss open, what it
may take from the others widens their intervals.

The estimate of a search of many episodes counts with the spread of all samples that predict the motion about as well,
as a density that holds over its whole width: the inverse of the scatter between episodes can claim that combinations of
parameters are known a thousand times better, where the motion hardly depends on them.

Forces that the model does not explain to within their noise count less: the information is divided by the misfit and,
because errors of the model last, by the number of successive residuals that go together, (1 + r) / (1 - r) for the
correlation r of neighbours (of a first-order autoregression; Bayley and Hammersley, 1946). With many episodes their
scatter counts, too: a standard error is at least that by the scores of whole episodes (the sandwich; White, 1982), so
that a friction that differs from push to push widens the interval. Forces of which the model explains less than half
are not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.least_squares import Policy, descend
from ...optimization.levenberg_marquardt import robust_loss
from ...optimization.problem import Box, Eliminated, NormalEquations, Point, Problem, Rows
from ...physics.world import World
from ...trajectories.observations import Observations
from .contact_result import ContactEstimate
from .force_residuals import ForceResiduals
from .loss_start import OPEN, loss_start
from .measured_forces import MeasuredForce

ROBUST_SCALE = 4.0
"""Scale of the robust loss of a force, in standard deviations."""
POLICY = Policy(
    iterations=15,
    damping=1.0,
    down=1.0,
    up=1e3,
    least_damping=1e-3,
    most_damping=1e4,
    factors=(1e-6, 0.1, 1.0, 10.0, 100.0),
    absolute=0.02,
    linearise_end=False,
)
"""A descent ends where the cost falls by less than 0.02, in units of chi-square; trials of a step are one batch."""
ROUNDS, SAME_MISFIT = 15, 0.01
"""Maximum number of descents, each with the misfit where the one before ended, and the relative change of the misfit
below which they end."""
MOST_CORRELATION = 0.98
"""Largest correlation of neighbouring residuals that is believed."""
MEDIAN_CHI2 = 2.366
"""Median of chi-square with 3 degrees of freedom."""
MANY_EPISODES = 8
"""Number of episodes from which on their scatter counts."""
END = 1.96
"""End of an interval, in standard errors."""
LEAST_POSTERIOR = 1e-3
"""Least share of the posterior, relative to that of the best minimum, with which another one widens intervals."""
MOST_UNEXPLAINED = 0.5
"""Largest typical difference of the model's forces from the measured ones, relative to these, with which they are
used."""
MOST_MISFIT = 2.0
"""Largest median chi-square of short intervals, relative to its expectation from the noise, with which they count."""
APART, LEAST_APART = 3.84, 0.1
"""Squared difference of the estimates by long and by short intervals that is chance, in units of its variance: 95 % of
a chi-square; and the least such variance, as a share of that by long intervals."""


def with_forces(
    world: World,
    estimate: ContactEstimate,
    forces: Sequence[MeasuredForce],
    observations: Observations,
    start_cov: Tensor,
) -> tuple[ContactEstimate, dict[str, Any]]:
    """Return the contact parameters with what measured forces say in addition, and the record of the descent.

    Args:
        world: The world.
        estimate: Contact parameters from the motion.
        forces: The measured forces.
        observations: The episodes (E), with the states at their first frames.
        start_cov: Covariance (E, 12 nf, 12 nf) of these states.
    """
    wide = estimate if estimate.spread is None else replace(estimate, covariance=estimate.spread)
    averaged = [force.slow() for force in forces]
    long = ForceResiduals(world, estimate.parameters, averaged, observations, start_cov)
    short = ForceResiduals(world, estimate.parameters, forces, observations, start_cov)
    first = _ForceProblem(long, wide).start()
    losses = loss_start(long, wide, ROBUST_SCALE)
    starts = [first] if losses is None else [first, replace(first, values=torch.as_tensor(losses)[None])]
    slow = _told(long, wide, starts)
    fast = _told(short, wide, slow.points)
    excess = _excess(slow, fast)
    record = {
        "episodes": len({force.episode.name for force in forces}),
        "intervals": sum(len(force.force_n) for force in forces),
        "std_n": float(np.median([force.std_n for force in forces])),
        "misfit": fast.misfit,
        "information_over": fast.problem.scale * fast.problem.repeats,
        "converged": fast.converged,
        "long_intervals": {
            "intervals": sum(len(force.force_n) for force in averaged),
            "misfit": slow.misfit,
            "information_over": slow.problem.scale * slow.problem.repeats,
            "converged": slow.converged,
        },
        "unexplained": slow.unexplained,
        "used": slow.unexplained <= MOST_UNEXPLAINED,
        "described": fast.misfit <= max(MOST_MISFIT, slow.misfit),
        "apart": [p.name for p, beyond in zip(estimate.parameters, excess, strict=True) if beyond > 0],
    }
    if not record["used"]:
        return estimate, record
    described = record["described"] and not excess.any()
    used, more = (fast, np.zeros_like(excess)) if described else (slow, excess)
    covariance = used.covariance + np.diag(more + _bent(used))
    return replace(estimate, values=used.values, covariance=covariance, spread=None), record


@dataclass(frozen=True, kw_only=True)
class _Told:
    """What forces on intervals of one length say."""

    points: Sequence[Point]
    """The minima that count, the best one first."""
    covariance: NDArray[np.float64]
    """Covariance of the parameters, shape (P, P)."""
    problem: _ForceProblem
    """The problem, with the scale and the repeats of that minimum."""
    misfit: float
    """Median chi-square of an interval, relative to its expectation."""
    unexplained: float
    """Typical difference of the model's forces from the measured ones, relative to these."""
    converged: bool
    """Whether the minimum was found."""

    @property
    def values(self) -> NDArray[np.float64]:
        """Estimate, shape (P,)."""
        return self.points[0].values[0].numpy()


def _told(residuals: ForceResiduals, estimate: ContactEstimate, starts: Sequence[Point]) -> _Told:
    """Return what forces say beside an estimate, from descents from several starts."""
    alone = _ForceProblem(residuals, estimate)
    ends = [_descended(alone, start) for start in starts]
    alone = alone.scaled(min(problem.scale for problem, _, _ in ends))
    ends = sorted(ends, key=lambda end: alone.cost(end[1]))
    problem, point, converged = ends[0]
    at_end = problem.residuals_at(point)
    misfit = _misfit(at_end)
    problem = problem.scaled(max(1.0, misfit), residuals.repeats(at_end, MOST_CORRELATION))
    modes = _modes(problem, [end[1] for end in ends])
    return _Told(
        points=[point for point, _, _ in modes],
        covariance=_mixed(modes),
        problem=problem,
        misfit=misfit,
        unexplained=residuals.unexplained(at_end),
        converged=converged,
    )


_Mode = tuple[Point, NDArray[np.float64], float]
"""A minimum, the covariance (P, P) of its parameters, and its share of the posterior, relative to the first one's."""


def _modes(problem: _ForceProblem, points: Sequence[Point]) -> list[_Mode]:
    """Return those of the minima that differ, and whose share of the posterior counts; the first one in any case."""
    found: list[_Mode] = []
    for point in points:
        if any(_same(point, other, covariance) for other, covariance, _ in found):
            continue
        covariance = _covariance(problem.linearised(point, Rows.of(problem.owner, 1)).eliminated())
        share = 1.0
        if found:
            wider = 0.5 * (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(found[0][1])[1])
            share = float(np.exp(min(wider - 0.5 * (problem.cost(point) - problem.cost(found[0][0])), 0.0)))
        if share > LEAST_POSTERIOR:
            found.append((point, covariance, share))
    return found


def _same(one: Point, other: Point, covariance: NDArray[np.float64]) -> bool:
    """Return whether two minima have the same parameters to within half a standard error."""
    apart = (one.values - other.values)[0].numpy()
    return bool((np.abs(apart) <= 0.5 * np.sqrt(np.diag(covariance))).all())


def _mixed(modes: Sequence[_Mode]) -> NDArray[np.float64]:
    """Return the covariance (P, P) about the first of several minima: of all of them, by their shares."""
    total, middle = sum(share for _, _, share in modes), modes[0][0].values[0].numpy()
    parts = []
    for point, covariance, share in modes:
        off = point.values[0].numpy() - middle
        parts.append(share / total * (covariance + np.outer(off, off)))
    return np.sum(parts, 0)


def _bent(told: _Told) -> NDArray[np.float64]:
    """Return variances (P,) by which others follow a parameter that stays open, beyond what the covariance says.

    A small loss in a joint hardly changes the force; ten times as much takes the place of another one. So the
    parameter is held at both ends of its interval, and the others descend.
    """
    problem, start = told.problem, told.points[0]
    std, more = np.sqrt(np.diag(told.covariance)), np.zeros(len(told.covariance))
    for k in np.flatnonzero(std > OPEN):
        for side in (-END, END):
            moved = start.values.clone()
            moved[:, k] = problem.box.clamped(moved + side * std[k])[:, k]
            held = problem.held(int(k), float(moved[0, k]))
            end = descend(held, replace(start, values=moved), POLICY).point
            off = (end.values - start.values)[0].numpy() / END
            beyond = np.square(off) - np.square(told.covariance[k]) / told.covariance[k, k]
            beyond[k] = 0.0
            more = np.maximum(more, beyond)
    return more


def _excess(slow: _Told, fast: _Told) -> NDArray[np.float64]:
    """Return the squared difference (P,) of two estimates beyond chance, of which the second knows more."""
    before, after = np.diag(slow.covariance), np.diag(fast.covariance)
    expected = np.maximum(before - after, LEAST_APART * before)
    return np.maximum(np.square(fast.values - slow.values) - APART * expected, 0.0)


class _ForceProblem(Problem):
    """Contact parameters (P) of one group; its items are the episodes (E), each with a start (S), and the motion.

    Args:
        residuals: Residuals of the forces.
        estimate: Contact parameters from the motion.
        scale: Factor of the variances of the forces.
        repeats: Number of successive residuals that go together.
    """

    def __init__(
        self, residuals: ForceResiduals, estimate: ContactEstimate, scale: float = 1.0, repeats: float = 1.0
    ) -> None:
        self.residuals, self.estimate, self.scale, self.repeats = residuals, estimate, scale, repeats
        self.episodes = len(residuals.forces)
        self.owner = torch.zeros(self.episodes + 1, dtype=torch.long)
        self.centre = torch.as_tensor(estimate.values)
        self.prior = torch.linalg.pinv(torch.as_tensor(estimate.covariance), hermitian=True)
        self.box = Box.within(torch.tensor([p.limits for p in estimate.parameters]).to(self.centre))

    def scaled(self, scale: float, repeats: float = 1.0) -> _ForceProblem:
        """Return the problem with another scale and number of residuals that go together."""
        return _ForceProblem(self.residuals, self.estimate, scale, repeats)

    def held(self, parameter: int, value: float) -> _ForceProblem:
        """Return the problem with one parameter held at a value."""
        problem = self.scaled(self.scale, self.repeats)
        low, high = problem.box.low.clone(), problem.box.high.clone()
        low[:, parameter] = high[:, parameter] = value
        problem.box = replace(problem.box, low=low, high=high)
        return problem

    def cost(self, point: Point) -> float:
        """Return the cost of a point."""
        return float(self.costs(point, Rows.of(self.owner, 1)).sum())

    def start(self) -> Point:
        """Return the estimate of the motion, with the starts of the first frames."""
        return Point(values=self.centre[None], states=(self.centre.new_zeros(len(self.owner), self._size),))

    def residuals_at(self, point: Point) -> list[Tensor]:
        """Return the residuals (N, 3) of each episode at a point."""
        starts = point.states[0][:, None]
        return [self.residuals.of(k, point.values, starts[k])[0] for k in range(self.episodes)]

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the cost (b,) of each item."""
        costs = self._motion_cost(point.values)[rows.owner]
        for item in range(self.episodes):
            mine = rows.items == item
            starts = point.states[0][mine]
            found = self.residuals.of(item, point.values[rows.owner[mine]], starts)
            costs[mine] = self._cost(found, starts)
        return costs

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations of the items."""
        pairs = zip(rows.items.tolist(), point.values[rows.owner], point.states[0], strict=True)
        return NormalEquations.joined([self._item(item, values, start) for item, values, start in pairs])

    @property
    def _size(self) -> int:
        return self.residuals.start_size

    def _motion_cost(self, values: Tensor) -> Tensor:
        """Return the cost (K,) of parameters (K, P) by the motion."""
        off = values - self.centre
        return ((off @ self.prior) * off).sum(-1)

    def _cost(self, residuals: Tensor, starts: Tensor) -> Tensor:
        """Return the cost (K,) of residuals (K, N, 3) and starts (K, S)."""
        loss = robust_loss(residuals.square().sum(-1) / self.scale, ROBUST_SCALE)[0]
        return loss.sum(-1) / self.repeats + starts.square().sum(-1)

    def _item(self, item: int, values: Tensor, start: Tensor) -> NormalEquations:
        """Return the normal equations of one item at parameters (P,) and a start (S,)."""
        if item == self.episodes:
            return self._motion(values)
        found, slopes = self.residuals.derivatives(item, values, start)
        weight = robust_loss(found.square().sum(-1) / self.scale, ROBUST_SCALE)[1] / (self.scale * self.repeats)
        prior = torch.nn.functional.pad(torch.eye(self._size).to(start), (len(values), 0))
        return NormalEquations.of_rows(
            torch.cat((found.flatten(), start))[None],
            torch.cat((slopes.flatten(0, 1), prior))[None],
            len(values),
            self._cost(found[None], start[None]),
            torch.cat((weight.repeat_interleave(3), torch.ones_like(start)))[None],
        )

    def _motion(self, values: Tensor) -> NormalEquations:
        """Return the normal equations of the motion, whose state is not used."""
        return NormalEquations(
            states=torch.eye(self._size).to(values)[None],
            mixed=values.new_zeros(1, self._size, len(values)),
            information=self.prior[None],
            state_slope=values.new_zeros(1, self._size),
            slope=(self.prior @ (self.centre - values))[None],
            cost=self._motion_cost(values[None]),
        )


def _descended(problem: _ForceProblem, point: Point) -> tuple[_ForceProblem, Point, bool]:
    """Return the problem at the misfit of its minimum, the minimum from a start, and whether it was found."""
    problem = problem.scaled(max(1.0, _misfit(problem.residuals_at(point))))
    for _ in range(ROUNDS):
        descent = descend(problem, point, POLICY)
        point, before = descent.point, problem.scale
        problem = problem.scaled(max(1.0, _misfit(problem.residuals_at(point))))
        if abs(problem.scale - before) <= SAME_MISFIT * before:
            return problem, point, descent.converged
    return problem, point, False


def _misfit(residuals: Sequence[Tensor]) -> float:
    """Return the median chi-square of an interval over its expectation, for residuals (N, 3) of each episode."""
    return float(torch.cat([each.square().sum(-1) for each in residuals]).quantile(0.5)) / MEDIAN_CHI2


def _covariance(by_item: Eliminated) -> NDArray[np.float64]:
    """Return the covariance (P, P) of the parameters, that of many episodes at least as wide as their scatter.

    Args:
        by_item: Information and gradient of each episode and, last, of the motion.
    """
    information, prior = by_item.information.sum(0).numpy(), by_item.information[-1].numpy()
    plain, slopes = np.linalg.inv(information), by_item.score[:-1].numpy()
    count = len(slopes)
    if count < MANY_EPISODES:
        return plain
    scatter = plain @ (count / (count - 1) * slopes.T @ slopes + prior) @ plain
    wider = np.sqrt(np.maximum(1.0, np.diag(scatter) / np.diag(plain)))
    return plain * np.outer(wider, wider)
