"""`cgwm control`: a task from the command line, its files, and going on after a kill."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.cli.app import app
from cgwm.datasets.models.model import write_model
from cgwm.pipeline.control import runner, stage
from cgwm.pipeline.control.wording import advice, wilson
from cgwm.pipeline.validate import validate
from cgwm.schemas import TASKS, ControlResult, InputDataError, UsageError, task_toml
from helpers import fused_host
from helpers.pushing import push_task, pushed_model
from typer.testing import CliRunner

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("control")
    write_model(folder / "model", pushed_model(visible=False))
    (folder / "T.toml").write_text(task_toml(push_task(goal={"position_m": [0.1, 0.0]})))
    return folder / "model", folder / "T.toml"


@pytest.fixture(scope="module")
def done(inputs: tuple[Path, Path]) -> Path:
    out = inputs[0].parent / "run"
    stage.control(*inputs, out, clock="ideal", seeds=2)
    return out


def test_a_run_is_complete_and_valid(done: Path, inputs: tuple[Path, Path]) -> None:
    result = ControlResult.model_validate_json((done / "control.json").read_text())
    assert (result.clock, result.plant, result.object, len(result.runs)) == ("ideal", "model", "cube", 2)
    assert [run.ended for run in result.runs] == ["timeout", "timeout"]
    assert result.sentence == (
        "0 of 2 runs reached the goal within 10 mm and 5 deg; 2 ran out of time; plans acted at once (ideal clock)."
    )
    report = validate(done)
    assert (report.kind, report.faults, report.facts["runs"]) == ("run", (), 2)
    page = (done / "control.html").read_text()
    assert "Ideal clock" in page and "Contact force" in page and "ran out of time" in page


def test_robomimic_finds_what_it_reads(done: Path) -> None:
    with h5py.File(done / "run.h5") as file:
        data = file["data"]
        assert json.loads(data.attrs["env_args"])["env_name"] == "cgwm"
        demo = data["demo_1"]
        count = demo.attrs["num_samples"]
        assert data.attrs["total"] == 2 * count == 12
        for name in ("actions", "rewards", "dones", "states", "obs/object", "next_obs/object"):
            assert len(demo[name]) == count
        assert np.abs(demo["actions"]).max() <= 1 and demo["dones"][-1] == 1
        np.testing.assert_array_equal(demo["obs/object"][1:], demo["next_obs/object"][:-1])
        assert demo["control/force"].attrs["unit"] == "N"
        assert demo["plans/object"].shape == (6, 5, 7)


def test_a_killed_run_goes_on_where_it_was(done: Path, inputs: tuple[Path, Path], monkeypatch) -> None:
    out, made = inputs[0].parent / "again", runner.run

    def killed(controller, plant, seed, *given):
        if seed == 1:
            raise KeyboardInterrupt
        return made(controller, plant, seed, *given)

    monkeypatch.setattr(runner, "run", killed)
    with pytest.raises(KeyboardInterrupt) as caught:
        stage.control(*inputs, out, clock="ideal", seeds=2)
    assert str(caught.value) == f"{out}.checkpoint holds the runs that ended; --resume goes on with them."
    with pytest.raises(UsageError, match=r"holds a run of .* that was interrupted"):
        stage.control(*inputs, out, clock="ideal", seeds=2)
    with pytest.raises(UsageError, match="was made with other solver"):
        stage.control(*inputs, out, solver="both", clock="ideal", seeds=2, resume=True)
    seeds = []
    monkeypatch.setattr(runner, "run", lambda *given: seeds.append(given[2]) or made(*given))
    stage.control(*inputs, out, clock="ideal", seeds=2, resume=True)
    assert seeds == [1]
    assert (out / "run.h5").read_bytes() == (done / "run.h5").read_bytes()
    assert not (out.parent / "again.checkpoint").exists()
    stage.control(*inputs, out, clock="ideal", seeds=2, resume=True)  # complete: kept
    assert seeds == [1]
    with pytest.raises(UsageError, match=r"again was made with other solver, seeds"):
        stage.control(*inputs, out, solver="both", clock="ideal", seeds=3, resume=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda demo: demo["control/target"].__setitem__(2, [9.0, 0.0]), "a target of joint 'x' exceeds its limits."),
        (lambda demo: demo["obs/object"].__setitem__((0, 3), 2.0), "obs/object has quaternions that are not of length"),
        (lambda demo: demo["control/force"].__setitem__((0, 0), np.nan), "control/force is not finite."),
    ],
)
def test_a_changed_recording_is_found(done: Path, tmp_path: Path, change, words: str) -> None:
    for name in ("run.h5", "control.json", "control.html"):
        (tmp_path / name).write_bytes((done / name).read_bytes())
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        change(file["data/demo_0"])
    faults = validate(tmp_path).faults
    assert any(words in fault for fault in faults)
    assert any("SHA-256" in fault for fault in faults)


def test_a_recording_without_an_array_is_refused(done: Path, tmp_path: Path) -> None:
    for name in ("run.h5", "control.json", "control.html"):
        (tmp_path / name).write_bytes((done / name).read_bytes())
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        del file["data/demo_0/plans/cost"]
    with pytest.raises(InputDataError, match="data/demo_0 lacks the array 'plans/cost'"):
        validate(tmp_path)


def test_a_rate_that_plans_cannot_hold_is_refused(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    fast = push_task(planner={"control_hz": 10_000.0})
    (tmp_path / "T.toml").write_text(task_toml(fast))
    with pytest.raises(InputDataError) as caught:
        stage.control(inputs[0], tmp_path / "T.toml", tmp_path / "run", clock="real")
    assert "[planner] control_hz = 10000: a plan takes" in str(caught.value)
    assert "plans a second are reached: control_hz =" in str(caught.value)
    assert not list(tmp_path.glob("run*"))


def test_the_command_prints_a_task_and_says_what_it_lacks() -> None:
    printed = CliRunner().invoke(app, ["control", "--print-task", "push"])
    assert (printed.exit_code, printed.stdout) == (0, task_toml(TASKS["push"]))
    assert CliRunner().invoke(app, ["control", "model"]).exit_code == 2


def test_numbers_out_of_range_are_refused(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--seeds 0"):
        stage.control(*inputs, tmp_path / "run", seeds=0)
    with pytest.raises(UsageError, match="--draws -1"):
        stage.control(*inputs, tmp_path / "run", draws=-1)


def test_draws_of_a_model_without_standard_errors_are_told() -> None:
    unsure = pushed_model(visible=False)
    parameters = tuple(one.model_copy(update={"std_error": None}) for one in unsure.file.parameters)
    sure = replace(unsure, file=unsure.file.model_copy(update={"parameters": parameters}))
    assert [len(stage.warnings_of("", draws, model)) for draws in (0, 4) for model in (unsure, sure)] == [0, 0, 0, 1]


def test_what_a_robots_file_has_beside_the_robot_is_told() -> None:
    (told,) = stage.warnings_of("", 0, pushed_model(visible=False), ("floor", "table"))
    assert "outside of its links, floor, table, is not there in predictions" in told


def test_advice_and_intervals() -> None:
    task = push_task(planner={"control_hz": 20.0, "samples": 16})
    assert advice(task, 0.1) == (
        "10 plans a second are reached: control_hz = 9 holds, or about samples = 8 (fewer plans are compared), or an "
        "idle machine."
    )
    assert advice(task, 0.02).startswith("single plans were late")
    assert wilson(0, 5)[0] == 0.0 and wilson(5, 5)[1] == 1.0
