"""The figures of docs/results*.md: each line is whole, its command exists, and `make results` was run."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
from cgwm.cli.app import VERBS

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))  # as `python benchmarks/render_results.py` has it
try:
    import diagnose_figures
    import render_results
    from render_results import DOCS, MOST_LINES, RESULTS, read_claims, record, render
finally:
    sys.path.remove(str(BENCHMARKS))

CLAIMS = {claim["name"]: claim for claim in read_claims()}
FIGURES = [(name, one) for name, claim in CLAIMS.items() for one in claim["figures"]]
COMMANDS = sorted({one.command for _, one in FIGURES})
LINE = {
    "figure": "speed",
    "value": 3.5,
    "unit": "m/s",
    "target": "at most 4",
    "met": True,
    "command": "make test",
    "commit": "0123abc",
    "machine": "2 cores",
    "date": "2026-01-31",
    "note": "",
    "status": "transcribed",
}


PAGES = render()


def test_the_pages_are_up_to_date() -> None:
    there = {path.name: path.read_text(encoding="utf-8") for path in DOCS.glob("results*.md")}
    assert there == PAGES, "run 'make results'"


def test_the_pages_are_short() -> None:
    assert max(len(text.splitlines()) for text in PAGES.values()) <= MOST_LINES <= 150


def test_every_figure_is_in_its_table_and_diagnosis_comes_first() -> None:
    for name, one in FIGURES:
        text = PAGES[f"results-{CLAIMS[name]['page']}.md"]
        assert one.figure in text and one.command in text
    first_screen = PAGES["results.md"].splitlines()[:22]  # eight pages, then the table
    assert sum("[Diagnosis]" in line for line in first_screen) >= 6
    assert any("false alarms" in line for line in first_screen)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_exist(command: str) -> None:
    for part in command.split(" && "):
        program, *words = shlex.split(part)
        if program == "python":
            file = ROOT / words[0]
            assert file.is_file()
            source = file.read_text(encoding="utf-8")
            assert all(f'"{word}"' in source for word in words if word.startswith("--"))
        elif program == "pytest":
            files = [word for word in words if word.startswith("tests/")]
            assert files and all((ROOT / file).is_file() for file in files)
        elif program == "make":
            targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
            assert words and set(words) <= set(targets)
        else:
            assert program == "cgwm" and words[0] in {name for name, *_ in VERBS}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"met": True, "target": ""}, "met"),
        ({"met": "yes"}, "met"),
        ({"value": None}, "value"),
        ({"value": True}, "value"),
        ({"commit": "later"}, "commit"),
        ({"status": "guessed"}, "status"),
        ({"date": "31.1.2026"}, "31.1.2026"),
        ({"command": ""}, "command"),
        ({"surprise": 1}, "surprise"),
    ],
)
def test_a_line_that_is_wrong_is_named(tmp_path: Path, change: dict, named: str) -> None:
    path = tmp_path / "one.jsonl"
    path.write_text(json.dumps(LINE) + "\n" + json.dumps(LINE | {"figure": "mass"} | change) + "\n")
    with pytest.raises(ValueError, match=rf"one\.jsonl, line 2.*{re.escape(named)}"):
        render_results.read_figures(path)


def test_a_figure_is_there_once(tmp_path: Path) -> None:
    (tmp_path / "one.jsonl").write_text(2 * (json.dumps(LINE) + "\n"))
    with pytest.raises(ValueError, match="twice"):
        render_results.read_figures(tmp_path / "one.jsonl")


def test_a_measurement_replaces_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CGWM_COMMIT", "89abcdef0123")
    path = tmp_path / "one.jsonl"
    path.write_text(json.dumps(LINE) + "\n" + json.dumps(LINE | {"figure": "mass"}) + "\n")
    new = record("one", "speed", 5.0, unit="m/s", target="at most 4", met=False, command="make demo", folder=tmp_path)
    record("one", "time", "short", command="make demo", machine="a clock", folder=tmp_path)
    speed, mass, time = render_results.read_figures(path)
    assert speed == new and mass.status == "transcribed" and time.machine == "a clock"
    assert (speed.value, speed.met, speed.status, speed.commit) == (5.0, False, "measured", "89abcdef0123")
    assert speed.machine and speed.date >= LINE["date"]


def test_diagnose_records_the_figures_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A report of a few cases replaces lines and adds none."""
    path = RESULTS / "diagnose.jsonl"
    (tmp_path / "diagnose.jsonl").write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setenv("CGWM_COMMIT", "89abcdef0123")
    monkeypatch.setattr(diagnose_figures, "record", lambda *a, **k: record(*a, **k, folder=tmp_path))
    errors = {
        when: {"open_loop_m": value, "state_fitted_m": value} for when, value in (("before", 2.0), ("after", 1.0))
    }
    rows = [
        {"effects": ["drag"], "magnitude": "large", "judged": "class", "seconds": {"diagnose": 3.0}, "errors": errors},
        {"effects": ["drag"], "magnitude": "small", "judged": "exact, and more"},
        {"effects": ["tilt"], "magnitude": "large", "judged": "exact"},
        {"effects": ["grip"], "magnitude": "large", "judged": "silent"},
        {"effects": ["grip"], "magnitude": "small", "judged": "wrong"},
        {"effects": ["drag", "grip"], "magnitude": "large", "judged": "exact"},
        {"effects": ["ghost"], "magnitude": "small", "judged": "exact"},
        {"effects": [], "magnitude": "null", "judged": "right"},
        {"effects": [], "magnitude": "null", "judged": "false alarm"},
    ]
    acts = {"drag": "flight", "tilt": "measurement", "grip": "contact", "ghost": "unknown"}
    diagnose_figures.record_figures(
        rows, acts=acts.__getitem__, bound=lambda *_: 0.25, covered=lambda _: [True, False], command="make evidence"
    )
    found = render_results.read_figures(tmp_path / "diagnose.jsonl")
    assert [one.figure for one in found] == [one.figure for one in CLAIMS["diagnose"]["figures"]]
    new = {one.figure: one for one in found if one.status == "measured"}
    flight = new["effects that act in flight, named exactly or up to equivalence"]
    assert (flight.value, flight.met, flight.note) == ("1 of 2 (50 %)", False, "large 1 of 1, small 0 of 1")
    assert new["large effects of contact, named"].note == "1 missed silently"
    assert (
        new["effects of contact, named wrongly"].value == "1 of 2" and not new["effects of contact, named wrongly"].met
    )
    assert new["false alarms where nothing is missing"].note == "95 % bound 25.0 %"
    assert new["open-loop error on test episodes, with the named effect / without it"].value == 0.5
    assert new["95 % intervals of added parameters that contain the true value"].value == "1 of 2 (50 %)"
