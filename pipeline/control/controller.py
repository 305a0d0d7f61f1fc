"""A controller without a simulator behind it: measured states in, commands by joint name out."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...datasets.models.model import Model, read_model
from ...schemas import JOINTS, ControlTask, NotConvergedError, SolverName, UsageError, read_task
from ..physics.fused.host import lacking
from ..physics.world import World
from ..runtime.device import resolve_device
from ..runtime.resources import one_torch_thread
from ..synthesize.parameters import draw_parameters, with_correlations
from ..synthesize.simulator import joined_worlds
from .horizon import Array, Horizon, Targets
from .objective import PushObjective, Worlds
from .proposals import PushProposals
from .solvers import solver_of
from .task_world import TaskWorld, task_world

UNIT_TOLERANCE = 0.01
"""Largest deviation of a measured quaternion's length from 1."""
_BATCHES = 16


@dataclass(frozen=True, kw_only=True)
class ControlState:
    """A measured state."""

    time_s: float
    """Time at which it was measured [s]; a state that is not later than the one before is stale."""
    joints: Mapping[str, float]
    """Position of each joint by name [m]."""
    position_m: Array
    """Origin of the object's frame, world frame [m], shape (3,)."""
    quat_wxyz: Array
    """Orientation of the object, body to world, shape (4,)."""
    velocity_m_s: Array | None = None
    """Velocity of that origin, world frame [m/s], shape (3,); None: at rest."""
    omega_body_rad_s: Array | None = None
    """Angular velocity, body frame [rad/s], shape (3,); None: at rest."""

    def fault(self) -> str:
        """Return what is wrong with the numbers of the state, in words; empty for nothing."""
        for name, size in (("position_m", 3), ("quat_wxyz", 4), ("velocity_m_s", 3), ("omega_body_rad_s", 3)):
            value = getattr(self, name)
            if value is not None and (np.shape(value) != (size,) or not np.isfinite(value).all()):
                return f"{name} is not {size} finite numbers"
        if abs(np.linalg.norm(self.quat_wxyz) - 1) > UNIT_TOLERANCE:
            return "quat_wxyz has not the length 1"
        wrong = [name for name in JOINTS if not math.isfinite(self.joints.get(name, math.nan))]
        if wrong:
            return f"joint '{wrong[0]}' has no finite position"
        return "" if math.isfinite(self.time_s) else "time_s is not finite"


@dataclass(frozen=True, kw_only=True)
class ControlPlan:
    """Commands for the time to come, and what the model predicts of them."""

    state_s: float
    """Time of the state that it was made from [s]."""
    acts_s: float
    """Time from which it acts [s]; until then it has the targets of the plan before."""
    targets: Targets
    """Targets of the joints over the horizon."""
    cost: float
    """Cost of the plan."""
    wall_s: float
    """Wall time that it took [s]."""
    cpu_s: float
    """Time of all processors that it took [s]."""


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What the model predicts of a plan."""

    times_s: Array
    """Times [s], shape (M + 1,)."""
    position_m: Array
    """Position of the object [m], shape (M + 1, 3)."""
    quat_wxyz: Array
    """Its orientation, body to world, shape (M + 1, 4)."""


class Controller:
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
        if draws < 0:
            raise UsageError(f"{draws} draws.", "0 or more.")
        self.task_world: TaskWorld = task_world(model, task)
        self.task = task
        self.held = 0
        """States until now that were missing, stale or no numbers."""
        self._solver = solver_of(solver, task.planner.samples)
        self._device = str(resolve_device(device))
        self._worlds = _worlds(self.task_world, draws, seed, self._device)
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Forget all plans and states, and begin with another seed."""
        self._rng = np.random.default_rng([seed, 1])
        self._plan: ControlPlan | None = None
        self._found: tuple[PushObjective, Tensor] | None = None
        self._command: dict[str, float] = {}
        self._last_s, self._bad, self.held = -math.inf, 0, 0

    @property
    def interval_s(self) -> float:
        """Length of a command [s]."""
        return 1 / self.task.planner.control_hz

    @property
    def lost(self) -> bool:
        """Whether so many states in a row were bad that a run has to stop."""
        return self._bad >= self.task.planner.bad_states

    @property
    def slow(self) -> str:
        """Why predictions run in the slow engine, in words; empty where they do not."""
        world = self._worlds.batch((0,) if self._worlds.draws > 1 else ())
        return "" if self._device != "cpu" else lacking(world) or ""

    def command(self, state: ControlState | None) -> dict[str, float]:
        """Return the targets of the joints at the end of the next command's interval [m], by joint name.

        A state that is missing, stale or no numbers holds the last command, and is counted in `held`. Before the first
        good state there is no command, and the result is empty.

        Args:
            state: The measured state; None where there is none.

        Raises:
            NotConvergedError: If `bad_states` states in a row were bad; the robot should stop.
        """
        plan = self.plan(state)
        if self.lost:
            raise NotConvergedError(
                f"{self._bad} states in a row are missing, stale or no numbers.",
                todo="stop the robot, and check what measures the state.",
            )
        if plan is None:
            return dict(self._command)
        before = self._command or (state.joints if state is not None else {})
        self._command = self.limited(before, plan.targets.at(plan.acts_s + self.interval_s))
        return dict(self._command)

    def limited(self, before: Mapping[str, float], wanted: Array) -> dict[str, float]:
        """Return targets within all limits.

        Args:
            before: The targets before, by joint; empty for none.
            wanted: The wanted targets [m], shape (joints,).
        """
        found, reach = {}, self.task.limits.speed_m_s * self.interval_s
        for name, value in zip(JOINTS, map(float, wanted), strict=True):
            low, high = self.task.limits.joints[name]
            last = before.get(name, value)
            found[name] = min(max(min(max(value, last - reach), last + reach), low), high)
        return found

    @one_torch_thread()
    def plan(self, state: ControlState | None, acts_s: float | None = None) -> ControlPlan | None:
        """Return a plan from a measured state; None for a state that is missing, stale or no numbers.

        Args:
            state: The measured state.
            acts_s: Time from which the plan will act [s], by default that of the state.
        """
        if state is None or state.fault() or state.time_s <= self._last_s:
            self.held += 1
            self._bad += 1
            return None
        self._bad, self._last_s = 0, state.time_s
        wall, cpu = time.perf_counter(), time.process_time()
        objective, warm = self._objective(state, state.time_s if acts_s is None else acts_s)
        found = self._solver.solve(objective, warm, PushProposals(objective=objective).draw, self._rng)
        self._found = objective, found.values
        self._plan = ControlPlan(
            state_s=state.time_s,
            acts_s=float(objective.horizon.chosen_s[0]),
            targets=objective.targets(found.values),
            cost=found.cost,
            wall_s=time.perf_counter() - wall,
            cpu_s=time.process_time() - cpu,
        )
        return self._plan

    @torch.no_grad()
    def forecast(self) -> Forecast:
        """Return what the model predicts of the last plan.

        Raises:
            UsageError: Before the first plan.
        """
        if self._found is None:
            raise UsageError("a forecast before the first plan.", todo="call plan(state) first.")
        objective, values = self._found
        motion = objective.predicted(values[None], torch.zeros(1, dtype=torch.long))
        index = self.task_world.object
        return Forecast(
            times_s=objective.horizon.times_s,
            position_m=motion.position_m[0, :, index].numpy(),
            quat_wxyz=motion.quat_wxyz[0, :, index].numpy(),
        )

    def _objective(self, state: ControlState, acts_s: float) -> tuple[PushObjective, Tensor]:
        """Return the objective of a plan, and the plan before over its pieces, shape (N, joints)."""
        planner = self.task.planner
        horizon = Horizon.of(state.time_s, max(acts_s, state.time_s), planner.horizon_s, planner.knots)
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


def _worlds(found: TaskWorld, draws: int, seed: int, device: str) -> Worlds:
    """Return the worlds of the predictions: that of the estimate, or of draws from the fit's posterior.

    The tensors of a world for a GPU stay on the CPU, from which a batch is copied in one piece.
    """
    rolls_on = None if device == "cpu" else device
    if draws == 0:
        one = replace(found.planning(), rolls_on=rolls_on)
        return Worlds(batch=lambda rows: one, draws=1)
    rng = np.random.default_rng([seed, 2])
    file = with_correlations(found.model)
    drawn = [replace(found.model, file=draw_parameters(file, 1.0, rng)[0]) for _ in range(draws)]
    worlds = [found.planning(World.from_model(model, geometry=found.world)) for model in drawn]

    @lru_cache(_BATCHES)
    def batch(rows: tuple[int, ...]) -> World:
        return replace(joined_worlds([worlds[row] for row in rows or (0,)]), rolls_on=rolls_on)

    return Worlds(batch=batch, draws=draws)
