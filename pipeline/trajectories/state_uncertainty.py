"""Effect of the initial state's uncertainty on a whole rollout, and the state that fits a whole rollout best.

Both evaluate states within the uncertainty of the warm-up's estimate. Rollouts with impacts are rough functions of
their start, so derivatives are differences over one standard deviation of it, not exact ones at a point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..optimization.least_squares import Policy, descend
from ..optimization.levenberg_marquardt import robust_loss
from ..optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ..physics.world import World
from .observations import Observations
from .residuals import STATE_SIZE, TrajectoryResiduals
from .track_noise import Noise

MAX_STEP = (0.005, 0.05, 0.1, 0.5)
"""Largest differences in position [m], rotation [rad], velocity [m/s], omega [rad/s], where nothing was measured."""
DAMPINGS = (0.01, 0.1, 1.0, 10.0, 100.0)
"""Levenberg-Marquardt dampings, tried in parallel, in units of the warm-up's information."""
POLICY = Policy(
    iterations=3,
    attempts=1,
    damping=1.0,
    down=1.0,
    least_damping=1.0,
    most_damping=math.inf,
    factors=DAMPINGS,
    linearise_end=False,
)
"""A fit ends where none of the dampings lowers the distance."""
ROBUST_SCALE = 3.0
"""Scale of the Cauchy loss, in sigmas."""
MAX_ITEMS = 128
"""Maximum number of rollouts in one batch: more exceed the processor's cache."""


@dataclass(frozen=True)
class StartUncertainty:
    """Rollouts from states within the uncertainty of the start, for a batch of episodes (B)."""

    world: World
    """The world in which the episodes are rolled out."""
    observations: Observations
    """The episodes, with their states at the warm-up's estimate."""
    covariance: Tensor
    """Covariance of the state changes, shape (B, S, S), S = 12 for each free body."""
    weight: Tensor
    """Frames that count, shape (B, T, nf), 1 or 0."""

    def noise_floor(self, samples: int, seeds: Sequence[int]) -> Tensor:
        """Return the mean distance (B,) [m] between rollouts from sampled states and the rollout from their mean.

        Args:
            samples: Number of samples for each episode.
            seeds: Seed of each episode, so that its samples do not depend on the others.
        """
        size = self.covariance.shape[-1]
        normal = np.stack(
            [
                np.random.default_rng(np.random.SeedSequence(0, spawn_key=(s,))).standard_normal((samples, size))
                for s in seeds
            ]
        )
        changes = torch.as_tensor(normal).to(self.covariance) @ covariance_root(self.covariance).transpose(1, 2)
        items = torch.arange(len(changes))
        rows = self.rows(torch.cat((torch.zeros_like(changes[:, :1]), changes), 1), items)[..., :3]
        return self.distance(rows[:, 1:] - rows[:, :1], items).mean(1)

    def fit(self, noise: Noise, iterations: int) -> Tensor:
        """Return the mean distance (B,) [m] to the measured track after fitting the state to all of it.

        Gauss-Newton steps with Cauchy weights in the coordinates in which the start's covariance is the identity, with
        several dampings in parallel; a state is kept only where it lowers the distance, so the result never exceeds
        that of the start.

        Args:
            noise: Standard deviations of the measurement (position [m], rotation [rad]).
            iterations: Number of steps.
        """
        problem = _StartFit(self, noise)
        return descend(problem, problem.start(), replace(POLICY, iterations=iterations)).cost

    def rows(self, changes: Tensor, items: Tensor) -> Tensor:
        """Return residuals (b, K, F, 6) in metres and radians of state changes (b, K, S) of some episodes (b,)."""
        batch, count, size = changes.shape
        every = items.repeat_interleave(count).tolist()
        flat = changes.reshape(-1, size)
        parts = []
        for first in range(0, len(every), MAX_ITEMS):
            chosen = self.observations.select(every[first : first + MAX_ITEMS])
            residuals = TrajectoryResiduals(
                world=self.world, parameters=[], observations=chosen, position_std_m=1.0, rotation_std_rad=1.0
            )
            parts.append(residuals(flat.new_zeros(0), flat[first : first + MAX_ITEMS], False)[0])
        return torch.cat(parts).unflatten(0, (batch, count))

    def distance(self, rows: Tensor, items: Tensor) -> Tensor:
        """Return the mean distance (b, K) [m] over the frames that count; infinite where a rollout diverged."""
        weight = self.weight.flatten(1)[items][:, None]
        distance = rows[..., :3].square().sum(-1).sqrt()
        mean = (distance * weight).sum(-1) / weight.sum(-1)
        return torch.nan_to_num(mean, nan=torch.inf, posinf=torch.inf)


class _StartFit(Problem):
    """Starts of episodes (B), fitted to their whole tracks; the cost is the distance and not the sum of squares.

    Args:
        uncertainty: The episodes, with the covariance of their starts.
        noise: Standard deviations of the measurement.
    """

    def __init__(self, uncertainty: StartUncertainty, noise: Noise) -> None:
        self.uncertainty, self.noise = uncertainty, noise
        root = _limited(covariance_root(uncertainty.covariance))
        self.directions = root.transpose(1, 2)  # row k: one standard deviation along the k-th coordinate
        self.owner = torch.arange(len(root), device=root.device)
        self.box = Box.unbounded(root.new_zeros(len(root), 0))
        self.damping_unit = root.new_ones(root.shape[-1])  # the information of the warm-up

    def start(self) -> Point:
        """Return the starts of the warm-up."""
        return Point(values=self.directions.new_zeros(len(self.owner), 0), states=(self.directions[:, 0] * 0.0,))

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the distance (b,) [m] of each episode."""
        changes = (point.states[0][:, None] @ self.directions[rows.items])[:, :1]
        return self.uncertainty.distance(self.uncertainty.rows(changes, rows.items), rows.items)[:, 0]

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations of residuals and of their differences over one standard deviation."""
        directions = self.directions[rows.items]
        here = point.states[0][:, None] @ directions
        every = self.uncertainty.rows(torch.cat((here, here + directions), 1), rows.items)
        counted = self.uncertainty.weight.flatten(1)[rows.items][..., None].expand(-1, -1, 6)
        found, jacobian = every[:, 0], every[:, 1:] - every[:, :1]
        scale = torch.cat([_spread(found[..., k : k + 3], self.noise[k // 3]) for k in (0, 3)], -1)[:, None] / counted
        scaled, slopes = found / scale, jacobian / scale[:, None]
        _, weight = robust_loss(scaled.square().sum(-1), ROBUST_SCALE)
        return NormalEquations.of_rows(
            torch.nan_to_num(scaled).flatten(1),
            torch.nan_to_num(slopes.flatten(2), posinf=0.0, neginf=0.0).mT,
            0,
            self.uncertainty.distance(every[:, :1], rows.items)[:, 0],
            weight.repeat_interleave(6, -1),
        )


def covariance_root(covariance: Tensor) -> Tensor:
    """Return R with covariance = R R^T, shape (B, S, S).

    By the Cholesky factor of the correlations, which is unique; eigenvectors of equal variances depend on the last bit.
    """
    std = covariance.diagonal(dim1=1, dim2=2).clamp_min(1e-300).sqrt()
    correlation = covariance / (std[:, :, None] * std[:, None])
    return std[:, :, None] * torch.linalg.cholesky(correlation + 1e-9 * torch.eye(std.shape[1]).to(std))


def _limited(root: Tensor) -> Tensor:
    """Shrink the columns of a covariance root (B, S, S) to at most MAX_STEP."""
    limit = torch.tensor([s for s in MAX_STEP for _ in range(3)]).to(root).repeat(root.shape[1] // STATE_SIZE)
    excess = (root.abs() / limit[:, None]).amax(1, keepdim=True)
    return root / excess.clamp_min(1.0)


def _spread(rows: Tensor, noise: float) -> Tensor:
    """Return the scale of one frame for each item (B, 3): noise and median residual, added in quadrature."""
    size = rows.square().sum(-1).sqrt()
    median = torch.nan_to_num(size.masked_fill(size == 0, torch.nan).nanmedian(1).values)
    return (median.square() + noise**2).sqrt()[:, None].expand(-1, 3)
