"""The scene control: its task has the truth for the plant alone, slow machines are told, and the whole in small."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cgwm.datasets.shapes.meshes import joined_properties, read_mesh
from cgwm.datasets.synthetic.objects import make_object
from cgwm.pipeline.demo import control_demo
from cgwm.pipeline.demo.control_demo import ControlDemoSettings, run_control_demo
from cgwm.schemas import (
    CalibrateConfig,
    ControlDemoResult,
    PhysConfig,
    SlowPlansError,
    SplatConfig,
    UsageError,
    read_json,
    read_task,
)

SEED = 4


def demo_in(folder: Path) -> control_demo._Demo:
    return control_demo._Demo(folder, folder, ControlDemoSettings(), SEED, "cpu")


def test_the_task_has_the_true_shape_and_numbers_for_its_plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solid = make_object(SEED)
    truth = SimpleNamespace(contact=SimpleNamespace(friction=0.41, friction_fingertip=0.27))
    monkeypatch.setattr(control_demo, "read_truth", lambda _: truth)
    monkeypatch.setattr(control_demo, "plan_scene", lambda *_: SimpleNamespace(solid=solid))
    control_demo._write_task(demo_in(tmp_path))
    task = read_task(tmp_path / "push.toml")
    assert (task.plant.kind, task.plant.friction, task.plant.finger_friction) == ("mujoco", 0.41, 0.27)
    assert task.plant.mass_kg == solid.mass
    parts = [read_mesh(task.folder / name) for name in task.plant.meshes]
    np.testing.assert_allclose(joined_properties(parts, "a part").com_m, solid.com, atol=1e-6)


def test_where_plans_are_slow_the_runs_have_the_ideal_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def control(*_: object, clock: str = "real", **__: object) -> str:
        asked.append(clock)
        if clock == "real":
            raise SlowPlansError("push.toml: a plan takes 163 ms here.")
        return "the result"

    monkeypatch.setattr(control_demo, "control", control)
    found, told = control_demo._pushed(demo_in(tmp_path))
    assert (asked, found) == (["real", "ideal"], "the result")
    assert told == [
        "control: push.toml: a plan takes 163 ms here. The runs are with the ideal clock, in which plans act at once."
    ]


def test_what_exists_and_wrong_seeds_are_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the seed is -1"):
        run_control_demo(tmp_path / "new", seed=-1, device="cpu")
    assert not list(tmp_path.iterdir())


@pytest.mark.evidence
def test_the_whole_scene_in_small(tmp_path: Path) -> None:
    small = ControlDemoSettings(
        photos=24,
        photo_size=(320, 240),
        video_size=(240, 180),
        calibrate=CalibrateConfig(max_features=1024),
        splats=SplatConfig(
            iterations=40, max_body_spheres=300, max_scene_spheres=500, max_collision_spheres=64, image_size=160
        ),
        physics=PhysConfig(supervise="images", population=8, generations=2, iterations=2, step_s=0.002),
        runs=1,
        timeout_s=1.0,
    )
    result = run_control_demo(tmp_path / "out", device="cpu", settings=small)
    assert {tmp_path / "out" / path for path in result.paths.values()} <= set((tmp_path / "out").iterdir())
    assert read_json(tmp_path / "out" / "report.json", ControlDemoResult) == result
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "data:video/webm;base64," in html
    assert result.verdict in html
