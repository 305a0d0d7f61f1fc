"""The mystery: nothing tells what is hidden, the loop is walked whole, and its story says plainly how it ended."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from cgwm.cli.app import app
from cgwm.datasets.io.kinds import kind_of
from cgwm.datasets.io.outputs import RECORD
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic.hidden_effects import draw_mystery, make_mystery, open_sealed
from cgwm.datasets.synthetic.hidden_effects.mystery import CHOICES
from cgwm.pipeline.demo import mystery
from cgwm.pipeline.demo.mystery import judged, run_mystery
from cgwm.pipeline.diagnose import stage
from cgwm.pipeline.validate import validate
from cgwm.schemas import (
    DiagnoseResult,
    HiddenEffect,
    InputDataError,
    MysteryResult,
    PhysConfig,
    SealedFile,
    UsageError,
    read_json,
)
from helpers.pages import Tags, clicked
from typer.testing import CliRunner

QUICK = PhysConfig(population=8, generations=2, iterations=2, step_s=0.002)
SEED = next(seed for seed in range(1000) if draw_mystery(seed).effects == ("magnus_lift",))


def short(seed: int):
    """Return the case of a seed with fewer and shorter episodes, throws alone."""
    return replace(draw_mystery(seed), train=4, test=2, length_s=0.45, protocol="throws")


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory):
    out = tmp_path_factory.mktemp("mystery") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mystery, "draw_mystery", short)
        patch.setattr(stage, "next_motions", lambda *_: None)  # they take seconds, and have tests of their own
        result = run_mystery(out, SEED, "cpu", physics=QUICK)
    return out, result


def test_a_seed_draws_one_of_all_kinds() -> None:
    drawn = [draw_mystery(seed) for seed in range(300)]
    assert drawn[:5] == [draw_mystery(seed) for seed in range(5)]
    assert {(case.thing, *case.effects) for case in drawn if case.effects} == set(CHOICES)
    nothing = sum(not case.effects for case in drawn)
    assert 20 < nothing < 75
    with pytest.raises(UsageError, match="the seed is -1"):
        draw_mystery(-1)


def test_nothing_tells_what_is_hidden(tmp_path: Path) -> None:
    seed = next(s for s in range(123456, 124456) if draw_mystery(s).effects)
    case = short(seed)
    make_mystery(tmp_path / "capture", tmp_path / "sealed.json", case)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "sealed.json"]
    files = sorted(path.relative_to(tmp_path / "capture").as_posix() for path in (tmp_path / "capture").rglob("*.*"))
    assert files == [RECORD, "capture.toml", *(f"tracks/00{k}.csv" for k in range(6))]
    secrets = [effect for _, effect in CHOICES] + ["mystery", "hidden", str(seed)]
    for name in files:
        written = (tmp_path / "capture" / name).read_text()
        assert not [word for word in secrets if word in written], name
    sealed = (tmp_path / "sealed.json").read_text()
    assert not [effect for _, effect in CHOICES if effect in sealed]
    (found,) = open_sealed(tmp_path / "sealed.json")
    assert (found.name,) == case.effects
    assert found.values == {k: v for k, v in case.drawn_effects()[0].values.items()}


def test_a_broken_seal_is_refused(tmp_path: Path) -> None:
    file = SealedFile(how_to_open="", zlib_base64="eJw=")
    (tmp_path / "sealed.json").write_text(file.model_dump_json())
    with pytest.raises(InputDataError, match="cannot be opened"):
        open_sealed(tmp_path / "sealed.json")


@pytest.mark.parametrize(
    ("verdict", "selected", "aliases", "hidden", "outcome", "words"),
    [
        ("none_missing", (), (), (), "right", "nothing was found: right"),
        ("missing_effect", ("wind",), (), (), "wrong", "false alarm"),
        ("unexplained", (), (), (), "wrong", "false alarm"),
        ("missing_effect", ("wind",), (), ("wind",), "right", "wind was named: right"),
        ("missing_effect", ("wind",), (), ("adhesion",), "wrong", "wind was named: wrong"),
        (
            "missing_effect",
            ("wind", "adhesion"),
            (),
            ("wind",),
            "partly",
            "adhesion, which was not hidden, was named, too",
        ),
        ("not_separable", ("a",), (("a", "b", "c"),), ("b",), "right_class", "one of a, b and c"),
        ("not_separable", ("a",), (("a", "b", "c"),), ("a",), "right_class", "right, as a class"),
        ("not_separable", ("a",), (("a", "b", "c"),), ("d",), "wrong", "a was named: wrong"),
        ("not_separable", ("a", "d"), (("a", "b"),), ("b",), "partly", "d, which was not hidden, was named, too"),
        ("unexplained", (), (), ("a",), "unnamed", "but did not name it"),
        ("none_missing", (), (), ("a",), "silent", "nothing was found: missed"),
    ],
)
def test_the_outcome_is_said_plainly(verdict, selected, aliases, hidden, outcome, words) -> None:
    found = DiagnoseResult(verdict=verdict, sentence="", selected=selected, aliases=aliases, episodes=6)
    truth = tuple(HiddenEffect(name=name, values={}, form="") for name in hidden)
    told, sentence = judged(found, truth)
    assert told == outcome
    assert words in sentence


def test_the_whole_loop(solved: tuple[Path, MysteryResult]) -> None:
    out, result = solved
    assert sorted(path.name for path in out.iterdir()) == sorted([RECORD, *result.paths.values()])
    assert read_json(out / "report.json", MysteryResult) == result
    assert read_json(out / "diagnosis.json", DiagnoseResult) == result.diagnosis
    assert open_sealed(out / "sealed.json") == result.hidden
    assert [effect.name for effect in result.hidden] == ["magnus_lift"]
    assert result.diagnosis.selected == ("magnus_lift",) and result.outcome == "right"
    base, child = result.comparison.models
    assert (base.model, child.model) == ("m0", "m1") and child.effects == ("magnus_lift",)
    assert child.translation_error_m.median < 0.5 * base.translation_error_m.median
    assert "--set phys-geo.population=8" in result.settings and "phys-geo.step_s=0.002" in result.settings
    (number,) = result.parameters
    assert number.parameter.name == "magnus_lift.s" and abs(number.true_value) == 0.04
    assert number.parameter.estimate == pytest.approx(number.true_value, rel=0.1)
    assert [kind_of(out / name) for name in ("capture", "m0", "m1")] == ["capture", "model", "model"]
    assert all(validate(out / name).passed for name in ("capture", "m0", "m1"))
    assert read_model(out / "m1").file.provenance.parent == "m0"
    # Nothing tells of the name that the directory had while it was being written.
    texts = [path for path in out.rglob("*") if path.suffix in (".json", ".html", ".toml")]
    assert [path.name for path in texts if ".partial" in path.read_text(encoding="utf-8")] == []


def test_the_page_tells_it_last(solved: tuple[Path, MysteryResult], tmp_path: Path) -> None:
    out, result = solved
    page = (out / "report.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(page)
    assert tags.faults == [] and tags.open == []
    assert "compare.html" in tags.addresses and {*result.paths.values()} <= {*tags.addresses}
    assert all((out / address).exists() for address in tags.addresses)
    titles = ["1. Fit", "2. Compare", "3. Diagnose", "4. Add", "5. Compare again", "What was hidden"]
    places = [next(m.start() for m in re.finditer(rf"<h2[^>]*>{re.escape(title)}", page)) for title in titles]
    assert places == sorted(places)
    assert places[-1] < page.index(result.sentence) and page.count(result.sentence) == 1
    assert result.hidden[0].form not in page[: places[-1]]
    assert max(map(len, page.split('"'))) < 20_000
    answer = clicked(out / "report.html", tmp_path, "return { rows: document.querySelectorAll('tr').length };")
    assert answer["faults"] == [] and answer["loaded"] == [] and answer["rows"] > 15


def test_the_command_prints_one_document(
    solved: tuple[Path, MysteryResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, result = solved
    asked = []

    def work(*arguments: object) -> MysteryResult:
        asked.append(arguments)
        return result

    monkeypatch.setattr("cgwm.pipeline.demo.run_mystery", work)
    words = ["demo", str(tmp_path / "out"), "--scene", "mystery", "--seed", "5", "--device", "cpu"]
    printed = CliRunner().invoke(app, [*words, "--json"])
    assert printed.exit_code == 0
    assert MysteryResult.model_validate(json.loads(printed.stdout)) == result
    told = CliRunner().invoke(app, words).stdout
    assert asked == 2 * [(tmp_path / "out", 5, "cpu", False)]
    assert [line.split()[0] for line in told.splitlines()[:6]] == [
        *("fit", "compare", "diagnose", "add", "compare", "hidden")
    ]
    assert result.sentence in told


def test_what_exists_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    refused = CliRunner().invoke(app, ["demo", str(tmp_path / "out"), "--scene", "mystery"])
    assert refused.exit_code == 2
    assert list((tmp_path / "out").iterdir()) == []
    with pytest.raises(UsageError, match="exists"):
        run_mystery(tmp_path / "out")


def test_an_error_names_the_stage_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(model: Path, capture: Path) -> DiagnoseResult:
        raise InputDataError(f"{capture}: the tracks are too short.")

    monkeypatch.setattr(mystery, "draw_mystery", short)
    monkeypatch.setattr(mystery, "fit", lambda *_, **__: None)
    monkeypatch.setattr(mystery, "diagnose", fail)
    with pytest.raises(InputDataError) as error:
        run_mystery(tmp_path / "out", SEED, "cpu")
    assert f"stage 'diagnose' (nothing was left in {tmp_path / 'out'})" in str(error.value)
    assert list(tmp_path.iterdir()) == []
