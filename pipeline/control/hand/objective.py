"""What the solvers minimise for a hand: the cost of targets of its joints under the model, for one state and goal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ...geometry.rotation import quat_turn
from ...physics.chains.joint_command import JointCommand
from ...physics.engine import rollout
from ...physics.rollout import Rollout
from ...physics.state import State
from ..horizon import Array, Forecast, Targets
from ..objective import Draw, Worlds, costs_of
from .world import HandWorld

FRAMES = 5
"""Largest number of frames of a piece whose errors count."""
SAME_DIGITS = 12
"""Decimal digits of a piece's length [s] by which it is told from others: less than what clocks tell apart."""
SINGLE = (0.1, 0.8)
"""Smallest and largest standard deviation of changes of a few joints, in units of the bound."""
CHANGED_SHARE = 0.25
"""Share of the joints that such a change has, on average."""


@dataclass(frozen=True, kw_only=True)
class HandObjective:
    """The cost of targets at knots, as distances from the values at the start in units of the span of each joint."""

    hand: HandWorld
    """The task."""
    worlds: Worlds
    """The worlds of the predictions."""
    state: State
    """State at the time of measurement (1, nb, ...)."""
    goal_wxyz: Array
    """Orientation that is wanted, body to world, shape (4,)."""
    times_s: Array
    """Times of the targets [s]: of the state, of acting where that is later, and of N knots; increasing."""
    given_rad: Array
    """Targets that the plan before has at the first of them [rad], shape (len(times_s) - N, joints)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of knots, and of joints."""
        return len(self.times_s) - len(self.given_rad), len(self.hand.joints)

    @property
    def bound(self) -> float:
        """Largest distance."""
        return 1.0

    @property
    def draws(self) -> int:
        """Number of draws of the model."""
        return self.worlds.draws

    @property
    def acts_s(self) -> float:
        """See :class:`PlanObjective`."""
        return float(self.times_s[len(self.given_rad) - 1])

    @torch.no_grad()
    def costs(self, values: Tensor) -> Tensor:
        """See :class:`Objective`."""
        return costs_of(self, values, self.hand.task.planner.risk)

    def residuals(self, values: Tensor, draws: Tensor) -> Tensor:
        """See :class:`Objective`."""
        costs, tips = self.hand.task.costs, self.hand.tips
        motion, targets = self._predicted(values, draws)
        position, quat = motion.position_m[:, 1:], motion.quat_wxyz[:, 1:]
        place = position[:, :, 0] - torch.tensor(self.hand.task.wanted_m, dtype=torch.float64)
        turn = quat_turn(torch.as_tensor(self.goal_wxyz), quat[:, :, 0])
        lost = ((place.square().sum(-1, keepdim=True) + 1e-24).sqrt() - costs.keep_m).clamp_min(0.0)
        errors = torch.cat((place / costs.position_m, lost / costs.lost_m, turn / math.radians(costs.turn_deg)), -1)
        weight = torch.full((errors.shape[1],), costs.path / errors.shape[1], dtype=torch.float64)
        weight[-1] += 1.0
        apart = tips.places(position[:, :, 1:], quat[:, :, 1:]) - position[:, :, :1]
        reach = apart.flatten(1) / (costs.reach_m * math.sqrt(max(1, apart[0, ..., 0].numel())))
        speeds = targets.diff(dim=1) / torch.as_tensor(np.diff(self.times_s))[:, None]
        share = 1 / math.sqrt(speeds.shape[1] * speeds.shape[2])
        errors = (errors * weight.sqrt()[:, None]).flatten(1)
        return torch.cat((errors, reach, (share / costs.speed_rad_s * speeds).flatten(1)), -1)

    def within_limits(self, values: Tensor) -> Tensor:
        """Return the targets (b, L + N, joints) [rad] of sequences (b, N, joints), within range and speed."""
        hand = self.hand
        lower, upper, home, span = (torch.as_tensor(x) for x in (hand.lower, hand.upper, hand.home, hand.span))
        wanted = (home + values * span).clamp(lower, upper)
        given = torch.as_tensor(self.given_rad).expand(len(values), *self.given_rad.shape)
        found = [*given.unbind(1)]
        for there, length in zip(wanted.unbind(1), np.diff(self.times_s)[len(given[0]) - 1 :].tolist(), strict=True):
            reach = hand.task.limits.speed_rad_s * length
            found.append(there.clamp(found[-1] - reach, found[-1] + reach))
        return torch.stack(found, 1)

    def values_of(self, targets: Targets) -> Tensor:
        """Return the sequence (N, joints) of targets."""
        wanted = targets.at(self.times_s[len(self.given_rad) :])
        return torch.as_tensor(((wanted - self.hand.home) / self.hand.span).clip(-1, 1))

    def targets(self, values: Tensor) -> Targets:
        """See :class:`PlanObjective`."""
        return Targets(times_s=self.times_s, values_m=self.within_limits(values[None])[0].numpy())

    def propose(self, warm: Tensor) -> Draw:
        """Return the source of plans that move a few joints otherwise than the plan before, more and more."""

        def draw(rng: np.random.Generator, count: int) -> Array:
            size = np.exp(rng.uniform(math.log(SINGLE[0]), math.log(SINGLE[1]), (count, 1, 1)))
            moved = rng.uniform(size=(count, 1, self.shape[1])) < CHANGED_SHARE
            ramp = np.linspace(0, 1, self.shape[0] + 1)[1:, None]
            change = size * ramp * moved * rng.normal(size=(count, *self.shape))
            return (warm.numpy() + change).clip(-1, 1)

        return draw

    def forecast(self, values: Tensor) -> Forecast:
        """See :class:`PlanObjective`."""
        motion, _ = self._predicted(values[None], torch.zeros(1, dtype=torch.long))
        return Forecast(
            times_s=self._frames.numpy() + self.times_s[0],
            position_m=motion.position_m[0, :, 0].numpy(),
            quat_wxyz=motion.quat_wxyz[0, :, 0].numpy(),
        )

    def _predicted(self, values: Tensor, draws: Tensor) -> tuple[Rollout, Tensor]:
        """Return the predicted motion of object and tips, of sequences (b, N, joints) under draws (b,), and targets."""
        targets = self.within_limits(values)
        times = torch.as_tensor(self.times_s - self.times_s[0])
        world = self.worlds.batch(tuple(draws.tolist()) if self.draws > 1 else ())
        command = JointCommand.targets(times[None], targets)
        counted = (self.hand.object, *self.hand.tips.links)
        return rollout(world, self.state, self._frames, {self.hand.chain.name: command}, bodies=counted), targets

    @property
    def _frames(self) -> Tensor:
        """Times of the predicted frames, from the state on [s]: up to `FRAMES` in a piece, at whole steps."""
        lengths = np.diff(self.times_s).round(SAME_DIGITS)  # plans at other times share what follows from them
        return _frames_of(tuple(lengths.tolist()), self.hand.task.planner.step_s)


@lru_cache(maxsize=64)
def _frames_of(lengths_s: tuple[float, ...], step_s: float) -> Tensor:
    """Return the times of frames [s] in pieces of some lengths [s]: up to `FRAMES` in each, at whole steps."""
    found = [0.0]
    for length in lengths_s:
        steps = max(1, math.ceil(length / step_s - 1e-6))
        frames = min(FRAMES, steps)
        found += (found[-1] + length * np.round(np.arange(1, frames + 1) * steps / frames) / steps).tolist()
    return torch.tensor(found, dtype=torch.float64)
