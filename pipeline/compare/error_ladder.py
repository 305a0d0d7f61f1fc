"""The error ladder: a chart of the errors of all episodes from model to model, as inline SVG."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...schemas import CompareResult, ErrorSummary
from ..report.charts import decades

_WIDTH, _HEIGHT = 1060, 360
_RUNG_WIDTH = 130
"""Width for each model, as far as the page has it: on a narrow screen the ladder of a few models is to be read."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 60, 150, 28, 44
_SMALLEST = 0.75
"""Scale below which the ladder is moved sideways, not made smaller."""
_LOWEST_MM = 0.01
_LABEL_HEIGHT = 14

_Scale = Callable[[float], float]


@dataclass(frozen=True)
class Rung:
    """One model of the ladder."""

    name: str
    """Name of the model."""
    errors_mm: Mapping[str, float]
    """Translation error by episode [mm]."""
    floor_mm: float | None = None
    """Median error due to the noise of the start alone [mm]; None where unknown."""
    fitted_mm: float | None = None
    """Median state-fitted residual [mm]; None where unknown."""


LADDER_WORDS = (
    "Each model sees the first 0.1 s of an episode; the rest is one uninterrupted prediction. State-fitted: the "
    "start is fitted to the whole episode, so the residual is what the model cannot follow even from the best "
    "start. Noise of the start alone: the error of a perfect model due to the uncertainty of the start."
)
"""Explanation of the ladder on the page."""
_LEGEND = (
    ("median", "median over the episodes"),
    ("episode", "one episode"),
    ("fitted", "state-fitted residual (median)"),
    ("floor", "noise of the start alone (median)"),
    ("zero", "without a model (medians)"),
)


def error_ladder(result: CompareResult, names: Sequence[str]) -> tuple[str, str]:
    """Return the ladder of a comparison and its legend, as HTML; their style is `player.REPLAY_STYLE`."""
    rungs = [
        Rung(
            name,
            {e.episode: 1e3 * e.translation_error_m for e in model.per_episode},
            _median_mm(model.state_noise_floor_m),
            _median_mm(model.state_fitted_residual_m),
        )
        for model, name in zip(result.models, names, strict=True)
    ]
    zeros = {
        f"{name} object": 1e3 * figures["translation_error_m"]["median"]
        for name, figures in result.models[0].baselines.items()
        if figures.get("translation_error_m")
    }
    legend = "".join(f'<span><i class="{style}"></i>{words}</span>' for style, words in _LEGEND)
    return f'<div class="scroll">{ladder_svg(rungs, zeros)}</div>', f'<div class="legend">{legend}</div>'


def _median_mm(summary: ErrorSummary | None) -> float | None:
    return None if summary is None else 1e3 * summary.median


def ladder_svg(rungs: Sequence[Rung], zeros_mm: Mapping[str, float]) -> str:
    """Return the ladder: a column for each model, a thin line for each episode, a thick line for the medians.

    Args:
        rungs: The models, in order.
        zeros_mm: Median errors of the baselines (frozen object, ballistic object) by name [mm].
    """
    extra = [value for rung in rungs for value in (rung.floor_mm, rung.fitted_mm) if value]
    values = [value for rung in rungs for value in rung.errors_mm.values()]
    low, high = decades([*values, *extra, *zeros_mm.values()], _LOWEST_MM)
    bottom = _HEIGHT - _BOTTOM

    def y(value: float) -> float:
        place = math.log(min(max(value, low), high) / low) / math.log(high / low)
        return bottom - (bottom - _TOP) * place

    width = min(_WIDTH, _LEFT + _RIGHT + _RUNG_WIDTH * len(rungs))
    columns = [_LEFT + (width - _LEFT - _RIGHT) * (k + 0.5) / len(rungs) for k in range(len(rungs))]
    parts = [
        f'<svg class="chart ladder" viewBox="0 0 {width} {_HEIGHT}" style="max-width:{width}px;'
        f'min-width:{round(_SMALLEST * width)}px" role="img" aria-label="errors by model">',
        f'<text class="title" x="{_LEFT}" y="15">translation error [mm], open loop</text>',
    ]
    right = width - _RIGHT
    for power in range(round(math.log10(low)), round(math.log10(high)) + 1):
        at = y(10.0**power)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{10.0**power:g}</text>')
    parts += _zeros(zeros_mm, y, right)
    parts += _episodes(rungs, columns, y)
    half = min(40.0, 0.3 * (right - _LEFT) / len(rungs))
    medians = []
    for rung, x in zip(rungs, columns, strict=True):
        median = float(np.median(list(rung.errors_mm.values())))
        medians.append(f"{x:.1f} {y(median):.1f}")
        for value, style, words in (
            (rung.floor_mm, "floor", "noise of the start alone"),
            (rung.fitted_mm, "fitted", "state-fitted residual"),
        ):
            if value:
                at = y(value)
                parts.append(
                    f'<line class="{style}" x1="{x - half:.1f}" x2="{x + half:.1f}" y1="{at:.1f}" y2="{at:.1f}">'
                    f"<title>{words}: {value:.2f} mm</title></line>"
                )
        parts.append(f'<text class="value" x="{x + 12:.1f}" y="{y(median) - 8:.1f}">{_figure(median)} mm</text>')
        parts.append(f'<text class="name" x="{x:.1f}" y="{bottom + 20}" text-anchor="middle">{_text(rung.name)}</text>')
    parts.append(f'<path class="line median" d="M{"L".join(medians)}"/>')
    parts += [f'<circle class="median" cx="{m.split()[0]}" cy="{m.split()[1]}" r="5"/>' for m in medians]
    return "".join([*parts, "</svg>"])


def _zeros(zeros_mm: Mapping[str, float], y: _Scale, right: float) -> list[str]:
    """Return dashed lines for the baselines, with labels that do not overlap."""
    parts, last = [], math.inf
    for name, value in sorted(zeros_mm.items(), key=lambda item: item[1]):
        at = y(value)
        label = min(at + 4, last - _LABEL_HEIGHT)
        last = label
        parts.append(f'<line class="zero" x1="{_LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{right + 6}" y="{label:.1f}">{_text(name)}: {_figure(value)}</text>')
    return parts


def _episodes(rungs: Sequence[Rung], columns: Sequence[float], y: _Scale) -> list[str]:
    parts = []
    for episode in dict.fromkeys(name for rung in rungs for name in rung.errors_mm):
        known = [(x, r.errors_mm[episode]) for r, x in zip(rungs, columns, strict=True) if episode in r.errors_mm]
        words = f"episode {episode}: " + ", ".join(_figure(value) for _, value in known) + " mm"
        path = "L".join(f"{x:.1f} {y(value):.1f}" for x, value in known)
        dots = "".join(f'<circle cx="{x:.1f}" cy="{y(value):.1f}" r="2.5"/>' for x, value in known)
        parts.append(f'<g class="episode"><title>{_text(words)}</title><path class="line" d="M{path}"/>{dots}</g>')
    return parts


def _figure(value: float) -> str:
    return f"{value:.0f}" if value >= 1e3 else f"{value:.3g}"


def _text(words: str) -> str:
    return html.escape(words)
