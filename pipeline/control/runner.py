"""What the stage needs of a task, whatever the robot: a controller, a plant, runs, and their tables and figures."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch

from ...datasets.models.model import Model
from ...datasets.rollouts.control_file import RunTables
from ...schemas import AnyTask, ClockName, ControlTask, SolverName
from ..physics.world import World
from .controller import Controller
from .film import film_of
from .hand.controller import HandController
from .hand.film import hand_film_of
from .hand.loop import goals_of, hand_errors, hand_start, run_hand
from .hand.plant import HandModelPlant, HandPlant, HandScenePlant
from .hand.tables import hand_tables_of
from .hand.world import hand_world
from .loop import Measured, Recording, Watch, run, unwatched
from .mujoco_plant import MujocoPlant
from .planning import PlanningController
from .plant import ModelPlant, Plant, start_of
from .tables import tables_of
from .task_world import task_world


class Runner(Protocol):
    """Runs of a task."""

    @property
    def controller(self) -> PlanningController:
        """The controller."""
        ...

    @property
    def object_name(self) -> str:
        """Name of the object."""
        ...

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of what the robot's file has beside the robot, and the object does not touch."""
        ...

    def reset(self, seed: int) -> Measured:
        """Put the plant where a run begins, and return its state.

        Raises:
            InputDataError: If something begins inside of something else.
        """
        ...

    def run(self, seed: int, clock: ClockName, watch: Watch = unwatched) -> Recording:
        """Run the task from a seed; `watch` is told of the recording after each command."""
        ...

    def tables(self, recording: Recording, timed: bool) -> RunTables:
        """Return a recording as arrays; without times equal runs are equal to the byte."""
        ...

    def start_errors(self, seed: int) -> tuple[float, float]:
        """Return the errors of position [m] and turn [deg] at the start."""
        ...

    def film(self, tables: RunTables, device: str) -> tuple[bytes | None, str]:
        """Return the film of a run, and some of its frames; None and "" where there is none."""
        ...


def planning_world(model: Model, task: AnyTask) -> World:
    """Return the world of the predictions of a task; errors as those of its controller."""
    found = task_world(model, task) if isinstance(task, ControlTask) else hand_world(model, task)
    return found.planning()


def runner_of(model: Model, task: AnyTask, solver: SolverName, draws: int, device: str) -> Runner:
    """Return the runner of a task.

    Args:
        model: The model.
        task: The task.
        solver: mppi, gauss-newton or both.
        draws: Draws of the model for each plan.
        device: Device of the predictions.
    """
    if isinstance(task, ControlTask):
        return PushRunner(Controller(model, task, solver, draws=draws, device=device))
    return HandRunner(HandController(model, task, solver, draws=draws, device=device))


class PushRunner:
    """Runs of a finger.

    Args:
        controller: The controller.
    """

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        found = controller.task_world
        self.plant: Plant = MujocoPlant(found) if found.task.plant.kind == "mujoco" else ModelPlant(found)

    @property
    def object_name(self) -> str:
        """See :class:`Runner`."""
        found = self.controller.task_world
        return found.world.body_names[found.object]

    @property
    def outside(self) -> tuple[str, ...]:
        """See :class:`Runner`."""
        return ()

    def reset(self, seed: int) -> Measured:
        """See :class:`Runner`."""
        return self.plant.reset(*start_of(self.controller.task_world, seed))

    def run(self, seed: int, clock: ClockName, watch: Watch = unwatched) -> Recording:
        """See :class:`Runner`."""
        return run(self.controller, self.plant, seed, clock, watch)

    def tables(self, recording: Recording, timed: bool) -> RunTables:
        """See :class:`Runner`."""
        return tables_of(recording, self.controller.task, timed)

    def start_errors(self, seed: int) -> tuple[float, float]:
        """See :class:`Runner`."""
        found = self.controller.task_world
        place, turn, _ = start_of(found, seed)
        position, quat = found.pose(place, turn)
        x, y, angle = found.goal.errors(torch.as_tensor(position), torch.as_tensor(quat)).tolist()
        return math.hypot(x, y), abs(math.degrees(angle))

    def film(self, tables: RunTables, device: str) -> tuple[bytes | None, str]:
        """See :class:`Runner`."""
        return film_of(self.controller.task_world, tables, device)


class HandRunner:
    """Runs of a hand.

    Args:
        controller: The controller.
    """

    def __init__(self, controller: HandController) -> None:
        self.controller = controller
        hand = controller.hand
        self.plant: HandPlant = HandScenePlant(hand) if hand.task.plant.kind == "mujoco" else HandModelPlant(hand)

    @property
    def object_name(self) -> str:
        """See :class:`Runner`."""
        return self.controller.hand.world.body_names[self.controller.hand.object]

    @property
    def outside(self) -> tuple[str, ...]:
        """See :class:`Runner`."""
        return self.controller.hand.outside

    def reset(self, seed: int) -> Measured:
        """See :class:`Runner`."""
        return self.plant.reset(*hand_start(self.controller.task, seed))

    def run(self, seed: int, clock: ClockName, watch: Watch = unwatched) -> Recording:
        """See :class:`Runner`."""
        return run_hand(self.controller, self.plant, seed, clock, watch)

    def tables(self, recording: Recording, timed: bool) -> RunTables:
        """See :class:`Runner`."""
        return hand_tables_of(recording, self.controller, timed)

    def start_errors(self, seed: int) -> tuple[float, float]:
        """See :class:`Runner`."""
        truth: Any = self.reset(seed)
        return hand_errors(self.controller.task, truth, next(goals_of(self.controller.task, seed)))

    def film(self, tables: RunTables, device: str) -> tuple[bytes | None, str]:
        """See :class:`Runner`."""
        return hand_film_of(self.controller.hand, tables, device)
