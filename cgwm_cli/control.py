"""The verb `cgwm control`: run a task of control through a fitted model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .execution import Emit, loading
from .options import AnyDevice, Overwrite, TrustEffects, trust
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import ControlResult


@verb
def control(
    emit: Emit,
    model: Annotated[
        Path | None, typer.Argument(metavar="MODEL", help="The fitted model.", show_default=False)
    ] = None,
    task: Annotated[
        Path | None, typer.Argument(metavar="TASK.toml", help="The task.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="RUN", help="The directory to write.", show_default=False)
    ] = None,
    solver: Annotated[
        Literal["mppi", "gauss-newton", "both"],
        typer.Option("--solver", help="mppi: sampling; gauss-newton: exact derivatives; both: one after the other."),
    ] = "mppi",
    clock: Annotated[
        Literal["real", "ideal"],
        typer.Option("--clock", help="real: a plan acts after the wall time that it took; ideal: at once."),
    ] = "real",
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", help="Runs, from the seeds 0 to N - 1.")] = 1,
    draws: Annotated[
        int,
        typer.Option("--draws", metavar="K", help="Draws of the fit's uncertainty that each plan is judged under; "
                     "0: the estimate alone."),
    ] = 0,
    device: AnyDevice = "cpu",
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted RUN; keep a finished one.")
    ] = False,
    overwrite: Overwrite = False,
    print_task: Annotated[
        Literal["push", "hand", "turn"] | None,
        typer.Option("--print-task", help="Print a task to edit, and stop. push: a finger pushes the object to a pose; "
                     "hand: a hand turns it to random orientations; turn: a hand turns it once.", show_default=False),
    ] = None,
    trust_effects: TrustEffects = "",
) -> None:  # fmt: skip
    """Run a task of control: a robot acts through a fitted model, on the model or on MuJoCo."""
    from ..schemas import UsageError

    if print_task is not None:
        from ..schemas import HAND_TASKS, TASKS, task_toml

        emit({**TASKS, **HAND_TASKS}[print_task], lambda found: task_toml(found).rstrip("\n"))
        return
    missing = [name for name, value in (("MODEL", model), ("TASK.toml", task), ("--out RUN", out)) if value is None]
    if missing or model is None or task is None or out is None:
        raise UsageError(
            f"cgwm control lacks {', '.join(missing)}.",
            "cgwm control MODEL TASK.toml --out RUN.",
            "for a task to edit: cgwm control --print-task push.",
        )
    trust(trust_effects)
    with loading():
        from ..pipeline.control import control as work
    result = work(model, task, out, solver, clock, seeds, draws, device, overwrite, resume)
    emit(result, lambda found: _summary(found, out))


def _summary(result: ControlResult, out: Path) -> str:
    from .output import millimetres, table, warnings

    header = ["seed", "ended", "time", "position error", "turn error", "late plans", "plan"]
    rows = [
        [
            str(run.seed), run.ended.replace("_", " "), f"{run.time_s:.1f} s", millimetres(run.position_error_m),
            f"{run.turn_error_deg:.1f} deg", f"{run.late_plans} of {run.plans}", f"{run.plan_ms:.0f} ms",
        ]
        for run in result.runs
    ]  # fmt: skip
    low, high = (100 * share for share in result.success_interval_95)
    rate = f"success {100 * result.success_rate:.0f} % (95 %: {low:.0f} to {high:.0f})"
    speed = f"{result.clock} clock: {result.control_hz:g} Hz asked for, {result.reached_hz:.3g} plans a second reached."
    said = [*result.warnings, *([result.advice] if result.advice else [])]
    lines = [result.sentence, table(rows, header), f"{rate}; {speed}", *warnings(said)]
    return "\n".join([*lines, f"Page: {out / result.page}"])
