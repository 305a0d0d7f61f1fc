"""A physics-informed rival in the manner of PIN-WM (arXiv 2504.16693): not its code, and not its engine.

What it has of PIN-WM: fixed geometry and looks, a differentiable rigid-body simulator, and Adam on the loss of
rendered frames alone, 100 iterations from prior values. What is ours: the contact law (cgwm's closed form instead of
a complementarity problem on meshes), the renderer (the same spheres as everybody's), the loss (cgwm's: L1 and, so
that all see the same data, silhouettes), and a start that is fitted, too, from that of cgwm's pose tracks. The gradient
is the renderer's by the poses, which is exact, times the rollout's Jacobian by differences, as cgwm's own refinement
has it. Mass is given, so it is not fitted.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.phys_geo.images.end_to_end import ImageObjective
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, apply_parameters
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.schemas import NotConvergedError
from torch import Tensor

from .base import Array, Cell, Prediction
from .training import Found, Training, find_poses, observed, open_training, rolled_out, starts

ITERATIONS = 100
STEP_S = 0.002
"""Half as many steps as cgwm takes, for twice as many iterations; PIN-WM's own are 4.2 ms."""
RATE, START_RATE = 0.05, 0.1
"""Adam's rates: of the logarithms of the contact numbers, and of the start in units of its uncertainty."""
MAX_SLOPE = 10.0
"""Longest gradient: through impacts it can be anything."""


@dataclass(frozen=True)
class PinWm:
    """Adam on the image loss; geometry stays as it is."""

    name: str
    iterations: int = ITERATIONS

    def fit(self, cell: Cell, budget_s: float | None) -> FittedPinWm:
        """Descend until the iterations or the budget are spent, and keep the best point that was seen.

        Raises:
            InputDataError, NotConvergedError: See `open_training` and `find_poses`; if the first rollouts diverge.
        """
        started = time.perf_counter()
        training = open_training(cell)
        training = replace(training, world=replace(training.world, step_s=STEP_S))
        found = observed(training, find_poses(training, cell))
        tracked = time.perf_counter() - started
        problem = _best_start(training, found)
        point = problem.first()
        optimizer = torch.optim.Adam(
            [
                {"params": [point[0]], "lr": RATE},
                {"params": [point[1]], "lr": START_RATE},
            ]
        )
        best, lowest = [part.clone() for part in point], float("inf")
        history: list[float] = []
        for _ in range(self.iterations):
            before = time.perf_counter()
            value, slopes = problem.value_and_slope(*point)
            history.append(value)
            if value < lowest:
                best, lowest = [part.clone() for part in point], value
            length = float(torch.cat(slopes).norm())
            if not (length < float("inf")):
                break  # the descent is lost; the best point stays
            scale = min(1.0, MAX_SLOPE / max(length, 1e-12))
            for part, slope in zip(point, slopes, strict=True):
                part.grad = scale * slope
            optimizer.step()
            point[0].clamp_(*problem.limits)
            now = time.perf_counter()
            if budget_s is not None and now - started + (now - before) > budget_s:
                break
        world = problem.world(best[0])
        law = {p.name: float(p.decode(best[0][k])) for k, p in enumerate(CONTACT_PARAMETERS)}
        record = {
            "parameters": law,
            "evaluations": len(history),
            "start_state": problem.name,
            "image_loss": {"first": history[0], "best": lowest, "history": history},
            "seconds_by_step": {"pose_tracks": round(tracked, 2)},
            "seconds": round(time.perf_counter() - started, 2),
        }
        return FittedPinWm(world, record)


@dataclass(frozen=True, eq=False)
class FittedPinWm:
    """The world with the fitted contact law."""

    fitted: World
    record: dict[str, Any]

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop."""
        return rolled_out(self.fitted, start, drives, times_s)


@dataclass(frozen=True)
class _Problem:
    """The image loss as a function of contact numbers (P,), encoded, and the start's change (S,), in root units."""

    name: str
    training: Training
    objective: ImageObjective
    root: Tensor

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Bounds of the contact numbers."""
        low, high = torch.tensor([p.limits for p in CONTACT_PARAMETERS], dtype=torch.float64).T
        return low, high

    def first(self) -> list[Tensor]:
        """Return the priors' centres, and no change of the start."""
        numbers = [p.encode(p.prior[0]) for p in CONTACT_PARAMETERS]
        return [torch.tensor(numbers, dtype=torch.float64), torch.zeros(len(self.root), dtype=torch.float64)]

    def world(self, numbers: Tensor) -> World:
        """Return the world with these contact numbers."""
        values = torch.stack([p.decode(z) for p, z in zip(CONTACT_PARAMETERS, numbers, strict=True)])
        return apply_parameters(self.training.world, CONTACT_PARAMETERS, values[None])

    def value(self) -> float:
        """Return the loss at the first point."""
        numbers, change = self.first()
        rollout = self.objective.rollout(numbers, (self.root @ change)[None])
        return float(self.training.costs(rollout.position_m, rollout.quat_wxyz)[0])

    def value_and_slope(self, numbers: Tensor, change: Tensor) -> tuple[float, list[Tensor]]:
        """Return the loss and its gradient (of the rollout by differences); infinite where the rollout diverges."""
        states = (self.root @ change)[None]
        rollout = self.objective.rollout(numbers, states)
        position, quat = rollout.position_m[0], rollout.quat_wxyz[0]
        if not bool(position.isfinite().all()) or not bool(quat.isfinite().all()):
            return float("inf"), [torch.full_like(numbers, torch.inf), torch.full_like(change, torch.inf)]
        count = len(position)
        values, slope = self.training.loss.gradient(torch.arange(count), position, quat)
        jacobian = self.objective.jacobian(numbers, states, rollout)[0]
        total = torch.einsum("tdp,td->p", jacobian, slope.double().cpu() / count)
        size = len(numbers)
        return float(values.mean()), [total[:size], self.root.T @ total[size:]]


def _best_start(training: Training, found: Found) -> _Problem:
    """Return the problem whose start explains the frames best at the priors' centres."""
    every = torch.arange(len(training.times_s)).repeat(2, 1)
    problems = []
    for name, state in starts(found).items():
        observations = replace(found.observations, state=state)
        objective = ImageObjective(
            world=training.world,
            parameters=CONTACT_PARAMETERS,
            observations=observations,
            losses=[training.loss],
            columns=[every],
        )
        problems.append(_Problem(name, training, objective, torch.as_tensor(found.root)))
    values = [problem.value() for problem in problems]
    if min(values) == float("inf"):
        raise NotConvergedError("PIN-WM: the rollouts from prior values diverge.", todo="check masses and units.")
    return problems[values.index(min(values))]
