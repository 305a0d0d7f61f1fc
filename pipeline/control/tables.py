"""The recording of a run as the arrays of `run.h5`, and as the figures of `control.json`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...datasets.rollouts.control_file import RunTables
from ...schemas import ControlRun, ControlTask
from .horizon import Array
from .loop import Recording


def tables_of(recording: Recording, task: ControlTask, timed: bool) -> RunTables:
    """Return a recording as arrays.

    Args:
        recording: The recording.
        task: The task.
        timed: Whether the durations of plans are kept; without them equal runs are equal to the byte.
    """
    rows = len(recording.commands.get("time_s", ()))

    def commands(name: str, *tail: int) -> Array:
        return np.asarray(recording.commands.get(name, ()), float).reshape(rows, *tail)

    time, finger = commands("time_s"), commands("finger_m", 2)
    pose = np.concatenate((commands("position_m", 3), commands("quat_wxyz", 4)), -1)
    moving = np.concatenate((commands("velocity_m_s", 3), commands("omega_body_rad_s", 3)), -1)
    errors = commands("position_error_m"), commands("turn_error_deg")
    dones = np.zeros(rows, np.uint8)
    dones[-1:] = 1
    arrays = {
        "actions": commands("action", 2),
        "rewards": -errors[0] / task.success.position_m - errors[1] / task.success.turn_deg,
        "dones": dones,
        "states": np.concatenate((time[:, None], pose, moving, finger), -1),
        "obs/object": pose,
        "obs/finger": finger,
        "next_obs/object": np.concatenate((commands("next_position_m", 3), commands("next_quat_wxyz", 4)), -1),
        "next_obs/finger": commands("next_finger_m", 2),
        "control/time": time,
        "control/target": commands("target_m", 2),
        "control/position_error": errors[0],
        "control/turn_error": errors[1],
        "control/force": commands("force_n", 3),
        **plan_arrays(recording, task.planner.knots, 2, timed),
    }
    return RunTables(seed=recording.seed, ended=recording.ended, arrays=arrays)


def plan_arrays(recording: Recording, knots: int, joints: int, timed: bool) -> dict[str, np.ndarray]:
    """Return the plans of a recording as arrays.

    Args:
        recording: The recording.
        knots: Number of pieces of a plan.
        joints: Number of joints.
        timed: Whether the durations are kept.
    """

    def plans(name: str, *tail: int) -> Array:
        return np.asarray(recording.plans.get(name, ()), float).reshape(-1, *tail)

    return {
        "plans/state_time": plans("state_s"),
        "plans/acts_time": plans("acts_s"),
        "plans/wall": plans("wall_s") * timed,
        "plans/cpu": plans("cpu_s") * timed,
        "plans/late": plans("late").astype(np.uint8),
        "plans/cost": plans("cost"),
        "plans/times": plans("times_s", knots),
        "plans/targets": plans("targets_m", knots, joints),
        "plans/object": np.concatenate((plans("position_m", knots, 3), plans("quat_wxyz", knots, 4)), -1),
    }


def figures_of(recording: Recording, tables: RunTables, start: tuple[float, float], interval_s: float) -> ControlRun:
    """Return the figures of a run.

    Args:
        recording: The run.
        tables: Its arrays.
        start: Errors of position [m] and turn [deg] at its start.
        interval_s: Length of a command [s].
    """
    arrays = tables.arrays
    wall, cpu = (1e3 * recording.column(name, "plans") for name in ("wall_s", "cpu_s"))
    errors = (arrays["control/position_error"], arrays["control/turn_error"])
    last = tuple(float(values[-1]) if len(values) else first for values, first in zip(errors, start, strict=True))
    return ControlRun(
        seed=recording.seed,
        ended=recording.ended,
        time_s=len(arrays["actions"]) * interval_s,
        position_error_m=last[0],
        turn_error_deg=last[1],
        start_position_error_m=start[0],
        start_turn_error_deg=start[1],
        goals=recording.goals,
        commands=len(arrays["actions"]),
        plans=len(wall),
        late_plans=recording.late,
        held_commands=recording.held,
        plan_ms=float(np.median(wall)) if len(wall) else 0.0,
        plan_ms_95=float(np.percentile(wall, 95)) if len(wall) else 0.0,
        plan_cpu_ms=float(np.median(cpu)) if len(cpu) else 0.0,
        largest_force_n=float(contact_force(arrays).max(initial=0.0)),
    )


def contact_force(arrays: Mapping[str, Array]) -> Array:
    """Return the size of the contact force on the object (commands,) [N]; of a hand the sum of all."""
    return arrays["control/grip"] if "control/grip" in arrays else np.linalg.norm(arrays["control/force"], axis=-1)
