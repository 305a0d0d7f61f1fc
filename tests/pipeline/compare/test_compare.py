"""Models side by side: a slippery cube against the true one, on throws that the true one made."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.cli import main
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.datasets.io.atomic import new_directory, sha256
from cgwm.datasets.models.model import Model, write_model
from cgwm.pipeline.compare.error_ladder import Rung, ladder_svg
from cgwm.pipeline.compare.page import default_page, mark_of
from cgwm.pipeline.compare.paired_difference import LEAST_EPISODES, paired_difference
from cgwm.pipeline.compare.short_horizon_errors import short_errors
from cgwm.pipeline.compare.stage import Comparison, compare, compare_models
from cgwm.pipeline.compare.verdict import comparison_verdict
from cgwm.pipeline.evaluate import evaluate
from cgwm.pipeline.evaluate.prediction import Motion
from cgwm.pipeline.physics import State, engine, world_of_model
from cgwm.pipeline.report.page_file import shows_the_same
from cgwm.pipeline.segments.prepare import prepare
from cgwm.schemas import PHASES, CompareResult, EffectModel, UsageError
from helpers.pages import Tags, clicked
from helpers.small_model import HALF, small_model
from helpers.thrown_cube import (
    FRAMES,
    NOISE_M,
    RATE_HZ,
    add_video,
    measured,
    quick,
    truth,
    with_friction,
    write_capture,
)

EPISODES = 6


def invisible(model: Model) -> Model:
    """The model without looks: what is compared is motion alone."""
    return replace(model, body_splats={}, scene=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A filmed capture and two models on disk, and the page that compares them."""
    torch.set_num_threads(1)
    root = tmp_path_factory.mktemp("compare")
    add_video(write_capture(root / "capture", episodes=EPISODES))
    write_model(root / "slippery", with_friction(0.1))
    write_model(root / "true", truth())
    return root


@pytest.fixture(scope="module")
def result(folder: Path) -> CompareResult:
    models = [folder / "slippery", folder / "true"]
    return compare(models, folder / "capture", out=folder / "page.html", device="cpu")


@pytest.fixture(scope="module")
def page(folder: Path, result: CompareResult) -> Path:
    assert result.report == str(folder / "page.html")
    return folder / "page.html"


# Figures


def test_the_json_is_the_contract(result: CompareResult) -> None:
    printed = json.loads(result.model_dump_json())
    assert CompareResult.model_validate(printed) == result
    assert printed["best"] == result.models[1].model and printed["split"] == "test" and printed["episodes"] == EPISODES
    for model in printed["models"]:
        assert {
            *("model", "translation_error_m", "rotation_error_deg", "psnr_db", "psnr_object_db"),
            *("state_fitted_residual_m", "state_noise_floor_m", "reduced_chi2", "by_phase", "worst"),
        } <= set(model)
        assert tuple(model["by_phase"]) == PHASES
        for moment in model["worst"]:
            assert set(moment) == {"episode", "t0_s", "t1_s", "phase", "quantity", "z"}
            assert 0 <= moment["t0_s"] < moment["t1_s"] <= (FRAMES - 1) / RATE_HZ + 1e-9
            assert moment["phase"] in PHASES and moment["quantity"].split()[0] == "cube"
        sizes = [moment["z"] for moment in model["worst"]]
        assert sizes == sorted(sizes, reverse=True) and len(sizes) > 3
    assert printed["measurement_std"]["position_m"] == NOISE_M


def test_open_loop_errors_are_those_of_eval(folder: Path, result: CompareResult) -> None:
    alone = evaluate(folder / "slippery", folder / "capture", device="cpu")
    mine = result.models[0]
    for name in ("translation_error_m", "rotation_error_deg", "psnr_db", "psnr_object_db", "per_episode"):
        assert getattr(mine, name) == getattr(alone, name)


def test_what_explains_the_data_is_within_the_noise(result: CompareResult) -> None:
    slippery, true = result.models
    assert true.reduced_chi2 is not None and 0.8 < true.reduced_chi2 < 1.25
    assert slippery.reduced_chi2 is not None and slippery.reduced_chi2 > 2 * true.reduced_chi2
    for model in result.models:  # friction says nothing about flight
        flight = model.by_phase["flight"]
        assert flight is not None and flight.reduced_chi2 is not None and 0.7 < flight.reduced_chi2 < 1.3
    wrong, right = (model.by_phase["sliding"] for model in result.models)
    assert wrong is not None and wrong.reduced_chi2 is not None and wrong.reduced_chi2 > 2
    assert right is not None and right.reduced_chi2 is not None and right.reduced_chi2 < 1.5
    assert wrong.sigmas["x"] > 2 * right.sigmas["x"]  # it is thrown along x
    assert slippery.worst[0].z > 5 > true.worst[0].z
    assert slippery.worst[0].phase in ("impact", "sliding", "sticking")


def test_pairs_and_verdict(result: CompareResult) -> None:
    (pair,) = result.pairs
    assert (pair.better, pair.episodes) == (EPISODES, EPISODES)
    assert pair.interval_95_m is not None and pair.interval_95_m[1] < 0
    assert pair.interval_95_m[0] <= pair.median_difference_m <= pair.interval_95_m[1]
    short = pair.short
    assert short is not None and short.frames > 100 and short.reduced_chi2 < 1.5 < short.than_reduced_chi2
    assert short.interval_95 is not None and short.interval_95[0] < short.interval_95[1] < 0
    start = "true is better than slippery in short predictions, most of all in "
    assert re.match(f"{start}(impacts|sliding): over ", result.verdict)  # friction acts in both, and in no flight
    assert f" true predicts {EPISODES} of {EPISODES} test episodes better than slippery (median " in result.verdict
    assert "chance" not in result.verdict
    assert result.verdict.endswith("Short predictions of true are within the noise in all phases.")


def test_the_verdict_says_when_it_may_be_chance(result: CompareResult) -> None:
    names = {result.models[0].model: "slippery", result.models[1].model: "true"}
    pair = result.pairs[0].model_copy(update={"better": 4, "interval_95_m": (-0.01, 0.002)})
    assert pair.short is not None
    unclear = pair.short.model_copy(update={"interval_95": (-0.5, 0.1)})
    pair = pair.model_copy(update={"short": unclear})
    words = comparison_verdict(result.model_copy(update={"pairs": (pair,)}), names)
    assert words.startswith("In short predictions the two cannot be told apart: over ")
    assert "true predicts 4 of 6 test episodes better" in words
    assert "may be chance: the 95 % interval of the difference contains zero" in words
    opposite = pair.model_copy(update={"better": 1, "interval_95_m": (0.002, 0.01), "short": result.pairs[0].short})
    words = comparison_verdict(result.model_copy(update={"pairs": (opposite,)}), names)
    assert ". Over whole episodes it is the other way round: true predicts 1 of 6 test episodes better" in words
    pair = pair.model_copy(update={"episodes": 3, "better": 3, "interval_95_m": None})
    words = comparison_verdict(result.model_copy(update={"pairs": (pair,), "episodes": 3}), names)
    assert "3 episodes are too few to decide whether a difference of open-loop errors is more than chance." in words
    worse = result.model_copy(update={"models": result.models[:1], "best": result.models[0].model, "pairs": ()})
    words = comparison_verdict(worse, names)
    assert "slippery predicts 6 test episodes with a median error of" in words
    assert ", no better than assuming a body at rest (" in words
    assert "times the noise in " in words and "they are within the noise in flight" in words
    better = result.model_copy(update={"models": result.models[1:], "pairs": ()})
    assert "; assuming a body at rest gives" in comparison_verdict(better, names)


def test_paired_differences() -> None:
    error = {str(k): 0.01 + 0.001 * k for k in range(8)}
    other = {name: value + 0.002 for name, value in error.items()}
    pair = paired_difference("a", "b", error, {**other, "more": 1.0})
    assert pair is not None and (pair.episodes, pair.better) == (8, 8)
    assert pair.interval_95_m == pytest.approx((-0.002, -0.002))
    few = paired_difference("a", "b", {k: error[k] for k in list(error)[: LEAST_EPISODES - 1]}, other)
    assert few is not None and few.interval_95_m is None and few.median_difference_m == pytest.approx(-0.002)
    assert paired_difference("a", "b", error, {"c": 1.0}) is None


def test_the_interval_covers_the_median_difference() -> None:
    """Of 20 normal differences the 95 % interval holds the true median in about that share of draws."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(200):
        error = {str(k): 1.0 + value for k, value in enumerate(rng.standard_normal(20))}
        pair = paired_difference("a", "b", error, dict.fromkeys(error, 0.7))
        assert pair is not None and pair.interval_95_m is not None
        held += pair.interval_95_m[0] <= 0.3 <= pair.interval_95_m[1]
    assert 0.88 <= held / 200 <= 0.995


# Other captures and models


def flights(root: Path, model: Model, turned: bool = True) -> Path:
    """Replace the throws of a capture by long flights of a model, all in another direction."""
    times, paths = np.arange(40) / 50, sorted((root / "tracks").iterdir())
    rows = [((-0.5, 0.1 * k, 2.0), (0.5 - 0.2 * k, 0.3, 2.5), (1.0, 0.5 * k, 0.0)) for k in range(len(paths))]
    place, velocity, omega = (torch.tensor(part).double()[:, None] for part in zip(*rows, strict=True))
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(len(paths), 1, 4)
    rollout = engine.rollout(world_of_model(model), State(place, upright, velocity, omega), torch.tensor(times))
    for seed, path in enumerate(paths):
        motion = Motion(rollout.position_m[seed].numpy(), rollout.quat_wxyz[seed].numpy())
        write_tracks(path, {"cube": measured(times, motion, seed, turned)}, overwrite=True)
    return root


def test_centroid_tracks(tmp_path: Path) -> None:
    root = flights(write_capture(tmp_path / "capture", episodes=2), truth(), turned=False)
    found = compare_models([("a", invisible(truth()))], Capture.open(root), device="cpu")
    (model,) = found.result.models
    assert model.rotation_error_deg is None
    assert model.reduced_chi2 is not None and 0.7 < model.reduced_chi2 < 1.3
    flight = model.by_phase["flight"]
    assert flight is not None and flight.rotation_rms_deg is None and set(flight.sigmas) == {"x", "y", "z"}
    assert all(figures is None for phase, figures in model.by_phase.items() if phase != "flight")
    assert "2 episodes are few to judge a model by" in found.result.verdict
    points = found.models[0].wrenches
    assert points and all(np.isnan(p.std[3:]).all() and np.isfinite(p.std[:3]).all() for p in points)


# In the suite: effects in rollouts and the order of wrenches have laws in test_effects.py and in `diagnose`.
@pytest.mark.evidence
def test_an_effect_is_rolled_out_and_what_it_would_explain_is_ordered(tmp_path: Path) -> None:
    """A push of 0.4 m/s2 in long flights: with the effect within the noise, without it the wrench says so."""
    push = EffectModel(name="constant_force", parameters={"f_x": 0.4, "f_y": 0.0, "f_z": 0.0})
    base = invisible(truth())
    pushed = replace(base, file=base.file.model_copy(update={"effects": (push,)}))
    root = flights(write_capture(tmp_path / "capture", episodes=EPISODES), pushed)
    found = compare_models([("base", base), ("pushed", pushed)], Capture.open(root), device="cpu")
    plain, right = found.result.models
    assert right.effects == ("constant_force",)
    assert right.reduced_chi2 is not None and 0.8 < right.reduced_chi2 < 1.25
    assert plain.reduced_chi2 is not None and plain.reduced_chi2 > 1.25 * right.reduced_chi2
    assert plain.wrench[0].coordinate == "constant" and plain.wrench[0].share > 0.5
    assert right.wrench == ()
    force = np.array([point.acceleration[0] for point in found.models[0].wrenches])
    weight = np.array([point.std[0] ** -2 for point in found.models[0].wrenches])
    assert float((force * weight).sum() / weight.sum()) == pytest.approx(0.4, abs=0.1)


def test_a_driven_body_and_two_free_ones(tmp_path: Path) -> None:
    """A tip pushes a cube and another one rests: residuals are those of both cubes, by name."""
    root = write_capture(tmp_path / "capture", episodes=1)
    text = (root / "capture.toml").read_text()
    more = '[[bodies]]\nname = "tip"\nmotion = "driven"\nshape = { sphere = { radius_m = 0.012 } }\n'
    more += '[[bodies]]\nname = "other"\nmass_kg = 0.37\n'
    more += f"shape = {{ box = {{ half_extents_m = [{HALF}, {HALF}, {HALF}] }} }}\n"
    (root / "capture.toml").write_text(text.replace("[measurement]", more + "[measurement]"))
    model = quick(small_model(driven=True, visible=False))
    other = model.file.bodies[0].model_copy(update={"name": "other"})
    file = model.file.model_copy(update={"bodies": (*model.file.bodies, other)})
    model = replace(model, file=file, collision={**model.collision, "other": model.collision["cube"]})
    times = np.arange(FRAMES) / RATE_HZ
    path = np.stack([0.11 - 0.25 * np.maximum(times - 0.1, 0), 0 * times, 0 * times + 0.04], 1)
    command = Track(times, path, np.tile([1.0, 0, 0, 0], (FRAMES, 1)))
    rest = torch.tensor([[[0.0, 0, HALF - 2e-4], [0, 0, 0], [0.0, 0.4, HALF - 2e-4]]]).double()
    unturned = torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 3]).double()
    state = State(rest, unturned, torch.zeros(1, 3, 3).double(), torch.zeros(1, 3, 3).double())
    rollout = engine.rollout(world_of_model(model), state, torch.tensor(times), {"tip": command})
    tracks = {"tip": command}
    for seed, (place, name) in enumerate(((0, "cube"), (2, "other"))):
        own = [rollout.position_m[0, :, [place]].numpy(), rollout.quat_wxyz[0, :, [place]].numpy()]
        tracks[name] = measured(times, Motion(*own), seed)
    write_tracks(root / "tracks" / "000.csv", tracks, overwrite=True)
    found = compare_models([("a", model)], Capture.open(root), device="cpu")
    (figures,) = found.result.models
    assert figures.reduced_chi2 is not None and 0.6 < figures.reduced_chi2 < 1.5
    assert {moment.quantity.split()[0] for moment in figures.worst} <= {"cube", "other"}
    short = found.models[0].short["000"]
    assert short.bodies == ("cube", "other") and np.isfinite(short.sigmas).all(0).any()
    assert found.models[0].wrenches == []


@pytest.fixture(scope="module")
def gapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Comparison, Capture]:
    """One episode with a gap and a missing frame, and a model with a name that nobody should have."""
    root = write_capture(tmp_path_factory.mktemp("gapped") / "capture", episodes=1)
    path = root / "tracks" / "000.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:10], *lines[11:17], *lines[20:]]) + "\n")
    capture = Capture.open(root)
    return compare_models([("</script><b>", invisible(truth()))], capture, device="cpu"), capture


def test_a_gap_and_uneven_times(gapped: tuple[Comparison, Capture]) -> None:
    (model,) = gapped[0].result.models
    short = gapped[0].models[0].short["000"]
    assert len(short.time_s) == FRAMES - 4
    assert model.reduced_chi2 is not None and 0.6 < model.reduced_chi2 < 1.4
    assert gapped[0].result.pairs == () and gapped[0].result.best == model.model


def test_a_comparison_repeats_itself_and_tells_who_has_seen_the_episodes(gapped: tuple[Comparison, Capture]) -> None:
    model = invisible(truth())
    track = sha256(gapped[1].root / "tracks" / "000.csv")
    source = model.file.provenance.model_copy(update={"input_sha256": {"tracks/000.csv": track}})
    model = replace(model, file=model.file.model_copy(update={"provenance": source}))
    again = compare_models([("</script><b>", model)], gapped[1], device="cpu").result
    warned = "</script><b> was fitted to 1 of the 1 episodes; its errors there are not predictions."
    assert again.warnings == (warned, *gapped[0].result.warnings)
    assert again.model_copy(update={"warnings": gapped[0].result.warnings}) == gapped[0].result


def test_what_files_say_is_no_html(gapped: tuple[Comparison, Capture]) -> None:
    from cgwm.pipeline.compare.page import comparison_html

    html = comparison_html(gapped[0].result, gapped[0].models, {})
    assert "</script><b>" not in html and "&lt;/script&gt;&lt;b&gt;" in html


# Bad input


def refused(arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the message with which a command ends; its exit code must be 2."""
    with pytest.raises(SystemExit) as ended:
        main(["compare", *(str(argument) for argument in arguments)])
    assert ended.value.code == 2
    return capsys.readouterr().err


def test_bad_input_is_refused(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, slippery, true = folder / "capture", folder / "slippery", folder / "true"
    out = ["--out", tmp_path / "page.html"]
    assert "MODEL... and CAPTURE are needed" in refused([slippery], capsys)
    twice = refused([slippery, true, f"{slippery}/", capture, *out], capsys)
    assert "this model is given twice" in twice and "Allowed: each model once." in twice
    assert "no split 'tset'" in refused([slippery, capture, "--split", "tset", *out], capsys)
    assert "split 'empty' has no episode" in refused([slippery, capture, "--split", "empty", *out], capsys)
    assert "not a positive duration" in refused([slippery, capture, "--warmup-s", "0", *out], capsys)
    there = tmp_path / "there.html"
    there.write_text("mine")
    assert "exists" in refused([slippery, capture, "--out", there], capsys)
    assert there.read_text() == "mine"
    assert "is a capture" in refused([capture, capture, *out], capsys)
    boxes = write_capture(tmp_path / "boxes", episodes=1, body="box")
    message = refused([slippery, boxes, *out], capsys)
    assert message.startswith(f"{slippery}: the model's bodies are 'cube'; those of {boxes} are 'box'")
    write_model(tmp_path / "bare", replace(truth(), file=truth().file.model_copy(update={"contact": None})))
    assert "no fitted physics" in refused([slippery, tmp_path / "bare", capture, *out], capsys)
    trackless = write_capture(tmp_path / "trackless", episodes=1)
    add_video(trackless)
    (trackless / "tracks" / "000.csv").unlink()
    assert "no track of 'cube'" in refused([slippery, trackless, *out], capsys)
    assert not (tmp_path / "page.html").exists()


def test_an_existing_page_is_told_before_the_work(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("mine")
    with pytest.raises(UsageError, match="exists"):
        compare([folder / "nothing"], folder / "capture", out=tmp_path / "page.html")
    with pytest.raises(UsageError, match="no page of cgwm, or was changed; --overwrite does not remove it"):
        compare([folder / "nothing"], folder / "capture", out=tmp_path / "page.html", overwrite=True)
    assert (tmp_path / "page.html").read_text() == "mine"


def test_the_page_is_beside_the_models_and_in_no_output(folder: Path, tmp_path: Path) -> None:
    assert default_page([folder / "slippery", folder / "true"]) == folder / "compare-slippery-true.html"
    assert default_page([Path("m0")]) == Path("compare-m0.html")
    with new_directory(tmp_path / "dataset", "dataset") as made:
        (made / "model").mkdir()
    assert default_page([tmp_path / "dataset" / "model"]) == tmp_path / "compare-dataset-model.html"
    both = [tmp_path / "dataset" / "model", tmp_path / "m1"]
    assert default_page(both) == tmp_path / "compare-dataset-model-m1.html"
    assert default_page([Path("a/m"), Path("b/m")]) == Path("a/compare-a-m-b-m.html")
    assert default_page([Path("m0")], "train") == Path("compare-m0-train.html")


def test_a_page_of_the_same_comparison_is_replaced_without_asking_and_nothing_else(
    page: Path, folder: Path, tmp_path: Path
) -> None:
    models, capture = [folder / "slippery", folder / "true"], folder / "capture"

    def known(page: Path, models: list[Path], capture: Path, split: str = "test") -> bool:
        return shows_the_same(page, mark_of(page, models, capture, split))

    assert known(page, models, capture)
    assert not known(page, models[:1], capture)
    assert not known(page, models[::-1], capture)
    assert not known(page, models, folder / "another")
    assert not known(page, models, capture, "train")
    assert not known(tmp_path / "none.html", models, capture)
    assert not known(tmp_path, models, capture)


def test_the_command_can_be_typed_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_capture(tmp_path / "capture", episodes=1)
    write_model(tmp_path / "m0", truth())
    page = tmp_path / "compare-m0.html"
    for _ in range(2):
        with pytest.raises(SystemExit) as ended:
            main(["compare", str(tmp_path / "m0"), str(capture), "--quiet"])
        assert ended.value.code == 0 and page.is_file()
    page.write_text("mine")
    assert "exists" in refused([tmp_path / "m0", capture], capsys)
    assert page.read_text() == "mine"


def test_the_summary(result: CompareResult) -> None:
    from cgwm.cli.compare import _summary

    lines = _summary(result).splitlines()
    assert lines[0] == result.verdict
    assert lines[1].split() == [model.model for model in result.models]
    assert any(line.split()[:2] == ["in", "sliding"] for line in lines)
    assert any("better in 6 of 6 episodes" in line for line in lines)
    assert lines[-1] == f"Page: {result.report}"


# The page


def test_the_page_needs_nothing_else(page: Path) -> None:
    html = page.read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(html)
    assert tags.faults == [] and tags.open == [] and tags.addresses == ["slippery", "true", "capture"]
    assert "http://" not in html and "https://" not in html and "@import" not in html
    assert page.stat().st_size < 10e6


CLICKS = """
const root = document.getElementById("replay"), part = name => root.querySelector("[data-part=" + name + "]");
const wait = ms => new Promise(done => setTimeout(done, ms));
const drawn = canvas => {
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let sum = 0;
  for (let k = 0; k < pixels.length; k += 4) sum += pixels[k] + pixels[k + 1] + pixels[k + 2];
  return sum / (pixels.length / 4);
};
const answer = { first: root.dataset.episode };
await wait(300);
answer.views = [drawn(part("side")), drawn(part("top"))];
answer.kinds = [...part("film").querySelectorAll("canvas")].map(c => c.dataset.kind);
answer.film = [...part("film").querySelectorAll("canvas")].map(drawn);
const slider = part("slider"), line = part("move").querySelector(".now");
const before = line.getAttribute("x1");
slider.value = 12; slider.dispatchEvent(new Event("input"));
answer.slid = [root.dataset.frame, before !== line.getAttribute("x1"), part("clock").textContent];
answer.values = part("values").textContent;
const box = part("z").getBoundingClientRect();
const press = { clientX: box.right - 3, clientY: box.top + 40, bubbles: true };
part("z").dispatchEvent(new PointerEvent("pointerdown", press));
answer.sought = Number(root.dataset.frame);
const go = [...document.querySelectorAll("button.go")].find(b => b.dataset.episode !== root.dataset.episode);
go.click();
answer.went = [root.dataset.episode, Number(root.dataset.time), go.dataset.episode, Number(go.dataset.time)];
const toggle = part("models").querySelector("button");
const paths = () => part("move").querySelectorAll("path.line").length;
answer.lines = [paths(), (toggle.click(), paths()), toggle.getAttribute("aria-pressed"), (toggle.click(), paths())];
const table = document.querySelector("table.sortable"), column = 2;
const cells = () => [...table.tBodies[0].rows].map(row => parseFloat(row.cells[column].textContent));
table.tHead.rows[0].cells[column].click(); answer.up = cells();
table.tHead.rows[0].cells[column].click(); answer.down = cells();
const chart = document.getElementById("wrench");
const pick = (name, value) => {
  const select = chart.querySelector("[data-part=" + name + "]");
  select.value = value; select.dispatchEvent(new Event("change"));
};
pick("kind", 6); answer.points = Number(chart.dataset.points); answer.circles = chart.querySelectorAll("circle").length;
pick("kind", 0); answer.forces = Number(chart.dataset.points);
pick("kind", 6);
const circle = chart.querySelectorAll("circle")[3], label = circle.querySelector("title").textContent;
circle.dispatchEvent(new MouseEvent("click", { bubbles: true }));
answer.circle = [label, root.dataset.episode, Number(root.dataset.time)];
part("episode").selectedIndex = 0; part("episode").dispatchEvent(new Event("change"));
part("speed").value = "1"; part("play").click(); await wait(400);
answer.played = [part("play").textContent, Number(root.dataset.frame)];
part("play").click();
answer.paused = part("play").textContent;
return answer;
"""


def test_the_page_is_clicked(page: Path, tmp_path: Path, result: CompareResult) -> None:
    answer = clicked(page, tmp_path, CLICKS)
    assert "failed" not in answer, answer
    assert answer["faults"] == []
    assert all(address.startswith("data:") for address in answer["loaded"])
    assert answer["first"] == "000"
    assert all(value > 0 for value in answer["views"])
    assert answer["kinds"] == ["recorded", "predicted 0", "difference 0", "predicted 1", "difference 1"]
    real, slippery, slippery_off, true, true_off = answer["film"]
    assert min(real, slippery, true) > 50 and true_off < slippery and true_off > 0 and slippery_off > 0
    assert answer["slid"] == ["12", True, f"{12 / RATE_HZ:.3f} s"]
    assert "slippery: " in answer["values"] and "true: " in answer["values"] and " mm, " in answer["values"]
    assert answer["sought"] == FRAMES - 1
    episode, time_s, wanted, wanted_s = answer["went"]
    assert episode == wanted and time_s == pytest.approx(wanted_s, abs=0.5 / RATE_HZ)
    assert answer["lines"] == [2, 1, "false", 2]
    numbers = [value for value in answer["up"] if value is not None]
    assert len(numbers) >= 4 and numbers == sorted(numbers) == answer["down"][::-1]
    assert answer["points"] == answer["circles"] > answer["forces"] > 0
    label, episode, time_s = answer["circle"]
    assert label.startswith(f"episode {episode}, ")
    assert float(label.split(", ")[1].split()[0]) == pytest.approx(time_s, abs=0.6 / RATE_HZ)
    assert answer["played"][0] == "Pause" and answer["played"][1] > 0
    assert answer["paused"] == "Play"


def test_the_ladder_has_every_episode_and_the_zeros() -> None:
    rungs = [
        Rung("a<b", {"0": 10.0, "1": 20.0, "2": 90.0}, floor_mm=0.5),
        Rung("c", {"0": 5.0, "1": 6.0}, fitted_mm=1.0),
    ]
    svg = ladder_svg(rungs, {"frozen object": 200.0, "ballistic object": 210.0})
    assert svg.count('<g class="episode">') == 3 and svg.count("<circle") == 5 + 2
    assert "20 mm" in svg and "5.5 mm" in svg and "a&lt;b" in svg
    assert svg.count('class="zero"') == 2 and svg.count('class="floor"') == 1 and svg.count('class="fitted"') == 1
    Tags().feed(svg)


def test_short_errors_leave_the_states_their_freedom(folder: Path) -> None:
    """Each segment's leverages add up to the numbers of its state."""
    capture = Capture.open(folder / "capture")
    world = world_of_model(truth())
    episodes = [(name, capture.tracks(name)) for name in capture.episodes("test")]
    given = capture.manifest.measurement
    prepared = prepare(world, episodes, (given.position_std_m, given.rotation_std_rad))
    assert prepared.noise == (given.position_std_m, given.rotation_std_rad)
    fit = short_errors(world, episodes, prepared, ["cube"])
    assert prepared.flight is not None and prepared.contact_items
    for segment in prepared.flight.items:
        one = fit.errors[episodes[segment.episode][0]]
        rows = slice(segment.first, segment.last + 1)
        taken = float((1 - one.freedom[rows]).sum())
        assert taken == pytest.approx(12, abs=0.05)
