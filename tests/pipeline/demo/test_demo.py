"""The demo: its stages are those of the commands, it appears whole or not at all, and its failures name the stage."""

import re
from pathlib import Path

import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.io.kinds import kind_of
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.demo import stage
from cgwm.pipeline.demo.stage import DemoSettings, run_demo
from cgwm.pipeline.validate import validate
from cgwm.schemas import (
    CalibrateConfig,
    CalibrationReport,
    DemoResult,
    InputDataError,
    NotConvergedError,
    PhysConfig,
    SplatConfig,
    SynthesizeConfig,
    UsageError,
    read_json,
)

SMALL = DemoSettings(
    photos=24,
    photo_size=(320, 240),
    video_size=(240, 180),
    calibrate=CalibrateConfig(max_features=1024),
    splats=SplatConfig(
        iterations=40, max_body_spheres=300, max_scene_spheres=500, max_collision_spheres=64, image_size=160
    ),
    physics=PhysConfig(population=8, generations=2, iterations=2, step_s=0.002),
    images=PhysConfig(population=8, generations=2, iterations=2, step_s=0.002),
    synthesize=SynthesizeConfig(rollouts=2, width=64, height=48, duration_s=0.5),
)


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def no_scene(name: str, out: Path, *_: object, **__: object) -> Path:
    out.mkdir()
    return out


def test_a_failing_stage_is_named_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(capture: Path, config: CalibrateConfig) -> CalibrationReport:
        assert config.seed == 7
        raise NotConvergedError(f"{capture}: 3 of 48 photos registered.", todo=f"look at {capture}.")

    monkeypatch.setattr(stage, "make_scene", no_scene)
    monkeypatch.setattr(stage, "calibrate", fail)
    out = tmp_path / "out"
    with pytest.raises(NotConvergedError) as error:
        run_demo(out, "fall", seed=7, device="cpu")
    assert str(error.value) == (
        f"the demo failed in the stage 'calibrate' (nothing was left in {out}): "
        f"{out}/capture: 3 of 48 photos registered.\nNext: look at {out}/capture."
    )
    assert leftovers(tmp_path) == []


def test_what_exists_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(UsageError, match="exists"):
        run_demo(tmp_path / "out", device="cpu")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scene": "fal"}, "unknown scene 'fal'"),
        ({"renderer": "egl"}, "unknown renderer 'egl'"),
        ({"seed": -1}, "the seed is -1"),
    ],
)
def test_wrong_names_are_refused(tmp_path: Path, arguments: dict, words: str) -> None:
    with pytest.raises(UsageError, match=re.escape(words)):
        run_demo(tmp_path / "out", device="cpu", **arguments)
    assert leftovers(tmp_path) == []


def test_a_fit_from_images_that_fails_is_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(capture: Path, out: Path, **settings: object) -> None:
        assert settings["phys_config"].supervise == "images"
        raise NotConvergedError(f"{capture}: the images say nothing.")

    monkeypatch.setattr(stage, "fit", fail)
    running = stage._Demo(tmp_path / ".out.partial", tmp_path / "out", SMALL, 0, "cpu")
    found = stage._fit_from_images(running)
    assert found.outcome == "not_converged"
    assert found.message == f"{tmp_path / 'out'}/capture: the images say nothing."
    assert found.evaluation is None


def test_a_wrong_input_is_no_such_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise InputDataError("no video.")

    monkeypatch.setattr(stage, "fit", fail)
    with pytest.raises(InputDataError):
        stage._fit_from_images(stage._Demo(tmp_path, tmp_path, SMALL, 0, "cpu"))


@pytest.mark.evidence
@pytest.mark.parametrize("scene", ["fall", "push"])
def test_the_whole_demo_in_small(tmp_path: Path, scene: str) -> None:
    out = tmp_path / "out"
    result = run_demo(out, scene, device="cpu", settings=SMALL)
    assert {out / path for path in result.paths.values()} <= set(out.iterdir())
    assert read_json(out / "report.json", DemoResult) == result
    assert [kind_of(out / name) for name in ("capture", "model", "dataset")] == ["capture", "model", "dataset"]
    for name in ("capture", "model", "dataset"):
        assert validate(out / name).passed
    html = (out / "report.html").read_text(encoding="utf-8")
    assert html.count("Test episode") == result.evaluation.episodes == 3
    assert result.verdict in html.replace("&#x27;", "'")
    assert 10_000 < (out / "demo.png").stat().st_size < 400_000
    assert result.calibration.photos_registered >= 22
    assert result.calibration.center_error_median_m < 0.005
    frozen = result.targets[0].frozen
    assert result.targets[0].value < frozen
    assert sum(result.seconds.values()) > 0
    # Nothing tells of the name that the directory had while it was being written.
    texts = [path for path in out.rglob("*") if path.suffix in (".json", ".html", ".toml")]
    assert [path.name for path in texts if "partial" in path.read_text(encoding="utf-8")] == []
    if result.images_only.outcome == "fitted":
        assert read_model(out / "model-images").file.provenance.parent == "model"
    assert sha256(out / "capture" / "cameras.json") == result.provenance.input_sha256["cameras.json"]
