"""The stage control (`cgwm control`): a task run through a model, from several seeds, with recording and page."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...datasets.io.atomic import new_directory, sha256
from ...datasets.io.neighbours import clean_stale
from ...datasets.io.outputs import reads, refuse_output
from ...datasets.io.progress import note
from ...datasets.models.fit_inputs import versions
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.control_file import write_runs
from ...schemas import (
    AnyTask,
    ClockName,
    ControlResult,
    ControlRun,
    InterruptedWork,
    SlowPlansError,
    SolverName,
    UsageError,
    files_of,
    read_any_task,
    read_json,
    task_toml,
)
from ..runtime.checkpoint import Checkpoint
from ..runtime.device import resolve_device
from ..runtime.resources import no_garbage_search
from .noted_runs import NOW, kept_tables, noting, seed_slot, tables_kept
from .page import FILM, PAGE, PageRun, control_html
from .runner import Runner, planning_world, runner_of
from .tables import figures_of
from .wording import advice, sentence, wilson
from .work import control_budget

DOCUMENT, RECORDING = "control.json", "run.h5"
MOST_DRAWS = 1000
"""Largest number of draws: each is a world of its own."""
TRIALS = 7
"""Plans that are timed before a run with the real clock; the first ones compile and are not counted."""
SLOWEST = 2.0
"""Largest duration of a plan in units of a command's: beyond it, half of the states are never looked at."""


@dataclass(frozen=True, kw_only=True)
class _Request:
    """Arguments of a control."""

    model: Model
    """The model."""
    task: AnyTask
    """The task."""
    solver: SolverName
    """Solver of the plans."""
    clock: ClockName
    """The clock."""
    seeds: int
    """Number of runs, with the seeds 0 to `seeds` - 1."""
    draws: int
    """Draws of the model for each plan."""
    device: str
    """Device of the predictions."""

    @property
    def settings(self) -> dict[str, str]:
        """What was asked for, by name."""
        names = ("solver", "clock", "seeds", "draws", "device")
        return {name: str(getattr(self, name)) for name in names} | {"task": self.task.model_dump_json()}

    def inputs(self) -> dict[str, str]:
        """Return the SHA-256 of the files that are read, by name."""
        files = {} if self.model.root is None else {"model": self.model.root / "model.json"}
        files |= {name: self.task.folder / name for name in files_of(self.task)}
        return {name: sha256(path) for name, path in files.items() if path.is_file()}


@reads("model", "task")
def control(
    model: Path,
    task: Path,
    out: Path,
    solver: SolverName = "mppi",
    clock: ClockName = "real",
    seeds: int = 1,
    draws: int = 0,
    device: str = "auto",
    overwrite: bool = False,
    resume: bool = False,
) -> ControlResult:
    """Run a task of control through a fitted model, from several seeds.

    Args:
        model: The model.
        task: The task's file.
        out: The directory to write: `control.json`, `run.h5`, a page and a film; it appears when complete.
        solver: mppi, gauss-newton or both.
        clock: real: a plan acts after the wall time that it took; ideal: at once.
        seeds: Number of runs, with the seeds 0 to `seeds` - 1.
        draws: Draws of the model's uncertainty that each plan is evaluated under; 0 for the estimate alone.
        device: Device of the predictions: auto, cpu or cuda.
        overwrite: Replace an existing run.
        resume: Continue an interrupted run; a complete one of the same inputs and settings is kept.

    Returns:
        The content of `control.json`.

    Raises:
        UsageError: If `out` exists, or a number is out of range.
        InputDataError: If the model cannot serve the task, or its plans take longer than the task allows.
    """
    out = Path(out)
    if seeds < 1:
        raise UsageError(f"--seeds {seeds}.", "1 or more.", "pass a positive number.")
    if not 0 <= draws <= MOST_DRAWS:
        raise UsageError(f"--draws {draws}.", f"0 to {MOST_DRAWS}.", "pass a number in this range.")
    clean_stale(out)
    finished = (out / DOCUMENT).is_file()
    if not (finished and resume):
        refuse_output(out, "run", overwrite)
    request = _Request(
        model=read_model(model),
        task=read_any_task(Path(task)),
        solver=solver,
        clock=clock,
        seeds=seeds,
        draws=draws,
        device=resolve_device(device).type,
    )
    made_of = {**request.inputs(), **request.settings, "versions": json.dumps(versions())}
    if finished and resume:
        kept = read_json(out / DOCUMENT, ControlResult)
        others = _others(kept, request)
        if not others:
            note(f"control: {out} is already the result of this command")
            Checkpoint.remove_of(out, made_of)  # which a process left that was killed at its very end
            return kept
        if not overwrite:
            raise UsageError(
                f"{out} was made with other {', '.join(others)}.",
                "the same command, with --resume.",
                "pass what was passed before, choose another name for the output, or pass --overwrite.",
            )
    refuse_output(out, "run", overwrite)
    planning = planning_world(request.model, request.task)
    with control_budget(planning, _briefly(request.task), 1, draws, out):  # faults are told before long work
        runner = runner_of(request.model, request.task, solver, draws, request.device)
        for seed in range(seeds):
            runner.reset(seed)  # refuses what begins inside of something else
        if clock == "real":
            _require_speed(runner, request.task)
    with control_budget(planning, request.task, seeds, draws, out):
        checkpoint = Checkpoint.beside(out, made_of, resume, overwrite, "a run")
        try:
            runs = [_run(runner, seed, clock, checkpoint, str(task)) for seed in range(seeds)]
            result = _write(out, request, runner, runs, (str(model), str(task)), overwrite)
        except KeyboardInterrupt:
            raise InterruptedWork(f"{checkpoint.path} holds the runs that ended; --resume goes on with them.") from None
    checkpoint.remove()
    return result


def _briefly(task: AnyTask) -> AnyTask:
    """Return a task that ends after the plans that are timed."""
    brief: Any = {"success": task.success.model_copy(update={"timeout_s": TRIALS / task.planner.control_hz})}
    return task.model_copy(update=brief)


def _others(found: ControlResult, request: _Request) -> list[str]:
    """Return the names of what a run was made of that is not what is asked for."""
    pairs = [(found.settings, request.settings), (found.input_sha256, request.inputs())]
    names = [
        name for before, now in pairs for name in dict.fromkeys((*now, *before)) if before.get(name) != now.get(name)
    ]
    return names + ([] if found.versions == versions() else ["version of cgwm or a library"])


def _require_speed(runner: Runner, task: AnyTask) -> None:
    """Check that a plan does not take much longer than a command.

    Raises:
        SlowPlansError: If it does, with the rate that is reached.
    """
    truth, controller, durations = runner.reset(0), runner.controller, []
    for number in range(TRIALS):
        state = truth.measured(number * controller.interval_s, truth.position_m, truth.quat_wxyz)
        plan = controller.plan(state, state.time_s + controller.interval_s)
        durations.append(math.inf if plan is None else plan.wall_s)
    taken = float(np.median(durations[TRIALS // 2 :]))
    if taken > SLOWEST * controller.interval_s:
        reason = f" Predictions run in the slow engine: {controller.slow}." if controller.slow else ""
        raise SlowPlansError(
            f"{task.source}: [planner] control_hz = {task.planner.control_hz:g}: a plan takes {1e3 * taken:.0f} ms "
            f"here, so {1 / taken:.3g} a second.{reason}",
            f"up to {SLOWEST / taken:.3g}, of which half is reached.",
            advice(task, taken) or "lower control_hz, or pass --clock ideal.",
        )


def _run(runner: Runner, seed: int, clock: ClockName, checkpoint: Checkpoint, source: str) -> PageRun:
    """Return a run from its checkpoint; it is made first if there is none."""
    slot = checkpoint.slot(seed_slot(seed))
    kept = slot.read(torch.device("cpu"))
    if kept is None:
        note(f"control: seed {seed}")
        watch = noting(runner, checkpoint.slot(NOW), source)
        with no_garbage_search():
            recording = runner.run(seed, clock, watch)
        tables = runner.tables(recording, clock == "real")
        figures = figures_of(recording, tables, runner.start_errors(seed), runner.controller.interval_s)
        kept = {"figures": figures.model_dump_json(), **kept_tables(tables, source)}
        slot.write(kept)
    figures = ControlRun.model_validate_json(kept["figures"])
    return PageRun(figures=figures, tables=tables_kept(kept))


def _write(
    out: Path,
    request: _Request,
    runner: Runner,
    runs: list[PageRun],
    names: tuple[str, str],
    overwrite: bool,
) -> ControlResult:
    """Write recording, film, page and document, and return the document."""
    with new_directory(out, "run", overwrite) as folder:
        creator = f"cgwm {versions()['cgwm']}"
        write_runs(folder / RECORDING, [one.tables for one in runs], task_toml(request.task), creator)
        film, sheet = runner.film(runs[0].tables, request.device)
        if film is not None:
            (folder / FILM).write_bytes(film)
        result = _result(request, runner, runs, names, folder / RECORDING, None if film is None else FILM)
        page = control_html(result, request.task, runs, film, sheet)
        (folder / PAGE).write_text(page, encoding="utf-8")
        (folder / DOCUMENT).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return result


def _result(
    request: _Request,
    runner: Runner,
    runs: Iterable[PageRun],
    names: tuple[str, str],
    recording: Path,
    film: str | None,
) -> ControlResult:
    figures = tuple(one.figures for one in runs)
    good = [one for one in figures if one.ended == "success"]
    taken = float(np.median([one.plan_ms for one in figures])) / 1e3
    late = sum(one.late_plans for one in figures)
    return ControlResult(
        model=names[0],
        task=names[1],
        object=runner.object_name,
        solver=request.solver,
        clock=request.clock,
        plant=request.task.plant.kind,
        draws=request.draws,
        device=request.device,
        control_hz=request.task.planner.control_hz,
        reached_hz=1 / taken if taken > 0 else 0.0,
        sentence=sentence(figures, request.task, request.clock),
        advice=advice(request.task, taken) if late else "",
        goals=sum(one.goals for one in figures),
        successes=len(good),
        success_rate=len(good) / len(figures),
        success_interval_95=wilson(len(good), len(figures)),
        median_time_s=float(np.median([one.time_s for one in good])) if good else None,
        runs=figures,
        recording=RECORDING,
        page=PAGE,
        video=film,
        recording_sha256=sha256(recording),
        input_sha256=request.inputs(),
        settings=request.settings,
        versions=versions(),
        warnings=warnings_of(runner.controller.slow, request.draws, request.model, runner.outside),
    )


def warnings_of(slow: str, draws: int, model: Model, outside: Sequence[str] = ()) -> tuple[str, ...]:
    """Return what a run should be told of.

    Args:
        slow: Why predictions run in the slow engine; empty where they do not.
        draws: Draws of the model for each plan.
        model: The model.
        outside: Names of what the robot's file has outside of its links.
    """
    found = [f"predictions run in the slow engine: {slow}."] if slow else []
    if outside:
        names = ", ".join(outside[:5]) + (", ..." if len(outside) > 5 else "")
        found.append(
            f"what the robot's file has outside of its links, {names}, is not there in predictions: "
            "the object does not touch it. Give the root link a box where the object needs one."
        )
    if draws and not any(parameter.std_error for parameter in model.file.parameters):
        found.append(f"--draws {draws}: the model has no standard errors, so that all draws are its estimate.")
    return tuple(found)
