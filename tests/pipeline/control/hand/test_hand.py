"""Control of a hand: its shapes and limits, plans and plants, and what a task may not ask."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.cli.app import app
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.rollouts.control_file import read_runs
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.loop import goals_of, hand_start, run_hand
from cgwm.pipeline.control.hand.plant import HandModelPlant, HandScenePlant
from cgwm.pipeline.control.hand.world import hand_world
from cgwm.pipeline.control.planning import ControlState
from cgwm.pipeline.geometry.rotation import quat_turn
from cgwm.pipeline.sg_gs.collision.link_hulls import rounded_hull
from cgwm.pipeline.validate import validate
from cgwm.schemas import (
    HAND_TASKS,
    ControlResult,
    HandTask,
    InputDataError,
    NotConvergedError,
    UsageError,
    read_any_task,
    task_toml,
)
from helpers import fused_host
from helpers.paddles import JOINTS, hand_task, write_hand
from helpers.pushing import pushed_model
from helpers.small_model import HALF
from typer.testing import CliRunner

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("hand")
    write_hand(found)
    return found


@pytest.fixture(scope="module")
def model() -> Model:
    return pushed_model(visible=False)


@pytest.fixture(scope="module")
def controller(folder: Path, model: Model) -> HandController:
    return HandController(model, hand_task(folder))


def begun(controller: HandController, time_s: float = 0.0) -> ControlState:
    task = controller.task
    return ControlState(
        time_s=time_s,
        joints=dict(zip(controller.joints, controller.hand.home.tolist(), strict=True)),
        position_m=np.array(task.start.position_m),
        quat_wxyz=np.array(task.start.quat_wxyz),
    )


def test_a_box_of_few_balls_is_the_box() -> None:
    half = np.array([0.1, 0.02, 0.04])
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    centers, radii = rounded_hull(half * signs, 16)
    assert len(radii) == 8
    for axis in np.eye(3):
        assert (centers @ axis + radii).max() == pytest.approx(half @ axis, abs=1e-12)


def test_a_shape_with_too_many_corners_keeps_those_that_reach_farthest() -> None:
    ball = np.random.default_rng(0).normal(size=(300, 3))
    ball *= 0.03 / np.linalg.norm(ball, axis=1, keepdims=True)
    centers, radii = rounded_hull(ball, 24)
    assert len(radii) <= 24
    reach = (centers @ ball.T / 0.03 + radii[:, None]).max(0)
    assert 0.7 * 0.03 < reach.min() and reach.max() < 1.05 * 0.03


def test_the_world_has_the_hand_of_the_file(controller: HandController) -> None:
    hand = controller.hand
    assert hand.joints == JOINTS
    assert hand.world.body_names == ["palm", "arm", "tip", "cube"]
    assert (hand.lower.tolist(), hand.upper.tolist()) == ([-1.5, -0.5], [1.5, 0.5])
    assert not controller.slow


def test_a_link_that_is_apart_touches_nothing(folder: Path, model: Model) -> None:
    hand = hand_world(model, hand_task(folder, robot={"apart": ("tip",)}))
    counts = [body.radii.shape[1] for body in hand.world.bodies]
    assert counts[:3] == [8, 8, 0] and [hand.world.body_names[k] for k, _ in hand.world.pairs if k != 3] == ["arm"]


def test_each_part_of_a_link_is_a_shape_that_may_have_a_friction_of_its_own(folder: Path, model: Model) -> None:
    """The common hull of a hook would fill its hollow, in which an object can lie."""
    one = '<geom type="box" size="0.04 0.006 0.015" pos="0.04 0 0" mass="0.05"/>'
    hook = one + '<geom type="box" size="0.006 0.03 0.015" pos="0.08 0.03 0" mass="0.01"/>'
    (folder / "parts.xml").write_text((folder / "hand.xml").read_text().replace(one, hook))
    robot = {"file": "parts.xml", "friction": {"arm": 0.5, "arm/1": 0.9}}
    world = hand_world(model, hand_task(folder, robot=robot)).world
    assert world.body_names == ["palm", "arm", "tip", "arm/1", "cube"]
    assert [float(world.law_of(k, 4).friction) for k in (1, 3)] == [0.5, 0.9]
    low, high = (getattr(world.bodies[1].centers[0], side)(0).values for side in ("min", "max"))
    assert (high - low)[1] < 0.012  # the arm alone, not the hull of both
    with pytest.raises(InputDataError, match="no link 'arm/2'"):
        hand_world(model, hand_task(folder, robot=robot | {"friction": {"arm/2": 0.9}}))


def test_a_convex_object_of_many_balls_has_as_few_corners_as_a_link(folder: Path, model: Model) -> None:
    convex = replace(model, file=model.file.model_copy(update={
        "bodies": tuple(body.model_copy(update={"convex": True}) for body in model.file.bodies)
    }))  # fmt: skip
    many, few = (
        hand_world(convex, hand_task(folder, robot={"corners": count})).world.bodies[-1] for count in (200, 24)
    )
    assert many.radii.shape[1] == 27
    assert few.radii.shape[1] <= 24
    reach = [(one.centers[0].abs() + one.radii[0][:, None]).amax(0) for one in (many, few)]
    torch.testing.assert_close(*reach, atol=1e-3, rtol=0)


def test_a_link_touches_the_root_as_the_hull_of_its_parts_and_the_object_as_its_parts(
    folder: Path, model: Model
) -> None:
    one = '<geom type="box" size="0.04 0.006 0.015" pos="0.04 0 0" mass="0.05"/>'
    hook = one + '<geom type="box" size="0.006 0.03 0.015" pos="0.08 0.03 0" mass="0.01"/>'
    (folder / "parts.xml").write_text((folder / "hand.xml").read_text().replace(one, hook))
    world = hand_world(model, hand_task(folder, robot={"file": "parts.xml", "touching": (("arm", "palm"),)})).world
    names = world.body_names
    assert names == ["palm", "arm", "tip", "arm/1", "arm/whole", "cube"]
    pairs = {(names[a], names[b]) for a, b in world.pairs}
    assert pairs == {("cube", "palm"), *((name, "cube") for name in ("arm", "tip", "arm/1")), ("arm/whole", "palm")}
    low, high = (getattr(world.bodies[4].centers[0], side)(0).values for side in ("min", "max"))
    assert 0.06 < (high - low)[1] < 0.067  # of both parts
    assert float(world.bodies[4].mass) == 0.0


def test_an_object_beyond_what_is_kept_costs_its_further_distance(folder: Path, model: Model) -> None:
    costs = []
    for lost_m in (1e5, 0.01):
        controller = HandController(model, hand_task(folder, costs={"keep_m": 0.02, "lost_m": lost_m}))
        state = begun(controller)
        there = replace(state, position_m=state.position_m + np.array([0.0, 0.03, 0.0]))
        objective, warm = controller._objective(there, 0.0)
        costs.append(float(objective.costs(warm[None])[0]))
    away = objective.forecast(warm).position_m[1:] - np.array(controller.task.wanted_m)
    further = np.maximum(np.linalg.norm(away, axis=1) - 0.02, 0) / 0.01
    assert further[-1] > 0.9
    assert costs[1] - costs[0] == pytest.approx((further**2).mean() + further[-1] ** 2, rel=1e-6)


def test_no_target_exceeds_range_or_speed_whatever_the_noise(controller: HandController) -> None:
    controller.restart(0)
    objective, _ = controller._objective(begun(controller), 0.05)
    values = torch.as_tensor(np.random.default_rng(0).normal(0, 50, (40, *objective.shape)))
    targets = objective.within_limits(values).numpy()
    assert (targets >= controller.hand.lower - 1e-12).all() and (targets <= controller.hand.upper + 1e-12).all()
    speeds = np.abs(np.diff(targets, axis=1)) / np.diff(objective.times_s)[:, None]
    assert speeds.max() <= controller.task.limits.speed_rad_s * (1 + 1e-9)


def test_equal_seeds_give_equal_commands_and_bad_states_hold_them(controller: HandController) -> None:
    controller.aim((math.cos(0.2), 0, 0, math.sin(0.2)))
    found = []
    for _ in range(2):
        controller.restart(3)
        found.append(controller.command(begun(controller)))
    assert found[0] == found[1] and set(found[0]) == set(JOINTS)
    assert controller.command(None) == found[1]
    broken = begun(controller, 1.0)
    broken.joints["swing"] = math.nan  # pyright: ignore[reportIndexIssue]
    assert controller.command(broken) == found[1] and controller.held == 2
    for _ in range(controller.task.planner.bad_states - 3):
        controller.command(None)
    with pytest.raises(NotConvergedError, match="30 states in a row"):
        controller.command(None)
    with pytest.raises(UsageError, match="orientation"):
        controller.aim((0, 0, 0, 0))


def test_a_plan_turns_the_object_the_way_that_is_wanted(controller: HandController) -> None:
    for side in (1, -1):
        controller.restart(0)
        controller.aim((math.cos(0.3), 0, 0, side * math.sin(0.3)))
        plan = controller.plan(begun(controller))
        assert plan is not None
        last = controller.forecast().quat_wxyz[-1]
        if plan.targets.values_m[-1, 0] > 0.1:  # the paddle comes from below and can push up alone
            assert np.isfinite(last).all()
    still = controller._objective(begun(controller), 0.0)[0]
    assert plan.cost <= float(still.costs(torch.zeros(1, *still.shape))[0]) + 1e-9


def test_turns_are_measured_the_shorter_way() -> None:
    goal = torch.tensor([math.cos(0.4), 0.0, 0.0, math.sin(0.4)], dtype=torch.float64)
    for quat in (goal, -goal):
        assert float(quat_turn(goal, quat).norm()) == pytest.approx(0, abs=1e-9)
    assert float(quat_turn(goal, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)).norm()) == pytest.approx(0.8)


def test_goals_are_the_turn_of_the_task_or_far_enough_apart(folder: Path) -> None:
    turn = hand_task(folder, goal={"turn_deg": 90.0}, start={"turn_deg": (-180.0, 180.0)})
    start, goal = hand_start(turn, 5)[1], next(goals_of(turn, 5))
    assert math.degrees(float(quat_turn(torch.as_tensor(goal), torch.as_tensor(start)).norm())) == pytest.approx(90)
    far = goals_of(hand_task(folder, goal={"kind": "random", "turn_deg": 60.0}), 1)
    drawn = [torch.as_tensor(next(far)) for _ in range(8)]
    for one, other in pairwise(drawn):
        assert math.degrees(float(quat_turn(other, one).norm())) >= 60
    with pytest.raises(ValueError, match=r"goal\.turn_deg = 180 of random goals is more than 175"):
        hand_task(folder, goal={"kind": "random", "turn_deg": 180.0})


@pytest.mark.parametrize("kind", [HandModelPlant, HandScenePlant])
def test_both_plants_move_the_joint_that_is_commanded(controller: HandController, kind: type) -> None:
    plant = kind(controller.hand)
    before = plant.reset(*hand_start(controller.task, 0))
    np.testing.assert_allclose(before.joints_rad, controller.hand.home, atol=1e-9)
    for _ in range(4):
        after = plant.advance(np.array([-0.5, 0.0]), 0.05)  # away from the cube
    assert after.joints_rad[0] < -0.2 and abs(after.joints_rad[1]) < 0.05
    assert np.linalg.norm(after.position_m - before.position_m) < 0.003
    weight = after.grip_n / 9.81  # on the palm
    assert weight == pytest.approx(
        0.2 if kind is HandScenePlant else float(controller.hand.world.bodies[-1].mass), rel=0.02
    )


def test_gears_and_offsets_of_a_servo_do_not_move_its_targets(tmp_path: Path, model: Model) -> None:
    geared = '<position joint="swing" kp="2" kv="0.1" gear="3"/>'
    general = '<general joint="lift" biastype="affine" gainprm="4" biasprm="0.5 -2 -0.1" ctrlrange="-2 2"/>'
    write_hand(tmp_path, servos=geared + general)
    hand = hand_world(model, hand_task(tmp_path, limits={"joints": {"lift": (-0.2, 0.5)}}))
    assert (hand.lower.tolist(), hand.upper.tolist()) == ([-1.5, -0.2], [1.5, 0.5])
    plant = HandScenePlant(hand)
    plant.reset(np.array([0.0, 0.06, 0.05]), np.array([1.0, 0, 0, 0]))
    for _ in range(20):
        truth = plant.advance(np.array([-0.5, 0.1]), 0.05)
    np.testing.assert_allclose(truth.joints_rad, (-0.5, 0.1), atol=0.02)
    with pytest.raises(InputDataError, match=r"\[limits\] joints: 'swing' = -90 to 90"):  # in degrees
        hand_world(model, hand_task(tmp_path, limits={"joints": {"swing": (-90, 90)}}))


def test_a_scene_with_another_gravity_is_refused(folder: Path, model: Model) -> None:
    (folder / "up.xml").write_text(
        (folder / "scene.xml").read_text().replace("<option ", '<option gravity="0 -9.81 0" ')
    )
    with pytest.raises(InputDataError, match=r"its gravity is \[0.0, -9.81, 0.0\]"):
        HandScenePlant(hand_world(model, hand_task(folder, plant={"kind": "mujoco", "scene": "up.xml"})))


def test_an_object_of_the_scene_in_other_units_is_refused(folder: Path, model: Model) -> None:
    large = (folder / "scene.xml").read_text().replace(f'size="{HALF} {HALF} {HALF}"', 'size="50 50 50"')
    (folder / "large.xml").write_text(large)
    with pytest.raises(InputDataError, match="body 'thing': the true object measures 173 m"):
        HandScenePlant(hand_world(model, hand_task(folder, plant={"kind": "mujoco", "scene": "large.xml"})))


def test_a_motor_of_the_scene_is_no_servo(folder: Path, model: Model) -> None:
    """It would take a target for a torque."""
    servo = '<position joint="lift" kp="2" kv="0.1"/>'
    (folder / "motor.xml").write_text((folder / "scene.xml").read_text().replace(servo, '<motor joint="lift"/>'))
    hand = hand_world(model, hand_task(folder, plant={"kind": "mujoco", "scene": "motor.xml"}))
    with pytest.raises(InputDataError, match="joint 'lift' has no servo"):
        HandScenePlant(hand)


def test_a_run_ends_at_its_time_or_when_the_object_is_dropped(controller: HandController) -> None:
    plant = HandScenePlant(controller.hand)
    found = run_hand(controller, plant, 0, "ideal")
    assert (found.ended, found.goals, len(found.commands["time_s"])) == ("timeout", 0, 6)
    plant.reset = lambda *_: HandScenePlant.reset(plant, np.array([0.0, 0.06, 0.5]), np.array([1.0, 0, 0, 0]))
    assert run_hand(controller, plant, 0, "ideal").ended == "dropped"


def test_the_verb_runs_a_hand_and_its_run_is_valid(folder: Path, model: Model, tmp_path: Path) -> None:
    write_model(tmp_path / "model", model)
    task = hand_task(folder, plant={"kind": "mujoco"})
    (folder / "task.toml").write_text(task_toml(task))
    words = ["control", str(tmp_path / "model"), str(folder / "task.toml"), "--out", str(tmp_path / "run")]
    done = CliRunner().invoke(app, [*words, "--clock", "ideal"])
    assert done.exit_code == 0, done.output
    result = ControlResult.model_validate_json((tmp_path / "run" / "control.json").read_text())
    assert result.sentence == (
        "0 of 1 runs reached the goal within 5 deg; 1 ran out of time; plans acted at once (ideal clock)."
    )
    report = validate(tmp_path / "run")
    assert (report.kind, report.faults) == ("run", ())
    page = (tmp_path / "run" / "control.html").read_text()
    assert "Joints" in page and ">swing" in page and "Sum of the sizes of all forces" in page
    assert "what a plan had predicted 0.4 s before" in page and result.video == "run.webm"
    recorded = read_runs(tmp_path / "run" / "run.h5")[0]
    assert recorded.joints == JOINTS and recorded.arrays["obs/joints"].shape == (6, 2)


def test_printed_tasks_are_read_again(tmp_path: Path) -> None:
    for name, task in HAND_TASKS.items():
        (tmp_path / f"{name}.toml").write_text(task_toml(task))
        assert read_any_task(tmp_path / f"{name}.toml").model_dump() == task.model_dump()
    named = hand_task(tmp_path, robot={"friction": {"arm/1": 0.4, "a b": 0.2}, "apart": ('the "thumb"', "C:\\tip")})
    (tmp_path / "named.toml").write_text(task_toml(named))
    assert read_any_task(tmp_path / "named.toml").model_dump() == named.model_dump()


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"limits": {"joints": {"swnig": (0, 1)}}}, "the hand has no joint 'swnig'; .* Did you mean 'swing'?"),
        ({"start": {"joints": {"swing": 2.0}}}, "'swing' = 2 rad"),
        ({"robot": {"friction": {"thumb": 0.3}}}, "the hand has no link 'thumb'"),
        ({"robot": {"apart": ("tap",)}}, "the hand has no link 'tap'; .* Did you mean 'tip'?"),
        ({"robot": {"touching": (("tip", "plam"),)}}, "the hand has no link 'plam'; .* Did you mean 'palm'?"),
        ({"robot": {"touching": (("tip", "arm"),)}}, r"\[robot\] touching: .*'tip' and 'arm' cannot touch each other"),
        ({"robot": {"apart": ("palm",), "touching": (("tip", "palm"),)}}, "'palm' .*has no shape"),
        ({"start": {"position_m": (-0.03, 0.0, 0.035)}}, "the start: .*inside"),
        ({"goal": {"position_m": (-0.03, 0.0, 0.035)}}, "position_m: .*inside"),
        ({"goal": {"position_m": (0.0, 0.0, 2.0)}}, "wanted 2 m from the root of the hand: out of reach"),
        ({"success": {"drop_m": 0.001}, "goal": {"position_m": (0.0, 0.0, 0.06)}}, "which counts as dropped"),
        ({"robot": {"file": "nothing.xml"}}, r"task\.toml: \[robot\] file: .*nothing\.xml"),
        ({"limits": {"joints": {"lift": (0.2, 0.1)}}}, "a range is"),
    ],
)
def test_what_a_hand_cannot_do_is_refused(folder: Path, model: Model, sections: dict, words: str) -> None:
    with pytest.raises(InputDataError, match=words):
        hand_world(model, hand_task(folder, **sections))


def test_a_hand_without_servos_needs_a_gain(tmp_path: Path, model: Model) -> None:
    write_hand(tmp_path, servos="")
    with pytest.raises(InputDataError, match=r"joint 'swing' of hand\.xml has no servo"):
        hand_world(model, hand_task(tmp_path))
    assert hand_world(model, hand_task(tmp_path, servo={"stiffness": 2.0, "damping": 0.1})).joints == JOINTS
    with pytest.raises(ValueError, match="greater than 0"):
        hand_task(tmp_path, servo={"stiffness": 0.0})


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        ({"body": "thign"}, "no free body 'thign'"),
        ({"scene": "hand.xml"}, "no free body"),
        ({"scene": "no.xml"}, "no.xml"),
    ],
)
def test_a_scene_that_lacks_something_is_refused(folder: Path, model: Model, plant: dict, words: str) -> None:
    found = hand_world(model, hand_task(folder, plant=plant))
    with pytest.raises(InputDataError, match=words):
        HandScenePlant(found)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"planner": {"horizon_s": 0.01}}, "shorter than one command"),
        ({"plant": {"kind": "mujoco"}}, "needs plant.scene"),
        ({"robot": {"quat_wxyz": (1.0, 1.0, 0.0, 0.0)}}, "not of length 1"),
        ({"goal": {"axis": (0.0, 0.0, 0.0)}}, "goal.axis is zero"),
    ],
)
def test_a_task_that_contradicts_itself_is_refused(changes: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        HandTask.model_validate(changes)
