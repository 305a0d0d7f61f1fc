"""Plants and the loop around them: known forces, the clock, delay, lost states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.control import loop
from cgwm.pipeline.control.controller import Controller
from cgwm.pipeline.control.loop import Sensor, run
from cgwm.pipeline.control.mujoco_plant import MujocoPlant
from cgwm.pipeline.control.plant import ModelPlant, Truth
from cgwm.pipeline.control.task_world import task_world
from cgwm.schemas import InputDataError
from helpers import fused_host
from helpers.pushing import RADIUS, push_task, pushed_model, write_cube
from helpers.small_model import HALF, MASS

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]
DT = 0.05
FRICTION = 0.4
KINDS = ("model", "mujoco")


def plant_of(kind: str, folder: Path, **errors: Any) -> ModelPlant | MujocoPlant:
    plant = {"kind": kind, "meshes": [write_cube(folder)], **errors}
    found = task_world(pushed_model(), push_task(str(folder / "T"), plant=plant))
    return ModelPlant(found) if kind == "model" else MujocoPlant(found)


def pushed(plant: ModelPlant | MujocoPlant, steps: int = 12, speed: float = 0.1) -> list[Truth]:
    """Push the resting cube along x, from contact."""
    finger = np.array([-HALF - RADIUS - 0.001, 0.0])
    plant.reset(np.zeros(2), 0.0, finger)
    return [plant.advance(finger + np.array((speed * DT * (k + 1), 0.0)), DT) for k in range(steps)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("errors", "expected"), [
    ({}, FRICTION * MASS * 9.81),
    ({"friction_factor": 0.5, "mass_factor": 1.5}, 0.75 * FRICTION * MASS * 9.81),
])  # fmt: skip
def test_a_steady_push_takes_the_force_of_friction(kind: str, errors: dict, expected: float, tmp_path: Path) -> None:
    steady = pushed(plant_of(kind, tmp_path, **errors))[6:]
    force = np.mean([truth.force_n for truth in steady], 0)
    assert force[0] == pytest.approx(expected, rel=0.05)
    moved = steady[-1].position_m - steady[0].position_m
    assert moved[0] == pytest.approx(0.1 * DT * (len(steady) - 1), rel=0.05)


@pytest.mark.parametrize(
    ("scale", "shift", "message"),
    [(1e3, 0.0, "true object measures 173 m"), (1.0, 0.1, "lies 0.1 m from")],
)
def test_a_true_mesh_in_other_units_or_another_frame_is_refused(
    scale: float, shift: float, message: str, tmp_path: Path
) -> None:
    path = tmp_path / write_cube(tmp_path)
    lines = [line.split() for line in path.read_text().splitlines()]
    moved = [
        " ".join(["v", str(scale * float(x) + shift), *(str(scale * float(one)) for one in rest)])
        if kind == "v" else " ".join((kind, x, *rest))
        for kind, x, *rest in lines
    ]  # fmt: skip
    path.write_text("\n".join(moved))
    found = task_world(pushed_model(), push_task(str(tmp_path / "T"), plant={"kind": "mujoco", "meshes": [path.name]}))
    with pytest.raises(InputDataError, match=message):
        MujocoPlant(found)


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_of_another_size_is_met_earlier(kind: str, tmp_path: Path) -> None:
    start = np.array([-HALF - RADIUS - 0.012, 0.0])
    ways = []
    for factor in (1.0, 1.2):
        plant = plant_of(kind, tmp_path, size_factor=factor)
        plant.reset(np.zeros(2), 0.0, start)
        ways.append(
            [plant.advance(start + np.array((0.1 * DT * (k + 1), 0.0)), DT) for k in range(6)][-1].position_m[0]
        )
    assert ways[0] < 0.021 < ways[0] + 0.01 < ways[1] + 0.002


@pytest.mark.parametrize("kind", KINDS)
def test_what_nobody_pushes_lies_still(kind: str, tmp_path: Path) -> None:
    plant, far = plant_of(kind, tmp_path), np.array([-0.3, 0.0])
    before = plant.reset(np.array([0.02, 0.03]), 0.4, far)
    after = [plant.advance(far, DT) for _ in range(4)][-1]
    np.testing.assert_allclose(after.position_m, before.position_m, atol=1e-3)  # it sinks in by g tau^2
    np.testing.assert_allclose(after.quat_wxyz, before.quat_wxyz, atol=2e-3)
    np.testing.assert_array_equal(after.force_n, 0.0)


class Slow(Controller):
    """A controller whose plans are said to take certain wall times."""

    walls = (0.01,)

    def plan(self, *given: Any) -> Any:
        plan = super().plan(*given)
        count = self.asked = getattr(self, "asked", -1) + 1
        return plan if plan is None else replace(plan, wall_s=self.walls[count % len(self.walls)])


@pytest.mark.parametrize(
    ("wall_s", "plans", "late"), [((0.01,), 6, 0), ((0.07,), 3, 3), ((0.01, 0.12), 4, 2)]
)  # fmt: skip
def test_plans_that_take_longer_than_a_command_are_counted_and_act_later(wall_s: tuple, plans: int, late: int) -> None:
    controller = Slow(pushed_model(), push_task(goal={"position_m": [0.1, 0.0]}))
    controller.walls = wall_s
    found = run(controller, ModelPlant(controller.task_world), 0, "real")
    assert (len(found.plans["cost"]), found.late) == (plans, late)
    assert len(found.commands["time_s"]) == 6
    targets, finger = found.column("target_m"), found.commands["finger_m"][0]
    np.testing.assert_array_equal(targets[0], finger)  # no plan acts at once
    assert found.ended == "timeout"


def test_the_ideal_clock_lets_a_plan_act_at_once() -> None:
    controller = Slow(pushed_model(), push_task(goal={"position_m": [0.1, 0.0]}))
    controller.walls = (9.0,)
    found = run(controller, ModelPlant(controller.task_world), 0, "ideal")
    assert (len(found.plans["cost"]), found.late) == (6, 0)
    assert (found.column("target_m")[0] != found.commands["finger_m"][0]).any()


def test_measured_states_are_late_and_noisy_as_asked() -> None:
    still = Truth(position_m=np.zeros(3), quat_wxyz=np.array([1.0, 0, 0, 0]), velocity_m_s=np.zeros(3),
                  omega_body_rad_s=np.zeros(3), finger_m=np.zeros(2), force_n=np.zeros(3))  # fmt: skip
    late = Sensor(push_task(plant={"delay_s": 1.5 * DT}).plant, DT, 0)
    seen = [late.seen(DT * k, replace(still, position_m=np.array([k, 0.0, 0.0]))) for k in range(4)]
    assert [state.time_s for state in seen] == pytest.approx([-1.5 * DT, -0.5 * DT, 0.5 * DT, 1.5 * DT])
    assert [state.position_m[0] for state in seen] == pytest.approx([0.0, 0.0, 0.5, 1.5])
    sensor = Sensor(push_task(plant={"delay_s": 2 * DT, "noise_m": 0.003, "noise_deg": 3.0}).plant, DT, 0)
    seen = [sensor.seen(DT * k, still) for k in range(600)]
    assert seen[5].velocity_m_s is None  # differences of noisy poses say nothing
    assert np.std([state.position_m for state in seen]) == pytest.approx(0.003, rel=0.1)
    turns = np.degrees([2 * state.quat_wxyz[1:] for state in seen])
    assert np.std(turns) == pytest.approx(3.0, rel=0.1)


def test_a_run_stops_when_states_stay_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop.Sensor, "seen", lambda self, time_s, truth: None)
    controller = Controller(pushed_model(), push_task(planner={"bad_states": 3}))
    found = run(controller, ModelPlant(controller.task_world), 0, "real")
    assert (found.ended, found.held) == ("bad_states", 3)
    assert len(found.commands["time_s"]) == 2
    np.testing.assert_array_equal(found.column("target_m"), found.column("finger_m"))


def test_an_object_at_its_goal_is_a_success_after_the_time_to_hold() -> None:
    start = {"position_m": [0.0, 0.0], "turn_deg": [0.0, 0.0], "finger_m": [-0.2, 0.0]}
    task = push_task(start=start, success={"hold_s": 2 * DT, "timeout_s": 1.0})
    controller = Controller(pushed_model(), task)
    found = run(controller, ModelPlant(controller.task_world), 0, "ideal")
    assert (found.ended, len(found.commands["time_s"])) == ("success", 2)
