"""The loop of commands on captures of another engine: hidden in flight, in contact, in the measurement, or nothing.

Evidence: the same loop is walked in each run of the tests by the mystery (`demo/test_mystery.py`).
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from cgwm.cli.app import app
from cgwm.datasets.synthetic.hidden_effects import cases, make_capture
from typer.testing import CliRunner

pytestmark = pytest.mark.evidence
HIDDEN = {
    "ball/quadratic_drag/large": {"quadratic_drag"},
    "ball/rolling_resistance/large": {"rolling_resistance"},
    "ball/length_scale/large": {"clock_scale", "length_scale", "gravity_scale", "buoyancy", "constant_force"},
}
CASES = {case.name: case for case in cases("development", nulls=2)}


def said(*words: object) -> dict:
    """Run a command, and return what it prints as JSON."""
    result = CliRunner().invoke(app, [*map(str, words), "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.parametrize("name", HIDDEN)
def test_what_is_hidden_is_found_added_and_the_error_falls(name: str, tmp_path: Path) -> None:
    capture, first, second = tmp_path / "capture", tmp_path / "m0", tmp_path / "m1"
    make_capture(capture, replace(CASES[f"development/{name}/0"], test=2))
    said("fit", capture, "--out", first)
    found = said("diagnose", first, capture)
    assert found["verdict"] in ("missing_effect", "not_separable")
    assert set(found["selected"]) & HIDDEN[name]
    group = next((set(group) for group in found["aliases"] if set(group) & set(found["selected"])), set())
    assert group <= HIDDEN[name]
    said("fit", capture, "--from", first, "--effects", ",".join(found["selected"]), "--out", second)
    compared = said("compare", first, second, capture, "--out", tmp_path / "compare.html")
    errors = [model["reduced_chi2"] for model in compared["models"]]
    assert errors[1] < errors[0]
    assert (tmp_path / "compare.html").stat().st_size < 10_000_000


def test_where_nothing_is_hidden_nothing_is_named(tmp_path: Path) -> None:
    null = next(case for case in CASES.values() if not case.effects)
    make_capture(tmp_path / "capture", null)
    said("fit", tmp_path / "capture", "--out", tmp_path / "m0")
    found = said("diagnose", tmp_path / "m0", tmp_path / "capture")
    assert (found["verdict"], found["selected"]) == ("none_missing", [])
