"""One run of a task: plant, sensing, controller and clock, step by step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
import torch

from ...schemas import JOINTS, ClockName, HandPlantSection, NotConvergedError, PlantSection
from ..geometry.rotation import quat_exp, quat_multiply
from .controller import Controller
from .horizon import Array
from .planning import ControlPlan, ControlState, PlanningController
from .plant import Plant, Truth, start_of

Ended = Literal["success", "timeout", "bad_states", "diverged", "dropped"]


@dataclass
class Recording:
    """What happened in a run: lists of rows, one for each command or each plan."""

    seed: int
    """Seed of the run."""
    ended: Ended = "timeout"
    """Why it ended."""
    late: int = 0
    """Plans that came after the command that they were for."""
    goals: int = 0
    """Goals that were reached, of a task that has several."""
    held: int = 0
    """States that were missing, stale or no numbers."""
    commands: dict[str, list[Any]] = field(default_factory=dict)
    """Columns with one row for each command: see :func:`_note_command`."""
    plans: dict[str, list[Any]] = field(default_factory=dict)
    """Columns with one row for each plan."""

    def column(self, name: str, of: Literal["commands", "plans"] = "commands") -> Array:
        """Return a column as an array."""
        return np.asarray(getattr(self, of).get(name, ()), float)

    def add(self, of: Literal["commands", "plans"], **row: Any) -> None:
        """Append a row."""
        table = getattr(self, of)
        for name, value in row.items():
            table.setdefault(name, []).append(value)

    def last(self, commands: int) -> Recording:
        """Return the recording with the last rows alone: of some commands, and of as many plans."""
        commands_kept, plans_kept = (
            {name: rows[-commands:] for name, rows in table.items()} for table in (self.commands, self.plans)
        )
        return replace(self, commands=commands_kept, plans=plans_kept)


Watch = Callable[[Recording], None]
"""Is told of the recording after each command."""


def unwatched(recording: Recording) -> None:
    """Do nothing: runs that nobody watches."""


class Measured(Protocol):
    """A true state that can be measured."""

    @property
    def position_m(self) -> Array:
        """Origin of the object's frame [m], shape (3,)."""
        ...

    @property
    def quat_wxyz(self) -> Array:
        """Orientation of the object, body to world, shape (4,)."""
        ...

    def measured(self, time_s: float, position_m: Array, quat_wxyz: Array) -> ControlState:
        """Return the state as it is measured, with a pose of the object that has errors."""
        ...


class Sensor:
    """Measured states of a plant: late by a constant delay, with noise.

    A state between two commands lies on the way between theirs; before the start the plant was at rest. Where poses are
    noisy there are no velocities: differences of such poses say nothing about them.

    Args:
        plant: The section of the task that has delay and noise.
        interval_s: Length of a command [s].
        seed: Seed of the noise.
    """

    def __init__(self, plant: PlantSection | HandPlantSection, interval_s: float, seed: int) -> None:
        self._late_s = plant.delay_s
        self._noise = plant.noise_m, math.radians(plant.noise_deg)
        self._rng = np.random.default_rng([seed, 3])
        self._states: deque[ControlState] = deque(maxlen=math.ceil(plant.delay_s / interval_s - 1e-9) + 1)

    def seen(self, time_s: float, truth: Measured) -> ControlState:
        """Return the newest state that has arrived at a time [s]."""
        self._states.append(truth.measured(time_s, truth.position_m, truth.quat_wxyz))
        state, (place, turn) = self._at(time_s - self._late_s), self._noise
        if not place and not turn:
            return state
        wrong = quat_exp(torch.as_tensor(self._rng.normal(0.0, 1.0, 3) * turn))
        return replace(
            state,
            position_m=state.position_m + self._rng.normal(0.0, 1.0, 3) * place,
            quat_wxyz=quat_multiply(torch.as_tensor(state.quat_wxyz), wrong).numpy(),
            velocity_m_s=None,
            omega_body_rad_s=None,
        )

    def _at(self, time_s: float) -> ControlState:
        """Return the state at a time [s]."""
        first, second = self._states[0], self._states[min(1, len(self._states) - 1)]
        if time_s <= first.time_s + 1e-9 or first is second:
            return replace(first, time_s=time_s)
        return first.towards(second, (time_s - first.time_s) / (second.time_s - first.time_s))


def run(controller: Controller, plant: Plant, seed: int, clock: ClockName, watch: Watch = unwatched) -> Recording:
    """Run a task from a seed.

    With the real clock a plan is made from the state at a command, and acts from the next command after the wall time
    that it took; until then the commands of the plan before go on. The plant waits meanwhile. With the ideal clock a
    plan acts at once.

    Args:
        controller: The controller.
        plant: The plant.
        seed: Seed of start, noise and plans.
        clock: real or ideal.
        watch: Is told of the recording after each command; no clock charges it.

    Raises:
        InputDataError: If something begins inside of something else.
    """
    task, interval = controller.task, controller.interval_s
    controller.restart(seed)
    truth = plant.reset(*start_of(controller.task_world, seed))
    sensor, recording = Sensor(task.plant, interval, seed), Recording(seed)
    commander, within = Commander(controller, clock, recording, task.planner.knots, truth.finger_m), 0.0
    for number in range(math.ceil(task.success.timeout_s / interval - 1e-9)):
        now = number * interval
        command = commander.command(now, sensor.seen(now, truth))
        if command is None:
            break
        before = truth
        try:
            truth = plant.advance(np.array([command[name] for name in JOINTS]), interval)
        except NotConvergedError:
            recording.ended = "diverged"
            break
        errors = _errors(controller, truth)
        _note_command(recording, controller, now, (before, truth), command, errors)
        watch(recording)
        good = errors[0] <= task.success.position_m and errors[1] <= task.success.turn_deg
        within = within + interval if good else 0.0
        if good and within >= task.success.hold_s - 1e-9:
            recording.ended = "success"
            break
    commander.finish()
    return recording


class Commander:
    """Turns measured states into commands: makes plans, waits for them, and limits what they ask for.

    Args:
        controller: The controller.
        clock: real or ideal.
        recording: Takes the plans, and why the run ended where states are bad.
        knots: Number of pieces of a plan.
        first: Targets before the first plan acts, shape (joints,).
    """

    def __init__(
        self, controller: PlanningController, clock: ClockName, recording: Recording, knots: int, first: Array
    ) -> None:
        self._controller, self._clock, self._recording, self._knots = controller, clock, recording, knots
        self._command = dict(zip(controller.joints, map(float, first), strict=True))
        self._waiting, self._acting, self._begun = Waiting(controller.interval_s, clock), None, False

    def command(self, now_s: float, state: ControlState) -> dict[str, float] | None:
        """Return the targets at the end of the command that begins now; None after too many bad states."""
        controller, interval = self._controller, self._controller.interval_s
        if not self._begun:
            controller.note_sent(now_s, self._command)
        self._begun = True
        self._acting = self._waiting.arrived(now_s) or self._acting
        if self._waiting.free:
            plan = controller.plan(state, now_s + self._waiting.expected_s)
            if plan is not None:
                late = self._waiting.begin(now_s, plan)
                note_plan(self._recording, controller, plan, late, self._knots)
                self._acting = self._waiting.arrived(now_s) or self._acting
        if controller.lost:
            self._recording.ended = "bad_states"
            return None
        if self._acting is not None:
            self._command = controller.limited(self._command, self._acting.targets.at(now_s + interval))
        controller.note_sent(now_s + interval, self._command)
        return self._command

    def finish(self) -> None:
        """Record how many plans were late, and how many states bad."""
        self._recording.late, self._recording.held = self._waiting.late, self._controller.held


class Waiting:
    """The plan that is being made, and when it acts.

    Args:
        interval_s: Length of a command [s].
        clock: real or ideal.
    """

    def __init__(self, interval_s: float, clock: ClockName) -> None:
        self._interval_s, self._clock = interval_s, clock
        self._plan: ControlPlan | None = None
        self._ready_s = self._last_s = 0.0
        self.late = 0
        """Plans that took longer than a command."""

    @property
    def expected_s(self) -> float:
        """Time after which the next plan will act, if it takes as long as the last one [s]."""
        if self._clock == "ideal":
            return 0.0
        return self._interval_s * max(1, math.ceil(self._last_s / self._interval_s - 1e-9))

    @property
    def free(self) -> bool:
        """Whether the next plan can be begun."""
        return self._plan is None

    def begin(self, now_s: float, plan: ControlPlan) -> bool:
        """Take a plan that was begun now, and return whether it is late."""
        self._plan = plan
        if self._clock == "ideal":
            self._ready_s = now_s
            return False
        self._ready_s, self._last_s = now_s + max(plan.wall_s, self._interval_s), plan.wall_s
        late = plan.wall_s > self._interval_s
        self.late += late
        return late

    def arrived(self, now_s: float) -> ControlPlan | None:
        """Return the plan that acts from now on; None where none is ready."""
        if self._plan is None or now_s < self._ready_s - 1e-9:
            return None
        plan, self._plan = self._plan, None
        return plan


def _errors(controller: Controller, truth: Truth) -> tuple[float, float]:
    """Return the error of the object's position [m] and of its turn [deg]."""
    pose = torch.as_tensor(truth.position_m), torch.as_tensor(truth.quat_wxyz)
    x, y, turn = controller.task_world.goal.errors(*pose).tolist()
    return math.hypot(x, y), abs(math.degrees(turn))


def _note_command(
    recording: Recording,
    controller: Controller,
    now_s: float,
    truths: tuple[Truth, Truth],
    command: dict[str, float],
    errors: tuple[float, float],
) -> None:
    """Record a command, the state before it and what came of it."""
    before, after = truths
    limits = controller.task.limits
    last = recording.commands["target_m"][-1] if recording.commands else before.finger_m
    target = np.array([command[name] for name in JOINTS])
    recording.add(
        "commands",
        time_s=now_s,
        position_m=before.position_m,
        quat_wxyz=before.quat_wxyz,
        velocity_m_s=before.velocity_m_s,
        omega_body_rad_s=before.omega_body_rad_s,
        finger_m=before.finger_m,
        target_m=target,
        action=np.clip((target - last) / (limits.speed_m_s * controller.interval_s), -1.0, 1.0),
        next_position_m=after.position_m,
        next_quat_wxyz=after.quat_wxyz,
        next_finger_m=after.finger_m,
        force_n=after.force_n,
        position_error_m=errors[0],
        turn_error_deg=errors[1],
    )


def note_plan(recording: Recording, controller: PlanningController, plan: ControlPlan, late: bool, knots: int) -> None:
    """Record a plan and what the model predicts of it, at the ends of its last `knots` pieces."""
    found, times = controller.forecast(), plan.targets.times_s[-knots:]
    index = np.searchsorted(found.times_s, times - 1e-9).clip(max=len(found.times_s) - 1)
    recording.add(
        "plans",
        state_s=plan.state_s,
        acts_s=plan.acts_s,
        wall_s=plan.wall_s,
        cpu_s=plan.cpu_s,
        late=late,
        cost=plan.cost,
        times_s=times,
        targets_m=plan.targets.values_m[-knots:],
        position_m=found.position_m[index],
        quat_wxyz=found.quat_wxyz[index],
    )
