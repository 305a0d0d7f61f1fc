"""Checks of runs of a task of control, as `cgwm control` writes them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...datasets.io.atomic import sha256
from ...datasets.rollouts.control_file import RunTables, read_runs
from ...schemas import (
    HAND_FORMAT,
    JOINTS,
    AnyTask,
    ControlResult,
    ControlRun,
    ControlTask,
    HandTask,
    InputDataError,
    ValidationReport,
    parse,
    read_json,
)
from ...schemas.documents import parse_json
from ...schemas.regular_files import real_path

ROUNDING = 1e-9
"""Largest relative excess of a limit."""


def validate_run(path: Path) -> ValidationReport:
    """Check that runs agree with their document, and that no command exceeds a limit.

    Args:
        path: Directory of the runs.

    Raises:
        InputDataError: If `control.json` does not fit its schema, or names a file elsewhere; or if the recording cannot
            be read.
    """
    document = path / "control.json"
    file = read_json(document, ControlResult)
    names = [name for name in (file.recording, file.page, file.video) if name is not None]
    outside = [name for name in names if real_path(path / name).parent != real_path(path)]
    if outside:
        raise InputDataError(
            f"{document}: '{outside[0]}' lies outside of the run.",
            "names in its directory.",
            todo="copy the whole directory that 'cgwm control' wrote, or run it again.",
        )
    faults = [f"control.json names {name}, which is missing." for name in names if not (path / name).is_file()]
    if (path / file.recording).is_file():
        if sha256(path / file.recording) != file.recording_sha256:
            faults.append(f"{file.recording} has another content than when it was written (SHA-256).")
        faults += _recording_faults(path / file.recording, file, document)
    if file.successes != sum(run.ended == "success" for run in file.runs):
        faults.append(f"control.json: successes is {file.successes}, which is not the number of successful runs.")
    facts = {
        "object": file.object,
        "runs": len(file.runs),
        "successes": file.successes,
        "solver": file.solver,
        "clock": file.clock,
        "plant": file.plant,
    }
    return ValidationReport(path=str(path), kind="run", facts=facts, faults=tuple(faults))


def _recording_faults(path: Path, file: ControlResult, document: Path) -> Iterator[str]:
    """Yield what is wrong with the recording."""
    asked = parse_json(file.settings.get("task", ""), document)
    hand = str(asked.get("format", "")) == HAND_FORMAT
    task = parse(asked, HandTask if hand else ControlTask, f"{document}, settings.task")
    runs = read_runs(path)
    if [run.seed for run in runs] != [run.seed for run in file.runs]:
        yield f"{path.name} holds other seeds than control.json."
        return
    for run, figures in zip(runs, file.runs, strict=True):
        yield from (f"{path.name}, demo_{run.seed}: {fault}" for fault in _run_faults(run, figures, task))


def _run_faults(run: RunTables, figures: ControlRun, task: AnyTask) -> Iterator[str]:
    """Yield what is wrong with one run."""
    arrays = run.arrays
    wrong = [name for name, values in arrays.items() if not np.isfinite(values).all()]
    if wrong:
        yield f"{wrong[0]} is not finite."
        return
    if run.ended != figures.ended or len(arrays["actions"]) != figures.commands:
        yield "it ended otherwise, or has another number of commands, than control.json says."
    if len(arrays["plans/cost"]) != figures.plans:
        yield "it has another number of plans than control.json says."
    if (run.robot == "hand") != isinstance(task, HandTask):
        yield "it is a run of another robot than that of the task."
        return
    yield from _hand_faults(run, figures, task) if isinstance(task, HandTask) else _finger_faults(run, task)
    for name in ("obs/object", "next_obs/object"):
        norm = np.linalg.norm(arrays[name][:, 3:], axis=-1)
        if np.abs(norm - 1).max(initial=0.0) > 1e-3:
            yield f"{name} has quaternions that are not of length 1."
    ends = arrays["control/position_error"]
    if len(ends) and abs(float(ends[-1]) - figures.position_error_m) > ROUNDING + 1e-6 * figures.position_error_m:
        yield "its last position error is not that of control.json."


def _finger_faults(run: RunTables, task: ControlTask) -> Iterator[str]:
    """Yield which targets of a finger exceed its limits."""
    for index, name in enumerate(JOINTS):
        low, high = task.limits.joints[name]
        target = run.arrays["control/target"][:, index]
        slack = ROUNDING * max(abs(low), abs(high))
        if len(target) and (target.min() < low - slack or target.max() > high + slack):
            yield f"a target of joint '{name}' exceeds its limits."
        fastest = np.abs(np.diff(target)).max(initial=0.0) * task.planner.control_hz
        if fastest > task.limits.speed_m_s * (1 + 1e-6):
            yield f"joint '{name}' was to move at {fastest:.4g} m/s, faster than its limit."


def _hand_faults(run: RunTables, figures: ControlRun, task: HandTask) -> Iterator[str]:
    """Yield what is wrong with a run of a hand; the ranges of its joints are in the file of the hand."""
    fastest = np.abs(np.diff(run.arrays["control/target"], axis=0)).max(initial=0.0) * task.planner.control_hz
    if fastest > task.limits.speed_rad_s * (1 + 1e-6):
        yield f"a joint was to move at {fastest:.4g} rad/s, faster than its limit."
    if int(run.arrays["control/reached"].sum()) != figures.goals:
        yield "it reached another number of goals than control.json says."
