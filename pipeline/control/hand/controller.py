"""The controller of a hand: measured states in, targets of its joints out, without a simulator behind it."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from ....datasets.models.model import Model, read_model
from ....schemas import HandTask, SolverName, UsageError, read_hand_task
from ...physics.world import World
from ...runtime.device import resolve_device
from ..controller import drawn_worlds, require_draws
from ..horizon import Targets
from ..objective import Worlds
from ..planning import ControlState, PlanningController
from ..solvers import Solver, solver_of
from .elites import Elites
from .objective import HandObjective
from .patience import FARTHER, Patience
from .tracker import LONGEST_S, STEP_S, HandTracker
from .world import HandWorld, hand_world, world_of


class HandController(PlanningController):
    """A controller that turns an object in a hand to an orientation.

    Args:
        model: The fitted model of the object, or its directory.
        task: The task, or its file.
        solver: mppi, gauss-newton or both.
        seed: Seed of everything random: equal seeds and states give equal commands on the CPU.
        draws: Number of draws of the model's uncertainty that each plan is evaluated under; 0 for the estimate alone.
        device: Device of the predictions: auto, cpu or cuda.

    Attributes:
        goal_wxyz: Orientation of the object that is wanted, body to world, shape (4,); set it by `aim`.

    Raises:
        InputDataError: If the model or the hand cannot serve the task, see `world`.
        UsageError: If the device is not there, or numbers are out of range.
    """

    def __init__(
        self,
        model: Model | Path | str,
        task: HandTask | Path | str,
        solver: SolverName = "mppi",
        seed: int = 0,
        draws: int = 0,
        device: str = "cpu",
    ) -> None:
        model = model if isinstance(model, Model) else read_model(model)
        task = task if isinstance(task, HandTask) else read_hand_task(Path(task))
        require_draws(draws)
        self.hand: HandWorld = hand_world(model, task)
        self.task = task
        self.goal_wxyz = np.array(task.start.quat_wxyz)
        self._patience, self._impatient = Patience(task), False
        where, found = str(resolve_device(device)), self.hand

        def planned(drawn: Model | None, step_s: float = task.planner.step_s) -> World:
            if drawn is None:
                return found.planning(step_s=step_s)
            factor = _friction(drawn) / _friction(model)
            return found.planning(world_of(drawn, task, found.chain, found.world.bodies[:-1], factor), step_s)

        likely = task.planner.risk == "likely"
        worlds = drawn_worlds(model, draws, seed, where, planned, likely)
        tracked = partial(planned, step_s=min(STEP_S, task.planner.step_s))
        self._tracker = HandTracker(found, drawn_worlds(model, draws, seed, where, tracked, likely))
        # of long plans that differ much the mean would be none of them
        self._usual, self._alone = (solver_of(solver, Elites(task.planner.samples, best=best)) for best in (3, 1))
        super().__init__(task.planner, worlds, self._usual, where, seed)

    def restart(self, seed: int) -> None:
        """See :class:`PlanningController`."""
        super().restart(seed)
        self._tracker.restart(seed)
        self._patience.aim()
        self._tracked_s = -math.inf

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of targets."""
        return self.hand.joints

    def limits(self, joint: str) -> tuple[float, float, float]:
        """Return the smallest and the largest target of a joint [rad], and its largest speed [rad/s]."""
        index = self.hand.joints.index(joint)
        return float(self.hand.lower[index]), float(self.hand.upper[index]), self.task.limits.speed_rad_s

    def aim(self, goal_wxyz: ArrayLike) -> None:
        """Set the orientation that is wanted, body to world, shape (4,).

        Raises:
            UsageError: If it is no orientation.
        """
        goal = np.asarray(goal_wxyz, float)
        if goal.shape != (4,) or not np.isfinite(goal).all() or not np.linalg.norm(goal) > 1e-9:
            raise UsageError(
                f"a goal of {np.asarray(goal_wxyz).tolist()}.",
                "w, x, y, z of an orientation.",
                todo="give four finite numbers that are not all 0.",
            )
        self.goal_wxyz = goal / np.linalg.norm(goal)
        self._patience.aim()

    def _sent_since(self, state: ControlState) -> Targets | None:
        """Return the targets of the joints since the last state that was tracked; None where they are unknown."""
        since, self._tracked_s = self._tracked_s, state.time_s
        if not self._sent or not since < state.time_s:
            return None
        # before the first command, and after the last one, the targets stay
        held = Targets(times_s=np.array([0.0]), values_m=self._sent[-1][1][None])
        return self._given(held, max(since, state.time_s - LONGEST_S), state.time_s)

    def _solver_now(self) -> Solver:
        """See :class:`PlanningController`."""
        return self._alone if self._impatient and self._solver is self._usual else self._solver

    def _planned_in(self) -> Worlds:
        """Return the worlds that plans are evaluated in: those of all draws, or that which agreed best."""
        if self._worlds.draws == 1 or self.task.planner.risk != "likely":
            return self._worlds
        likely = self._worlds.batch((self._tracker.draw,))
        return Worlds(batch=lambda rows: likely, draws=1)

    def _objective(self, state: ControlState, acts_s: float) -> tuple[HandObjective, Tensor]:
        """Return the objective of a plan, and the plan before over its knots, shape (N, joints)."""
        planner, hand = self.task.planner, self.hand
        measured = np.array([state.joints[name] for name in hand.joints])
        before = (
            self._plan.targets if self._plan else Targets(times_s=np.array([state.time_s]), values_m=measured[None])
        )
        believed = self._tracker.update(state, self._sent_since(state))
        self._impatient = self._patience.over(state.time_s, believed.quat_wxyz[0, hand.object].numpy(), self.goal_wxyz)
        lead = self._given(before, state.time_s, acts_s)
        if acts_s - state.time_s > self.interval_s + 1e-9:  # the planner's own steps do for one command
            believed = self._tracker.ahead(believed, lead)
            lead = Targets(times_s=lead.times_s[-1:], values_m=lead.values_m[-1:])
        length_s = planner.horizon_s * (FARTHER if self._impatient else 1.0)
        knots = acts_s + length_s / planner.knots * np.arange(1, planner.knots + 1)
        objective = HandObjective(
            hand=hand,
            worlds=self._planned_in(),
            state=believed,
            goal_wxyz=self.goal_wxyz,
            times_s=np.array([*lead.times_s, *knots]),
            given_rad=lead.values_m,
        )
        return objective, objective.values_of(before)


def _friction(model: Model) -> float:
    contact = model.file.contact
    assert contact is not None  # a model without is refused
    return contact.friction
