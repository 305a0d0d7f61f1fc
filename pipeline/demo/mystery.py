"""The mystery (`cgwm demo --scene mystery`): find a hidden effect by fit, compare and diagnose, then reveal it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...datasets.capture.capture import Capture
from ...datasets.io.atomic import new_directory
from ...datasets.models.model import read_model
from ...datasets.synthetic.hidden_effects import draw_mystery, make_mystery, open_sealed
from ...schemas import (
    ComparedParameter,
    CompareResult,
    DiagnoseResult,
    FittedParameter,
    HiddenEffect,
    ModelFile,
    MysteryResult,
    Outcome,
    PhysConfig,
)
from ..compare.frames import footage_of
from ..compare.page import comparison_html
from ..compare.stage import REPORT_HTML as COMPARE_HTML
from ..compare.stage import compare_models
from ..diagnose.stage import diagnose
from ..fit import fit
from ..report.page import listed, way_link
from ..runtime.device import resolve_device
from ..runtime.timing import StagedRun
from .mystery_page import REPORT_HTML, REPORT_JSON, mystery_html

SEALED, DIAGNOSIS = "sealed.json", "diagnosis.json"
BASE, CHILD = "m0", "m1"
SPLIT = "test"
STEP_S = 0.002
"""Time step of the simulation [s]: twice that of `cgwm fit`, which halves the run time."""


@dataclass(frozen=True)
class _Mystery(StagedRun):
    """A run of the mystery and the settings that its stages share."""

    physics: PhysConfig
    """Settings of both fits."""
    seed: int
    """Seed of the capture and of the fits."""
    device: str
    """auto, cpu or cuda."""


def run_mystery(
    out: Path,
    seed: int = 0,
    device: str = "auto",
    overwrite: bool = False,
    physics: PhysConfig | None = None,
) -> MysteryResult:
    """Make a capture with a hidden effect or none, search for it with the commands of the loop, and open the seal.

    Args:
        out: The directory to write; it appears once it is complete.
        seed: Seed that draws the body, the hidden effect, the throws and the noise.
        device: auto, cpu or cuda.
        overwrite: Replace what is at `out`.
        physics: Settings of both fits, default those of `cgwm fit` with steps of 2 ms; seed and device are filled in.

    Returns:
        The content of `report.json`.

    Raises:
        UsageError: If `out` exists, or the seed is negative.
        NotConvergedError: If a stage fails; its message names the stage, and nothing is written.
    """
    resolve_device(device)  # refuse a wrong device now, not after minutes
    case = draw_mystery(seed)
    settings = (physics or PhysConfig(step_s=STEP_S)).model_dump() | {"seed": seed, "device": device}
    with new_directory(Path(out), "demo", overwrite) as folder:
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
    """Compare on the test split, as `cgwm compare` does, with names relative to the directory that is written."""
    source = Capture.open(run.folder / "capture", splits=(SPLIT,))
    found = compare_models([(name, read_model(run.folder / name)) for name in names], source, SPLIT, device=run.device)
    result = found.result.model_copy(update={"capture": "capture", "report": COMPARE_HTML})
    files = [(kind, way_link(name, name)) for kind, name in (
        ("report", REPORT_HTML), *(("model", name) for name in names), ("capture", "capture"))]  # fmt: skip
    html = comparison_html(result, found.models, footage_of(found.models, source, run.device), files)
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
    added = [p for p in files[-1].parameters if any(p.name.startswith(f"{name}.") for name in diagnosis.selected)]
    return MysteryResult(
        seed=run.seed,
        device=str(resolve_device(run.device)),
        body=capture.body_names[0],
        train_episodes=len(capture.episodes("train")),
        test_episodes=len(capture.episodes(SPLIT)),
        settings=" ".join(f"--set phys-geo.{name}={value}" for name, value in _changed(run.physics).items()),
        diagnosis=diagnosis,
        parameters=tuple(_compared(parameter, hidden) for parameter in added),
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
    """Return the settings that differ from the defaults of `cgwm fit`, without device and effects."""
    usual = PhysConfig().model_dump()
    return {k: v for k, v in physics.model_dump().items() if v != usual[k] and k not in ("device", "effects")}


def _compared(parameter: FittedParameter, hidden: Sequence[HiddenEffect]) -> ComparedParameter:
    true = {f"{effect.name}.{key}": value for effect in hidden for key, value in effect.values.items()}
    value, span = true.get(parameter.name), parameter.interval_95
    if value is None or isinstance(value, list):
        return ComparedParameter(parameter=parameter)
    covered = None if span is None else span[0] <= value <= span[1]
    return ComparedParameter(parameter=parameter, true_value=value, covered=covered)


def judged(diagnosis: DiagnoseResult, hidden: Sequence[HiddenEffect]) -> tuple[Outcome, str]:
    """Judge the diagnosis by the hidden effects: the outcome, and the same as a sentence."""
    names = {effect.name for effect in hidden}
    if diagnosis.selected:
        return _named(diagnosis, names)
    unnamed = diagnosis.verdict == "unexplained"
    if not names:
        if unnamed:
            return "wrong", "Nothing was hidden, but the diagnosis reported a missing effect: a false alarm."
        return "right", "Nothing was hidden, and nothing was found: right."
    if unnamed:
        return "unnamed", f"{_were_hidden(names)}. The diagnosis found that something is missing, but did not name it."
    return "silent", f"{_were_hidden(names)}, and nothing was found: missed."


def _were_hidden(names: set[str]) -> str:
    return f"{listed(sorted(names))} {'was' if len(names) == 1 else 'were'} hidden"


def _named(diagnosis: DiagnoseResult, names: set[str]) -> tuple[Outcome, str]:
    selected = list(diagnosis.selected)
    if not names:
        return "wrong", f"Nothing was hidden, but {listed(selected)} was named: a false alarm."
    hidden = _were_hidden(names)
    classes = [diagnosis.equals_of(name) for name in selected]
    if not names <= {name for group in classes for name in group}:
        return "wrong", f"{hidden}, but {listed(selected)} was named: wrong."
    extra = [name for name, group in zip(selected, classes, strict=True) if not names & set(group)]
    if extra:
        return "partly", f"{hidden} and found, but {listed(extra)}, which was not hidden, was named, too."
    wide = next((group for group in classes if len(group) > 1), None)
    if wide is None:
        return "right", f"{hidden}, and {listed(selected)} was named: right."
    words = f"one of {listed(wide)}, which these data cannot distinguish"
    return "right_class", f"{hidden}. The diagnosis named {words}: right, as a class."
