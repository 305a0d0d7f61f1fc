"""`cgwm demo --scene mystery`: fit, compare, diagnose, add, compare again; and only then, what had been hidden."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..datasets.atomic import new_directory
from ..datasets.capture import Capture
from ..datasets.models import read_model
from ..datasets.scenes.hidden import draw_mystery, make_mystery, open_sealed
from ..schemas import (
    ComparedParameter,
    CompareResult,
    DiagnoseResult,
    HiddenEffect,
    ModelFile,
    MysteryResult,
    Outcome,
    Parameter,
    PhysConfig,
)
from .compare import REPORT_HTML as COMPARE_HTML
from .compare import compare_models
from .diagnose import diagnose
from .fit import fit
from .reporting.comparison import comparison_html
from .reporting.footage import footage_of
from .reporting.mystery import REPORT_HTML, REPORT_JSON, mystery_html
from .sg_gs import resolve_device
from .staged import StagedRun

SEALED, DIAGNOSIS = "sealed.json", "diagnosis.json"
BASE, CHILD = "m0", "m1"
SPLIT = "test"
STEP_S = 0.002
"""Twice the step of `cgwm fit`, for half the time."""


@dataclass(frozen=True)
class _Mystery(StagedRun):
    """A run of the mystery, with what its stages share."""

    physics: PhysConfig
    seed: int
    device: str


def run_mystery(
    out: Path,
    seed: int = 0,
    device: str = "auto",
    overwrite: bool = False,
    physics: PhysConfig | None = None,
) -> MysteryResult:
    """Make a capture with something hidden in it, or nothing; find it by the commands of the loop; open the seal.

    Args:
        out: The directory to write; it appears when all of it is complete.
        seed: Draws the body, what is hidden, the throws and the noise.
        device: auto, cpu or cuda.
        overwrite: Replace what is at `out`.
        physics: Settings of both fits, default those of `cgwm fit` with steps of 2 ms; seed and device are filled in.

    Returns:
        What stands in `report.json`.

    Raises:
        UsageError: If `out` exists, or the seed is negative.
        NotConvergedError: If a stage fails; its message names the stage, and nothing is written.
    """
    resolve_device(device)  # a wrong device is better told now than after minutes
    case = draw_mystery(seed)
    settings = (physics or PhysConfig(step_s=STEP_S)).model_dump() | {"seed": seed, "device": device}
    with new_directory(Path(out), overwrite) as folder:
        run = _Mystery(folder, Path(out), PhysConfig.model_validate(settings), seed, device)
        with run.stage("make the capture"):
            make_mystery(folder / "capture", folder / SEALED, case)
        return _solve(run)


def _solve(run: _Mystery) -> MysteryResult:
    folder, capture = run.folder, run.folder / "capture"
    with run.stage("fit"):
        files = [fit(capture, folder / BASE, phys_config=run.physics)]
    with run.stage("diagnose"):
        diagnosis = diagnose(folder / BASE, capture)
        (folder / DIAGNOSIS).write_text(diagnosis.model_dump_json(indent=1) + "\n", encoding="utf-8")
    if diagnosis.selected:
        with run.stage("add what is missing"):
            config = run.physics.model_copy(update={"effects": diagnosis.selected})
            files.append(fit(capture, folder / CHILD, parent=folder / BASE, phys_config=config))
    with run.stage("compare"):
        comparison = _compare(run, [BASE, CHILD][: len(files)])
    with run.stage("open the seal"):
        hidden = open_sealed(folder / SEALED)
    result = _result(run, files, diagnosis, comparison, hidden)
    (folder / REPORT_JSON).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
    (folder / REPORT_HTML).write_text(mystery_html(result), encoding="utf-8")
    return result


def _compare(run: _Mystery, names: Sequence[str]) -> CompareResult:
    """Compare on the test split, as `cgwm compare` does, with names that hold when the directory has its own."""
    source = Capture.open(run.folder / "capture", splits=(SPLIT,))
    found = compare_models([(name, read_model(run.folder / name)) for name in names], source, SPLIT, device=run.device)
    result = found.result.model_copy(update={"capture": "capture", "report": COMPARE_HTML})
    html = comparison_html(result, found.models, footage_of(found.models, source, run.device))
    (run.folder / COMPARE_HTML).write_text(html, encoding="utf-8")
    return result


def _result(
    run: _Mystery,
    files: Sequence[ModelFile],
    diagnosis: DiagnoseResult,
    comparison: CompareResult,
    hidden: tuple[HiddenEffect, ...],
) -> MysteryResult:
    capture = Capture.open(run.folder / "capture", check=False)
    outcome, sentence = judged(diagnosis, hidden)
    paths = {"report": REPORT_HTML, "figures": REPORT_JSON, "comparison": COMPARE_HTML, "diagnosis": DIAGNOSIS}
    paths |= {"capture": "capture", "sealed": SEALED, "model": BASE}
    own = [p for p in files[-1].parameters if any(p.name.startswith(f"{name}.") for name in diagnosis.selected)]
    return MysteryResult(
        seed=run.seed,
        device=str(resolve_device(run.device)),
        body=capture.body_names[0],
        train_episodes=len(capture.episodes("train")),
        test_episodes=len(capture.episodes(SPLIT)),
        settings=" ".join(f"--set phys-geo.{name}={value}" for name, value in _changed(run.physics).items()),
        diagnosis=diagnosis,
        parameters=tuple(_compared(parameter, hidden) for parameter in own),
        comparison=comparison,
        hidden=hidden,
        outcome=outcome,
        sentence=sentence,
        seconds=dict(run.seconds),
        paths=paths | ({"model with the effect": CHILD} if len(files) > 1 else {}),
        warnings=tuple(
            run.plain(f"fit of {name}: {message}")
            for name, file in zip((BASE, CHILD), files, strict=False)
            for message in file.warnings
        ),
    )


def _changed(physics: PhysConfig) -> dict[str, object]:
    """Return what differs from the settings of `cgwm fit`, the device aside."""
    usual = PhysConfig().model_dump()
    return {k: v for k, v in physics.model_dump().items() if v != usual[k] and k not in ("device", "effects")}


def _compared(parameter: Parameter, hidden: Sequence[HiddenEffect]) -> ComparedParameter:
    true = {f"{effect.name}.{key}": value for effect in hidden for key, value in effect.values.items()}
    value, span = true.get(parameter.name), parameter.interval_95
    if value is None or isinstance(value, list):
        return ComparedParameter(parameter=parameter)
    covered = None if span is None else span[0] <= value <= span[1]
    return ComparedParameter(parameter=parameter, true_value=value, covered=covered)


def judged(diagnosis: DiagnoseResult, hidden: Sequence[HiddenEffect]) -> tuple[Outcome, str]:
    """Return how the diagnosis did against what was hidden, and the same in words."""
    names = {effect.name for effect in hidden}
    if diagnosis.selected:
        return _named(diagnosis, names)
    unnamed = diagnosis.verdict == "unexplained"
    if not names:
        if unnamed:
            return "wrong", "Nothing was hidden, and something was said to be missing: a false alarm."
        return "right", "Nothing was hidden, and nothing was found: right."
    if unnamed:
        return "unnamed", f"Hidden was {_and(sorted(names))}. That something is missing was found, but not what."
    return "silent", f"Hidden was {_and(sorted(names))}, and nothing was found: it was missed."


def _named(diagnosis: DiagnoseResult, names: set[str]) -> tuple[Outcome, str]:
    selected = list(diagnosis.selected)
    if not names:
        return "wrong", f"Nothing was hidden, and {_and(selected)} was named: a false alarm."
    told = f"Hidden was {_and(sorted(names))}"
    classes = [next((group for group in diagnosis.aliases if name in group), (name,)) for name in selected]
    if not names <= {name for group in classes for name in group}:
        return "wrong", f"{told}, and {_and(selected)} was named: wrong."
    extra = [name for name, group in zip(selected, classes, strict=True) if not names & set(group)]
    if extra:
        return "partly", f"{told}, and it was found; but {_and(extra)} was named beside it, and was not hidden."
    wide = next((group for group in classes if len(group) > 1), None)
    if wide is None:
        return "right", f"{told}, and {_and(selected)} was named: right."
    listed = f"one of {_and(wide)}, which these data cannot tell apart"
    return "right_class", f"{told}. What was named is {listed}: right, as a class."


def _and(names: Sequence[str]) -> str:
    return " and ".join((", ".join(names[:-1]), names[-1]) if len(names) > 1 else names)
