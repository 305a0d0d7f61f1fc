"""Plans that look farther ahead where an object comes no nearer to its goal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.patience import FARTHER, Patience
from cgwm.pipeline.control.planning import ControlState
from cgwm.schemas import HandTask
from helpers import fused_host
from helpers.paddles import hand_task, write_hand
from helpers.pushing import pushed_model

WANTED = np.array([1.0, 0.0, 0.0, 0.0])


def about_z(angle_deg: float) -> np.ndarray:
    half = math.radians(angle_deg) / 2
    return np.array([math.cos(half), 0.0, 0.0, math.sin(half)])


def over(angle_deg: Callable[[float], float], kind: str = "random") -> list[float]:
    """Return the times, 0.1 s apart, at which an object at an angle from its goal has not come nearer for 2 s."""
    task = HandTask.model_validate(
        {"goal": {"kind": kind}, "planner": {"patience_s": 2.0}, "success": {"turn_deg": 20.0}}
    )
    patience, times = Patience(task), np.arange(0.0, 8.0, 0.1)
    return [time_s for time_s in times if patience.over(time_s, about_z(angle_deg(time_s)), WANTED)]


def test_patience_ends_where_an_object_stays_and_returns_when_it_comes_nearer() -> None:
    found = over(lambda time_s: 100.0 if time_s < 4.95 else 94.0)
    assert (found[0], found[-1]) == (pytest.approx(2.0), pytest.approx(7.9))
    assert not [time_s for time_s in found if 4.95 < time_s < 6.95]


def test_nearer_is_meant_from_where_patience_ended() -> None:
    """It had been nearer, and fell back."""
    found = over(lambda time_s: 40.0 if time_s < 1 else 110.0 if time_s < 4.95 else 100.0)
    assert found[0] == pytest.approx(2.0) and not [time_s for time_s in found if 4.95 < time_s < 6.9]


@pytest.mark.parametrize(
    ("angle_deg", "kind"),
    [
        (lambda time_s: 170.0 - 20 * time_s, "random"),  # comes nearer
        (lambda time_s: 15.0, "random"),  # is there
        (lambda time_s: 100.0, "turn"),
    ],
)
def test_otherwise_it_does_not_end(angle_deg: Callable[[float], float], kind: str) -> None:
    assert not over(angle_deg, kind)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
def test_plans_are_longer_then_until_there_is_a_new_goal(tmp_path: Path) -> None:
    write_hand(tmp_path)
    task = hand_task(tmp_path, goal={"kind": "random"}, planner={"patience_s": 0.2})
    controller = HandController(pushed_model(visible=False), task)
    controller.aim(about_z(150.0))
    still = ControlState(
        time_s=0.0,
        joints=dict(zip(controller.joints, controller.hand.home.tolist(), strict=True)),
        position_m=np.array(task.start.position_m),
        quat_wxyz=np.array(task.start.quat_wxyz),
    )
    lengths = []
    for time_s in (0.0, 0.1, 0.25):
        plan = controller.plan(replace(still, time_s=time_s))
        assert plan is not None
        lengths.append(plan.targets.times_s[-1] - time_s)
    controller.aim(about_z(140.0))
    plan = controller.plan(replace(still, time_s=0.3))
    assert plan is not None
    usual = task.planner.horizon_s
    assert [*lengths, plan.targets.times_s[-1] - 0.3] == pytest.approx([usual, usual, FARTHER * usual, usual])
