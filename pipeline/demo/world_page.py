"""The page and the picture of the scenes with fixed surfaces."""

from __future__ import annotations

import base64

import numpy as np

from ...datasets.synthetic.worlds import WorldPlan
from ...datasets.synthetic.worlds.truth_engine import picture
from ...schemas import ComparedParameter, WorldDemoResult
from ..rendering.contact_sheets import contact_sheet, small_png
from ..report.page import cautions, facts, fixed, number, page, paragraph, section, table, unit_text, way_link

REPORT_HTML, REPORT_JSON, PICTURE = "report.html", "report.json", "demo.png"

_SHOWN = {"bin": (0.0, 0.12, 1.0), "ramp": (0.0, 0.3, 0.6)}
"""Shares of the first rollout at which it is shown."""


def world_picture(plan: WorldPlan, poses: np.ndarray) -> bytes:
    """Return a PNG of a rollout at three moments, from the true shapes at the predicted poses (frames, bodies, 7)."""
    moments = [round(share * (len(poses) - 1)) for share in _SHOWN[plan.name]]
    frames = np.stack([picture(plan, poses[moment]) for moment in moments])
    return small_png(contact_sheet([frames]))


def world_html(result: WorldDemoResult, png: bytes) -> str:
    """Return the whole page."""
    shown = base64.b64encode(png).decode("ascii")
    rows = [_row(compared) for compared in result.parameters]
    files = [(kind, way_link(name, name)) for kind, name in result.paths.items()]
    error = result.evaluation.translation_error_m.median
    body = [
        f"<h1>cgwm demo · scene {result.scene} · seed {result.seed}</h1>",
        paragraph(result.verdict, "verdict"),
        f'<p><img src="data:image/png;base64,{shown}" alt="The first rollout at three moments" '
        'style="max-width:100%"></p>',
        section(
            "Contact parameters",
            table(["parameter", "estimate", "95 % interval", "truth", "unit"], rows),
            paragraph(
                "The true values are those of the simulator that made the capture; the fit does not see them, except "
                "where the capture states them (given)."
            ),
        ),
        section(
            "Test episodes",
            paragraph(
                f"Open-loop error: {fixed(error, 1, 1e3)} mm (median; test episodes: {result.evaluation.episodes})."
            ),
        ),
        section("Files", facts(files)),
        cautions(list(result.warnings)),
    ]
    return page(f"cgwm demo: {result.scene}, seed {result.seed}", [part for part in body if part])


def _row(compared: ComparedParameter) -> list[str]:
    parameter = compared.parameter
    low, high = parameter.interval_95 or (None, None)
    span = f"{number(low)} to {number(high)}" if parameter.state == "fitted" else parameter.state.replace("_", " ")
    return [
        parameter.name,
        number(parameter.estimate),
        span,
        number(compared.true_value),
        unit_text(parameter.unit),
    ]
