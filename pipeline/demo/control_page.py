"""The page of the scene control."""

from __future__ import annotations

from ...schemas import ComparedParameter, ControlDemoResult, ControlRun
from ..control.film import AHEAD_S
from ..report.page import (
    cautions,
    command,
    facts,
    film,
    fixed,
    number,
    page,
    paragraph,
    section,
    table,
    text,
    unit_text,
    way_link,
)

REPORT_HTML, REPORT_JSON = "report.html", "report.json"


def control_demo_html(result: ControlDemoResult, webm: bytes) -> str:
    """Return the whole page.

    Args:
        result: The result.
        webm: The film of the first run; empty for none.
    """
    found = result.control
    files = [(kind, way_link(name, name)) for kind, name in result.paths.items()]
    files.append(("errors over time, plan times, forces", way_link(found.page, f"{result.paths['runs']}/{found.page}")))
    took = [(stage, f"{seconds:.0f} s") for stage, seconds in result.seconds.items()]
    body = [
        f"<h1>cgwm demo · scene control · seed {result.seed}</h1>",
        f'<p class="verdict">{text(result.verdict)}</p>',
        paragraph(
            f"Photos and one short video of a {result.family.replace('_', ' ')} gave a model of its shape, its look "
            "and its contacts. With this model a finger plans its pushes, 30 times a second; they act on another "
            "simulator, MuJoCo, with the true mesh and the true friction, which the model never saw."
        ),
        _film(webm),
        section("Runs", _runs(found.runs), paragraph(_speed(result))),
        section(
            "What the video gave",
            table(
                ["parameter", "estimate", "95 % interval", "truth", "unit", "state"],
                [_row(p) for p in result.parameters],
            ),
            paragraph(
                "The true values are those of the simulator that made the capture; the fit does not see them. What is "
                "not observable stays near its prior: one push hardly shows it."
            ),
        ),
        section(
            "Go on",
            paragraph("Edit the task, and run it again from more starts:"),
            command(f"cgwm control {result.paths['model']} {result.paths['task']} --out again --seeds 20"),
            facts(files),
        ),
        section("Wall time", facts([*took, ("all", f"{sum(result.seconds.values()):.0f} s")])),
        cautions(list(result.warnings)),
    ]
    return page(f"cgwm demo: control, seed {result.seed}", [piece for piece in body if piece])


def _film(webm: bytes) -> str:
    if not webm:
        return ""
    told = f"Left the plant, right what a plan had predicted {AHEAD_S:g} s before, in splats. The cross is the goal."
    return section("Plant and prediction", film(webm, "plant beside prediction"), paragraph(told))


def _runs(runs: tuple[ControlRun, ...]) -> str:
    header = ["seed", "ended", "time [s]", "at the start", "at the end", "plans", "late"]
    rows = [
        [
            str(run.seed),
            run.ended.replace("_", " "),
            fixed(run.time_s),
            f"{fixed(run.start_position_error_m, 0, 1e3)} mm, {fixed(run.start_turn_error_deg, 0)} deg",
            f"{fixed(run.position_error_m, 1, 1e3)} mm, {fixed(run.turn_error_deg)} deg",
            str(run.plans),
            str(run.late_plans),
        ]
        for run in runs
    ]
    return table(header, rows, numeric=(0, 2, 5, 6))


def _speed(result: ControlDemoResult) -> str:
    found = result.control
    if found.clock == "ideal":
        return "Ideal clock: a plan acted at once, however long it took; here plans take longer than a command."
    return (
        f"Real clock: a plan acts after the wall time that it took. {found.control_hz:g} commands a second are asked "
        f"for, {found.reached_hz:.3g} plans a second are reached (median)."
    )


def _row(compared: ComparedParameter) -> list[str]:
    parameter = compared.parameter
    span = parameter.interval_95
    state = text(parameter.state.replace("_", " "))
    return [
        parameter.name,
        number(parameter.estimate),
        "" if span is None else f"{number(span[0])} to {number(span[1])}",
        number(compared.true_value),
        unit_text(parameter.unit),
        f'<span class="bad">{state}</span>' if parameter.state in ("on_bound", "not_observable") else state,
    ]
