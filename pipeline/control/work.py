"""The work of runs of a task of control, estimated from counts."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from pathlib import Path

from ...schemas import AnyTask
from ..physics.rollout_cost import rollout_seconds
from ..physics.world import World
from ..runtime.work_budget import Part, duration, within_budget

LESS = "ask for fewer --seeds or --draws, or in the task for fewer samples, a lower control_hz or a shorter timeout_s."
_POLISH = 3.0
"""Work of a plan in units of its samples: Gauss-Newton, and the fixed costs of a batch."""
_STATE_BYTES = 13 * 8 * 6
"""Poses and velocities of a body at the end of a piece, with what residuals take of them, float64 [bytes]."""
_PLAN_BYTES = 9 * 8
"""Of a plan, by piece, in the recording [bytes]."""


def control_budget(world: World, task: AnyTask, seeds: int, draws: int, out: Path) -> AbstractContextManager[None]:
    """Return the check of the work of runs, see :func:`within_budget`.

    Args:
        world: The world of the predictions.
        task: The task.
        seeds: Number of runs.
        draws: Draws of the model for each plan.
        out: Where the runs are written.
    """
    planner = task.planner
    plans = seeds * math.ceil(task.success.timeout_s * planner.control_hz)
    rollouts = planner.samples * max(draws, 1)
    seconds = _POLISH * plans * rollout_seconds(world, rollouts, planner.horizon_s, rollouts)
    recorded = plans * planner.knots * _PLAN_BYTES
    part = Part(
        what=f"{task.source}: {plans:.3g} plans of {rollouts} rollouts of {duration(planner.horizon_s)}, "
        f"{planner.step_s:g} s a step",
        seconds=seconds,
        memory_bytes=rollouts * (planner.knots + 3) * len(world.bodies) * _STATE_BYTES + recorded,
        disk_bytes=recorded,
    )
    return within_budget([part], LESS, out)
