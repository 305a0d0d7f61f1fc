"""End-to-end refinement: contact parameters and initial states against the image loss of whole rollouts.

The gradient is exact: the renderer gives the loss's gradient by the poses of every frame in reverse mode, the rollout
gives the poses' Jacobian by parameters and states in forward mode, and the two are multiplied. No graph is kept over
the hundreds of steps between two impacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...datasets.progress import progress
from ..estimation.least_squares import robust_loss
from ..estimation.observations import Observations
from ..estimation.trajectory import TrajectoryResiduals
from ..physics.parameters import Parameter
from ..physics.rollout import Rollout
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply
from ..physics.world import World
from .image_loss import ImageLoss

TRACK_WEIGHT = 0.01
"""With tracks too: a mean misfit of one sigma costs this share of the image loss at the start (choice of cgwm)."""
TRACK_ROBUST_SCALE = 4.0
CURVATURE_BLUR = 8
"""Pixels over which the curvature (not the gradient) averages residuals: without it the L1 norm's steps are tiny."""
ATTEMPTS = 7
SMALLEST_FALL = 3e-4
"""The refinement ends when the objective falls by less than this fraction."""


@dataclass(frozen=True)
class TrackTerm:
    """Measured tracks beside the images: their observations on the same time grid, and their noise [m, rad]."""

    observations: Observations
    noise: tuple[float, float]


@dataclass(frozen=True)
class ImageObjective:
    """The image loss of rollouts from a batch of episodes (B), and the track term where there is one.

    Attributes:
        world: The world.
        parameters: What is fitted (P).
        observations: The start states and time grids.
        losses: The image loss of each episode.
        columns: For each episode, the instants of its footage (row 0) and their frames in the grid (row 1), (2, k).
        tracks: Measured tracks to be matched as well.
        scale: Unit of the objective: the image loss at the start, with tracks; else 1.
    """

    world: World
    parameters: Sequence[Parameter]
    observations: Observations
    losses: Sequence[ImageLoss]
    columns: Sequence[Tensor]
    tracks: TrackTerm | None = None
    scale: float = 1.0

    def rollout(self, shared: Tensor, states: Tensor) -> Rollout:
        """Return the rollouts of parameters (P,), in fitted coordinates, and state changes (B, S)."""
        return self._residuals().rollout(shared, states)

    def parts(self, rollout: Rollout) -> Tensor:
        """Return the loss by parts (3,): photometric, mask, tracks; infinite if the rollout blew up."""
        images = torch.zeros(2, dtype=torch.float64)
        count = sum(pair.shape[1] for pair in self.columns)
        for item, (loss, (instants, frames)) in enumerate(zip(self.losses, self.columns, strict=True)):
            position, quat = rollout.position_m[item, frames], rollout.quat_wxyz[item, frames]
            if not bool(position.isfinite().all()) or not bool(quat.isfinite().all()):
                return torch.full((3,), torch.inf)
            with torch.no_grad():
                images += loss.parts(instants, position, quat).sum(0).double() / count
        tracks, _, _ = self._tracks(rollout)
        return torch.cat([images, tracks[None]])

    def value(self, parts: Tensor) -> float:
        """Return the objective of parts."""
        return float(parts[:2].sum()) / self.scale + TRACK_WEIGHT * float(parts[2])

    def gradient(self, rollout: Rollout) -> Tensor:
        """Return the exact gradient (B, T, 6 nf) of the image loss by the free bodies' poses at the grid's frames."""
        batch, length = self.observations.times_s.shape
        slope = torch.zeros(batch, length, 6 * len(self.observations.free), dtype=torch.float64)
        count = sum(pair.shape[1] for pair in self.columns)
        for item, (loss, (instants, frames)) in enumerate(zip(self.losses, self.columns, strict=True)):
            _, part = loss.gradient(instants, rollout.position_m[item, frames], rollout.quat_wxyz[item, frames])
            slope[item, frames] = part.double() / count
        return slope

    def curvature(self, rollout: Rollout) -> Tensor:
        """Return the curvature (B, T, 6 nf, 6 nf) of the image loss by poses, as re-weighted least squares has it."""
        batch, length = self.observations.times_s.shape
        size = 6 * len(self.observations.free)
        curvature = torch.zeros(batch, length, size, size, dtype=torch.float64)
        count = sum(pair.shape[1] for pair in self.columns)
        for item, (loss, (instants, frames)) in enumerate(zip(self.losses, self.columns, strict=True)):
            model = loss.expand(
                instants, rollout.position_m[item, frames], rollout.quat_wxyz[item, frames], CURVATURE_BLUR
            )
            curvature[item, frames] = model.curvature.double() / count
        return curvature

    def jacobian(self, shared: Tensor, states: Tensor, rollout: Rollout) -> Tensor:
        """Return the poses' Jacobian (B, T, 6 nf, P + S) at a rollout; coordinates of `PoseModel`."""
        _, jacobian = self._residuals(rollout)(shared, states, True)
        assert jacobian is not None
        bodies = len(self.observations.free)
        return jacobian.unflatten(1, (-1, bodies)).flatten(2, 3)

    def normal_equations(
        self, shared: Tensor, states: Tensor, rollout: Rollout, curvature: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return matrix and exact gradient of the objective in (P + B S) unknowns: parameters, then each state."""
        jacobian = self.jacobian(shared, states, rollout)
        _, track_slope, track_weight = self._tracks(rollout)
        slope = self.gradient(rollout) / self.scale + TRACK_WEIGHT * track_slope
        blocks = curvature / self.scale + TRACK_WEIGHT * torch.diag_embed(track_weight)
        local = torch.einsum("btdi,btde,btej->bij", jacobian, blocks, jacobian)
        local_slope = torch.einsum("btdi,btd->bi", jacobian, slope)
        count, (batch, size) = len(self.parameters), states.shape
        matrix = torch.zeros(count + batch * size, count + batch * size, dtype=torch.float64)
        vector = torch.zeros(count + batch * size, dtype=torch.float64)
        for item in range(batch):
            first = count + item * size
            index = torch.cat([torch.arange(count), torch.arange(first, first + size)])
            matrix[index[:, None], index] += local[item]
            vector[index] += local_slope[item]
        return matrix, vector

    def _residuals(self, at: Rollout | None = None) -> TrajectoryResiduals:
        """Return the rollouts' residuals; against `at`, where they vanish and their Jacobian is that of the poses."""
        observations = self.observations
        if at is not None:
            free = list(observations.free)
            ones = torch.ones_like(observations.seen)
            observations = replace(
                observations,
                position_m=at.position_m[:, :, free],
                quat_wxyz=at.quat_wxyz[:, :, free],
                seen=ones,
                turned=ones,
            )
        return TrajectoryResiduals(self.world, self.parameters, observations, 1.0, 1.0)

    def _tracks(self, rollout: Rollout) -> tuple[Tensor, Tensor, Tensor]:
        """Return the tracks' mean robust misfit, its slope and weights (B, T, 6 nf) by the poses."""
        shape = (*self.observations.times_s.shape, 6 * len(self.observations.free))
        if self.tracks is None:
            nothing = torch.zeros(shape, dtype=torch.float64)
            return nothing.sum(), nothing, nothing
        seen, free = self.tracks.observations, list(self.observations.free)
        against = replace(seen, position_m=rollout.position_m[:, :, free], quat_wxyz=rollout.quat_wxyz[:, :, free])
        rows = _difference(against, seen)
        variance = torch.tensor([sigma**2 for sigma in self.tracks.noise for _ in range(3)], dtype=torch.float64)
        measured = torch.stack([seen.seen] * 3 + [seen.turned] * 3, -1)
        chi2 = (measured * rows.square() / variance).sum(-1)
        loss, weight = robust_loss(chi2, TRACK_ROBUST_SCALE)
        count = 6 * seen.seen.sum().clamp_min(1)
        scaled = (2 / count) * weight[..., None] * measured / variance
        return loss.sum() / count, (scaled * rows).flatten(2), scaled.flatten(2)


def _difference(poses: Observations, measured: Observations) -> Tensor:
    """Return what leads from measured poses to others (B, T, nf, 6): shift [m], turn [rad]."""
    turn = quat_log(quat_multiply(quat_conjugate(measured.quat_wxyz), poses.quat_wxyz))
    return torch.cat([poses.position_m - measured.position_m, turn], -1)


@dataclass(frozen=True)
class Refined:
    """Where the refinement ended: shared (P,), states (B, S), parts (3,) of the loss before and after, history.

    stopped: why it ended: `small fall`, `no lower point along the step` (not a minimum for sure) or `iterations`.
    """

    shared: Tensor
    states: Tensor
    before: Tensor
    after: Tensor
    history: list[float]
    stopped: str


def refine_end_to_end(
    objective: ImageObjective, shared: Tensor, states: Tensor, bounds: Tensor, iterations: int
) -> Refined:
    """Lower the objective by damped Gauss-Newton steps; a step is kept only if the true loss falls.

    Args:
        objective: What is to fall.
        shared: Start of the parameters in fitted coordinates, shape (P,).
        states: Start of the state changes, shape (B, S).
        bounds: Bounds of the parameters, shape (P, 2).
        iterations: Most steps.
    """
    rollout = objective.rollout(shared, states)
    before = parts = objective.parts(rollout)
    history, damping, stopped = [objective.value(parts)], 1e-2, "iterations"
    curvature = objective.curvature(rollout)
    for _ in progress(range(iterations), "phys-geo: images end to end", iterations):
        matrix, slope = objective.normal_equations(shared, states, rollout, curvature)
        accepted = False
        for _ in range(ATTEMPTS):
            next_shared, next_states = _step(matrix, slope, damping, shared, states, bounds)
            trial = objective.rollout(next_shared, next_states)
            trial_parts = objective.parts(trial)
            if objective.value(trial_parts) < history[-1]:
                accepted = True
                break
            damping *= 6
        if not accepted:
            stopped = "no lower point along the step"
            break
        shared, states, rollout, parts = next_shared, next_states, trial, trial_parts
        damping = max(damping / 5, 1e-4)
        history.append(objective.value(parts))
        if history[-2] - history[-1] < SMALLEST_FALL * history[-2]:
            stopped = "small fall"
            break
    return Refined(shared, states, before, parts, history, stopped)


def _step(
    matrix: Tensor, slope: Tensor, damping: float, shared: Tensor, states: Tensor, bounds: Tensor
) -> tuple[Tensor, Tensor]:
    """Return parameters and states after one damped step; a parameter that a bound stops takes no part."""
    count = len(shared)
    blocked = torch.zeros(len(slope), dtype=torch.bool)
    blocked[:count] = ((shared <= bounds[:, 0]) & (slope[:count] > 0)) | (
        (shared >= bounds[:, 1]) & (slope[:count] < 0)
    )
    free = (~blocked).double()
    diagonal = matrix.diagonal().clamp_min(1e-12)
    system = matrix * free[:, None] * free + torch.diag(damping * diagonal + (1 - free) * diagonal)
    step = -torch.linalg.solve(system, slope * free)
    moved = (shared + step[:count]).clamp(bounds[:, 0], bounds[:, 1])
    return moved, states + step[count:].view_as(states)
