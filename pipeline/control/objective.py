"""What the solvers minimise: the cost of sequences of speeds under the model, for one state and horizon."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ...schemas import ControlTask
from ..physics.engine import rollout
from ..physics.kinematic import Drive
from ..physics.rollout import Rollout
from ..physics.state import State
from ..physics.world import World
from .horizon import Forecast, Horizon, Targets
from .proposals import PushProposals
from .task_world import TaskWorld

Draw = Callable[[np.random.Generator, int], np.ndarray]
"""Returns up to a number of proposals (n, N, joints)."""
WORST = 0.25
"""Share of the draws that count where the worst ones do."""


class Objective(Protocol):
    """A cost that is a sum of squares, of sequences (N, joints) within a box, under each of K draws of a model."""

    @property
    def shape(self) -> tuple[int, int]:
        """N and the number of joints."""
        ...

    @property
    def bound(self) -> float:
        """Largest magnitude of each number."""
        ...

    @property
    def draws(self) -> int:
        """K."""
        ...

    def costs(self, values: Tensor) -> Tensor:
        """Return the costs (B,) of sequences (B, N, joints), infinite where a prediction fails."""
        ...

    def residuals(self, values: Tensor, draws: Tensor) -> Tensor:
        """Return residuals (b, R), whose squares add up to the cost, of sequences (b, N, joints) under draws (b,)."""
        ...


class PlanObjective(Objective, Protocol):
    """The cost of sequences from a state on, with the targets that a sequence stands for."""

    @property
    def acts_s(self) -> float:
        """Time from which the sequences act [s]."""
        ...

    def targets(self, values: Tensor) -> Targets:
        """Return the targets of a sequence (N, joints) over the whole horizon."""
        ...

    def forecast(self, values: Tensor) -> Forecast:
        """Return what the model predicts of a sequence (N, joints)."""
        ...

    def propose(self, warm: Tensor) -> Draw:
        """Return the source of sequences other than the plan before, shape (N, joints)."""
        ...


@dataclass(frozen=True, kw_only=True)
class Worlds:
    """The worlds that plans are evaluated in."""

    batch: Callable[[tuple[int, ...]], World]
    """Return the worlds of some draws as one batch."""
    draws: int
    """Number of draws."""


@dataclass(frozen=True, kw_only=True)
class PushObjective:
    """The cost of speeds of the finger, from one state of the object; see `CostsSection`."""

    task_world: TaskWorld
    """The task."""
    worlds: Worlds
    """The worlds of the predictions."""
    state: State
    """State at the first time of the horizon (1, nb, ...)."""
    horizon: Horizon
    """Times of the plan."""
    given_m_s: np.ndarray
    """Speeds of the given pieces [m/s], shape (L, 2)."""

    @property
    def task(self) -> ControlTask:
        """The task."""
        return self.task_world.task

    @property
    def shape(self) -> tuple[int, int]:
        """Number of chosen pieces, and of joints."""
        return len(self.horizon.lengths_s), 2

    @property
    def bound(self) -> float:
        """Largest speed [m/s]."""
        return self.task.limits.speed_m_s

    @property
    def draws(self) -> int:
        """Number of draws of the model."""
        return self.worlds.draws

    @property
    def acts_s(self) -> float:
        """See :class:`PlanObjective`."""
        return float(self.horizon.chosen_s[0])

    @torch.no_grad()
    def costs(self, values: Tensor) -> Tensor:
        """See :class:`Objective`."""
        return costs_of(self, values, self.task.planner.risk)

    def propose(self, warm: Tensor) -> Draw:
        """See :class:`PlanObjective`."""
        return PushProposals(objective=self).draw

    def forecast(self, values: Tensor) -> Forecast:
        """See :class:`PlanObjective`."""
        motion, index = self.predicted(values[None], torch.zeros(1, dtype=torch.long)), self.task_world.object
        return Forecast(
            times_s=self.horizon.times_s,
            position_m=motion.position_m[0, :, index].numpy(),
            quat_wxyz=motion.quat_wxyz[0, :, index].numpy(),
        )

    def residuals(self, values: Tensor, draws: Tensor) -> Tensor:
        """See :class:`Objective`."""
        found = self.predicted(values, draws)
        index, finger = self.task_world.object, self.task_world.finger
        object_m, quat = found.position_m[:, 1:, index], found.quat_wxyz[:, 1:, index]
        return self.rows(object_m, quat, found.position_m[:, 1:, finger, :2], values)

    def rows(self, object_m: Tensor, quat_wxyz: Tensor, finger_m: Tensor, values: Tensor) -> Tensor:
        """Return the residuals (b, R) of motions at the ends of all pieces.

        Args:
            object_m: Position of the object [m], shape (b, L + N, 3).
            quat_wxyz: Its orientation, shape (b, L + N, 4).
            finger_m: x and y of the finger [m], shape (b, L + N, 2).
            values: The speeds [m/s], shape (b, N, 2).
        """
        costs = self.task.costs
        errors = self.task_world.goal.errors(object_m, quat_wxyz)
        scales = errors.new_tensor([costs.position_m, costs.position_m, math.radians(costs.turn_deg)])
        lengths = torch.as_tensor(np.diff(self.horizon.times_s))
        weight = costs.path * lengths / lengths.sum()
        weight[-1] += 1.0
        parts = [(errors / scales * weight.sqrt()[:, None]).flatten(1)]
        apart = finger_m - object_m[..., :2]
        parts.append((apart / costs.reach_m * (lengths / lengths.sum()).sqrt()[:, None]).flatten(1))
        share = torch.as_tensor(self.horizon.lengths_s / self.horizon.lengths_s.sum()).sqrt()
        parts.append((values / costs.speed_m_s * share[:, None]).flatten(1))
        return torch.cat(parts, -1)

    def predicted(self, values: Tensor, draws: Tensor) -> Rollout:
        """Return the predicted motion (b, L + N + 1, nb, ...) of speeds (b, N, 2) under draws (b,)."""
        times = torch.as_tensor(self.horizon.times_s - self.horizon.times_s[0])
        speeds = self.within_limits(torch.cat((self._given(len(values)), values), 1))
        start = self.state.position_m[:, self.task_world.finger]
        drive = drive_of(times, start, speeds)
        name = self.task_world.world.body_names[self.task_world.finger]
        state = State(*(part.expand(len(values), *part.shape[1:]) for part in self.state.tensors))
        world = self.worlds.batch(tuple(draws.tolist()) if self.draws > 1 else ())
        return rollout(world, state, times, {name: drive})

    def within_limits(self, speeds: Tensor) -> Tensor:
        """Return speeds (b, L + N, 2) of the targets after these are kept within the limits of the joints."""
        lengths = torch.as_tensor(np.diff(self.horizon.times_s))[:, None]
        start = self.state.position_m[0, self.task_world.finger, :2]
        low, high = limits_of(self.task)
        low, high = torch.minimum(low, start), torch.maximum(high, start)  # one that begins outside may come in
        places = torch.minimum(torch.maximum(start + (speeds * lengths).cumsum(1), low), high)
        return torch.diff(places, dim=1, prepend=start.expand(len(speeds), 1, 2)) / lengths

    def targets(self, values: Tensor) -> Targets:
        """Return the targets of a sequence (N, 2) over the whole horizon."""
        speeds = self.within_limits(torch.cat((self._given(1), values[None]), 1))[0].numpy()
        start = self.state.position_m[0, self.task_world.finger, :2].numpy()
        lengths = np.diff(self.horizon.times_s)[:, None]
        places = np.concatenate((start[None], start + np.cumsum(speeds * lengths, 0)))
        return Targets(times_s=self.horizon.times_s, values_m=places)

    def _given(self, count: int) -> Tensor:
        return torch.as_tensor(self.given_m_s).expand(count, *self.given_m_s.shape)


def drive_of(times_s: Tensor, start_m: Tensor, speeds_m_s: Tensor) -> Drive:
    """Return the motion of the finger from its position (1 or b, 3) with speeds (b, M, 2) between times (M + 1,)."""
    velocity = torch.nn.functional.pad(speeds_m_s, (0, 1))
    moved = torch.nn.functional.pad((velocity * times_s.diff()[:, None]).cumsum(1), (0, 0, 1, 0))
    upright = start_m.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(velocity), len(times_s), 4)
    velocity = torch.nn.functional.pad(velocity, (0, 0, 0, 1))
    return Drive(
        times_s=times_s.expand(len(velocity), -1),
        position_m=start_m[:, None] + moved,
        quat_wxyz=upright,
        velocity_m_s=velocity,
        omega_world_rad_s=torch.zeros_like(velocity),
        last=torch.full((len(velocity),), len(times_s) - 2),
    )


def limits_of(task: ControlTask) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest targets (2,) of the joints [m]."""
    pairs = torch.tensor([task.limits.joints[name] for name in ("x", "y")], dtype=torch.float64)
    return pairs[:, 0], pairs[:, 1]


def costs_of(objective: Objective, values: Tensor, risk: str) -> Tensor:
    """Return the costs (B,) of sequences (B, N, joints) from their residuals under all draws.

    Args:
        objective: The objective.
        values: The sequences.
        risk: mean or worst_quarter.
    """
    draws = objective.draws
    every = torch.arange(draws).repeat(len(values))
    squares = objective.residuals(values.repeat_interleave(draws, 0), every).square().sum(-1)
    return _risk(squares.nan_to_num(nan=math.inf).reshape(-1, draws), risk)


def _risk(costs: Tensor, risk: str) -> Tensor:
    """Return the mean (B,) of costs (B, K) of all draws, or of the worst quarter of them."""
    if risk == "mean":
        return costs.mean(1)
    count = max(1, math.ceil(WORST * costs.shape[1]))
    return costs.sort(1, descending=True).values[:, :count].mean(1)
