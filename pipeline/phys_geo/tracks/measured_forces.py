"""Contact parameters from the measured forces of driven bodies, after the motion has told what it can.

In slow pushing friction leaves the track unchanged: the pushed body goes where the pusher goes, and only the force that
this takes depends on the friction. The estimate from the motion, with its covariance, is the prior here; the residuals
are the mean forces on short intervals against those of rollouts over whole episodes. A Gauss-Newton descent with
differences combines the two (for independent errors: the product of two normal densities).

Forces that the model does not explain to within their noise count less: the information is divided by the misfit and,
because errors of the model last, by the number of successive residuals that go together, (1 + r) / (1 - r) for the
correlation r of neighbours (of a first-order autoregression; Bayley and Hammersley, 1946).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....datasets.capture.tracks import Episode, Track
from ...optimization.levenberg_marquardt import robust_loss
from ...physics.engine import rollout as rolled_out
from ...physics.kinematic import Drive
from ...physics.observation_model import true_times
from ...physics.parameters import apply_parameters
from ...physics.world import World
from ...trajectories.observations import Observations
from .contact_result import ContactEstimate

MOST_INTERVALS = 200
"""Maximum number of intervals of an episode; of more samples, several are averaged."""
STEP = 0.1
"""Step of the differences by a parameter, in standard deviations of its prior."""
ROBUST_SCALE = 4.0
"""Scale of the robust loss of a force, in standard deviations."""
ITERATIONS, HALVINGS = 12, 4
"""Maximum number of steps of the descent, and of halvings of each."""
SETTLED = 0.02
"""Step below which the descent has converged, in standard errors."""
MOST_CORRELATION = 0.98
"""Largest correlation of neighbouring residuals that is believed."""
NOISY_CHANGE = 4.0
"""Largest squared change of a force from interval to interval, relative to its expectation from the noise alone, that
counts as noise."""
MEDIAN_CHI2 = 2.366
"""Median of chi-square with 3 degrees of freedom."""


@dataclass(frozen=True, kw_only=True)
class MeasuredForce:
    """Force that one driven body exerts in an episode; K intervals."""

    episode: Episode
    """Name and tracks."""
    row: int
    """Item of the observations, with the state at its first frame."""
    body: int
    """Index of the driven body."""
    edges_s: np.ndarray
    """Edges of the intervals [s], shape (K + 1,)."""
    force_n: np.ndarray
    """Mean force on each interval, world frame [N], shape (K, 3)."""
    std_n: float
    """Noise of a component of these means [N]."""
    spread_n: np.ndarray
    """Standard deviation of a component by which a mean may differ from that of a rollout [N], shape (K,)."""

    @staticmethod
    def of(episode: Episode, row: int, body: int, track: Track, start_s: float, std_n: float | None) -> MeasuredForce:
        """Average the samples of a track from a start on, each between the middles to its neighbours."""
        late = track.window(start_s)
        force = np.zeros((0, 3)) if late.force_n is None else late.force_n
        each = max(1, -(-(len(late) - 2) // MOST_INTERVALS))
        count = max(0, (len(late) - 2) // each)
        middle = 0.5 * (late.time_s[1:] + late.time_s[:-1])
        means = force[1 : 1 + count * each].reshape(count, each, 3).mean(1)
        std = (std_n or force_noise(force)) / float(np.sqrt(each))
        return MeasuredForce(
            episode=episode,
            row=row,
            body=body,
            edges_s=middle[: count * each + 1 : each],
            force_n=means,
            std_n=std,
            spread_n=np.hypot(std, _jumps(means, std)),
        )


def _jumps(force_n: np.ndarray, std_n: float) -> np.ndarray:
    """Return the error (K,) of a component [N] that an error in time of an interval makes of mean forces (K, 3).

    Where the force changes, at a first touch or a release, it tells the time of that, which frames and shapes do not
    give to a part of an interval. Changes within the noise of the means count as none.
    """
    padded = np.concatenate([force_n[:1], force_n, force_n[-1:]])
    change = np.square(0.5 * (padded[2:] - padded[:-2])).sum(1)
    return np.where(change > NOISY_CHANGE * 1.5 * std_n**2, np.sqrt(change), 0.0)


def force_noise(force_n: np.ndarray) -> float:
    """Return the noise of a component [N] of forces (T, 3) from their second differences, robust against impacts."""
    bent = np.diff(force_n, 2, axis=0)
    robust = 1.4826 * float(np.median(np.abs(bent))) / np.sqrt(6.0) if bent.size else 0.0
    return max(robust, 1e-4 * float(np.abs(force_n).max(initial=0.0)), 1e-9)


def measured_forces(
    world: World, episodes: Sequence[Episode], observations: Observations, std_n: float | None
) -> list[MeasuredForce]:
    """Return the measured forces of the driven bodies in the episodes of the observations."""
    found = []
    for row, (episode, start) in enumerate(zip(episodes, observations.times_s[:, 0].tolist(), strict=True)):
        for index, body in enumerate(world.bodies):
            track = episode.tracks.get(body.name)
            if body.motion == "driven" and track is not None and track.force_n is not None:
                force = MeasuredForce.of(episode, row, index, track, start, std_n)
                found += [force] if len(force.force_n) else []
    return found


def with_forces(
    world: World, estimate: ContactEstimate, forces: Sequence[MeasuredForce], observations: Observations
) -> tuple[ContactEstimate, dict[str, Any]]:
    """Return the contact parameters with what measured forces say in addition, and the record of the descent.

    Args:
        world: The world.
        estimate: Contact parameters from the motion.
        forces: The measured forces.
        observations: The episodes, with the states at their first frames.
    """
    fit = _ForceFit(world, estimate, forces, observations)
    values, converged = estimate.values.copy(), False
    for _ in range(ITERATIONS):
        point = fit.at(values)
        move, error = point.step()
        values, moved = fit.descended(point, move)
        converged = bool((np.abs(moved) < SETTLED * error).all())
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
    return replace(estimate, values=values, covariance=np.linalg.inv(point.information)), record


@dataclass(frozen=True, kw_only=True)
class _Point:
    """Residuals at a point of the descent."""

    values: np.ndarray
    """Parameters in fitted coordinates (P,)."""
    residuals: np.ndarray
    """Of all intervals, in standard deviations, shape (N, 3)."""
    jacobian: np.ndarray
    """Shape (N, 3, P)."""
    weight: np.ndarray
    """Weight of each interval (N,)."""
    misfit: float
    """Median chi-square of an interval, relative to its expectation."""
    growth: float
    """Factor by which the information is divided."""
    prior: tuple[np.ndarray, np.ndarray]
    """Estimate (P,) and information (P, P) of the motion."""

    @property
    def information(self) -> np.ndarray:
        """Information (P, P) of forces and motion."""
        weighted = self.jacobian * (self.weight / self.growth)[:, None, None]
        return np.einsum("nip,niq->pq", weighted, self.jacobian) + self.prior[1]

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gauss-Newton step (P,) and the standard errors (P,)."""
        slope = np.einsum("nip,ni,n->p", self.jacobian, self.residuals, self.weight / self.growth)
        slope = slope + self.prior[1] @ (self.values - self.prior[0])
        covariance = np.linalg.inv(self.information)
        return -covariance @ slope, np.sqrt(np.diag(covariance))


class _ForceFit:
    """Residuals of measured forces as a function of the contact parameters."""

    def __init__(
        self, world: World, estimate: ContactEstimate, forces: Sequence[MeasuredForce], observations: Observations
    ) -> None:
        self.world, self.estimate, self.forces, self.observations = world, estimate, forces, observations
        self.steps = np.array([STEP * parameter.prior[1] for parameter in estimate.parameters])
        self.prior = estimate.values, np.linalg.pinv(estimate.covariance, hermitian=True)
        self.limits = np.array([parameter.limits for parameter in estimate.parameters])

    def at(self, values: np.ndarray) -> _Point:
        """Return residuals and derivatives at parameters (P,)."""
        moves = np.diag(self.steps)
        every = self._residuals(np.concatenate([values[None], values + moves, values - moves]))
        count = len(values)
        slopes = (every[1 : count + 1] - every[count + 1 :]) / (2 * self.steps[:, None, None])
        chi2 = np.square(every[0]).sum(-1)
        misfit = float(np.median(chi2)) / MEDIAN_CHI2
        scaled = torch.as_tensor(chi2 / max(1.0, misfit))
        return _Point(
            values=values,
            residuals=every[0],
            jacobian=np.moveaxis(slopes, 0, -1),
            weight=robust_loss(scaled, ROBUST_SCALE)[1].numpy(),
            misfit=misfit,
            growth=max(1.0, misfit) * self._lasting(every[0]),
            prior=self.prior,
        )

    def descended(self, point: _Point, move: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return parameters (P,) with a lower cost along a step, and how far they are from the point."""
        tried = [(point.values + 0.5**k * move).clip(*self.limits.T) for k in range(HALVINGS)]
        costs = [
            self._cost(point, values, rows)
            for values, rows in zip(tried, self._residuals(np.stack(tried)), strict=True)
        ]
        if min(costs) >= self._cost(point, point.values, point.residuals):
            return point.values, np.zeros_like(move)
        best = tried[int(np.argmin(costs))]
        return best, best - point.values

    def _cost(self, point: _Point, values: np.ndarray, residuals: np.ndarray) -> float:
        scale = max(1.0, point.misfit)
        loss = robust_loss(torch.as_tensor(np.square(residuals).sum(-1) / scale), ROBUST_SCALE)[0]
        off = values - self.prior[0]
        return float(loss.sum()) * scale / point.growth + float(off @ self.prior[1] @ off)

    def _lasting(self, residuals: np.ndarray) -> float:
        """Return how many successive residuals (N, 3) go together."""
        parts = np.split(residuals, np.cumsum([len(force.force_n) for force in self.forces])[:-1])
        ahead = sum(float((part[1:] * part[:-1]).sum()) for part in parts)
        size = sum(float(np.square(part).sum()) for part in parts)
        correlation = min(max(ahead / max(size, 1e-30), 0.0), MOST_CORRELATION)
        return (1 + correlation) / (1 - correlation)

    def _residuals(self, samples: np.ndarray) -> np.ndarray:
        """Return the residuals (K, N, 3) of parameters (K, P), in standard deviations."""
        parts = []
        for force in self.forces:
            expected = self._exerted(force, samples)
            parts.append((expected - force.force_n) / force.spread_n[:, None])
        return np.nan_to_num(np.concatenate(parts, 1), nan=1e6, posinf=1e6, neginf=-1e6)

    def _exerted(self, force: MeasuredForce, samples: np.ndarray) -> np.ndarray:
        """Return the mean forces (K, intervals, 3) [N] that the driven body exerts in rollouts by parameters (K, P)."""
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
            rollout = rolled_out(world, seen.state.repeat(repeats), true_times(world, times), drives, True)
        return _mean_force(rollout.contacts, force.body, times)[:, len(ahead) :].numpy()


def _mean_force(contacts: Any, body: int, times_s: Tensor) -> Tensor:
    """Return the mean force (K, T - 1, 3) [N] that a driven body, the second of its pairs, exerts between frames."""
    impulse = contacts.impulse_n_s[:, 1:, contacts.body_b == body].sum(2)
    return impulse / times_s.diff(dim=1)[..., None]
