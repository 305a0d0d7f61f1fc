"""Residuals of measured forces: mean forces on short intervals against those of rollouts over whole episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...physics.chains.state import on_joints
from ...physics.engine import rollout as rolled_out
from ...physics.kinematic import Drive
from ...physics.observation_model import true_times
from ...physics.parameters import Parameter, apply_parameters
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.residuals import retract
from .measured_forces import MeasuredForce

STEP = 0.1
"""Step of the differences by a parameter or a start, in standard deviations of its prior."""
LEAST_SHARE = 1e-6
"""Least eigenvalue of the correlations of a start that is varied [1], and least part of the largest change of a state
that an axis makes where links keep to their joints."""
TOUCHES = 5.0
"""Size of a mean force, in standard deviations of a component, from which on it counts as one."""
NEAR = 1e-3
"""Step of the differences that show this, in standard deviations."""


class ForceResiduals:
    """Residuals of the forces of each episode (E) by the contact parameters (P) and the change of its start (S).

    A change of a start is in standard deviations along the axes of its covariance. Starts with fewer axes than others
    have coordinates that change nothing.

    Args:
        world: The world.
        parameters: The contact parameters.
        forces: The measured forces.
        observations: The episodes, with the states at their first frames.
        start_cov: Covariance of these states, (episodes, 12 nf, 12 nf).
    """

    def __init__(
        self,
        world: World,
        parameters: Sequence[Parameter],
        forces: Sequence[MeasuredForce],
        observations: Observations,
        start_cov: Tensor,
    ) -> None:
        self.world, self.parameters, self.observations = world, parameters, observations
        rows = list(dict.fromkeys(force.row for force in forces))
        self.forces = [[force for force in forces if force.row == row] for row in rows]
        roots = [self._on_joints(row, _root(start_cov[row])) for row in rows]
        self.start_size = max(root.shape[1] for root in roots)
        self.roots = [torch.nn.functional.pad(root, (0, self.start_size - root.shape[1])) for root in roots]

    def of(self, episode: int, values: Tensor, starts: Tensor) -> Tensor:
        """Return the residuals (K, N, 3) of an episode for parameters (K, P) and starts (K, S)."""
        changes = starts @ self.roots[episode].T
        parts = [
            (self._exerted(force, values, changes) - torch.as_tensor(force.force_n))
            / torch.as_tensor(force.spread_n)[:, None]
            for force in self.forces[episode]
        ]
        return torch.cat(parts, 1).nan_to_num(nan=1e6, posinf=1e6, neginf=-1e6)

    def derivatives(self, episode: int, values: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (N, 3) at parameters (P,) and a start (S,), and central differences (N, 3, P + S)."""
        widths = [STEP * parameter.prior[1] for parameter in self.parameters]
        sizes = torch.tensor([*widths, *[STEP] * self.start_size]).to(values)
        moves = torch.cat((torch.zeros_like(sizes)[None], torch.diag(sizes), -torch.diag(sizes)))
        count, axes = len(values), int(self.roots[episode].abs().sum(0).count_nonzero())
        varied = torch.cat((torch.arange(count + axes) + 1, torch.arange(count + axes) + 1 + len(sizes)))
        kept = torch.cat((torch.zeros(1, dtype=torch.long), varied))
        every = self.of(episode, values + moves[kept, :count], start + moves[kept, count:])
        ahead, behind = every[1:].chunk(2)
        slopes = ((ahead - behind) / (2 * sizes[: count + axes, None, None])).movedim(0, -1)
        return every[0], torch.nn.functional.pad(slopes, (0, self.start_size - axes))

    def repeats(self, residuals: Sequence[Tensor], most: float) -> float:
        """Return how many successive residuals, of each episode (N, 3), go together.

        Args:
            residuals: The residuals.
            most: Largest correlation of neighbours that is believed.
        """
        ahead = size = 0.0
        for group, every in zip(self.forces, residuals, strict=True):
            for part in every.split([len(force.force_n) for force in group]):
                ahead += float((part[1:] * part[:-1]).sum())
                size += float(part.square().sum())
        correlation = min(max(ahead / max(size, 1e-30), 0.0), most)
        return (1 + correlation) / (1 - correlation)

    def unexplained(self, residuals: Sequence[Tensor]) -> float:
        """Return how far forces are from the measured ones, relative to these, in the middle of all that touch.

        Args:
            residuals: The residuals of each episode (N, 3).
        """
        off, size = [torch.zeros(0)], [torch.zeros(0)]
        for group, every in zip(self.forces, residuals, strict=True):
            for force, part in zip(group, every.split([len(force.force_n) for force in group]), strict=True):
                exerted = torch.as_tensor(force.force_n).norm(dim=1)
                touches = exerted > TOUCHES * force.std_n
                off.append((part.norm(dim=1) * torch.as_tensor(force.spread_n))[touches])
                size.append(exerted[touches])
        every = torch.cat(size)
        return float(torch.cat(off).median() / every.median()) if len(every) else 0.0

    def _on_joints(self, row: int, root: Tensor) -> Tensor:
        """Return the axes (12 nf, S) of a start without those that joints do not admit, in place of a root of it."""
        if not self.world.chains:
            return root
        moves = NEAR * torch.cat((torch.eye(root.shape[1]), -torch.eye(root.shape[1]))).to(root)
        start = self.observations.select([row]).state.repeat(len(moves))
        with torch.no_grad():
            states = on_joints(self.world, retract(start, moves @ root.T, self.observations.free))
        ahead, behind = torch.cat([value.flatten(1) for value in states.tensors], 1).chunk(2)
        _, sizes, axes = torch.linalg.svd((ahead - behind).T, full_matrices=False)
        return root @ axes[sizes > LEAST_SHARE * sizes.amax()].T

    def _exerted(self, force: MeasuredForce, values: Tensor, changes: Tensor) -> Tensor:
        """Return the mean forces (K, intervals, 3) [N] that the driven body exerts in rollouts.

        Args:
            force: What was measured.
            values: Parameters (K, P).
            changes: Changes of the start (K, 12 nf).
        """
        repeats = len(values)
        decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(self.parameters)], -1)
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
            world = apply_parameters(seen.world(self.world, repeats), self.parameters, decoded)
            state = retract(seen.state.repeat(repeats), changes, seen.free)
            rollout = rolled_out(world, on_joints(world, state), true_times(world, times), drives, True)
        return _mean_force(rollout.contacts, force.body, times)[:, len(ahead) :]


def _root(covariance: Tensor) -> Tensor:
    """Return a matrix R (n, S) with R R^T = the covariance (n, n), without directions that hardly vary."""
    scale = covariance.diagonal().clamp_min(1e-300).sqrt()
    values, axes = torch.linalg.eigh(covariance / torch.outer(scale, scale))
    kept = values > LEAST_SHARE
    return scale[:, None] * axes[:, kept] * values[kept].sqrt()


def _mean_force(contacts: Any, body: int, times_s: Tensor) -> Tensor:
    """Return the mean force (K, T - 1, 3) [N] that a driven body, the second of its pairs, exerts between frames."""
    impulse = contacts.impulse_n_s[:, 1:, contacts.body_b == body].sum(2)
    return impulse / times_s.diff(dim=1)[..., None]
