"""The controller of a finger: measured states in, commands by joint name out, without a simulator behind it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...datasets.models.model import Model, read_model
from ...schemas import JOINTS, ControlTask, SolverName, UsageError, read_task
from ..physics.model_world import world_of_model
from ..physics.world import World
from ..runtime.device import resolve_device
from ..synthesize.parameters import draw_parameters, with_correlations
from ..synthesize.simulator import joined_worlds
from .horizon import Horizon, Targets
from .objective import PushObjective, Worlds
from .planning import ControlPlan, ControlState, Forecast, PlanningController
from .solvers import Mppi, solver_of
from .task_world import TaskWorld, task_world

__all__ = ["ControlPlan", "ControlState", "Controller", "Forecast", "drawn_worlds"]

_BATCHES = 16
"""Batches of worlds that are kept."""


class Controller(PlanningController):
    """A controller of a task.

    Args:
        model: The fitted model, or its directory.
        task: The task, or its file.
        solver: mppi, gauss-newton or both.
        seed: Seed of everything random: equal seeds and states give equal commands on the CPU.
        draws: Number of draws of the model's uncertainty that each plan is evaluated under; 0 for the estimate alone.
        device: Device of the predictions: auto, cpu or cuda.

    Raises:
        InputDataError: If the model cannot serve the task, see `task_world`.
        UsageError: If the device is not there, or numbers are out of range.
    """

    def __init__(
        self,
        model: Model | Path | str,
        task: ControlTask | Path | str,
        solver: SolverName = "mppi",
        seed: int = 0,
        draws: int = 0,
        device: str = "cpu",
    ) -> None:
        model = model if isinstance(model, Model) else read_model(model)
        task = task if isinstance(task, ControlTask) else read_task(Path(task))
        require_draws(draws)
        self.task_world: TaskWorld = task_world(model, task)
        self.task = task
        where = str(resolve_device(device))
        found = self.task_world

        def planned(drawn: Model | None) -> World:
            return found.planning(None if drawn is None else world_of_model(drawn, geometry=found.world))

        worlds = drawn_worlds(found.model, draws, seed, where, planned)
        super().__init__(task.planner, worlds, solver_of(solver, Mppi(task.planner.samples)), where, seed)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of targets."""
        return JOINTS

    def limits(self, joint: str) -> tuple[float, float, float]:
        """Return the smallest and the largest target of a joint [m], and its largest speed [m/s]."""
        return (*self.task.limits.joints[joint], self.task.limits.speed_m_s)

    def _objective(self, state: ControlState, acts_s: float) -> tuple[PushObjective, Tensor]:
        """Return the objective of a plan, and the plan before over its pieces, shape (N, joints)."""
        planner = self.task.planner
        horizon = Horizon.of(state.time_s, acts_s, planner.horizon_s, planner.knots)
        measured = np.array([state.joints[name] for name in JOINTS])
        before = self._plan.targets if self._plan else Targets(times_s=horizon.times_s[:1], values_m=measured[None])
        finger = before.at(state.time_s)  # the target, which the servo follows: the model's finger has no servo
        speeds = before.speeds(horizon.times_s)
        zero = np.zeros(3)
        objective = PushObjective(
            task_world=self.task_world,
            worlds=self._worlds,
            state=self.task_world.state(
                state.position_m,
                np.asarray(state.quat_wxyz, float) / np.linalg.norm(state.quat_wxyz),
                finger,
                zero if state.velocity_m_s is None else state.velocity_m_s,
                zero if state.omega_body_rad_s is None else state.omega_body_rad_s,
            ),
            horizon=horizon,
            given_m_s=speeds[: horizon.given],
        )
        return objective, torch.as_tensor(speeds[horizon.given :])


def require_draws(draws: int) -> None:
    """Refuse a negative number of draws."""
    if draws < 0:
        raise UsageError(f"{draws} draws.", "0 or more.", todo="give 0 for the mean parameters, or more.")


def drawn_worlds(
    model: Model, draws: int, seed: int, device: str, planned: Callable[[Model | None], World], estimate: bool = False
) -> Worlds:
    """Return the worlds of the predictions: that of the estimate, or of draws from the fit's posterior.

    The tensors of a world for a GPU stay on the CPU, from which a batch is copied in one piece.

    Args:
        model: The model.
        draws: Number of draws; 0 for the estimate alone.
        seed: Seed of the draws.
        device: cpu or cuda.
        planned: Returns the world of predictions of a draw of the model; for None that of the estimate.
        estimate: Whether the estimate comes before the draws.
    """
    rolls_on = None if device == "cpu" else device
    if draws == 0:
        one = replace(planned(None), rolls_on=rolls_on)
        return Worlds(batch=lambda rows: one, draws=1)
    rng = np.random.default_rng([seed, 2])
    file = with_correlations(model)
    names = [parameter.name for parameter in file.parameters]
    # one quantile of each parameter in each of K equal parts, as few draws should cover what is possible
    parts = (rng.permuted(np.tile(np.arange(draws), (len(names), 1)), axis=1) + rng.random((len(names), draws))) / draws
    drawn = [draw_parameters(file, 1.0, rng, quantiles=dict(zip(names, part, strict=True)))[0] for part in parts.T]
    worlds = [planned(replace(model, file=one)) for one in drawn]
    if estimate:
        worlds = [planned(None), *worlds]

    @lru_cache(_BATCHES)
    def batch(rows: tuple[int, ...]) -> World:
        return replace(joined_worlds([worlds[row] for row in rows or (0,)]), rolls_on=rolls_on)

    return Worlds(batch=batch, draws=len(worlds))
