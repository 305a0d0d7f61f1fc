"""The manners of the command line: exit codes, messages word for word, a stdout that holds the result alone."""

import json
import os
import resource
import signal
import subprocess
import sys
import tomllib
import types
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cgwm.cli import main
from cgwm.cli.app import GROUPS, VERBS
from cgwm.cli.output import quantity, table
from cgwm.schemas import (
    CalibrateConfig,
    CheckFailedError,
    FileModel,
    InputDataError,
    InterruptedWork,
    NotConvergedError,
    PhysConfig,
    SplatConfig,
    SynthesizeConfig,
    ValidationReport,
)
from helpers.forked import forked
from helpers.small_model import write_small_model

CGWM = [sys.executable, "-m", "cgwm"]
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Run a command in this process; return its exit code, stdout and stderr."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    monkeypatch.setenv("CGWM_QUIET", "")
    monkeypatch.setattr("logging.disable", lambda level: None)

    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return int(ended.value.code or 0), out, err

    with warnings.catch_warnings():
        yield call
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, Callable[..., Any]], None]:
    """Put a function in a stage's place, so that only the command line around it is tested."""

    def replace(module: str, function: str, body: Callable[..., Any]) -> None:
        double = types.ModuleType(module)
        setattr(double, function, body)
        monkeypatch.setitem(sys.modules, module, double)

    return replace


def raising(error: BaseException) -> Callable[..., Any]:
    def body(*arguments: object) -> None:
        raise error

    return body


# Help


def test_help_answers_within_300_ms() -> None:
    # Processor time, and the least of five: what else runs on the machine, or shares a core with it, only adds to it.
    seconds = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*CGWM, "--help"], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(seconds) < 0.3


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom cgwm.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "print('MODULES', *sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    text, _, modules = done.stdout.partition("MODULES ")
    assert "synthesize" in text
    heavy = "torch numpy scipy mujoco h5py hdf5plugin pycolmap cv2 matplotlib tqdm pydantic rich".split()
    assert set(modules.split()) & set(heavy) == set()


def test_a_module_that_was_not_linked_is_said_with_what_to_do(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cgwm.pipeline.validate", None)
    code, out, err = run("validate", "nowhere")
    assert (code, out) == (1, "")
    assert "lacks 'cgwm.pipeline.validate'" in err and "'make install'" in err


def test_help_names_every_verb_and_the_exit_codes(run: Run) -> None:
    code, out, err = run("--help")
    assert (code, err) == (0, "")
    assert all(f"  {name} " in out for name in [*(name for name, _, _ in VERBS), *GROUPS])
    assert "..." not in out.replace("COMMAND [ARGS]...", "")  # no sentence is cut off
    assert "Exit codes: 0 done, 1 the work failed, 2 wrong usage or bad input, 130" in out


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_names_its_verbs(run: Run, group: str) -> None:
    code, out, _ = run(group, "--help")
    assert code == 0
    assert all(f"  {verb} " in out for verb, _, _ in GROUPS[group][1])
    assert "..." not in out.replace("COMMAND [ARGS]...", "")


@pytest.mark.parametrize(
    "verb", [name for name, _, _ in VERBS] + [f"{g} {v}" for g in GROUPS for v, _, _ in GROUPS[g][1]]
)
def test_every_verb_has_the_same_manners(run: Run, verb: str) -> None:
    code, out, _ = run(*verb.split(), "--help")
    assert code == 0
    assert all(option in out for option in ("--json", "--quiet", "--debug"))


@pytest.mark.parametrize(
    ("verb", "configs"),
    [
        ("calibrate", [CalibrateConfig]),
        ("fit", [SplatConfig, PhysConfig]),
        ("synthesize", [SynthesizeConfig]),
    ],
)
def test_defaults_shown_in_the_help_are_those_of_the_stage(run: Run, verb: str, configs: list[type[FileModel]]) -> None:
    from cgwm.cli.app import app
    from typer.main import get_command

    shown = {
        parameter.name: parameter.show_default
        for parameter in get_command(app).commands[verb].params  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(parameter.show_default, str)
    }
    defaults = {name: field.default for config in configs for name, field in config.model_fields.items()}
    defaults["shard"] = f"{defaults.get('shard')}/{defaults.get('shards')}"
    assert shown
    assert shown == {name: str(defaults[name]) for name in shown}


def test_version(run: Run) -> None:
    from cgwm import __version__

    assert run("--version") == (0, f"cgwm {__version__}\n", "")


# Wrong usage


def test_an_unknown_verb(run: Run) -> None:
    assert run("fti", "capture") == (
        2,
        "",
        "cgwm: there is no command 'fti'.\n"
        "Allowed: demo, mask, calibrate, fit, synthesize, merge, view, eval, compare, diagnose, improve, control, "
        "import, export, validate, doctor, effects. "
        "Did you mean 'fit'?\n"
        "Next: run 'cgwm --help'.\n",
    )
    assert run("effects", "shwo", "wind") == (
        2,
        "",
        "cgwm effects: there is no command 'shwo'.\n"
        "Allowed: list, show, new. Did you mean 'show'?\n"
        "Next: run 'cgwm effects --help'.\n",
    )


def test_an_unknown_option(run: Run) -> None:
    assert run("validate", "capture", "--jsno") == (
        2,
        "",
        "cgwm validate: there is no option '--jsno'.\n"
        "Allowed: --accept-units, --debug, --json, --quiet, --sample, --seed, --help. Did you mean '--json'?\n"
        "Next: run 'cgwm validate --help'.\n",
    )


def test_dashes_alone_make_no_option_like_another(run: Run) -> None:
    assert "Did you mean" not in run("compare", "model", "capture", "--page")[2]


def test_a_capture_before_the_models_is_told(run: Run, tmp_path: Path) -> None:
    for name, mark in (("c", "capture.toml"), ("m", "model.json")):
        (tmp_path / name).mkdir()
        (tmp_path / name / mark).touch()
    code, _, said = run("compare", str(tmp_path / "c"), str(tmp_path / "m"))
    assert code == 2 and said.splitlines()[-1] == f"Next: cgwm compare {tmp_path / 'm'} {tmp_path / 'c'}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit"], "cgwm fit: Missing argument 'CAPTURE'."),
        (["fit", "capture"], "cgwm fit: Missing option '--out' / '-o'."),
        (["validate", "a", "b"], "cgwm validate: Got unexpected extra argument(s) (b)."),
        (
            ["eval", "a", "b", "--device", "cude"],
            "cgwm eval: Invalid value for '--device': 'cude' is not one of 'auto', 'cpu', 'cuda'. Did you mean 'cuda'?",
        ),
    ],
)
def test_wrong_arguments(run: Run, arguments: list[str], message: str) -> None:
    assert run(*arguments) == (2, "", f"{message}\nNext: run 'cgwm {arguments[0]} --help'.\n")


def test_no_arguments_print_the_help(run: Run) -> None:
    code, out, err = run()
    assert (code, out) == (2, "")
    assert err.startswith("Usage: cgwm")


# Settings


@pytest.fixture
def settings_seen(stage: Callable[..., None]) -> list[Any]:
    """Collect the configuration that `cgwm calibrate` hands to its stage."""
    seen: list[Any] = []

    def body(capture: Path, config: CalibrateConfig, overwrite: bool, intrinsics: Path | None) -> None:
        seen.append(config)
        raise CheckFailedError("stop here")

    stage("cgwm.pipeline.calibrate", "calibrate", body)
    return seen


def test_the_command_line_wins_over_set_and_set_over_the_file(
    run: Run, settings_seen: list[Any], tmp_path: Path
) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("[calibrate]\nseed = 1\nmax_features = 1000\nretries = 7\n")
    run("calibrate", "capture", "--config", file, "--set", "calibrate.max_features=2000", "--seed", 3)
    assert settings_seen == [CalibrateConfig(seed=3, max_features=2000, retries=7)]


def test_without_settings_the_stage_has_its_defaults(run: Run, settings_seen: list[Any]) -> None:
    run("calibrate", "capture")
    assert settings_seen == [CalibrateConfig()]


def test_wrong_settings(run: Run, settings_seen: list[Any], tmp_path: Path) -> None:
    assert run("calibrate", "c", "--set", "sg-gs.seed=1") == (
        2,
        "",
        "--set sg-gs.seed=1: this command runs no stage 'sg-gs'.\nAllowed: calibrate.\n"
        "Next: begin the key with the name of one of these stages.\n",
    )
    assert run("calibrate", "c", "--set", "seed") == (
        2,
        "",
        "--set seed: not a setting.\nAllowed: STAGE.KEY=VALUE, for example calibrate.seed=1.\n"
        "Next: write it as in the example.\n",
    )
    assert run("calibrate", "c", "--set", "calibrate.retrys=1") == (
        2,
        "",
        "settings (--set calibrate.retrys=1): [calibrate] has an unknown field 'retrys'.\n"
        "Allowed: seed, max_features, max_image_size, retries, turntable. Did you mean 'retries'?\n"
        "Next: correct the field.\n",
    )
    missing = tmp_path / "none.toml"
    assert run("calibrate", "c", "--config", missing) == (
        2,
        "",
        f"{missing}: no such file.\nAllowed: a regular file.\nNext: check the path.\n",
    )
    file = tmp_path / "settings.toml"
    file.write_text("[calibrat]\nseed = 1\n")
    assert run("calibrate", "c", "--config", file) == (
        2,
        "",
        f"{file}, line 1: the top level has an unknown field 'calibrat'.\n"
        "Allowed: calibrate. Did you mean 'calibrate'?\n"
        "Next: correct the field.\n",
    )
    assert settings_seen == []


def test_a_wrong_value_in_a_settings_file_is_told_with_its_line(
    run: Run, settings_seen: list[Any], tmp_path: Path
) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("[calibrate]\nretries = -1\n")
    code, out, err = run("calibrate", "c", "--config", file)
    assert (code, out) == (2, "")
    assert err.startswith(f"{file}, line 2: calibrate.retries: input should be greater than or equal to 0 (found -1).")


@pytest.mark.parametrize("shard", ["3", "3/3", "a/4", "-1/4"])
def test_a_wrong_shard(run: Run, stage: Callable[..., None], shard: str) -> None:
    stage("cgwm.pipeline.synthesize", "synthesize", raising(AssertionError("must not be reached")))
    assert run("synthesize", "model", "--out", "dataset", f"--shard={shard}") == (
        2,
        "",
        f"--shard {shard}: not a shard.\nAllowed: I/N with 0 <= I < N, for example 3/64.\nNext: pass --shard I/N.\n",
    )


def test_the_command_makes_a_template_and_prints_the_plan_resolved(run: Run, tmp_path: Path) -> None:
    model = write_small_model(tmp_path / "model", visible=False)
    code, template, _ = run("synthesize", model, "--print-plan")
    assert code == 0 and "# Brightness of a rollout's light" in template
    assert [entry.name for entry in tmp_path.iterdir()] == ["model"]
    plan = tmp_path / "plan.toml"
    plan.write_text(template.replace("no_contact = false", "no_contact = true\npenetration_m = 0.05"))
    command = ("synthesize", model, "--rollouts", 1, "--set", "synthesize.duration_s=0.5", "--plan", plan)
    code, out, _ = run(*command, "--out", tmp_path / "one")
    assert code == 0 and out.startswith('The plan, resolved:\n\nstart = "throw"\n')
    resolved = tomllib.loads(out.split("resolved:\n\n")[1].split("\nWrote ")[0])
    assert resolved["reject"] == {"no_contact": True, "penetration_m": 0.05, "attempts": 100}
    code, out, _ = run(*command, "--out", tmp_path / "two", "--json")
    assert code == 0 and json.loads(out)["plan"]["reject"]["no_contact"] is True
    code, _, err = run(*command)
    assert (code, err) == (2, "--out is missing.\nNext: name the directory to write: --out DATASET.\n")
    code, _, err = run(*command, "--set", "synthesize.plan.views=1", "--out", tmp_path / "three")
    assert code == 2 and err.startswith("--plan and synthesize.plan in the settings were given.")


# Outcomes


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (NotConvergedError("The fit diverged.", todo="look."), 1, "The fit diverged.\nNext: look.\n"),
        (CheckFailedError("3 faults."), 1, "3 faults.\n"),
        (InputDataError("a.csv, line 3: NaN.", "numbers."), 2, "a.csv, line 3: NaN.\nAllowed: numbers.\n"),
        (KeyboardInterrupt(), 130, "Interrupted; no output was written.\n"),
        (KeyboardInterrupt("decoding with 'cp437' codec failed"), 130, "Interrupted; no output was written.\n"),
        (InterruptedWork("2 of 3 are complete."), 130, "Interrupted; 2 of 3 are complete.\n"),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes."),
            1,
            "Out of memory.\nNext: close other programs, or work on less at a time.\n",
        ),
        (OSError(28, "No space left on device", "out/x"), 1, "out/x: No space left on device.\n"),
        (
            ModuleNotFoundError("No module named 'mujoco'", name="mujoco"),
            1,
            "The package 'mujoco' is not installed.\nNext: run 'cgwm doctor', which prints the pip line.\n",
        ),
        (
            ZeroDivisionError("division by zero"),
            1,
            "Internal error in cgwm: ZeroDivisionError: division by zero\n"
            "Next: run the command again with --debug, and report the traceback.\n",
        ),
    ],
)
def test_errors_and_exit_codes(
    run: Run, stage: Callable[..., None], error: BaseException, code: int, message: str
) -> None:
    stage("cgwm.pipeline.validate", "validate", raising(error))
    assert run("validate", "thing") == (code, "", message)
    assert run("validate", "thing", "--json") == (code, "", message)


def test_a_traceback_only_with_debug(run: Run, stage: Callable[..., None]) -> None:
    stage("cgwm.pipeline.validate", "validate", raising(InputDataError("bad.")))
    assert "Traceback" not in run("validate", "thing")[2]
    code, out, err = run("validate", "thing", "--debug")
    assert (code, out) == (2, "")
    assert "Traceback (most recent call last)" in err
    assert err.endswith("bad.\n")


@pytest.mark.parametrize(("faults", "code"), [((), 0), (("a.csv: NaN in line 3.",), 1)])
def test_validate_prints_its_report_either_way(
    run: Run, stage: Callable[..., None], faults: tuple[str, ...], code: int
) -> None:
    report = ValidationReport(path="c", kind="capture", facts={"episodes": 3}, faults=faults)
    stage("cgwm.pipeline.validate", "validate", lambda thing, *sample: report)
    ended, out, err = run("validate", "c", "--json")
    assert (ended, err) == (code, "")
    assert ValidationReport.model_validate_json(out) == report
    ended, out, err = run("validate", "c")
    assert (ended, err) == (code, "")
    assert out.splitlines()[0] == ("capture c: 1 fault." if faults else "capture c: no faults.")
    assert run("validate", "c", "--quiet") == (code, "", "")
    assert run("validate", "c", "--quiet", "--json")[1] != ""


def test_what_a_library_prints_never_reaches_stdout() -> None:
    code = """
import logging, os, sys, types, warnings
from cgwm.cli import main
from cgwm.schemas import ValidationReport

def noisy(thing, *sample):
    print("a library talks")
    os.write(1, b"a compiled library talks\\n")
    os.write(2, b"a compiled library logs\\n")
    warnings.warn("a library warns")
    logging.getLogger("a").error("a library logs")
    return ValidationReport(path="c", kind="capture")

stage = sys.modules["cgwm.pipeline.validate"] = types.ModuleType("stage")
stage.validate = noisy
main(["validate", "c", "--json"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert json.loads(done.stdout) == {"path": "c", "kind": "capture", "facts": {}, "faults": [], "failures": []}


def test_doctor_prints_one_json_document() -> None:
    done = forked("doctor", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    report = json.loads(done.stdout)
    assert report["missing"] == []
    assert report["cpu_cores"] >= 1


def read_by_nobody() -> None:
    reader, writer = os.pipe()
    os.dup2(writer, 1)
    os.close(writer)
    os.close(reader)


def test_a_reader_that_goes_away_is_no_error() -> None:
    done = forked("effects", "list", before=read_by_nobody)
    assert done.stderr == ""


# Text


def test_tables_align_words_left_and_numbers_right() -> None:
    assert table([["a", "1.5", "mm"], ["bcd", "10", "s"]], ["what", "value", "unit"]) == (
        "  what  value  unit\n  a       1.5  mm\n  bcd      10  s"
    )
    assert table([]) == ""


def test_quantities() -> None:
    assert quantity(float("nan"), "m") == "-"
    assert quantity(1234.5678, digits=6) == "1234.57"


@pytest.mark.parametrize(
    ("setting", "nearest"), [("phys-geo.popluation=4", "population"), ("sg-gs.imag_size=64", "image_size")]
)
def test_an_unknown_setting_of_a_stage_names_the_nearest(run: Run, tmp_path: Path, setting: str, nearest: str) -> None:
    code, _, err = run("fit", "capture", "--out", tmp_path / "model", "--set", setting)
    allowed = next(line for line in err.splitlines() if line.startswith("Allowed: "))
    assert code == 2 and nearest in allowed.split(", ") and allowed.endswith(f" Did you mean '{nearest}'?")
