"""The ladder of models: what is proposed, what is accepted, and how its page and files are read again."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.cli.app import app
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.model import read_model, write_model
from cgwm.datasets.synthetic.hidden_effects import cases, make_capture
from cgwm.pipeline.diagnose.report.pictures import DrawnMotion
from cgwm.pipeline.improve import improve
from cgwm.pipeline.improve.folds import folds_of
from cgwm.pipeline.improve.held_out_errors import HeldOutErrors, error_ratio, typical_error
from cgwm.pipeline.improve.ladder import Climb, helps
from cgwm.pipeline.improve.ladder_files import LadderFiles
from cgwm.pipeline.improve.page import ladder_html
from cgwm.pipeline.improve.proposals import Proposal, proposals_of
from cgwm.pipeline.improve.wording import remaining_words, share_words, worse_words
from cgwm.pipeline.phys_geo.effects.requested_effects import with_effects
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.validate import validate
from cgwm.schemas import (
    DiagnoseResult,
    ErrorRatio,
    ImproveConfig,
    ImproveResult,
    ImproveStep,
    ImproveTest,
    ImproveTestStep,
    ImproveTrial,
    InputDataError,
    LawTerm,
    NextExperiment,
    PhysConfig,
    RankedEffect,
    Remaining,
    ResidualLaw,
    UsageError,
    read_json,
)
from helpers.pages import Tags
from helpers.small_model import small_model, write_small_model
from helpers.thrown_cube import write_capture
from typer.testing import CliRunner

RANKED = RankedEffect(effect="linear_drag", acts_in=("flight",), judged_in="flight", score_p=1e-9)
LAW = ResidualLaw(
    terms=(LawTerm(term="-u", coefficient=0.3, std_error=0.01, unit="1/s"),), left_chi2=1.0, where="speed"
)


def found(verdict: str = "missing_effect", **fields: object) -> DiagnoseResult:
    return DiagnoseResult.model_validate({"verdict": verdict, "sentence": "said", "episodes": 6, **fields})


def test_every_episode_is_in_one_fold() -> None:
    names = [f"{k:02d}" for k in range(11)]
    for count in (2, 4, 20):
        folds = folds_of(names, count)
        assert sorted(name for fold in folds for name in fold) == names
        assert len(folds) == min(count, 11)
        assert max(map(len, folds)) - min(map(len, folds)) <= 1


def test_a_ratio_is_that_of_each_episode_and_its_interval_needs_several() -> None:
    rng = np.random.default_rng(0)
    before = {f"{k}": float(np.exp(rng.normal(0, 2))) for k in range(12)}
    after = {name: 0.5 * value * float(np.exp(rng.normal(0, 0.1))) for name, value in before.items()}
    for count in (2, 4, 12):
        names = list(before)[:count]
        ratio = error_ratio({n: before[n] for n in names}, {n: after[n] for n in names})
        assert ratio is not None and ratio.ratio == pytest.approx(0.5, rel=0.2)
        assert (ratio.interval_95 is None) == (count == 2)
        if ratio.interval_95 is not None:
            assert ratio.interval_95[0] < 0.5 * 1.1 and ratio.ratio < ratio.interval_95[1] < 1
    same = error_ratio(before, {name: value * float(np.exp(rng.normal(0, 0.3))) for name, value in before.items()})
    assert same is not None and same.interval_95 is not None and same.interval_95[0] < 1 < same.interval_95[1]
    assert error_ratio(before, {"other": 1.0}) is None


def test_an_addition_helps_if_one_error_falls_beyond_chance_and_none_rises() -> None:
    def ratio(value: float, low: float, high: float) -> ErrorRatio:
        return ErrorRatio(episodes=8, better=4, before=1.0, after=value, ratio=value, interval_95=(low, high))

    falls, chance, rises = ratio(0.5, 0.4, 0.7), ratio(0.9, 0.7, 1.1), ratio(1.3, 1.1, 1.6)
    assert helps(falls, chance) and helps(None, falls)
    assert helps(falls, ratio(1.024, 1.001, 1.053)) and not helps(falls, ratio(1.024, 1.021, 1.027))
    assert not helps(falls, rises) and not helps(chance, None) and not helps(None, None)
    assert not helps(ratio(0.99, 0.985, 0.995), None)
    assert not helps(falls.model_copy(update={"interval_95": None}), None)


def test_a_few_impacts_do_not_outweigh_a_long_flight() -> None:
    flight, impact = torch.full((100,), 4.0), torch.full((3,), 1e6)
    before, after = torch.cat((flight, impact)), torch.cat((0.25 * flight, 2 * impact))
    assert after.mean() > before.mean()
    assert typical_error(after) < 0.7 * typical_error(before)


def test_what_is_named_comes_first_and_what_is_not_is_tried_where_nothing_is(tmp_path: Path) -> None:
    law = tmp_path / "law_0.py"
    named = proposals_of(found(selected=("wind", "linear_drag")), (), law)
    assert [[p.effects for p in group] for group in named] == [[("wind", "linear_drag")], [("wind",), ("linear_drag",)]]
    unnamed = found("unexplained", ranking=(RANKED,), residual_law=LAW)
    ((first, second),) = proposals_of(unnamed, (), law)
    assert (first.effects, first.why) == (("linear_drag",), "first_of_the_ranking")
    assert (second.names, second.why) == (("law_0.py:ResidualLaw",), "law")
    assert law.is_file()
    assert proposals_of(unnamed, ("linear_drag@group", "effects/law_0.py:ResidualLaw"), law) == []
    assert proposals_of(found("none_missing"), (), law) == []
    weak = found("unexplained", ranking=(RANKED.model_copy(update={"score_p": 0.1}),))
    assert proposals_of(weak, (), law) == []


@pytest.fixture
def climb(tmp_path: Path) -> Climb:
    """A ladder at its first model, whose models without a fold are not fitted."""
    files = LadderFiles(tmp_path / "out", {}, resume=False, overwrite=False)
    write_small_model(files / "m0")
    capture = Capture.open(write_capture(tmp_path / "capture", 3), splits=("test",))
    return Climb(
        capture=capture,
        split="test",
        files=files,
        folds=((),),
        config=ImproveConfig(),
        physics=PhysConfig(),
        library=(),
        throws=(),
        accept_units=False,
    )


SCATTER = np.random.default_rng(0).normal(0, 0.2, 8)


def set_errors(monkeypatch: pytest.MonkeyPatch, errors: dict[tuple[str, ...], float]) -> None:
    """Let the models with some effects have an error in eight unseen episodes; that of the law scatters."""

    def measured(_: Climb, __: str, ___: str, effects: tuple[str, ...]) -> HeldOutErrors:
        names = tuple(name.rpartition("/")[2] for name in effects)
        scatter = SCATTER - SCATTER.mean() if any(name.startswith("law_") for name in names) else np.zeros(8)
        values = (errors[names] * np.exp(scatter)).tolist()
        return HeldOutErrors(flight={f"{k}": value for k, value in enumerate(values)}, contact={})

    monkeypatch.setattr(Climb, "_measured", measured)


@pytest.mark.parametrize(("law_error", "added"), [(0.43, "linear_drag"), (0.2, "law_0.py:ResidualLaw")])
def test_a_law_is_taken_before_an_effect_only_where_it_predicts_better_beyond_chance(
    climb: Climb, monkeypatch: pytest.MonkeyPatch, law_error: float, added: str
) -> None:
    set_errors(monkeypatch, {(): 1.0, ("linear_drag",): 0.45, ("law_0.py:ResidualLaw",): law_error})
    tried, best = climb._tried(0, "m0", found("unexplained", ranking=(RANKED,), residual_law=LAW))
    assert all(trial.helps for trial in tried) and len(tried) == 2
    assert best is not None and best[1].names == (added,)


def test_the_law_of_an_interrupted_ladder_is_run_again(climb: Climb, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CGWM_TRUSTED_EFFECTS", "")
    law = climb.files / "law_0.py"
    proposals_of(found("unexplained", residual_law=LAW), (), law)
    fitted = with_effects((), [f"{law}:ResidualLaw"])
    model = small_model()
    write_model(
        climb.files / "folds" / "m0-0-0", replace(model, file=model.file.model_copy(update={"effects": fitted}))
    )
    monkeypatch.setenv("CGWM_TRUSTED_EFFECTS", "")  # the next process
    set_errors(monkeypatch, {(): 1.0, ("law_0.py:ResidualLaw",): 0.5})
    climb._trial("m0", "m0-0", Proposal((f"{law}:ResidualLaw",), "law"))
    world_of_model(read_model(climb.files / "folds" / "m0-0-0"))


def test_what_the_others_do_without_is_left_out(climb: Climb, monkeypatch: pytest.MonkeyPatch) -> None:
    drag, force = ("linear_drag",), ("constant_force",)
    named = ("quadratic_drag", *force, *drag)
    errors = {(): 1.0, named: 0.4, named[:2]: 0.5, ("quadratic_drag", *drag): 0.6, force + drag: 0.401}
    set_errors(monkeypatch, errors)
    tried, best = climb._tried(0, "m0", found(selected=named))
    assert best is not None and best[1].names == force + drag
    assert [trial.effects for trial in tried] == list(errors)[1:]


def test_what_remains_is_said_in_sentences() -> None:
    left = Remaining(
        position_rms_m=0.002,
        slow_position_std_m=0.0011,
        slow_time_s=0.03,
        own_acceleration_std_m_s2=0.0981,
        repeats=False,
        coordinate="x",
        p_value=0.4,
        share_explained=0.9,
    )
    entry = RANKED.model_copy(update={"effect": "drag"})
    said = found(selected=("drag",), ranking=(entry,), remaining=left, contact_chi2=1.5)
    text = " ".join(remaining_words(said))
    for words in (
        "1.2 mm along each axis",
        "1.1 mm change within 30 ms",
        "leaned by 10 mrad",
        "Nothing of it is common",
        "chi2 of 1.5",
    ):
        assert words in text
    assert "drag explains 90.0 %" in share_words(said)[0]
    fast = left.model_copy(update={"slow_position_std_m": 0.0, "own_acceleration_std_m_s2": 0.0, "repeats": True})
    text = " ".join(remaining_words(found(remaining=fast)))
    assert "No slow errors" in text and "leaned" not in text and "place along x" in text
    assert "said of it" in remaining_words(found())[0] and share_words(found()) == []


def test_an_unfinished_ladder_is_continued_by_the_same_command_only(tmp_path: Path) -> None:
    out = tmp_path / "out"
    files = LadderFiles(out, {"split": "train"}, resume=False, overwrite=False)
    files.document("one.json", ImproveConfig, lambda: ImproveConfig(steps=3))
    with pytest.raises(UsageError, match="was interrupted"):
        LadderFiles(out, {"split": "train"}, resume=False, overwrite=False)
    with pytest.raises(UsageError, match="other values of split"):
        LadderFiles(out, {"split": "look"}, resume=True, overwrite=False)
    again = LadderFiles(out, {"split": "train"}, resume=True, overwrite=False)
    assert again.document("one.json", ImproveConfig, ImproveConfig).steps == 3
    assert not (LadderFiles(out, {}, resume=False, overwrite=True) / "one.json").exists()
    again.remove()
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_improved_is_refused_before_any_work(tmp_path: Path) -> None:
    capture, model = write_capture(tmp_path / "capture", 3), write_small_model(tmp_path / "model")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    for arguments, message in (
        ({"out": tmp_path / "mine"}, "exists"),
        ({"out": tmp_path / "mine", "overwrite": True}, "holds no ladder"),
        ({"phys_config": PhysConfig(supervise="images")}, "judged on measured tracks"),
        ({"parent": model, "phys_config": PhysConfig(effects=("wind",))}, "with a model to start from"),
        ({"split": "nowhere"}, "no split 'nowhere'"),
        ({"candidates": ("wind@episode",)}, "one value for all episodes"),
    ):
        with pytest.raises((UsageError, InputDataError), match=re.escape(message)):
            improve(capture, **{"out": tmp_path / "out", "split": "test", **arguments})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "mine", "model"]


@pytest.fixture
def ladder(tmp_path: Path) -> Path:
    """A ladder of one model, to which nothing was added."""
    out = tmp_path / "ladder"
    out.mkdir()
    write_small_model(out / "m0")
    trial = ImproveTrial(effects=("<b>",), why="selected", helps=False, failure="<i>no</i>")
    step = ImproveStep(**found(ranking=(RANKED,)).model_dump(), model="m0", tried=(trial,))
    result = ImproveResult(
        capture="<script>",
        split="train",
        episodes=2,
        folds=(("a",), ("b",)),
        models=("m0",),
        model_sha256={"m0": sha256(out / "m0" / "model.json")},
        sentence="Nothing <was> added.",
        stopped="nothing_helps",
        steps=(step,),
        page="improve.html",
    )
    (out / "improve.json").write_text(result.model_dump_json())
    (out / "improve.html").write_text(ladder_html(result, out))
    return out


def test_the_page_is_whole_and_takes_no_text_for_html(ladder: Path) -> None:
    text = (ladder / "improve.html").read_text()
    for words in ("<b>", "<i>", "<was>", "http://", "https://"):
        assert words not in text
    tags = Tags()
    tags.feed(text)
    assert (tags.faults, tags.open) == ([], [])
    assert {address.rpartition("/")[2] for address in tags.addresses} == {"m0", "improve.json", "%3Cscript%3E"}


def test_the_page_draws_the_last_experiment_that_was_asked_for(ladder: Path) -> None:
    result = read_json(ladder / "improve.json", ImproveResult)
    throw = NextExperiment(what="throw it", initial_state={"a": 1}, separates=("a", "b", "c"), expected_gain_nats=1.0)
    steps = [result.steps[0].model_copy(update={"model": name, "next_experiment": throw}) for name in ("m0", "m1")]
    asked = result.model_copy(update={"steps": (*steps, result.steps[0])})
    drawn = ladder_html(asked, ladder, (DrawnMotion("throw it", np.array([[0.0, 1.0], [1.0, 0.0]])),))
    assert "It tells a, b and c apart. Asked for by the diagnosis of m1." in drawn
    assert "along the throw [m]" in drawn and "along the throw [m]" not in ladder_html(asked, ladder)


def test_a_ladder_is_validated_with_its_models(ladder: Path) -> None:
    assert validate(ladder).faults == ()
    document = json.loads((ladder / "improve.json").read_text())
    for change, words in (
        ({"model_sha256": {"m0": 64 * "0"}}, "another content"),
        ({"models": ["m0", "m1"]}, "the model m1 is missing"),
        ({"folds": [["a"], ["a"]]}, "2 episodes, not 2 different"),
        ({"page": "other.html"}, "the page other.html is missing"),
    ):
        (ladder / "improve.json").write_text(json.dumps(document | change))
        assert any(words in fault for fault in validate(ladder).faults), words
    for change in ({"models": ["../m0"]}, {"added": 1}, {"episodes": "2"}):
        (ladder / "improve.json").write_text(json.dumps(document | change))
        with pytest.raises(InputDataError):
            validate(ladder)


@pytest.mark.evidence
def test_hidden_drag_is_added_and_test_errors_fall_in_the_same_ladder_after_an_interruption(tmp_path: Path) -> None:
    (case,) = (one for one in cases("development") if one.name == "development/ball/quadratic_drag/large/0")
    make_capture(tmp_path / "capture", replace(case, test=4))
    words = ["improve", str(tmp_path / "capture"), "--out", str(tmp_path / "ladder"), "--json"]
    said = CliRunner().invoke(app, words)
    assert said.exit_code == 0, said.output
    result = json.loads(said.stdout)
    assert [step["added"] for step in result["steps"] if step["added"]] == [["quadratic_drag"]]
    first, last = result["test"]["models"]
    assert last["translation_error_m"]["median"] < 0.5 * first["translation_error_m"]["median"]
    assert validate(tmp_path / "ladder").faults == ()
    kept = (tmp_path / "ladder" / "improve.json").read_bytes()
    for again in (words, [*words, "--resume"]):
        assert json.loads(CliRunner().invoke(app, again).stdout) == result
    assert CliRunner().invoke(app, [*words, "--steps", "1"]).exit_code == 2
    assert (tmp_path / "ladder" / "improve.json").read_bytes() == kept


@pytest.mark.parametrize(("low", "said"), [(5.7, True), (0.9, False)])
def test_a_model_that_is_worse_on_the_test_episodes_is_said(low: float, said: bool) -> None:
    near = ErrorRatio(episodes=3, better=3, before=2.1, after=2.0, ratio=0.96, interval_95=(0.9, 1.01))
    far = ErrorRatio(episodes=3, better=0, before=0.015, after=0.11, ratio=7.3, interval_95=(low, 9.4))
    step = ImproveTestStep(model="m1", than="m0", contact=near, translation_error_m=far)
    words = worse_words(ImproveTest(split="test", episodes=3, verdict="", models=(), steps=(step,)))
    assert len(words) == said
    assert not said or ("m1 predicts the test episodes worse than m0" in words[0] and "7.3 times" in words[0])
