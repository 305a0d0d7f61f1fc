"""Contact parameters from the measured forces of driven bodies, after the motion has told what it can.

In slow pushing friction leaves the track unchanged: the pushed body goes where the pusher goes, and only the force that
this takes depends on the friction. The estimate from the motion, with its covariance, is the prior here; the residuals
are the mean forces on short intervals against those of rollouts over whole episodes. A Gauss-Newton descent with
differences combines the two (for independent errors: the product of two normal densities).

The force also depends on where the pusher touches, and so on the start of each episode, which its first frames tell to
their noise alone: the starts are estimated with the parameters, with what the first frames say of them as their prior,
and eliminated from the information.

Forces that the model does not explain to within their noise count less: the information is divided by the misfit and,
because errors of the model last, by the number of successive residuals that go together, (1 + r) / (1 - r) for the
correlation r of neighbours (of a first-order autoregression; Bayley and Hammersley, 1946). With many episodes their
scatter counts, too: a standard error is at least that by the scores of whole episodes (the sandwich; White, 1982), so
that a friction that differs from push to push widens the interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.levenberg_marquardt import robust_loss
from ...physics.chain_state import on_joints
from ...physics.engine import rollout as rolled_out
from ...physics.kinematic import Drive
from ...physics.observation_model import true_times
from ...physics.parameters import apply_parameters
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.residuals import retract
from .contact_result import ContactEstimate
from .measured_forces import MeasuredForce

Array = NDArray[Any]

STEP = 0.1
"""Step of the differences by a parameter or a start, in standard deviations of its prior."""
ROBUST_SCALE = 4.0
"""Scale of the robust loss of a force, in standard deviations."""
ITERATIONS = 15
"""Maximum number of steps of the descent."""
DAMPINGS = (0.0, 0.1, 1.0, 10.0, 100.0)
"""Factors of the diagonal of the information that are added to it; of the steps so found the best is taken."""
SETTLED = 0.02
"""Decrease of the cost, in units of chi-square, below which the descent has converged."""
MOST_CORRELATION = 0.98
"""Largest correlation of neighbouring residuals that is believed."""
MEDIAN_CHI2 = 2.366
"""Median of chi-square with 3 degrees of freedom."""
MANY_EPISODES = 8
"""Number of episodes from which on their scatter counts."""
LEAST_SHARE = 1e-6
"""Least eigenvalue of the correlations of a start that is varied [1]."""


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
    fit = _ForceFit(world, estimate, forces, observations, start_cov)
    values, converged = _Values(estimate.values.copy(), [np.zeros(root.shape[1]) for root in fit.roots]), False
    for _ in range(ITERATIONS):
        values, gained = fit.descended(fit.at(values, lasting=False))
        converged = gained < SETTLED
        if converged:
            break
    point = fit.at(values)
    record = {
        "episodes": len({force.episode.name for force in forces}),
        "intervals": sum(len(force.force_n) for force in forces),
        "std_n": float(np.median([force.std_n for force in forces])),
        "misfit": point.misfit,
        "information_over": point.growth,
        "converged": converged,
    }
    return replace(estimate, values=point.values.shared, covariance=point.covariance), record


@dataclass(frozen=True)
class _Values:
    """What is fitted."""

    shared: Array
    """Contact parameters in fitted coordinates (P,)."""
    starts: list[Array]
    """Of each episode with forces the change of its start, in standard deviations along the axes of its covariance."""

    def moved(self, shared: Array, starts: Sequence[Array]) -> _Values:
        """Return values that are changed by steps."""
        return _Values(self.shared + shared, [one + move for one, move in zip(self.starts, starts, strict=True)])


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Normal equations of one episode, in standard deviations; the start has S numbers."""

    shared: Array
    """Information (P, P) on the parameters."""
    mixed: Array
    """Information (P, S) on parameters and start."""
    start: Array
    """Information (S, S) on the start, that of its prior included."""
    score: Array
    """Gradient (P,) by the parameters."""
    start_score: Array
    """Gradient (S,) by the start."""

    def damped(self, factor: float) -> _Part:
        """Return the equations with a multiple of the diagonals of their information added to it."""
        shared, start = (x + factor * np.diag(np.diag(x)) for x in (self.shared, self.start))
        return replace(self, shared=shared, start=start)

    @property
    def gain(self) -> Array:
        """The change (S, P) of the start that a change of the parameters takes back."""
        return np.linalg.solve(self.start, self.mixed.T)

    @property
    def information(self) -> Array:
        """Information (P, P) on the parameters, the start eliminated."""
        return self.shared - self.mixed @ self.gain

    @property
    def slope(self) -> Array:
        """Gradient (P,), the start eliminated."""
        return self.score - self.gain.T @ self.start_score


@dataclass(frozen=True, kw_only=True)
class _Point:
    """Residuals at a point of the descent, and what follows from them."""

    values: _Values
    """The point."""
    residuals: list[Array]
    """Of each episode (N, 3), in standard deviations."""
    parts: list[_Part]
    """Of each episode."""
    misfit: float
    """Median chi-square of an interval, relative to its expectation."""
    growth: float
    """Factor by which the information is divided."""
    prior: tuple[Array, Array]
    """Estimate (P,) and information (P, P) of the motion."""

    @property
    def information(self) -> Array:
        """Information (P, P) of forces and motion."""
        return sum((part.information for part in self.parts), self.prior[1])

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the parameters, that of many episodes at least as wide as their scatter."""
        plain, count = np.linalg.inv(self.information), len(self.parts)
        if count < MANY_EPISODES:
            return plain
        slopes = np.stack([part.slope for part in self.parts])
        scatter = plain @ (count / (count - 1) * slopes.T @ slopes + self.prior[1]) @ plain
        wider = np.sqrt(np.maximum(1.0, np.diag(scatter) / np.diag(plain)))
        return plain * np.outer(wider, wider)

    def moved(self, damping: float) -> _Values:
        """Return the values after a damped Gauss-Newton step."""
        parts = [part.damped(damping) for part in self.parts]
        slope = sum((part.slope for part in parts), self.prior[1] @ (self.values.shared - self.prior[0]))
        information = sum((part.information for part in parts), self.prior[1])
        move = -np.linalg.solve(information, slope)
        starts = [-np.linalg.solve(part.start, part.start_score) - part.gain @ move for part in parts]
        return self.values.moved(move, starts)


class _ForceFit:
    """Residuals of measured forces as a function of the contact parameters and the starts of the episodes."""

    def __init__(
        self,
        world: World,
        estimate: ContactEstimate,
        forces: Sequence[MeasuredForce],
        observations: Observations,
        start_cov: Tensor,
    ) -> None:
        self.world, self.estimate, self.observations = world, estimate, observations
        self.steps = np.array([STEP * parameter.prior[1] for parameter in estimate.parameters])
        self.prior = estimate.values, np.linalg.pinv(estimate.covariance, hermitian=True)
        self.limits = np.array([parameter.limits for parameter in estimate.parameters])
        self.rows = list(dict.fromkeys(force.row for force in forces))
        self.forces = [[force for force in forces if force.row == row] for row in self.rows]
        self.roots = [_root(start_cov[row].numpy()) for row in self.rows]

    def at(self, values: _Values, lasting: bool = True) -> _Point:
        """Return residuals and derivatives at a point; `lasting`: successive residuals may go together."""
        count = len(values.shared)
        found, slopes = [], []
        for number, start in enumerate(values.starts):
            sizes = np.concatenate([self.steps, np.full(len(start), STEP)])
            moves = np.diag(sizes)
            around = np.concatenate([np.zeros((1, len(sizes))), moves, -moves])
            every = self._residuals(number, values.shared + around[:, :count], start + around[:, count:])
            ahead, behind = every[1 : len(sizes) + 1], every[len(sizes) + 1 :]
            found.append(every[0])
            slopes.append((ahead - behind) / (2 * sizes[:, None, None]))
        misfit = float(np.median(np.concatenate([np.square(each).sum(-1) for each in found]))) / MEDIAN_CHI2
        growth = max(1.0, misfit) * (_lasting(self.forces, found) if lasting else 1.0)
        parts = [
            self._part(each, slope, start, max(1.0, misfit), growth)
            for each, slope, start in zip(found, slopes, values.starts, strict=True)
        ]
        return _Point(values=values, residuals=found, parts=parts, misfit=misfit, growth=growth, prior=self.prior)

    def _part(self, residuals: Array, slopes: Array, start: Array, misfit: float, growth: float) -> _Part:
        """Return the normal equations of an episode from residuals (N, 3) and their slopes (P + S, N, 3)."""
        chi2 = torch.as_tensor(np.square(residuals).sum(-1) / misfit)
        weight = robust_loss(chi2, ROBUST_SCALE)[1].numpy() / growth
        weighted, count = slopes * weight[:, None], len(self.steps)
        information = np.einsum("ani,bni->ab", weighted, slopes)
        score = np.einsum("ani,ni->a", weighted, residuals)
        return _Part(
            shared=information[:count, :count],
            mixed=information[:count, count:],
            start=information[count:, count:] + np.eye(len(start)),
            score=score[:count],
            start_score=score[count:] + start,
        )

    def descended(self, point: _Point) -> tuple[_Values, float]:
        """Return the values after the best step from a point, if any lowers the cost, and by how much it does."""
        tried = [point.moved(factor) for factor in DAMPINGS]
        tried = [replace(one, shared=one.shared.clip(*self.limits.T)) for one in tried]
        every = [
            self._residuals(
                number, np.stack([one.shared for one in tried]), np.stack([one.starts[number] for one in tried])
            )
            for number in range(len(self.rows))
        ]
        costs = [self._cost(point, one, [each[k] for each in every]) for k, one in enumerate(tried)]
        gained = self._cost(point, point.values, point.residuals) - min(costs)
        return (tried[int(np.argmin(costs))], gained) if gained > 0 else (point.values, 0.0)

    def _cost(self, point: _Point, values: _Values, residuals: Sequence[Array]) -> float:
        scale = max(1.0, point.misfit)
        chi2 = np.concatenate([np.square(each).sum(-1) for each in residuals])
        loss = float(robust_loss(torch.as_tensor(chi2 / scale), ROBUST_SCALE)[0].sum()) * scale / point.growth
        off = values.shared - self.prior[0]
        return loss + float(off @ self.prior[1] @ off) + sum(float(np.square(start).sum()) for start in values.starts)

    def _residuals(self, number: int, samples: Array, starts: Array) -> Array:
        """Return the residuals (K, N, 3) of an episode for parameters (K, P) and starts (K, S)."""
        parts = [
            (self._exerted(force, samples, starts @ self.roots[number].T) - force.force_n) / force.spread_n[:, None]
            for force in self.forces[number]
        ]
        return np.nan_to_num(np.concatenate(parts, 1), nan=1e6, posinf=1e6, neginf=-1e6)

    def _exerted(self, force: MeasuredForce, samples: Array, changes: Array) -> Array:
        """Return the mean forces (K, intervals, 3) [N] that the driven body exerts in rollouts.

        Args:
            force: What was measured.
            samples: Parameters (K, P).
            changes: Changes of the start (K, 12 nf).
        """
        repeats, parameters = len(samples), self.estimate.parameters
        values = torch.as_tensor(samples)
        decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(parameters)], -1)
        seen = self.observations.select([force.row])
        start = float(seen.times_s[0, 0])
        ahead = [start] if force.edges_s[0] > start + 1e-9 else []
        times = torch.tensor([*ahead, *force.edges_s], dtype=torch.float64).repeat(repeats, 1)
        like = self.world.gravity
        drives = {
            body.name: Drive.of([force.episode.tracks[body.name]], like).repeat(repeats)
            for body in self.world.bodies
            if body.motion == "driven"
        }
        with torch.no_grad():
            world = apply_parameters(seen.world(self.world, repeats), parameters, decoded)
            state = retract(seen.state.repeat(repeats), torch.as_tensor(changes), seen.free)
            rollout = rolled_out(world, on_joints(world, state), true_times(world, times), drives, True)
        return _mean_force(rollout.contacts, force.body, times)[:, len(ahead) :].numpy()


def _root(covariance: Array) -> Array:
    """Return a matrix R (n, S) with R R^T = the covariance (n, n), without directions that hardly vary."""
    scale = np.sqrt(np.diag(covariance).clip(1e-300))
    values, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > LEAST_SHARE
    return scale[:, None] * axes[:, kept] * np.sqrt(values[kept])


def _lasting(forces: Sequence[Sequence[MeasuredForce]], residuals: Sequence[Array]) -> float:
    """Return how many successive residuals, of each episode (N, 3), go together."""
    ahead = size = 0.0
    for group, every in zip(forces, residuals, strict=True):
        for part in np.split(every, np.cumsum([len(force.force_n) for force in group])[:-1]):
            ahead += float((part[1:] * part[:-1]).sum())
            size += float(np.square(part).sum())
    correlation = min(max(ahead / max(size, 1e-30), 0.0), MOST_CORRELATION)
    return (1 + correlation) / (1 - correlation)


def _mean_force(contacts: Any, body: int, times_s: Tensor) -> Tensor:
    """Return the mean force (K, T - 1, 3) [N] that a driven body, the second of its pairs, exerts between frames."""
    impulse = contacts.impulse_n_s[:, 1:, contacts.body_b == body].sum(2)
    return impulse / times_s.diff(dim=1)[..., None]
