"""Effect of the initial state's uncertainty on a whole rollout, and the state that fits a whole rollout best.

Both evaluate states within the uncertainty of the warm-up's estimate. Rollouts with impacts are rough functions of
their start, so derivatives are differences over one standard deviation of it, not exact ones at a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..optimization.levenberg_marquardt import robust_loss
from ..physics.world import World
from .observations import Observations
from .residuals import STATE_SIZE, TrajectoryResiduals
from .track_noise import Noise

MAX_STEP = (0.005, 0.05, 0.1, 0.5)
"""Largest differences in position [m], rotation [rad], velocity [m/s], omega [rad/s], where nothing was measured."""
DAMPINGS = (0.01, 0.1, 1.0, 10.0, 100.0)
"""Levenberg-Marquardt dampings, tried in parallel, in units of the warm-up's information."""
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
        rows = self._rows(torch.cat((torch.zeros_like(changes[:, :1]), changes), 1))[..., :3]
        return self._distance(rows[:, 1:] - rows[:, :1]).mean(1)

    def fit(self, noise: Noise, iterations: int) -> Tensor:
        """Return the mean distance (B,) [m] to the measured track after fitting the state to all of it.

        Gauss-Newton steps with Cauchy weights in the coordinates in which the start's covariance is the identity, with
        several dampings in parallel; a state is kept only where it lowers the distance, so the result never exceeds
        that of the start. The loop is its own, because it lowers the distance and not the sum that it linearises.

        Args:
            noise: Standard deviations of the measurement (position [m], rotation [rad]).
            iterations: Number of steps.
        """
        root = _limited(covariance_root(self.covariance))
        directions = root.transpose(1, 2)  # row k: one standard deviation along the k-th coordinate
        best = torch.zeros_like(directions[:, :1])
        rows = self._rows(best)
        distance = self._distance(rows)
        for _ in range(iterations):
            moved = self._rows(best + directions)
            jacobian = moved - rows
            steps = self._steps(rows[:, 0], jacobian, noise)
            candidates = torch.cat((best, best + steps @ directions), 1)
            all_rows = torch.cat((rows, self._rows(candidates[:, 1:])), 1)
            distances = self._distance(all_rows)
            choice = distances.argmin(1)
            item = torch.arange(len(choice))
            best, rows = candidates[item, choice][:, None], all_rows[item, choice][:, None]
            distance = distances[item, choice][:, None]
        return distance[:, 0]

    def _steps(self, rows: Tensor, jacobian: Tensor, noise: Noise) -> Tensor:
        """Return the damped steps (B, dampings, S) of residuals (B, F, 6) and differences (B, S, F, 6)."""
        counted = self.weight.flatten(1)[..., None].expand(-1, -1, 6)
        scale = torch.cat([_spread(rows[..., k : k + 3], noise[k // 3]) for k in (0, 3)], -1)[:, None] / counted
        scaled, slopes = rows / scale, jacobian / scale[:, None]
        _, weight = robust_loss(scaled.square().sum(-1), ROBUST_SCALE)
        flat = torch.nan_to_num(slopes.flatten(2), posinf=0.0, neginf=0.0)
        weighted = flat * weight.repeat_interleave(6, -1)[:, None]
        normal = weighted @ flat.transpose(1, 2)
        gradient = -(weighted @ torch.nan_to_num(scaled).flatten(1)[..., None])
        eye = torch.eye(normal.shape[-1]).to(normal)
        return torch.stack([torch.linalg.solve(normal + d * eye, gradient).squeeze(-1) for d in DAMPINGS], 1)

    def _rows(self, changes: Tensor) -> Tensor:
        """Return residuals (B, K, F, 6) in metres and radians of state changes (B, K, S)."""
        batch, count, size = changes.shape
        items = [item for item in range(batch) for _ in range(count)]
        flat = changes.reshape(-1, size)
        parts = []
        for first in range(0, len(items), MAX_ITEMS):
            chosen = self.observations.select(items[first : first + MAX_ITEMS])
            residuals = TrajectoryResiduals(
                world=self.world, parameters=[], observations=chosen, position_std_m=1.0, rotation_std_rad=1.0
            )
            parts.append(residuals(flat.new_zeros(0), flat[first : first + MAX_ITEMS], False)[0])
        return torch.cat(parts).unflatten(0, (batch, count))

    def _distance(self, rows: Tensor) -> Tensor:
        """Return the mean distance (B, K) [m] over the frames that count; infinite where a rollout diverged."""
        weight = self.weight.flatten(1)[:, None]
        distance = rows[..., :3].square().sum(-1).sqrt()
        mean = (distance * weight).sum(-1) / weight.sum(-1)
        return torch.nan_to_num(mean, nan=torch.inf, posinf=torch.inf)


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
