"""One run of a task for a hand: goals one after the other, until all are reached, the object drops or time is up."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from ....schemas import ClockName, HandTask, NotConvergedError
from ...geometry.rotation import quat_multiply, quat_turn
from ..horizon import Array
from ..loop import Commander, Recording, Sensor, Watch, unwatched
from .controller import HandController
from .plant import HandPlant, HandTruth


def hand_start(task: HandTask, seed: int) -> tuple[Array, Array]:
    """Return position (3,) [m] and orientation (4,) of the object at the start of a run."""
    low, high = np.radians(task.start.turn_deg)
    turn = np.random.default_rng([seed, 0]).uniform(low, high)
    quat = quat_multiply(torch.as_tensor(_about(task.goal.axis, turn)), torch.tensor(task.start.quat_wxyz))
    return np.array(task.start.position_m), quat.numpy()


def goals_of(task: HandTask, seed: int) -> Iterator[Array]:
    """Yield the orientations (4,) that are wanted one after the other."""
    rng = np.random.default_rng([seed, 4])
    last = hand_start(task, seed)[1]
    if task.goal.kind == "turn":
        side = 1.0 if rng.uniform() < 0.5 else -1.0
        while True:
            turn = torch.as_tensor(_about(task.goal.axis, side * math.radians(task.goal.turn_deg)))
            last = quat_multiply(turn, torch.as_tensor(last)).numpy()
            yield last
    while True:
        drawn = rng.normal(size=4)
        drawn /= np.linalg.norm(drawn)
        if _angle_deg(drawn, last) >= task.goal.turn_deg:
            last = drawn
            yield drawn


def run_hand(
    controller: HandController, plant: HandPlant, seed: int, clock: ClockName, watch: Watch = unwatched
) -> Recording:
    """Run a task for a hand from a seed; clocks as in `loop.run`.

    Args:
        controller: The controller.
        plant: The plant.
        seed: Seed of start, goals, noise and plans.
        clock: real or ideal.
        watch: Is told of the recording after each command; no clock charges it.
    """
    task, interval = controller.task, controller.interval_s
    controller.restart(seed)
    truth, goals = plant.reset(*hand_start(task, seed)), goals_of(task, seed)
    goal = next(goals)
    controller.aim(goal)
    sensor, recording = Sensor(task.plant, interval, seed), Recording(seed)
    commander = Commander(controller, clock, recording, task.planner.knots, controller.hand.home)
    within, since = 0.0, 0.0
    for number in range(math.ceil(task.success.timeout_s / interval - 1e-9)):
        now = number * interval
        command = commander.command(now, sensor.seen(now, truth))
        if command is None:
            break
        before = truth
        try:
            truth = plant.advance(np.array([command[name] for name in controller.joints]), interval)
        except NotConvergedError:
            recording.ended = "diverged"
            break
        errors = hand_errors(task, truth, goal)
        good = errors[1] <= task.success.turn_deg and errors[0] <= (task.success.position_m or math.inf)
        within, since = within + interval if good else 0.0, since + interval
        reached = good and within >= task.success.hold_s - 1e-9
        _note_command(recording, controller, now, (before, truth), command, goal, (*errors, float(reached)))
        watch(recording)
        if reached:
            recording.goals += 1
            if recording.goals >= task.success.goals:
                recording.ended = "success"
                break
            goal, within, since = next(goals), 0.0, 0.0
            controller.aim(goal)
        if errors[0] > task.success.drop_m:
            recording.ended = "dropped"
            break
        if since >= task.success.goal_s - 1e-9:
            break
    commander.finish()
    return recording


def hand_errors(task: HandTask, truth: HandTruth, goal_wxyz: Array) -> tuple[float, float]:
    """Return the distance of the object from where it is wanted [m], and its turn from the goal [deg]."""
    away = float(np.linalg.norm(truth.position_m - np.array(task.wanted_m)))
    return away, _angle_deg(truth.quat_wxyz, goal_wxyz)


def _angle_deg(quat_wxyz: Array, goal_wxyz: Array) -> float:
    turn = quat_turn(torch.as_tensor(goal_wxyz), torch.as_tensor(quat_wxyz))
    return math.degrees(float(turn.norm()))


def _about(axis: tuple[float, float, float], angle_rad: float) -> Array:
    direction = np.array(axis) / np.linalg.norm(axis)
    return np.array([math.cos(angle_rad / 2), *(math.sin(angle_rad / 2) * direction)])


def _note_command(
    recording: Recording,
    controller: HandController,
    now_s: float,
    truths: tuple[HandTruth, HandTruth],
    command: dict[str, float],
    goal_wxyz: Array,
    outcome: tuple[float, float, float],
) -> None:
    """Record a command, the state before it and what came of it."""
    before, after = truths
    last = recording.commands["target"][-1] if recording.commands else controller.hand.home
    target = np.array([command[name] for name in controller.joints])
    reach = controller.task.limits.speed_rad_s * controller.interval_s
    recording.add(
        "commands",
        time_s=now_s,
        position_m=before.position_m,
        quat_wxyz=before.quat_wxyz,
        velocity_m_s=before.velocity_m_s,
        omega_body_rad_s=before.omega_body_rad_s,
        joints=before.joints_rad,
        speeds=before.speeds_rad_s,
        target=target,
        action=np.clip((target - last) / reach, -1.0, 1.0),
        next_position_m=after.position_m,
        next_quat_wxyz=after.quat_wxyz,
        next_joints=after.joints_rad,
        goal_wxyz=goal_wxyz,
        grip_n=after.grip_n,
        position_error_m=outcome[0],
        turn_error_deg=outcome[1],
        reached=outcome[2],
    )
