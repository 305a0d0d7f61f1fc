"""CEM + MuJoCo + R: MuJoCo's contact numbers and the start state by the cross-entropy method on the image loss.

The rival that needs no derivatives: rollouts of MuJoCo, rendered with the same splats (`ImageLoss`, the loss and frames
of `cgwm fit`), the best of each generation kept. Its fair chance: the start is that of cgwm's own pose tracks, within
their uncertainty; the first samples come from the same priors as cgwm's; the first half of the generations looks at
small pictures, which cost less; the size of a generation is what the budget allows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.trajectories.residuals import retract
from cgwm.schemas import NotConvergedError

from .base import Array, Cell, Prediction
from .mujoco_world import ContactNumbers, MujocoWorld
from .training import Training, checked, find_poses, observed, open_training, small_pictures, starts

NUMBERS = ("friction", "friction_driven", "time_constant_s", "damping_ratio")
CENTER, SPREAD = np.log([0.3, 0.3, 0.0033 / 0.4, 0.4]), np.array([0.5, 0.5, 0.6, 0.6])
"""First samples, of the logarithms: cgwm's priors of friction, contact time over damping ratio, and damping ratio."""
LOW, HIGH = np.log([0.01, 0.01, 2e-3, 0.02]), np.log([2.0, 2.0, 0.1, 3.0])
POPULATION = (16, 128)
GENERATIONS = 12
ELITES = 1 / 8
"""Share of a generation that the next one is drawn from; at least 4."""
SMOOTHING = 0.5
"""Share of the old mean and spread that a generation keeps, so that it does not collapse early."""
FREE_BUDGET_S = 60.0
"""Without a budget: for tests."""


@dataclass(frozen=True)
class CemMujoco:
    """MuJoCo with the object's true shape and mass distribution, or with the splats' collision spheres.

    solid: reads the true solid of a capture; None: the learned shape. generations: of the search.
    """

    name: str
    solid: Callable[[Path], SolidObject] | None = None
    generations: int = GENERATIONS

    def fit(self, cell: Cell, budget_s: float | None) -> FittedMujoco:
        """Search until the generations or the budget are spent; one generation is always finished.

        Raises:
            InputDataError, NotConvergedError: See `open_training` and `find_poses`; if every rollout diverges.
        """
        started = time.perf_counter()
        training = open_training(cell)
        solids = {} if self.solid is None else {OBJECT: self.solid(cell.capture)}
        simulator = MujocoWorld(training.world, solids)
        found = observed(training, find_poses(training, cell))
        tracked = time.perf_counter() - started
        search = _Search(training, small_pictures(training, cell), simulator, found.start, found.root)
        guesses = starts(found)
        best, record = search.run(guesses, cell.seed, self.generations, (budget_s or FREE_BUDGET_S) - tracked)
        numbers = ContactNumbers(*np.exp(best[: len(NUMBERS)]).tolist())
        parameters = {name: float(getattr(numbers, name)) for name in NUMBERS}
        if not training.drives:
            del parameters["friction_driven"]
        # MuJoCo's solref: the natural time is the time constant times the damping ratio
        parameters["contact_time_s"] = numbers.time_constant_s * numbers.damping_ratio
        record |= {"parameters": parameters, "seconds_by_step": {"pose_tracks": round(tracked, 2)}}
        record["seconds"] = round(time.perf_counter() - started, 2)
        return FittedMujoco(simulator, numbers, record)


@dataclass(frozen=True, eq=False)
class FittedMujoco:
    """MuJoCo with fitted numbers."""

    simulator: MujocoWorld
    numbers: ContactNumbers
    record: dict[str, Any]

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop."""
        return checked(*self.simulator.rollout(self.numbers, start, drives, times_s))


@dataclass
class _Search:
    """The search; coordinates are the logarithms of `NUMBERS`, and the start's change in units of its uncertainty.

    start: from which the change counts; root (S, S): the factor of the covariance of that change.
    """

    training: Training
    small: Training
    simulator: MujocoWorld
    start: State
    root: Array
    evaluations: int = 0

    def run(
        self, guesses: Mapping[str, State], seed: int, generations: int, budget_s: float
    ) -> tuple[Array, dict[str, Any]]:
        """Return the best point that was seen, by the loss on the larger pictures, and a record."""
        begin = time.perf_counter()
        mean = np.concatenate([CENTER, np.zeros(len(self.root))])
        spread = np.concatenate([SPREAD, np.ones(len(self.root))])
        values = {}
        for name, self.start in guesses.items():
            values[name] = float(self.costs(mean[None], self.training)[0])
        each_s = (time.perf_counter() - begin) / len(guesses)
        chosen = min(values, key=lambda name: values[name])
        self.start, best, lowest = guesses[chosen], mean, values[chosen]
        affordable = max(budget_s - (time.perf_counter() - begin), 0.0) / each_s
        # half of the generations look at small pictures, which cost about a third
        population = int(np.clip(1.5 * affordable / generations, *POPULATION))
        elites = max(4, round(ELITES * population))
        rng, history, done, late = np.random.default_rng(seed), [lowest], 0, False
        while not late or done < 2:
            fine = done >= generations / 2 or (done > 0 and time.perf_counter() - begin > budget_s / 2)
            samples = mean + spread * rng.standard_normal((population, len(mean)))
            samples[0] = mean  # the fitted centre is judged, too
            samples[:, : len(NUMBERS)] = samples[:, : len(NUMBERS)].clip(LOW, HIGH)
            before = time.perf_counter()
            costs = self.costs(samples, self.training if fine else self.small)
            now, done = time.perf_counter(), done + 1
            order = np.argsort(costs, kind="stable")
            if not np.isfinite(costs[order[:elites]]).all():
                raise NotConvergedError("CEM: nearly every rollout of MuJoCo diverged.", todo="check masses and units.")
            if fine and costs[order[0]] < lowest:
                best, lowest = samples[order[0]], float(costs[order[0]])
            kept = samples[order[:elites]]
            mean = SMOOTHING * mean + (1 - SMOOTHING) * kept.mean(0)
            spread = SMOOTHING * spread + (1 - SMOOTHING) * kept.std(0)
            history.append(float(costs[order[0]]))
            late = now - begin + (now - before) > budget_s
        return best, {
            "evaluations": self.evaluations,
            "population": population,
            "generations": done,
            "start_state": chosen,
            "image_loss": {"first": history[0], "best": lowest, "history": history},
        }

    def costs(self, samples: Array, training: Training) -> Array:
        """Return the image loss (N,) of points (N, D)."""
        motions = [self._motion(sample) for sample in samples]
        self.evaluations += len(samples)
        position, quat = (torch.as_tensor(np.stack(values)) for values in zip(*motions, strict=True))
        return training.costs(position, quat).numpy()

    def _motion(self, sample: Array) -> tuple[Array, Array]:
        numbers = ContactNumbers(*np.exp(sample[: len(NUMBERS)]).tolist())
        change = torch.as_tensor(self.root @ sample[len(NUMBERS) :])[None]
        start = retract(self.start, change, self.training.world.free)
        return self.simulator.rollout(numbers, start, self.training.drives, self.training.times_s)
