"""The controller without a plant: commands within limits, equal seeds, bad states."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from cgwm.pipeline.control.controller import Controller, ControlState
from cgwm.pipeline.control.horizon import Targets
from cgwm.pipeline.control.loop import Waiting
from cgwm.pipeline.control.planning import ControlPlan
from cgwm.schemas import NotConvergedError, UsageError
from helpers import fused_host
from helpers.pushing import push_task, pushed_model
from helpers.small_model import HALF

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]
GOOD = ControlState(
    time_s=0.0,
    joints={"x": -0.055, "y": 0.01},
    position_m=np.array([0.02, 0.01, HALF]),
    quat_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
)


def at(time_s: float, **changes: object) -> ControlState:
    return replace(GOOD, time_s=time_s, **changes)


def test_no_command_leaves_the_limits_whatever_the_noise() -> None:
    limits = {"speed_m_s": 0.25, "joints": {"x": [-0.12, 0.14], "y": [-0.13, 0.13]}}
    controller = Controller(pushed_model(), push_task(limits=limits), "mppi", seed=3)
    rng, before = np.random.default_rng(0), GOOD.joints
    for k in range(25):
        quat = rng.normal(size=4)
        state = at(
            0.05 * k,
            joints=dict(zip("xy", rng.normal(0, 0.3, 2), strict=True)) if k else GOOD.joints,
            position_m=rng.normal(0, 0.2, 3),
            quat_wxyz=quat / np.linalg.norm(quat),
            velocity_m_s=rng.normal(0, 3, 3),
            omega_body_rad_s=rng.normal(0, 30, 3),
        )
        command = controller.command(state)
        for name, value in command.items():
            low, high = limits["joints"][name]
            assert low <= value <= high
            assert abs(value - before[name]) <= 0.25 * controller.interval_s * (1 + 1e-12)
        before = command


def test_equal_seeds_give_equal_commands_and_others_do_not() -> None:
    task, model = push_task(goal={"position_m": [0.1, 0.0]}), pushed_model()
    states = [at(0.0), at(0.05), at(0.1)]
    one, same, other = (
        [controller.command(state) for state in states]
        for controller in (Controller(model, task, seed=seed, draws=2) for seed in (5, 5, 6))
    )
    assert one == same
    assert one != other


def test_bad_states_hold_the_last_command_are_counted_and_stop_the_run() -> None:
    controller = Controller(pushed_model(), push_task(planner={"bad_states": 5}))
    assert controller.command(None) == {}  # nothing to hold yet
    command = controller.command(at(0.1))
    nan = np.array([0.0, math.nan, 0.05])
    bad = [None, at(0.1), at(0.05), at(0.2, position_m=nan)]
    assert [controller.command(state) for state in bad] == [command] * 4
    assert controller.held == 5
    assert controller.command(at(0.25)) != {}  # a good one begins the count anew
    for state in (at(0.3, joints={"x": 0.0}), at(0.3, quat_wxyz=np.zeros(4)), None, None):
        controller.command(state)
    with pytest.raises(NotConvergedError) as caught:
        controller.command(None)
    assert str(caught.value) == (
        "5 states in a row are missing, stale or no numbers; the last one: there is none.\n"
        "Next: stop the robot, and check what measures the state."
    )
    assert controller.held == 10


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position_m": np.zeros(2)}, "position_m is not 3 finite numbers"),
        ({"quat_wxyz": np.ones(4)}, "quat_wxyz has not the length 1"),
        ({"joints": {"x": 0.0}}, "joint 'y' has no finite position"),
        ({"time_s": math.nan}, "time_s is not finite"),
        ({"quat_wxyz": None}, "quat_wxyz is not 4 finite numbers"),
        ({"position_m": ["0", "far", "0"]}, "position_m is not 3 finite numbers"),
        ({"joints": {"x": "0.0", "y": 0.0}}, "joint 'x' has no finite position"),
        ({"joints": None}, "joint 'x' has no finite position"),
        ({"joint_speeds": {"y": None}}, "joint 'y' has no finite speed"),
        ({"velocity_m_s": np.array([0, math.inf, 0])}, "velocity_m_s is not 3 finite numbers"),
        ({}, ""),
    ],
)
def test_a_state_says_what_is_wrong_with_it(changes: dict, words: str) -> None:
    assert replace(GOOD, **changes).fault() == words


def test_states_of_a_robot_with_more_joints_serve_and_those_in_other_units_are_told() -> None:
    alone, more = (Controller(pushed_model(), push_task(planner={"bad_states": 2})) for _ in range(2))
    joints = {**GOOD.joints, "wrist": math.nan}
    listed = [0.0, 0.0, float(GOOD.position_m[2])]
    state = at(0.1, joints=joints, joint_speeds={"wrist": 1.0}, position_m=listed, quat_wxyz=[1, 0, 0, 0])
    command = alone.command(at(0.1, position_m=np.array(listed), quat_wxyz=np.array([1.0, 0, 0, 0])))
    assert more.command(state) == more.command(at(0.2), math.nan) == command and more.held == 1
    for _ in range(2):
        more.plan(at(0.3, joints={"x": -60.0, "y": 0.0}))
    with pytest.raises(NotConvergedError, match="joint 'x' is at -60, far from its limits"):
        more.command(at(0.4, joints={"x": -60.0, "y": 0.0}))


def test_worst_draws_cost_more_than_all() -> None:
    state = at(0.0, joints={"x": -0.06, "y": 0.0})
    costs = {}
    for risk in ("mean", "worst_quarter"):
        task = push_task(planner={"risk": risk}, goal={"position_m": [0.1, 0.0]}, start={"finger_m": [-0.1, 0.0]})
        controller = Controller(pushed_model(), task, seed=1, draws=4)
        objective, warm = controller._objective(state, 0.0)
        costs[risk] = float(objective.costs(warm[None] + 0.1))
    assert costs["worst_quarter"] > costs["mean"]


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="-1 draws"):
        Controller(pushed_model(), push_task(), draws=-1)
    with pytest.raises(UsageError, match=r"no solver 'both\+'"):
        Controller(pushed_model(), push_task(), "both+")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UsageError, match="before the first plan"):
        Controller(pushed_model(), push_task()).forecast()


def test_a_plan_is_made_for_the_command_by_which_the_last_one_would_have_come() -> None:
    targets = Targets(times_s=np.zeros(1), values_m=np.zeros((1, 2)))
    plan = ControlPlan(state_s=0.0, acts_s=0.02, targets=targets, cost=0.0, wall_s=0.03, cpu_s=0.03)
    waiting = Waiting(0.02, "real")
    assert waiting.expected_s == 0.02
    assert waiting.begin(0.0, plan) and waiting.arrived(0.02) is None and waiting.arrived(0.04) is plan
    assert waiting.expected_s == 0.04
    assert not waiting.begin(0.04, replace(plan, wall_s=0.01)) and waiting.expected_s == 0.02
    assert Waiting(0.02, "ideal").expected_s == 0.0
