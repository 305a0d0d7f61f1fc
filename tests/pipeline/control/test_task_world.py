"""What a task may not ask of a model: one message for each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from cgwm.pipeline.control.mujoco_plant import MujocoPlant
from cgwm.pipeline.control.plant import ModelPlant, start_of
from cgwm.pipeline.control.task_world import task_world
from cgwm.schemas import (
    TASKS,
    CamerasFile,
    ControlTask,
    Ground,
    InputDataError,
    Pose,
    Scale,
    parse,
    read_task,
    task_toml,
)
from cgwm.schemas.surfaces import Surface
from helpers.pushing import push_task, pushed_model, write_cube
from helpers.small_model import HALF

MODEL = pushed_model()
FILE = MODEL.file


def changed(**changes: object):
    return replace(MODEL, file=FILE.model_copy(update=changes))


def free_twice():
    second = FILE.bodies[0].model_copy(update={"name": "other"})
    collision = {**MODEL.collision, "other": MODEL.collision["cube"]}
    return replace(MODEL, file=FILE.model_copy(update={"bodies": (*FILE.bodies, second)}), collision=collision)


def wall():
    box = {"name": "wall", "pose": {"position_m": [0.3, 0.0, 0.0]}, "box": {"half_extents_m": [0.05, 0.5, 0.5]}}
    return changed(surfaces=(Surface.model_validate(box),))


CASES = {
    "no physics": (changed(contact=None), {}, "the model: the model has no fitted physics, only the scene."),
    "no scale": (
        replace(MODEL, cameras=CamerasFile(scale=Scale(kind="unscaled", source="none"), cameras={})),
        {},
        "the model: the model has no scale: its cameras are unscaled.",
    ),
    "no ground": (changed(ground=None), {}, "the model: the model has no ground."),
    "tilted": (
        changed(ground=Ground(normal=(0.0, 0.28, 0.96))),
        {},
        "the model: the ground is tilted by 16.3 deg.",
    ),
    "two free bodies": (free_twice(), {}, "T: the model has 2 free bodies: cube, other."),
    "unknown object": (
        MODEL,
        {"object": "cubes"},
        "T: object = 'cubes' is no free body of the model.\nAllowed: cube. Did you mean 'cube'?\n"
        "Next: correct the name.",
    ),
    "robot is the object": (
        MODEL,
        {"robot": {"name": "cube"}},
        "T: [robot] name = 'cube' is a free body of the model.",
    ),
    "finger in the ground": (
        MODEL,
        {"robot": {"height_m": 0.01}},
        "T: [robot] height_m = 0.01 m is less than radius_m: the finger is in the ground.",
    ),
    "finger above": (MODEL, {"robot": {"height_m": 0.3}}, "T: at the height 0.3 m the finger passes over the object."),
    "goal out of reach": (
        MODEL,
        {"goal": {"position_m": [1.0, 0.0]}},
        "T: the goal at x = 1 m is out of reach: to push from all sides the finger has to go from 0.930 to 1.070 m.\n"
        "Allowed: joint 'x': -0.45 to 0.45 m, [limits] joints.\n"
        "Next: move the goal, or widen the limits if the robot can.",
    ),
    "goal in a wall": (wall(), {"goal": {"position_m": [0.25, 0.0]}}, "T: the goal is 50.0 mm inside surface 'wall'."),
}


@pytest.mark.parametrize("name", CASES)
def test_what_a_model_cannot_do_is_refused(name: str) -> None:
    model, sections, words = CASES[name]
    sections = dict(sections)
    chosen = sections.pop("object", None)
    task = push_task("T", **sections).model_copy(update={"object": chosen})
    task._source = "T"
    with pytest.raises(InputDataError) as caught:
        task_world(model, task)
    assert str(caught.value).startswith(words)


@pytest.mark.parametrize("kind", ["model", "mujoco"])
def test_an_object_that_begins_in_the_hand_is_refused(kind: str, tmp_path: Path) -> None:
    start = {"position_m": [0.0, 0.0], "turn_deg": [0.0, 0.0], "finger_m": [0.0, 0.02]}
    plant = {"kind": kind, "meshes": [write_cube(tmp_path)]}
    found = task_world(MODEL, push_task(str(tmp_path / "T"), start=start, plant=plant))
    with pytest.raises(InputDataError, match="deep inside"):
        (ModelPlant if kind == "model" else MujocoPlant)(found).reset(*start_of(found, 0))


def test_a_mesh_that_is_not_convex_is_refused(tmp_path: Path) -> None:
    text = (tmp_path / write_cube(tmp_path)).read_text().splitlines()
    (tmp_path / "two.obj").write_text("\n".join(
        [*text[:8], *(f"v {float(line.split()[1]) + 0.3} {' '.join(line.split()[2:])}" for line in text[:8]),
         *text[8:], *("f " + " ".join(str(int(n) + 8) for n in line.split()[1:]) for line in text[8:])]
    ))  # fmt: skip
    task = push_task(str(tmp_path / "T"), plant={"kind": "mujoco", "meshes": ["two.obj"]})
    with pytest.raises(
        InputDataError, match=r"two.obj: the mesh is not convex: its hull, which MuJoCo takes, is 100 %"
    ):
        MujocoPlant(task_world(MODEL, task))


def test_a_mesh_that_is_missing_is_refused_by_the_name_of_its_field(tmp_path: Path) -> None:
    task = push_task(str(tmp_path / "T"), plant={"kind": "mujoco", "meshes": ["none.obj"]})
    with pytest.raises(InputDataError, match=r"T: \[plant\] meshes: .*none\.obj: no such file"):
        MujocoPlant(task_world(MODEL, task))


FAULTS = {
    "[limits.joints]\nx = [-1, 1]\nz = [0, 1]": "limits: the robot has no joint 'z'; its joints are x, y",
    "[limits.joints]\nx = [-1, 1]\nyy = [0, 1]": "limits: the robot has no joint 'yy'; its joints are x, y. "
    "Did you mean 'y'?",
    "[limits.joints]\nx = [1, -1]\ny = [0, 1]": "limits: joint 'x': a range is [low, high]; found [1, -1]",
    "[limits.joints]\nx = [-1, 1]": "limits: joint 'y' has no limits",
    "[servo]\nstiffness_n_m = 0.0": "servo.stiffness_n_m: input should be greater than 0 (found 0.0)",
    "[planner]\nhorizon_s = 0.02": "planner: horizon_s = 0.02 s is shorter than one command, which lasts "
    "1/control_hz = 0.0333333 s",
    "[planner]\nknots = 500": "planner: 500 knots in 1.5 s are closer together than step_s = 0.01 s",
    '[plant]\nkind = "mujoco"': 'plant.kind = "mujoco" needs plant.meshes, the convex parts of the object\'s true mesh',
    "[start]\nturn_deg = [90.0, 0.0]": "start.turn_deg is a range [low, high]; found [90.0, 0.0]",
    "[planer]\nknots = 5": "the top level has an unknown field 'planer'.",
}


@pytest.mark.parametrize("text", FAULTS)
def test_a_wrong_task_is_refused_by_its_field(text: str, tmp_path: Path) -> None:
    path = tmp_path / "T.toml"
    path.write_text(text + "\n")
    with pytest.raises(InputDataError) as caught:
        read_task(path)
    assert FAULTS[text] in str(caught.value)
    assert str(caught.value).startswith(f"{path}")


def test_the_printed_task_is_the_default_one(tmp_path: Path) -> None:
    (tmp_path / "T.toml").write_text(task_toml(TASKS["push"]))
    assert read_task(tmp_path / "T.toml").model_dump() == ControlTask().model_dump()
    asked = push_task(goal={"turn_deg": 30.0}, plant={"kind": "mujoco", "meshes": ["a.obj"]})
    (tmp_path / "U.toml").write_text(task_toml(asked))
    assert read_task(tmp_path / "U.toml").model_dump() == asked.model_dump()
    assert parse(asked.model_dump(mode="json"), ControlTask, "task") is not None


def test_starts_are_within_reach_and_repeat_themselves() -> None:
    task = push_task(start={"within_m": 0.2, "turn_deg": [-90.0, 90.0]})
    found = task_world(MODEL, task)
    starts = [start_of(found, seed) for seed in range(40)]
    for place, turn, finger in starts:
        assert (place**2).sum() <= 0.2**2 and abs(turn) <= 1.5708
        assert (abs(finger) <= 0.45).all() and (abs(finger - place) > HALF).any()
    assert len({round(float(place[0]), 6) for place, _, _ in starts}) == 40
    again = start_of(found, 7)
    assert (again[0] == starts[7][0]).all() and again[1] == starts[7][1]
    assert Pose().quat_wxyz == tuple(found.goal.quat_wxyz.tolist())
