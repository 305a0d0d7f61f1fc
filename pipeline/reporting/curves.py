"""The section with the errors over time, an episode beside the other."""

from __future__ import annotations

from collections.abc import Sequence

from ...schemas import EpisodeCurves
from .charts import Chart, Line, chart_svg, decades
from .page import paragraph, section

KINDS = ("model", "frozen", "ballistic")
_MM = 1e3
_MOST = 1e3


def curves_section(curves: Sequence[EpisodeCurves]) -> str:
    """Return charts of translation and rotation error, model beside frozen and ballistic object; one an episode."""
    if not curves:
        return ""
    moves = {(c.episode, kind): _scaled(getattr(c, kind).translation_error_m, _MM) for c in curves for kind in KINDS}
    turns = {(c.episode, kind): list(getattr(c, kind).rotation_error_deg) for c in curves for kind in KINDS}
    rows = [_chart_row(curves, moves, "translation error [mm]", 0.1)]
    if any(turns.values()):
        rows.append(_chart_row(curves, turns, "rotation error [deg]", 0.1))
    legend = "".join(
        f'<span><i class="{style}"></i>{words}</span>'
        for style, words in (
            ("model", "model"),
            ("frozen", "frozen object"),
            ("ballistic", "ballistic object"),
            ("seen", "warm-up, which the model sees"),
            ("moment", "first contact"),
        )
    )
    words = "Distance and angle between prediction and measured track, on logarithmic scales; what exceeds "
    words += "a scale runs along its rim. Nothing of the object's motion after the warm-up is shown to the model: the "
    words += "errors are those of one uninterrupted rollout."
    return section("Error over time", paragraph(words), f'<div class="legend">{legend}</div>', *rows)


def _chart_row(
    curves: Sequence[EpisodeCurves], values: dict[tuple[str, str], list[float | None]], unit: str, floor: float
) -> str:
    """Return one chart for each episode, all on one scale."""
    low, high = decades([value for line in values.values() for value in line], floor)
    high = min(high, _MOST)  # a ballistic object falls through the ground, and would flatten everything else
    charts = []
    for curve in curves:
        lines = [Line(kind, kind, values[curve.episode, kind]) for kind in KINDS if values[curve.episode, kind]]
        title = f"episode {curve.episode}: {unit}"
        charts.append(
            chart_svg(Chart(title, curve.time_s, lines, low, high, curve.warmup_end_s, curve.first_contact_s))
        )
    return f'<div class="charts">{"".join(charts)}</div>'


def _scaled(values: Sequence[float | None], scale: float) -> list[float | None]:
    return [None if value is None else value * scale for value in values]
