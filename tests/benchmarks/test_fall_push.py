"""The benchmark `fall_push.py` in its quick form: one box that falls, small pictures, few steps of every contender."""

from __future__ import annotations

import dataclasses
import importlib
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic import TRUTH_FILE, TRUTH_MESH, make_scene, read_truth
from cgwm.datasets.synthetic.objects import make_object
from cgwm.pipeline.fit import fit
from cgwm.pipeline.phys_geo.tracks import contact_shooting
from cgwm.schemas import NotConvergedError, SplatConfig
from helpers.worlds import ball_body, box_body, state_of, world_of

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
TESTS = ("001", "002")
NAMES = {"tasks": ("fall",), "objects": ("box",), "materials": ("wood",), "engines": ("mujoco",)}
pytestmark = pytest.mark.evidence
FEW = {"generations": 3, "population": 16, "iterations": 2}


MODULES = ("fall_push", "fall_push_engines", "fall_push_table", "scoring", "store")
CONTENDERS = ("cem_mujoco", "cgwm_default", "floor", "mujoco_world", "paper", "pinwm", "rows", "training", "zeros")


@pytest.fixture(scope="module")
def bench():
    """The benchmark's modules, as `python benchmarks/fall_push.py` has them."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        found = {name: importlib.import_module(name) for name in MODULES}
        found |= {name: importlib.import_module(f"contenders.{name}") for name in CONTENDERS}
        yield SimpleNamespace(**found)
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def work(bench, tmp_path_factory):
    """A folder with the capture of a falling box, with two test episodes, and its splats."""
    folder = tmp_path_factory.mktemp("fall_push")
    made = bench.fall_push.Work(folder, 0, "cpu", 0)
    capture = made.capture("fall", "box", "wood")
    make_scene("fall", capture, photo_size=(128, 96), video_size=(96, 72), photos=16)
    (capture / "cameras.json").write_text(read_truth(capture).cameras.model_dump_json())
    manifest = Capture.open(capture).manifest.model_copy(update={"splits": {"train": ("000",), "test": TESTS}})
    write_manifest(capture / "capture.toml", manifest, overwrite=True)
    small = {"iterations": 80, "image_size": 96, "max_body_spheres": 300, "max_scene_spheres": 600}
    config = SplatConfig(device="cpu", max_collision_spheres=60, turntable=False, **small)
    fit(capture, folder / "models" / "box_fall", stage="sg-gs", splat_config=config)
    return made


@pytest.fixture(scope="module")
def blind(work):
    """The cell with a capture without the truth, without measured tracks, and without its test episodes."""
    cell = work.cell("fall", "box", "wood")
    copy = work.folder / "blind"
    shutil.copytree(cell.capture, copy)
    shutil.rmtree(copy / "tracks")
    for episode in TESTS:
        for path in copy.glob(f"video*/*/{episode}"):
            shutil.rmtree(path)
    (copy / TRUTH_FILE).unlink()
    (copy / TRUTH_MESH).unlink()
    return dataclasses.replace(cell, capture=copy)


@pytest.fixture(scope="module")
def judge(bench, work):
    return bench.scoring.Judge.of(work.cell("fall", "box", "wood"), 12)


@pytest.fixture(scope="module")
def poses(bench, blind):
    """The track of the training episode, found once for all contenders."""
    return bench.training.find_poses(bench.training.open_training(blind), blind)


def errors(judge, fitted, key="translation_mm"):
    return float(np.mean([episode[key] for episode in judge.episode_errors(fitted)]))


@pytest.fixture(scope="module")
def frozen(bench, blind, judge):
    return errors(judge, bench.zeros.Frozen().fit(blind, None))


def test_cgwm_beats_what_does_not_learn_without_tracks_or_truth(bench, blind, judge, frozen, monkeypatch):
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 2)
    fitted = bench.cgwm_default.Cgwm("cgwm", FEW).fit(blind, None)
    ballistic = errors(judge, bench.zeros.Ballistic().fit(blind, None))
    assert errors(judge, fitted) < 0.7 * min(frozen, ballistic)
    assert fitted.record["seconds"] > 0
    rows = judge.episode_errors(fitted)
    assert [row["episode"] for row in rows] == list(TESTS)
    assert all(10 < row["psnr_db"] < 40 and 5 < row["psnr_object_db"] < 40 for row in rows)
    assert set(judge.parameter_errors(fitted.record["parameters"])) >= {"friction"}


@pytest.mark.parametrize("which", ["mujoco", "pinwm", "paper"])
def test_rivals_learn_from_images_alone(bench, blind, judge, frozen, poses, monkeypatch, which):
    for module in (bench.cem_mujoco, bench.pinwm, bench.paper):
        monkeypatch.setattr(module, "find_poses", lambda *_: poses)
    rival = {
        "mujoco": lambda: bench.cem_mujoco.CemMujoco("rival", None, generations=2),
        "pinwm": lambda: bench.pinwm.PinWm("rival", 3),
        "paper": lambda: bench.paper.Paper("rival", 3),
    }[which]()
    fitted = rival.fit(blind, 8.0 if which == "mujoco" else None)  # the search takes all the time that there is
    loss = fitted.record["image_loss"]
    assert loss["best"] < loss["first"]
    assert fitted.record["evaluations"] >= 3
    assert errors(judge, fitted) < frozen


def test_the_floor_knows_the_truth(bench, work, judge, frozen):
    fitted = bench.floor.Floor().fit(work.cell("fall", "box", "wood"), None)
    assert judge.parameter_errors(fitted.record["parameters"])["friction"] == 0
    assert errors(judge, fitted) < 0.2 * frozen


def test_the_true_start_is_the_first_frame(judge):
    for episode in judge.episodes:
        assert np.array_equal(episode.start.position_m[0, episode.place].numpy(), episode.position_m[0])
        step = (episode.position_m[1] - episode.position_m[0]) / (episode.times_s[1] - episode.times_s[0])
        velocity = episode.start.velocity_m_s[0, episode.place].numpy()
        assert np.abs(step - velocity - (0, 0, -9.81 / 60)).max() < 0.05


def test_results_are_stored_and_taken_up_again(bench, work, tmp_path, monkeypatch):
    monkeypatch.setenv("CGWM_COMMIT", "abc")
    Row, zeros = bench.rows.Row, bench.zeros
    calls = []

    def fails():
        raise NotConvergedError("it did not converge.")

    def counted(one, *given):
        calls.append(given)
        return one

    rows = {
        "cgwm": Row(lambda: counted(zeros.Frozen())),
        "ballistic": Row(lambda: counted(zeros.Ballistic()), 4.0),
        "hopeless": Row(fails),
    }
    monkeypatch.setattr(bench.fall_push, "ROWS", rows)
    names = NAMES | {"rows": tuple(rows)}
    path = tmp_path / "results.jsonl"
    with ThreadPoolExecutor(1) as pool:
        bench.fall_push.run(work, bench.store.Store("x", path), names, pool)
        assert len(calls) == 2
        again = bench.store.Store("x", path)
        bench.fall_push.run(work, again, names, pool)
        assert len(calls) == 2
        other = bench.store.Store("x", path)
        monkeypatch.setenv("CGWM_COMMIT", "def")
        assert bench.store.Store("x", path).results() == []
        assert len(bench.store.Store("x", path, any_commit=True).results()) == 3
    text = bench.fall_push_table.table(other.results(), names, 0)
    cells = [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if "|" in line]
    lines = {row[1]: row for row in cells}
    assert lines["hopeless"][6:9] == ["failed", "–", "0/1"]
    assert "it did not converge." in text
    stored = other.known("fall/box/wood/ballistic/seed 0/cpu")
    assert stored["budget_s"] == 4 * other.known("fall/box/wood/cgwm/seed 0/cpu")["fit"]["seconds"]
    means = [episode["translation_mm"] for episode in stored["episodes"]]
    assert lines["ballistic"][2] == f"{np.median(means):.1f} ({np.mean(means):.1f})"


def test_the_worst_prediction_becomes_a_picture(bench, work, judge, tmp_path):
    cell = work.cell("fall", "box", "wood")
    job = bench.fall_push.Job("fall", "box", "wood", "cgwm", cell)
    fitted = bench.zeros.Frozen().fit(cell, None)
    bench.fall_push._picture(job, judge, fitted, judge.episode_errors(fitted), tmp_path / "pictures")
    strip = judge.strip(fitted, TESTS[1])
    assert strip.masks is not None and strip.real.shape == strip.predicted.shape
    assert [path.stem[:-4] for path in (tmp_path / "pictures").iterdir()] == ["fall_box_wood_mujoco"]


def test_a_budget_needs_its_reference(bench, work, tmp_path, monkeypatch):
    monkeypatch.setattr(bench.fall_push, "ROWS", {"rival": bench.rows.Row(bench.zeros.Frozen, 1.0)})
    with ThreadPoolExecutor(1) as pool, pytest.raises(SystemExit, match="budget"):
        store = bench.store.Store("x", tmp_path / "results.jsonl")
        bench.fall_push.run(work, store, NAMES | {"rows": ("rival",)}, pool)


def test_in_mujoco_a_driven_body_follows_its_command_and_pushes(bench):
    solid = make_object(0)
    half = solid.vertices.max(0)
    tip = dataclasses.replace(ball_body(0.01, name="tip"), motion="driven")
    simulator = bench.mujoco_world.MujocoWorld(world_of(box_body(), tip), {"box": solid})
    begin, reach = -half[0] - 0.03, half[0] + 0.01
    command = Track(np.array([0.0, 1.0]), np.array([[begin, 0, half[2]], [begin + 0.2, 0, half[2]]]))
    unturned, still = (1.0, 0, 0, 0), (0.0, 0, 0)
    start = state_of(((0, 0, half[2]), unturned, still, still), (still, unturned, still, still))
    numbers = bench.mujoco_world.ContactNumbers(0.3, 0.3, 0.01, 1.0)
    times = np.arange(7) / 15
    position, _ = simulator.rollout(numbers, start, {"tip": command}, times)
    tip_x, box = position[:, 1, 0], position[:, 0]
    assert np.abs(tip_x - (begin + 0.2 * times)).max() < 1e-9
    assert abs(box[-1, 0] - (tip_x[-1] + reach)) < 3e-3
    assert abs(box[-1, 2] - half[2]) < 2e-3


def test_the_table_by_engine_pairs_captures_and_leaves_mujoco_out_of_the_pool(bench) -> None:
    def row(engine: str, name: str, shift: float) -> dict:
        return {
            "engine": engine, "task": "fall", "object": "box", "material": "wood", "seed": 0, "row": name,
            "fit": {"parameters": {"friction": 0.4}, "intervals_95": {"friction": [0.3, 0.38]}, "seconds": 1.0},
            "parameter_errors": {"friction": 0.1},
            "episodes": [{"episode": "001", "translation_mm": 10.0 + shift, "rotation_deg": 5.0}],
        }  # fmt: skip

    rows = [row("drake", "cgwm", 0), row("drake", "frozen", 5), row("dart", "cgwm", 2), row("dart", "frozen", 7)]
    rows += [row("mujoco", "cgwm", 90), row("mujoco", "frozen", 95)]
    names = {**NAMES, "rows": ("cgwm", "frozen"), "engines": ("mujoco", "drake", "dart")}
    found = bench.fall_push_engines.engine_table(rows, names)
    pooled = found.split("**fall, all engines but MuJoCo**")[1].split("**fall, mujoco**")[0]
    assert "| cgwm | 2 | 11.0 (11.0) |" in pooled
    assert "| frozen | 2 | 16.0 (16.0) |" in pooled and "+5.0 (+5.0 to +5.0)" in pooled
    assert "2 of 2" in pooled  # 0.4 / 1.1 lies in the interval
    assert "100.0 (100.0)" in found.split("**fall, mujoco**")[1]
