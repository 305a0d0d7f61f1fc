"""The page of a run: its figures, the film's frames, errors over time, plan times against the deadline, and forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...datasets.rollouts.control_file import RunTables
from ...schemas import AnyTask, ControlResult, ControlRun, ControlTask, HandTask
from ..report.page import cautions, facts, film, fixed, folded, number, page, paragraph, section, table, text, way_link
from ..report.plots import Plot, Series, legend, plot_svg
from .film import AHEAD_S
from .tables import contact_force

PAGE, FILM = "control.html", "run.webm"
MOST_POINTS = 400
"""Largest number of points of a line."""
MOST_LINES = 6
"""Runs that are drawn in one plot."""


@dataclass(frozen=True, kw_only=True)
class PageRun:
    """A run."""

    figures: ControlRun
    """Its figures."""
    tables: RunTables
    """Its arrays."""


def control_html(result: ControlResult, task: AnyTask, runs: Sequence[PageRun], webm: bytes | None, sheet: str) -> str:
    """Return the page of runs.

    Args:
        result: The result.
        task: The task.
        runs: The runs.
        webm: The film; None for none.
        sheet: URI of some of its frames; empty for none.
    """
    body = [
        f"<h1>cgwm control · {text(Path(result.task).name)} · {text(result.object)}</h1>",
        f'<p class="verdict">{text(result.sentence)}</p>',
        cautions([*result.warnings, *([result.advice] if result.advice else [])]),
        section("Runs", _table(result, runs)),
        _film(result, task, webm, sheet),
        section("Errors", *_errors(task, runs)),
        _joints(runs) if isinstance(task, HandTask) else section("Way of object and finger", *_ways(task, runs)),
        _times(result, task, runs),
        section("Contact force", *_forces(runs)),
        section("What was asked for", _asked(result)),
    ]
    return page(f"cgwm control: {Path(result.task).name}", [piece for piece in body if piece])


def _table(result: ControlResult, runs: Sequence[PageRun]) -> str:
    """Return a table of the runs."""
    real = result.clock == "real"
    hand = any("obs/joints" in run.tables.arrays for run in runs)
    header = ["seed", "ended", "time [s]", "position error [mm]", "turn error [deg]", "commands"]
    header += [*(["goals"] if hand else []), "largest force [N]"]
    header += ["late plans", "plan, median [ms]", "plan, 95 % [ms]"] if real else []
    rows = []
    for run in result.runs:
        row = [str(run.seed), run.ended.replace("_", " "), fixed(run.time_s), fixed(run.position_error_m, 1, 1e3)]
        row += [fixed(run.turn_error_deg), str(run.commands)]
        row += [*([str(run.goals)] if hand else []), number(run.largest_force_n)]
        row += [f"{run.late_plans} of {run.plans}", fixed(run.plan_ms), fixed(run.plan_ms_95)] if real else []
        rows.append(row)
    return table(header, rows, numeric=(0, *range(2, len(header))), sorts=True)


def _film(result: ControlResult, task: AnyTask, webm: bytes | None, sheet: str) -> str:
    """Return the section with the film and some of its frames."""
    if result.video is None or webm is None:
        return ""
    ahead = f"{min(AHEAD_S, task.planner.horizon_s):g} s before"
    told = (
        f"Seed {result.runs[0].seed}: left, and above, the plant; right, and below, what a plan had predicted {ahead}"
    )
    told += ", on the fingers as they were." if isinstance(task, HandTask) else ". The cross is the goal."
    picture = f'<img src="{sheet}" alt="plant and prediction, six moments" style="max-width:100%">'
    shown = film(webm, "plant beside prediction")
    return section("Plant and prediction", paragraph(told), shown, picture, facts([("film", way_link(FILM, FILM))]))


def _errors(task: AnyTask, runs: Sequence[PageRun]) -> list[str]:
    """Return plots of the errors over time."""
    pieces, goal = [], task.success
    place_mm = None if goal.position_m is None else 1e3 * goal.position_m
    for name, title, scale, bar in (
        (
            "control/position_error",
            "Position error [mm]",
            1e3,
            place_mm,
        ),
        ("control/turn_error", "Turn error [deg]", 1.0, goal.turn_deg),
    ):
        lines = _lines(runs, name, scale)
        end = max((points[-1][0] for one in lines if (points := one.points)), default=1.0)
        if bar is not None:
            lines.append(Series(name="success", points=((0.0, bar), (end, bar)), color="good", kind="dashed"))
        pieces += [plot_svg(Plot(title=title, x="time [s]", series=lines, zero=True)), legend(lines)]
    return pieces


def _lines(runs: Sequence[PageRun], name: str, scale: float) -> list[Series]:
    """Return an array of the first runs over the time of their commands."""
    found = []
    for index, run in enumerate(runs[:MOST_LINES]):
        values, time = scale * run.tables.arrays[name], run.tables.arrays["control/time"]
        found.append(Series(name=f"seed {run.figures.seed}", points=_thinned(time, values), color=f"m{index % 6}"))
    return found


def _thinned(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], ...]:
    step = max(1, len(x) // MOST_POINTS)
    return tuple(zip(x[::step].tolist(), y[::step].tolist(), strict=True))


def _ways(task: ControlTask, runs: Sequence[PageRun]) -> list[str]:
    """Return the way of object and finger along the ground, of the first run."""
    arrays = runs[0].tables.arrays
    goal = task.goal.position_m
    lines = [
        Series(name="object", points=_thinned(*arrays["obs/object"][:, :2].T), color="m0"),
        Series(name="finger", points=_thinned(*arrays["obs/finger"].T), color="m1"),
        Series(name="goal", points=(goal,), color="good", kind="dots"),
    ]
    told = paragraph(f"Seed {runs[0].figures.seed}, seen from above.")
    return [told, plot_svg(Plot(title="y [m]", x="x [m]", series=lines, equal=True)), legend(lines)]


def _joints(runs: Sequence[PageRun]) -> str:
    """Return the section of the joints' values and targets over time, of the first run."""
    arrays = runs[0].tables.arrays
    time, names = arrays["control/time"], runs[0].tables.joints
    moved = np.argsort(-np.ptp(arrays["obs/joints"], axis=0))[:MOST_LINES] if len(time) else np.arange(0)
    lines = []
    for index, joint in enumerate(moved):
        color = f"m{index % 6}"
        values, target = arrays["obs/joints"][:, joint], arrays["control/target"][:, joint]
        lines.append(Series(name=names[joint], points=_thinned(time, values), color=color))
        lines.append(Series(name=f"{names[joint]}, target", points=_thinned(time, target), color=color, kind="dashed"))
    told = f"Seed {runs[0].figures.seed}, the joints that move most of {len(names)}; dashed: their targets."
    plot = plot_svg(Plot(title="Joint [rad, of slides m]", x="time [s]", series=lines))
    return section("Joints", paragraph(told), plot, legend(lines))


def _times(result: ControlResult, task: AnyTask, runs: Sequence[PageRun]) -> str:
    """Return the section of plan times; with the ideal clock they do not matter."""
    if result.clock == "ideal":
        told = "Ideal clock: a plan acted at once, however long it took. Pass --clock real for what a robot would see."
        return section("Plan time", paragraph(told))
    deadline, lines = 1e3 / task.planner.control_hz, []
    for index, run in enumerate(runs[:MOST_LINES]):
        time, wall = run.tables.arrays["plans/state_time"], 1e3 * run.tables.arrays["plans/wall"]
        lines.append(Series(name=f"seed {run.figures.seed}", points=_thinned(time, wall), color=f"m{index % 6}"))
    end = max((one.points[-1][0] for one in lines if one.points), default=1.0)
    lines.append(Series(name="deadline", points=((0.0, deadline), (end, deadline)), color="bad", kind="dashed"))
    told = (
        f"Real clock: a plan acts after the wall time that it took. {result.control_hz:g} commands a second are asked "
        f"for, {result.reached_hz:.3g} plans a second are reached (median)."
    )
    plot = plot_svg(Plot(title="Wall time of a plan [ms]", x="time [s]", series=lines, zero=True))
    return section("Plan time", paragraph(told), plot, legend(lines))


def _forces(runs: Sequence[PageRun]) -> list[str]:
    """Return the contact force over time."""
    lines, hand = [], "control/grip" in runs[0].tables.arrays
    for index, run in enumerate(runs[:MOST_LINES]):
        points = _thinned(run.tables.arrays["control/time"], contact_force(run.tables.arrays))
        lines.append(Series(name=f"seed {run.figures.seed}", points=points, color=f"m{index % 6}"))
    told = "Sum of the sizes of all forces on the object" if hand else "Of the finger on the object"
    told = paragraph(f"{told}, mean over a command.")
    return [told, plot_svg(Plot(title="Force [N]", x="time [s]", series=lines, zero=True)), legend(lines)]


def _asked(result: ControlResult) -> str:
    """Return what was asked for, and where the numbers are."""
    rows = [("model", text(result.model)), ("task", text(result.task)), ("plant", text(result.plant))]
    rows += [("solver", text(result.solver)), ("clock", text(result.clock)), ("device", text(result.device))]
    rows += [
        ("draws of the model", str(result.draws)),
        ("states, commands, plans", way_link(result.recording, result.recording)),
    ]
    files = [(name, text(digest)) for name, digest in result.input_sha256.items()]
    return facts(rows) + folded(
        "Inputs (SHA-256)", facts([*files, *((k, text(v)) for k, v in result.versions.items())])
    )
