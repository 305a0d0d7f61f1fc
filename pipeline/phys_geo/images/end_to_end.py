"""End-to-end refinement: contact parameters, touching spheres and start states against the image loss of rollouts.

The renderer gives the exact gradient of the loss by the poses of every frame in reverse mode; the rollout gives how the
poses answer to parameters, spheres and states, by differences; the two are multiplied. Derivatives of the rollout
would be exact too and of no use: those of a body that rests on many spheres grow by a third in every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...datasets.progress import progress
from ..estimation.least_squares import bound_stops, robust_loss
from ..estimation.observations import Observations
from ..estimation.trajectory import STATE_SIZE, STATE_STEPS, retract
from ..physics.dispatch import rollouts_at_once
from ..physics.measured import measure
from ..physics.parameters import Parameter, apply_parameters
from ..physics.rollout import Rollout
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply
from ..physics.world import World
from .image_loss import ImageLoss
from .touching import TouchingSpheres

TRACK_WEIGHT = 0.01
"""With tracks too: a mean misfit of one sigma costs this share of the image loss at the start (choice of cgwm)."""
TRACK_ROBUST_SCALE = 4.0
CURVATURE_BLUR = 8
"""Pixels over which the curvature (not the gradient) averages residuals: without it the L1 norm's steps are tiny."""
ATTEMPTS = 7
SMALLEST_FALL = 3e-4
"""The refinement ends when the objective falls by less than this fraction."""
PATIENCE = 2
"""It also ends after so many steps without a lower loss of the frames that are held out."""
GEOMETRY_WEIGHT = 1e-5
"""Share of the image loss at the start that a sphere costs which is moved by its prior's width: it holds those that
the motion does not tell about, and lets those move that it does (choice of cgwm)."""
PARAMETER_STEP, SPHERE_STEP = 0.03, 0.25
"""Differences of a parameter (fitted coordinate) and of a sphere (in widths of its prior)."""


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
        held: The same of the instants that are held out.
        tracks: Measured tracks to be matched as well.
        scale: Unit of the objective: the image loss at the start, with tracks; else 1.
        unit: The objective at the start.
        geometry: Spheres that are fitted too (G coordinates, which follow the parameters), or None.
    """

    world: World
    parameters: Sequence[Parameter]
    observations: Observations
    losses: Sequence[ImageLoss]
    columns: Sequence[Tensor]
    held: Sequence[Tensor] = ()
    tracks: TrackTerm | None = None
    scale: float = 1.0
    unit: float = 1.0
    geometry: TouchingSpheres | None = None

    @property
    def moved(self) -> int:
        """Number of coordinates of spheres (G)."""
        return 0 if self.geometry is None else self.geometry.count

    def rollout(self, shared: Tensor, states: Tensor) -> Rollout:
        """Return the rollouts of parameters and spheres (P + G,), in fitted coordinates, and state changes (B, S)."""
        with torch.no_grad():
            return self._rolled(shared.expand(len(states), -1), states, list(range(len(states))))

    def _rolled(self, shared: Tensor, states: Tensor, items: list[int]) -> Rollout:
        """Return rollouts of parameters and spheres (K, P + G) and state changes (K, S) of episodes (K)."""
        count, seen = len(self.parameters), self.observations.select(items)
        values = torch.stack([p.decode(shared[:, k]) for k, p in enumerate(self.parameters)], -1)
        world = apply_parameters(self.world, self.parameters, values)
        if self.geometry is not None:
            world = self.geometry.apply(world, shared[:, count:])
        return measure(world, retract(seen.state, states, seen.free), seen.times_s, seen.drives)

    def parts(self, rollout: Rollout, held: bool = False) -> Tensor:
        """Return the loss by parts (3,): photometric, mask, tracks; infinite if the rollout blew up.

        held: Of the frames that are held out, instead of the others; without tracks.
        """
        images = torch.zeros(2, dtype=torch.float64)
        columns = self.held if held else self.columns
        count = sum(pair.shape[1] for pair in columns)
        for item, (loss, (instants, frames)) in enumerate(zip(self.losses, columns, strict=True)):
            position, quat = rollout.position_m[item, frames], rollout.quat_wxyz[item, frames]
            if not bool(position.isfinite().all()) or not bool(quat.isfinite().all()):
                return torch.full((3,), torch.inf)
            with torch.no_grad():
                images += loss.parts(instants, position, quat).sum(0).double().cpu() / count
        if held:
            return torch.cat([images, images.new_zeros(1)])
        tracks, _, _ = self._tracks(rollout)
        return torch.cat([images, tracks[None]])

    def value(self, parts: Tensor, shared: Tensor) -> float:
        """Return the objective of parts, with what the spheres (in `shared`) cost that were moved."""
        held_back = GEOMETRY_WEIGHT * self.unit * float(shared[len(self.parameters) :].square().sum())
        return float(parts[:2].sum()) / self.scale + TRACK_WEIGHT * float(parts[2]) + held_back

    def gradient(self, rollout: Rollout) -> Tensor:
        """Return the exact gradient (B, T, 6 nf) of the image loss by the free bodies' poses at the grid's frames."""
        batch, length = self.observations.times_s.shape
        slope = torch.zeros(batch, length, 6 * len(self.observations.free), dtype=torch.float64)
        count = sum(pair.shape[1] for pair in self.columns)
        for item, (loss, (instants, frames)) in enumerate(zip(self.losses, self.columns, strict=True)):
            _, part = loss.gradient(instants, rollout.position_m[item, frames], rollout.quat_wxyz[item, frames])
            slope[item, frames] = part.double().cpu() / count
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
            curvature[item, frames] = model.curvature.double().cpu() / count
        return curvature

    def jacobian(self, shared: Tensor, states: Tensor, rollout: Rollout) -> Tensor:
        """Return how the poses change (B, T, 6 nf, P + G + S), by differences; coordinates of `PoseModel`."""
        batch, size = states.shape
        steps = torch.cat(
            [
                torch.full((len(self.parameters),), PARAMETER_STEP),
                torch.full((self.moved,), SPHERE_STEP),
                torch.tensor([step for step in STATE_STEPS for _ in range(3)]).repeat(size // STATE_SIZE),
            ]
        ).to(shared)
        inputs = torch.cat([shared.expand(batch, -1), states], 1)
        changed = (inputs[:, None] + torch.diag(steps)).flatten(0, 1)
        items = [item for item in range(batch) for _ in range(len(steps))]
        free, columns = list(self.observations.free), []
        chunk = rollouts_at_once(self.world)
        for first in range(0, len(items), chunk):
            rows, some = changed[first : first + chunk], items[first : first + chunk]
            with torch.no_grad():
                moved = self._rolled(rows[:, : len(shared)], rows[:, len(shared) :], some)
            here = [rollout.position_m[some][:, :, free], rollout.quat_wxyz[some][:, :, free]]
            turn = quat_log(quat_multiply(quat_conjugate(here[1]), moved.quat_wxyz[:, :, free]))
            columns.append(torch.cat([moved.position_m[:, :, free] - here[0], turn], -1).flatten(2))
        slopes = torch.cat(columns).unflatten(0, (batch, len(steps))) / steps[:, None, None]
        return torch.nan_to_num(slopes, posinf=0.0, neginf=0.0).movedim(1, -1)

    def normal_equations(
        self, shared: Tensor, states: Tensor, rollout: Rollout, curvature: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return matrix and gradient of the objective in (P + G + B S) unknowns: parameters, spheres, each state."""
        jacobian = self.jacobian(shared, states, rollout)
        _, track_slope, track_weight = self._tracks(rollout)
        slope = self.gradient(rollout) / self.scale + TRACK_WEIGHT * track_slope
        blocks = curvature / self.scale + TRACK_WEIGHT * torch.diag_embed(track_weight)
        local = torch.einsum("btdi,btde,btej->bij", jacobian, blocks, jacobian)
        local_slope = torch.einsum("btdi,btd->bi", jacobian, slope)
        count, (batch, size) = len(shared), states.shape
        matrix = torch.zeros(count + batch * size, count + batch * size, dtype=torch.float64)
        vector = torch.zeros(count + batch * size, dtype=torch.float64)
        for item in range(batch):
            first = count + item * size
            index = torch.cat([torch.arange(count), torch.arange(first, first + size)])
            matrix[index[:, None], index] += local[item]
            vector[index] += local_slope[item]
        spheres = torch.arange(len(self.parameters), count)
        matrix[spheres, spheres] += 2 * GEOMETRY_WEIGHT * self.unit
        vector[spheres] += 2 * GEOMETRY_WEIGHT * self.unit * shared[spheres]
        return matrix, vector

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
    """Where the refinement ended.

    shared (P + G,), states (B, S); before, after (3,): parts of the loss; history: of the objective; held: the image
    loss of the frames held out, after every step, empty without such frames; kept: the step that is returned, which
    has the lowest of them; stopped: why it ended.
    """

    shared: Tensor
    states: Tensor
    before: Tensor
    after: Tensor
    history: list[float]
    held: list[float]
    kept: int
    stopped: str


def refine_end_to_end(
    objective: ImageObjective, shared: Tensor, states: Tensor, bounds: Tensor, iterations: int
) -> Refined:
    """Lower the objective by damped Gauss-Newton steps; a step is kept only if the true loss falls.

    Args:
        objective: What is to fall.
        shared: Start of the parameters and spheres in fitted coordinates, shape (P + G,).
        states: Start of the state changes, shape (B, S).
        bounds: Bounds of the parameters and spheres, shape (P + G, 2).
        iterations: Most steps.
    """
    rollout = objective.rollout(shared, states)
    before = parts = objective.parts(rollout)
    history, damping, stopped = [objective.value(parts, shared)], 1e-2, "iterations"
    held = [float(objective.parts(rollout, held=True).sum())] if objective.held else []
    kept, best = 0, (shared, states, parts)
    curvature = objective.curvature(rollout)
    for step in progress(range(iterations), "phys-geo: images end to end", iterations):
        matrix, slope = objective.normal_equations(shared, states, rollout, curvature)
        accepted = False
        for _ in range(ATTEMPTS):
            next_shared, next_states = _step(matrix, slope, damping, shared, states, bounds)
            trial = objective.rollout(next_shared, next_states)
            trial_parts = objective.parts(trial)
            if objective.value(trial_parts, next_shared) < history[-1]:
                accepted = True
                break
            damping *= 6
        if not accepted:
            stopped = "no lower point along the step"
            break
        shared, states, rollout, parts = next_shared, next_states, trial, trial_parts
        damping = max(damping / 5, 1e-4)
        history.append(objective.value(parts, shared))
        if held:
            held.append(float(objective.parts(rollout, held=True).sum()))
        if not held or held[-1] < held[kept]:
            kept, best = step + 1, (shared, states, parts)
        if history[-2] - history[-1] < SMALLEST_FALL * history[-2]:
            stopped = "small fall"
            break
        if step + 1 - kept >= PATIENCE:
            stopped = "the frames held out are no longer explained better"
            break
    return Refined(best[0], best[1], before, best[2], history, held, kept, stopped)


def _step(
    matrix: Tensor, slope: Tensor, damping: float, shared: Tensor, states: Tensor, bounds: Tensor
) -> tuple[Tensor, Tensor]:
    """Return shared numbers and states after one damped step; a number that a bound stops takes no part."""
    count = len(shared)
    free = torch.ones_like(slope)
    free[:count] = (~bound_stops(shared, -slope[:count], bounds)).double()
    diagonal = matrix.diagonal().clamp_min(1e-12)
    system = matrix * free[:, None] * free + torch.diag(damping * diagonal + (1 - free) * diagonal)
    step = -torch.linalg.solve(system, slope * free)
    moved = (shared + step[:count]).clamp(bounds[:, 0], bounds[:, 1])
    return moved, states + step[count:].view_as(states)
