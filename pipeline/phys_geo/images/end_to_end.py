"""End-to-end refinement of contact parameters, contact spheres and start states on the image loss of rollouts.

The renderer gives the exact gradient of the loss by the poses of every frame in reverse mode; rollouts give the
response of the poses to parameters, spheres and states by differences; the two are multiplied. Exact derivatives of the
rollout are unsuitable: for a body that rests on many spheres they grow by a third in every step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ....datasets.io.progress import progress
from ...geometry.rotation import quat_turn
from ...optimization.least_squares import Descent, Policy, Stop, descend
from ...optimization.levenberg_marquardt import robust_loss
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ...physics.engine import rollouts_at_once
from ...physics.observation_model import measure
from ...physics.parameters import Parameter, apply_parameters
from ...physics.rollout import Rollout
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.residuals import STATE_SIZE, STATE_STEPS, retract
from ...trajectories.track_noise import Noise
from .contact_spheres import ContactSpheres
from .image_loss import ImageLoss

TRACK_WEIGHT = 0.01
"""Cost of a mean track misfit of one standard deviation, as a share of the image loss at the start (choice of cgwm)."""
TRACK_ROBUST_SCALE = 4.0
"""Scale of the robust loss of tracks, in standard deviations."""
CURVATURE_BLUR = 8
"""Side of the squares over which the curvature (not the gradient) averages residuals [px]; without it the steps of the
L1 norm are tiny."""
ATTEMPTS = 7
"""Maximum number of dampings that are tried in a step."""
SMALLEST_FALL = 3e-4
"""Relative decrease of the objective in a step below which the refinement ends."""
PATIENCE = 2
"""Number of steps without a lower loss of the held-out frames after which the refinement ends."""
STOPPED = {
    Stop.CONVERGED: "small fall",
    Stop.NO_LOWER_COST: "no lower point along the step",
    Stop.ITERATIONS: "iterations",
    Stop.NOT_FINITE: "the rollouts diverge",
    Stop.WATCHER: "the frames held out are no longer explained better",
}
"""Reasons for the end, as they are reported."""
GEOMETRY_WEIGHT = 1e-5
"""Cost of moving a sphere by one standard deviation of its prior, as a share of the image loss at the start. It fixes
spheres that the motion does not identify, and hardly restrains the others (choice of cgwm)."""
PARAMETER_STEP, SPHERE_STEP = 0.03, 0.25
"""Steps of the differences: of a parameter (fitted coordinate), and of a sphere (standard deviations of its prior)."""


@dataclass(frozen=True)
class TrackTerm:
    """Measured tracks in addition to the images."""

    observations: Observations
    """Observations on the time grid of the images."""
    noise: Noise
    """Standard deviation of the tracks' errors: position [m], rotation [rad]."""


@dataclass(frozen=True, kw_only=True)
class ImageObjective:
    """Image loss of rollouts from a batch of episodes (B), with a track term where there is one."""

    world: World
    """The world."""
    parameters: Sequence[Parameter]
    """Fitted parameters (P)."""
    observations: Observations
    """Start states and time grids."""
    losses: Sequence[ImageLoss]
    """Image loss of each episode."""
    columns: Sequence[Tensor]
    """For each episode, the instants of its footage (row 0) and their frames in the grid (row 1), shape (2, k)."""
    held: Sequence[Tensor] = ()
    """As `columns`, for the held-out instants."""
    tracks: TrackTerm | None = None
    """Measured tracks that are matched in addition."""
    scale: float = 1.0
    """Unit of the objective: with tracks the image loss at the start, otherwise 1."""
    unit: float = 1.0
    """Objective at the start."""
    geometry: ContactSpheres | None = None
    """Contact spheres that are fitted too (G coordinates, which follow the parameters), or None."""

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

        Args:
            rollout: The rollouts.
            held: Use the held-out frames instead of the others, and no tracks.
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
        """Return the objective from its parts, with the cost of the moved spheres in `shared`."""
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
        """Return the curvature (B, T, 6 nf, 6 nf) of the image loss by poses, from re-weighted least squares."""
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
        """Return the Jacobian of the poses (B, T, 6 nf, P + G + S) by differences; coordinates of `PoseModel`."""
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
            turn = quat_turn(here[1], moved.quat_wxyz[:, :, free])
            columns.append(torch.cat([moved.position_m[:, :, free] - here[0], turn], -1).flatten(2))
        slopes = torch.cat(columns).unflatten(0, (batch, len(steps))) / steps[:, None, None]
        return torch.nan_to_num(slopes, posinf=0.0, neginf=0.0).movedim(1, -1)

    def normal_equations(
        self, shared: Tensor, states: Tensor, rollout: Rollout, curvature: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return matrix and gradient of the objective in P + G + B S unknowns: parameters, spheres, states."""
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
        """Return the mean robust misfit of the tracks, with its gradient and weights by the poses (B, T, 6 nf)."""
        shape = (*self.observations.times_s.shape, 6 * len(self.observations.free))
        if self.tracks is None:
            nothing = torch.zeros(shape, dtype=torch.float64)
            return nothing.sum(), nothing, nothing
        seen, free = self.tracks.observations, list(self.observations.free)
        against = replace(seen, position_m=rollout.position_m[:, :, free], quat_wxyz=rollout.quat_wxyz[:, :, free])
        rows = _difference(against, seen)
        variance = torch.tensor([sigma**2 for sigma in self.tracks.noise for _ in range(3)], dtype=torch.float64)
        measured = torch.stack([seen.seen] * 3 + [seen.has_orientation] * 3, -1)
        chi2 = (measured * rows.square() / variance).sum(-1)
        loss, weight = robust_loss(chi2, TRACK_ROBUST_SCALE)
        count = 6 * seen.seen.sum().clamp_min(1)
        scaled = (2 / count) * weight[..., None] * measured / variance
        return loss.sum() / count, (scaled * rows).flatten(2), scaled.flatten(2)


def _difference(poses: Observations, measured: Observations) -> Tensor:
    """Return the difference of poses from measured ones (B, T, nf, 6): shift [m], rotation vector [rad]."""
    turn = quat_turn(measured.quat_wxyz, poses.quat_wxyz)
    return torch.cat([poses.position_m - measured.position_m, turn], -1)


@dataclass(frozen=True, kw_only=True)
class Refined:
    """Result of the refinement."""

    shared: Tensor
    """Parameters and spheres in fitted coordinates, shape (P + G,)."""
    states: Tensor
    """Changes of the start states, shape (B, S)."""
    before: Tensor
    """Parts of the loss at the start: photometric, mask, tracks, shape (3,)."""
    after: Tensor
    """Parts of the loss at the returned step, shape (3,)."""
    history: list[float]
    """Objective at the start and after each step."""
    held: list[float]
    """Image loss of the held-out frames at the start and after each step; empty without such frames."""
    kept: int
    """Step that is returned: the one with the lowest loss of the held-out frames."""
    stopped: str
    """Reason for the end."""


def refine_end_to_end(
    objective: ImageObjective, shared: Tensor, states: Tensor, bounds: Tensor, iterations: int
) -> Refined:
    """Minimise the objective by damped Gauss-Newton steps, each accepted only if the true loss decreases.

    Args:
        objective: The objective.
        shared: Start of the parameters and spheres in fitted coordinates, shape (P + G,).
        states: Start of the state changes, shape (B, S).
        bounds: Bounds of the parameters and spheres, shape (P + G, 2).
        iterations: Maximum number of steps.
    """
    problem = _ImageProblem(objective, len(shared), states.shape, bounds)
    start = Point(values=torch.cat([shared, states.flatten()])[None])
    rollout, first = problem.rolled(start)
    points, parts = [start], [first]
    held = [float(objective.parts(rollout, held=True).sum())] if objective.held else []
    with progress(desc="phys-geo: images end to end", total=iterations) as bar:

        def watch(iteration: int, descent: Descent) -> bool:
            """Record an accepted step; True where the held-out frames have not been explained better for a while."""
            del iteration
            if int(descent.accepted[0]) < len(points):
                return False
            bar.update()
            rollout, found = problem.rolled(descent.point)
            points.append(descent.point)
            parts.append(found)
            if held:
                held.append(float(objective.parts(rollout, held=True).sum()))
            return bool(held) and len(held) - 1 - _best(held) >= PATIENCE

        policy = Policy(
            iterations=iterations * ATTEMPTS,
            steps=iterations,
            attempts=ATTEMPTS,
            damping=1e-2,
            least_damping=1e-4,
            relative=SMALLEST_FALL,
            linearise_end=False,
        )
        end = descend(problem, start, policy, watch)
    kept = _best(held) if held else len(points) - 1
    shared, states = problem.split(points[kept])
    return Refined(
        shared=shared,
        states=states,
        before=parts[0],
        after=parts[kept],
        history=end.costs,
        held=held,
        kept=kept,
        stopped=STOPPED[end.reasons[0]],
    )


def _best(held: Sequence[float]) -> int:
    """Return the first step with the lowest loss of the held-out frames."""
    return min(range(len(held)), key=held.__getitem__)


class _ImageProblem(Problem):
    """Parameters, spheres and all start states of an objective as one dense problem, without eliminated states.

    Args:
        objective: The objective.
        count: Number of parameters and spheres (P + G).
        shape: Shape of the state changes (B, S).
        bounds: Bounds of the parameters and spheres, shape (P + G, 2).
    """

    def __init__(self, objective: ImageObjective, count: int, shape: Sequence[int], bounds: Tensor) -> None:
        self.objective, self.count, self.shape = objective, count, tuple(shape)
        far = torch.full((math.prod(shape), 2), torch.inf).to(bounds) * torch.tensor([-1.0, 1.0]).to(bounds)
        self.owner = torch.zeros(1, dtype=torch.long)
        self.box = Box.within(torch.cat([bounds, far]))
        self.curvature: Tensor | None = None  # that of the image loss by poses, at the start
        self._last: tuple[Tensor, Rollout, Tensor] | None = None

    def split(self, point: Point) -> tuple[Tensor, Tensor]:
        """Return parameters and spheres (P + G,), and state changes (B, S)."""
        shared, states = point.values[0].split([self.count, math.prod(self.shape)])
        return shared, states.view(self.shape)

    def rolled(self, point: Point) -> tuple[Rollout, Tensor]:
        """Return the rollouts at a point and the parts of their loss; those of the last point are kept."""
        if self._last is None or not torch.equal(self._last[0], point.values):
            rollout = self.objective.rollout(*self.split(point))
            self._last = point.values, rollout, self.objective.parts(rollout)
        return self._last[1:]

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the objective (1,)."""
        del rows
        value = self.objective.value(self.rolled(point)[1], self.split(point)[0])
        return torch.tensor([value], dtype=torch.float64)

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations of the objective."""
        rollout, _ = self.rolled(point)
        if self.curvature is None:
            self.curvature = self.objective.curvature(rollout)
        matrix, slope = self.objective.normal_equations(*self.split(point), rollout, self.curvature)
        return NormalEquations.of_parameters(matrix[None], -slope[None], self.costs(point, rows))
