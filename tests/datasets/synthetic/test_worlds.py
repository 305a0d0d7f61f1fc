"""The worlds with fixed surfaces: their truth obeys the laws of the ramp, rests in the bin, and is a sound capture."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.surface_distance import surface_distance
from cgwm.datasets.synthetic.worlds import make_world, plan_world
from cgwm.datasets.synthetic.worlds.bin import INSIDE_M
from cgwm.datasets.synthetic.worlds.ramp import BALL_M, BLOCK_M, SLOPE_DEG
from cgwm.datasets.synthetic.worlds.record import record
from cgwm.datasets.synthetic.worlds.truth_engine import build_model, picture, simulate
from cgwm.schemas import Surface, UsageError


def test_on_the_ramp_the_block_slides_and_the_ball_rolls() -> None:
    plan = plan_world("ramp", 1)
    mu, slope = plan.contact.friction["plastic", "wood"], math.radians(SLOPE_DEG)
    poses = simulate(plan, build_model(plan), replace(plan.episodes[0], length_s=0.3), 120)
    down = np.array([math.cos(slope), 0.0, -math.sin(slope)])
    times = np.arange(len(poses))[12:] / 120  # both have touched down by then
    for body, wanted in ((0, math.sin(slope) - mu * math.cos(slope)), (1, 5 / 7 * math.sin(slope))):
        rate = 2 * np.polyfit(times, poses[12:, body, :3] @ down, 2)[0]
        assert rate == pytest.approx(9.81 * wanted, rel=0.02)


def test_on_the_floor_the_block_slides_by_the_friction_that_is_stated_and_is_not_lifted() -> None:
    plan = plan_world("ramp", 0)
    place, speed = plan.episodes[0].qpos.copy(), np.zeros((2, 6))
    place[0], place[1, :3], speed[0, 0] = [0.3, 0.3, BLOCK_M[2], 1, 0, 0, 0], [1.0, -0.5, BALL_M], 0.8
    start = replace(plan.episodes[0], qpos=place, qvel=speed, length_s=0.12)
    poses = simulate(plan, build_model(plan), start, 120)[:, 0]
    rate = 2 * np.polyfit(np.arange(len(poses))[2:] / 120, poses[2:, 0], 2)[0]
    assert rate == pytest.approx(-9.81 * plan.contact.friction["plastic", "rubber"], rel=2e-3)
    assert np.abs(poses[:, 2] - BLOCK_M[2]).max() < 5e-5


def test_the_bin_holds_its_objects_and_they_come_to_rest() -> None:
    plan = plan_world("bin", 0)
    poses = simulate(plan, build_model(plan), replace(plan.episodes[0], length_s=1.0), 30)
    assert np.abs(poses[-1, :, :2]).max() < INSIDE_M
    assert poses[-1, :, 2].min() > 0.02
    assert np.abs(poses[-1, :, :3] - poses[-2, :, :3]).max() * 30 < 0.01


@pytest.mark.parametrize("name", ["ramp", pytest.param("bin", marks=pytest.mark.evidence)])
def test_equal_seeds_make_equal_captures_that_are_sound(tmp_path: Path, name: str) -> None:
    plan = plan_world(name, 3)
    plan = replace(plan, episodes=plan.episodes[:1])
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        record(plan, tmp_path / folder)
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / f).rglob("*.*")} for f in ("one", "two"))
    assert one == two
    capture = Capture.open(tmp_path / "one")
    assert capture.inconsistencies == ()
    truth = json.loads((tmp_path / "one" / "truth.json").read_text("utf-8"))
    assert {f"{a},{b}" for a, b in plan.contact.friction} == set(truth["friction"])


def test_a_picture_shows_every_body() -> None:
    plan = plan_world("bin", 0)
    poses = np.array([[*thing.place.position_m, *thing.place.quat_wxyz] for thing in plan.things])
    shown = picture(plan, poses, (160, 120)).reshape(-1, 3).astype(float)
    directions = shown / np.linalg.norm(shown, axis=1, keepdims=True)
    for thing in plan.things:
        color = np.asarray(thing.color) / np.linalg.norm(thing.color)
        assert (directions @ color > 0.999).sum() > 20, thing.name


@pytest.mark.parametrize(("name", "seed", "words"), [("bim", 0, "unknown scene 'bim'"), ("bin", -1, "the seed is -1")])
def test_wrong_names_and_seeds_are_refused(tmp_path: Path, name: str, seed: int, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_world(name, tmp_path / "out", seed)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("shape", "wanted"),
    [
        ({"half_space": {}}, 0.3),
        ({"rectangle": {"half_extents_m": (0.1, 0.1)}}, 0.5),
        ({"box": {"half_extents_m": (0.1, 0.1, 0.1)}}, math.hypot(0.4, 0.2)),
        ({"cylinder": {"radius_m": 0.1, "half_length_m": 0.3}}, 0.4),
        ({"height_field": {"path": "h.npy", "size_m": (0.2, 0.2), "height_m": 0.1}}, math.hypot(0.4, 0.2)),
        ({"mesh": {"path": "m.obj"}}, 0.0),
    ],
)
def test_the_distance_to_a_surface_is_that_to_its_box(shape: dict, wanted: float) -> None:
    surface = Surface.model_validate({"name": "s", "pose": {"position_m": (0.0, 0.0, 1.0)}, **shape})
    assert surface_distance((surface,), np.array([[0.5, 0.0, 1.3]])) == pytest.approx([wanted])
