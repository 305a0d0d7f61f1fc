"""Whether an object comes nearer to its goal: where it does not, plans look farther ahead."""

from __future__ import annotations

import math

import torch

from ....schemas import HandTask
from ...geometry.rotation import quat_turn
from ..horizon import Array

NEARER_RAD = math.radians(5.0)
"""By how much a turn has to come nearer to the goal to count as progress [rad]."""
FARTHER = 2.0
"""Factor of the length of plans where there is none."""


class Patience:
    """Watches whether an object comes nearer to its goal.

    An object that lies on the palm, with no finger at it, is not tipped within a plan of half a second: nearly all
    samples cost the same, and the few that touch it mostly cost more, so that the fingers stay away. Plans of twice the
    length find how to tip it, but are worse while an object moves.

    Args:
        task: The task.
    """

    def __init__(self, task: HandTask) -> None:
        self._longest_s = task.planner.patience_s if task.goal.kind == "random" else math.inf
        self._within = math.radians(task.success.turn_deg)
        self.aim()

    def aim(self) -> None:
        """Begin anew: there is another goal."""
        self._nearest, self._since_s, self._over = math.inf, 0.0, False

    def over(self, time_s: float, quat_wxyz: Array, goal_wxyz: Array) -> bool:
        """Return whether an object has not come nearer for too long.

        Args:
            time_s: Time [s].
            quat_wxyz: Its orientation then, shape (4,).
            goal_wxyz: The goal, shape (4,).
        """
        left = float(quat_turn(torch.as_tensor(quat_wxyz), torch.as_tensor(goal_wxyz)).norm())
        if left < self._nearest - NEARER_RAD or left <= self._within:
            self._nearest, self._since_s, self._over = left, time_s, False
        elif not self._over and time_s - self._since_s >= self._longest_s:
            self._nearest, self._over = left, True  # nearer than here is progress, wherever it was before
        return self._over
