"""The recording of a run of a hand as the arrays of `run.h5`."""

from __future__ import annotations

import numpy as np

from ....datasets.rollouts.control_file import RunTables
from ..horizon import Array
from ..loop import Recording
from ..tables import plan_arrays
from .controller import HandController


def hand_tables_of(recording: Recording, controller: HandController, timed: bool) -> RunTables:
    """Return a recording as arrays.

    Args:
        recording: The recording.
        controller: The controller.
        timed: Whether the durations of plans are kept; without them equal runs are equal to the byte.
    """
    task, count = controller.task, len(controller.joints)
    rows = len(recording.commands.get("time_s", ()))

    def commands(name: str, *tail: int) -> Array:
        return np.asarray(recording.commands.get(name, ()), float).reshape(rows, *tail)

    time, joints = commands("time_s"), commands("joints", count)
    pose = np.concatenate((commands("position_m", 3), commands("quat_wxyz", 4)), -1)
    moving = np.concatenate((commands("velocity_m_s", 3), commands("omega_body_rad_s", 3)), -1)
    errors, goal = (commands("position_error_m"), commands("turn_error_deg")), commands("goal_wxyz", 4)
    dones = np.zeros(rows, np.uint8)
    dones[-1:] = 1
    place = task.success.position_m or task.costs.position_m
    arrays = {
        "actions": commands("action", count),
        "rewards": -errors[0] / place - errors[1] / task.success.turn_deg,
        "dones": dones,
        "states": np.concatenate((time[:, None], pose, moving, joints, commands("speeds", count)), -1),
        "obs/object": pose,
        "obs/joints": joints,
        "obs/goal": goal,
        "next_obs/object": np.concatenate((commands("next_position_m", 3), commands("next_quat_wxyz", 4)), -1),
        "next_obs/joints": commands("next_joints", count),
        "next_obs/goal": goal,
        "control/time": time,
        "control/target": commands("target", count),
        "control/position_error": errors[0],
        "control/turn_error": errors[1],
        "control/grip": commands("grip_n"),
        "control/reached": commands("reached").astype(np.uint8),
        **plan_arrays(recording, task.planner.knots, count, timed),
    }
    return RunTables(seed=recording.seed, ended=recording.ended, arrays=arrays, robot="hand", joints=controller.joints)
