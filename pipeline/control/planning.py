"""What controllers of all robots have in common: measured states in, plans and commands by joint name out."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...schemas import JOINTS, NotConvergedError, PlannerSection, UsageError
from ..geometry.rotation import quat_exp, quat_multiply, quat_turn
from ..physics.fused.host import lacking
from ..runtime.resources import one_torch_thread
from .horizon import Array, Forecast, Targets
from .objective import PlanObjective, Worlds
from .solvers import Solver

SENT = 512
"""Commands that are kept, from which late states are predicted forward."""
FARTHEST, LEAST_HALF = 10.0, 0.1
"""Largest distance of a joint from the middle of its limits, in units of half of their range, and the least such half
[rad or m], for joints that a task holds still: beyond it the position is in other units, degrees or millimetres."""
UNIT_TOLERANCE = 0.01
"""Largest deviation of a measured quaternion's length from 1."""


@dataclass(frozen=True, kw_only=True)
class ControlState:
    """A measured state."""

    time_s: float
    """Time at which it was measured [s]; a state that is not later than the one before is stale."""
    joints: Mapping[str, float]
    """Position of each joint by name [m, of hinges rad]."""
    position_m: Array
    """Origin of the object's frame, world frame [m], shape (3,)."""
    quat_wxyz: Array
    """Orientation of the object, body to world, shape (4,)."""
    velocity_m_s: Array | None = None
    """Velocity of that origin, world frame [m/s], shape (3,); None: at rest."""
    omega_body_rad_s: Array | None = None
    """Angular velocity, body frame [rad/s], shape (3,); None: at rest."""
    joint_speeds: Mapping[str, float] | None = None
    """Speed of each joint by name [m/s, of hinges rad/s]; None: at rest. A finger without servos has none."""

    def towards(self, other: ControlState, share: float) -> ControlState:
        """Return a state on the way to a later one, at a share of the time between both, from 0 to 1."""

        def mean(first: Array, second: Array) -> Array:
            return (1 - share) * first + share * second

        def means(first: Mapping[str, float] | None, second: Mapping[str, float] | None) -> dict[str, float] | None:
            if first is None or second is None:
                return None
            return {name: (1 - share) * value + share * second[name] for name, value in first.items()}

        def mean_or_none(first: Array | None, second: Array | None) -> Array | None:
            return None if first is None or second is None else mean(first, second)

        first, second = torch.as_tensor(self.quat_wxyz), torch.as_tensor(other.quat_wxyz)
        turn = quat_turn(first, second)
        return ControlState(
            time_s=(1 - share) * self.time_s + share * other.time_s,
            joints=means(self.joints, other.joints) or {},
            position_m=mean(self.position_m, other.position_m),
            quat_wxyz=quat_multiply(first, quat_exp(share * turn)).numpy(),
            velocity_m_s=mean_or_none(self.velocity_m_s, other.velocity_m_s),
            omega_body_rad_s=mean_or_none(self.omega_body_rad_s, other.omega_body_rad_s),
            joint_speeds=means(self.joint_speeds, other.joint_speeds),
        )

    def fault(self, joints: Sequence[str] = JOINTS) -> str:
        """Return what is wrong with the numbers of the state, in words; empty for nothing.

        Args:
            joints: Names of the robot's joints; by default the finger's.
        """
        for name, size in (("position_m", 3), ("quat_wxyz", 4), ("velocity_m_s", 3), ("omega_body_rad_s", 3)):
            value = getattr(self, name)
            needed = value is not None or not name.startswith(("velocity", "omega"))
            if needed and not np.isfinite(_numbers(value, size)).all():
                return f"{name} is not {size} finite numbers"
        if abs(np.linalg.norm(_numbers(self.quat_wxyz, 4)) - 1) > UNIT_TOLERANCE:
            return "quat_wxyz has not the length 1"
        for what, given, missing in (("position", self.joints, math.nan), ("speed", self.joint_speeds, 0.0)):
            wrong = [name for name in joints if not math.isfinite(_number((given or {}).get(name, missing)))]
            if wrong:
                return f"joint '{wrong[0]}' has no finite {what}"
        return "" if math.isfinite(_number(self.time_s)) else "time_s is not finite"

    def of(self, joints: Sequence[str]) -> ControlState:
        """Return the state as arrays and numbers, with the joints of a robot alone: others may be measured, too."""

        def known(given: Mapping[str, float] | None) -> dict[str, float] | None:
            return None if given is None else {name: float(given[name]) for name in joints if name in given}

        def array(given: Array | None) -> Array | None:
            return None if given is None else np.asarray(given, float)

        return ControlState(
            time_s=float(self.time_s),
            joints=known(self.joints) or {},
            position_m=np.asarray(self.position_m, float),
            quat_wxyz=np.asarray(self.quat_wxyz, float),
            velocity_m_s=array(self.velocity_m_s),
            omega_body_rad_s=array(self.omega_body_rad_s),
            joint_speeds=known(self.joint_speeds),
        )


def _number(value: object) -> float:
    """Return a value as a number; nan for what is none, such as a text."""
    try:
        return math.nan if isinstance(value, str) else float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        return math.nan


def _numbers(value: object, size: int) -> Array:
    """Return values as numbers (size,); nan for what is none."""
    try:
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        return np.full(size, np.nan)
    return found if found.shape == (size,) else np.full(size, np.nan)


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


class PlanningController(ABC):
    """A controller that makes a plan from each measured state.

    Args:
        planner: The section of the task that says how plans are made.
        worlds: The worlds of the predictions.
        solver: The solver.
        device: Device of the predictions.
        seed: Seed of everything random.
    """

    def __init__(self, planner: PlannerSection, worlds: Worlds, solver: Solver, device: str, seed: int) -> None:
        self.held = 0
        """States until now that were missing, stale or no numbers."""
        self.interval_s = 1 / planner.control_hz
        """Length of a command [s]."""
        self.bad_states = planner.bad_states
        """Bad states in a row after which a run stops."""
        self._worlds, self._solver, self._device = worlds, solver, device
        self.restart(seed)

    @property
    @abstractmethod
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of targets."""

    @abstractmethod
    def limits(self, joint: str) -> tuple[float, float, float]:
        """Return the smallest and the largest target of a joint [m, of hinges rad], and its largest speed."""

    @abstractmethod
    def _objective(self, state: ControlState, acts_s: float) -> tuple[PlanObjective, Tensor]:
        """Return the objective of a plan, and the plan before over its pieces, shape (N, joints)."""

    def _solver_now(self) -> Solver:
        """Return the solver of the plan whose objective was just made."""
        return self._solver

    def restart(self, seed: int) -> None:
        """Forget all plans and states, and begin with another seed."""
        self._rng = np.random.default_rng([seed, 1])
        self._plan: ControlPlan | None = None
        self._found: tuple[PlanObjective, Tensor] | None = None
        self._command: dict[str, float] = {}
        self._sent: deque[tuple[float, Array]] = deque(maxlen=SENT)
        self._last_s, self._bad, self._fault, self.held = -math.inf, 0, "", 0

    @property
    def lost(self) -> bool:
        """Whether so many states in a row were bad that a run has to stop."""
        return self._bad >= self.bad_states

    @property
    def slow(self) -> str:
        """Why predictions run in the slow engine, in words; empty where they do not."""
        world = self._worlds.batch((0,) if self._worlds.draws > 1 else ())
        return "" if self._device != "cpu" else lacking(world) or ""

    def note_sent(self, time_s: float, command: Mapping[str, float]) -> None:
        """Note the targets that the joints have at a time [s], by joint name; times increase."""
        self._sent.append((time_s, np.array([command[name] for name in self.joints])))

    def _given(self, before: Targets, state_s: float, acts_s: float) -> Targets:
        """Return the targets from the time of a state to that of acting [s]: what was sent, then a plan.

        Args:
            before: The plan before.
            state_s: Time of the state.
            acts_s: Time from which the next plan acts.
        """
        sent = self._sent_from(state_s, acts_s)
        if not sent:
            times = np.array([state_s, acts_s] if acts_s > state_s + 1e-9 else [state_s])
            return Targets(times_s=times, values_m=before.at(times))
        known = Targets(times_s=np.array([time for time, _ in sent]), values_m=np.stack([each for _, each in sent]))
        inner = [time for time, _ in sent if state_s + 1e-9 < time < acts_s - 1e-9]
        times = np.array([state_s, *inner, acts_s] if acts_s > state_s + 1e-9 else [state_s])
        later = times > known.times_s[-1] + 1e-9
        if not later.any():
            return Targets(times_s=times, values_m=known.at(times))
        return Targets(times_s=times, values_m=np.where(later[:, None], before.at(times), known.at(times)))

    def _sent_from(self, first_s: float, last_s: float) -> list[tuple[float, Array]]:
        """Return the targets that were sent until a time [s], from the last ones before another time on."""
        found = []
        for time_s, target in reversed(self._sent):
            if time_s < last_s + 1e-9:
                found.append((time_s, target))
            if time_s <= first_s:
                break
        return found[::-1]

    def command(self, state: ControlState | None, now_s: float | None = None) -> dict[str, float]:
        """Return the targets of the joints at the end of the next command's interval, by joint name [m, rad].

        A state that is missing, stale or no numbers holds the last command, and is counted in `held`. Before the first
        good state there is no command, and the result is empty.

        Args:
            state: The measured state; None where there is none.
            now_s: Time from which the command acts [s]; by default that of the state. A state that is older is
                predicted forward to it.

        Raises:
            NotConvergedError: If `bad_states` states in a row were bad; the robot should stop.
        """
        plan = self.plan(state, now_s)
        if self.lost:
            raise NotConvergedError(
                f"{self._bad} states in a row are missing, stale or no numbers; the last one: {self._fault}.",
                todo="stop the robot, and check what measures the state.",
            )
        if plan is None:
            return dict(self._command)
        before = self._command or (state.joints if state is not None else {})
        self._command = self.limited(before, plan.targets.at(plan.acts_s + self.interval_s))
        if not self._sent:
            self.note_sent(plan.acts_s, before)
        self.note_sent(plan.acts_s + self.interval_s, self._command)
        return dict(self._command)

    def limited(self, before: Mapping[str, float], wanted: Array) -> dict[str, float]:
        """Return targets within all limits.

        Args:
            before: The targets before, by joint; empty for none.
            wanted: The wanted targets [m, of hinges rad], shape (joints,).
        """
        found = {}
        for name, value in zip(self.joints, map(float, wanted), strict=True):
            low, high, speed = self.limits(name)
            last, reach = before.get(name, value), speed * self.interval_s
            found[name] = min(max(min(max(value, last - reach), last + reach), low), high)
        return found

    def _fault_of(self, state: ControlState | None, acts_s: float | None) -> str:
        """Return why no plan can be made from a state, in words; empty for nothing."""
        if state is None:
            return "there is none"
        fault = state.fault(self.joints)
        if fault or (acts_s is not None and not math.isfinite(_number(acts_s))):
            return fault or "the time of the command is not finite"
        if state.time_s <= self._last_s:
            return f"its time, {state.time_s:.6g} s, is not later than {self._last_s:.6g} s"
        for name in self.joints:
            low, high, _ = self.limits(name)
            half = max(0.5 * (high - low), LEAST_HALF)
            if abs(state.joints[name] - 0.5 * (low + high)) > FARTHEST * half:
                return f"joint '{name}' is at {state.joints[name]:g}, far from its limits, {low:g} to {high:g}"
        return ""

    @one_torch_thread()
    def plan(self, state: ControlState | None, acts_s: float | None = None) -> ControlPlan | None:
        """Return a plan from a measured state; None for a state that is missing, stale or no numbers.

        Args:
            state: The measured state.
            acts_s: Time from which the plan will act [s], by default that of the state.
        """
        self._fault = self._fault_of(state, acts_s)
        if state is None or self._fault:
            self.held += 1
            self._bad += 1
            return None
        state = state.of(self.joints)
        self._bad, self._last_s = 0, state.time_s
        wall, cpu = time.perf_counter(), time.process_time()
        objective, warm = self._objective(state, state.time_s if acts_s is None else max(acts_s, state.time_s))
        found = self._solver_now().solve(objective, warm, objective.propose(warm), self._rng)
        self._found = objective, found.values
        self._plan = ControlPlan(
            state_s=state.time_s,
            acts_s=objective.acts_s,
            targets=objective.targets(found.values),
            cost=found.cost,
            wall_s=time.perf_counter() - wall,
            cpu_s=time.process_time() - cpu,
        )
        return self._plan

    @torch.no_grad()
    @one_torch_thread()
    def forecast(self) -> Forecast:
        """Return what the model predicts of the last plan.

        Raises:
            UsageError: Before the first plan.
        """
        if self._found is None:
            raise UsageError("a forecast before the first plan.", todo="call plan(state) first.")
        objective, values = self._found
        return objective.forecast(values)
