"""Small charts as inline SVG, without fonts or scripts: lines over time, and intervals."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 400, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 26, 34
_LABEL_GAP = 4


@dataclass(frozen=True)
class Line:
    """One line of a chart."""

    name: str
    """Name, which browsers show on hovering."""
    style: str
    """Class in the page's style sheet."""
    values: Sequence[float | None]
    """Value at each time; None where it is missing."""


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Lines over time on a logarithmic scale."""

    title: str
    """Title above the chart, with the unit."""
    times_s: Sequence[float]
    """Times of the values of all lines [s]."""
    lines: Sequence[Line]
    """The lines; the first is drawn last, on top."""
    low: float
    """Lower end of the scale; smaller values are drawn at it."""
    high: float
    """Upper end of the scale; larger values are drawn at it."""
    shaded_until_s: float | None = None
    """End of the shaded start, which the model may see [s]."""
    marked_s: float | None = None
    """Moment marked by a vertical line [s]."""


def decades(values: Sequence[float | None], floor: float) -> tuple[float, float]:
    """Return the powers of ten that enclose all values, not below `floor`, at least one decade apart.

    >>> decades([0.5, 210.0, None], 0.1)
    (0.1, 1000.0)
    """
    known = [value for value in values if value is not None and value > 0]
    if not known:
        return floor, 10 * floor
    low = max(floor, 10.0 ** math.floor(math.log10(min(known))))
    return low, max(10 * low, 10.0 ** math.ceil(math.log10(max(known))))


def chart_svg(chart: Chart) -> str:
    """Return a chart as an SVG element that scales with its container."""
    end = max(chart.times_s[-1], 1e-9)
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(chart.title)}">',
        f'<text class="title" x="{_LEFT}" y="15">{html.escape(chart.title)}</text>',
    ]
    bottom = HEIGHT - _BOTTOM
    if chart.shaded_until_s is not None:
        width = _x(chart.shaded_until_s, end) - _LEFT
        parts.append(f'<rect class="seen" x="{_LEFT}" y="{_TOP}" width="{width:.1f}" height="{bottom - _TOP}"/>')
    parts += _scales(chart, end)
    if chart.marked_s is not None and 0 <= chart.marked_s <= end:
        x = _x(chart.marked_s, end)
        parts.append(f'<line class="moment" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{bottom}"/>')
    for line in reversed(chart.lines):
        path = _path(chart, line.values, end)
        if path:
            parts.append(f'<path class="line {line.style}" d="{path}"><title>{html.escape(line.name)}</title></path>')
    return "".join([*parts, "</svg>"])


def _scales(chart: Chart, end: float) -> list[str]:
    """Return grid lines for each power of ten and about five ticks of time, with their labels."""
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    parts = []
    for power in range(round(math.log10(chart.low)), round(math.log10(chart.high)) + 1):
        y = _y(10.0**power, chart)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - _LABEL_GAP}" y="{y + 4:.1f}" text-anchor="end">{10.0**power:g}</text>')
    step = _round_step(end / 5)
    for k in range(math.floor(end / step + 1e-9) + 1):
        x = _x(k * step, end)
        parts.append(f'<line class="tick" x1="{x:.1f}" x2="{x:.1f}" y1="{bottom}" y2="{bottom + 4}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{k * step:g}</text>')
    parts.append(f'<text x="{right}" y="{HEIGHT - 4}" text-anchor="end">time [s]</text>')
    return parts


def _path(chart: Chart, values: Sequence[float | None], end: float) -> str:
    """Return the path of a line, interrupted where values are missing."""
    parts, joined = [], False
    for time, value in zip(chart.times_s, values, strict=True):
        if value is None:
            joined = False
            continue
        parts.append(f"{'L' if joined else 'M'}{_x(time, end):.1f} {_y(value, chart):.1f}")
        joined = True
    return "".join(parts)


def _x(time: float, end: float) -> float:
    return _LEFT + (WIDTH - _LEFT - _RIGHT) * time / end


def _y(value: float, chart: Chart) -> float:
    clipped = min(max(value, chart.low), chart.high)
    place = math.log(clipped / chart.low) / math.log(chart.high / chart.low)
    return HEIGHT - _BOTTOM - (HEIGHT - _BOTTOM - _TOP) * place


def _round_step(step: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is at least `step`."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= step - 1e-12)


def interval_svg(estimate: float, interval: tuple[float, float], true_value: float | None) -> str:
    """Return a small chart of an estimate (dot), its interval (bar) and the true value (tick)."""
    shown = [estimate, *interval, *([] if true_value is None else [true_value])]
    low, high = min(shown), max(shown)
    span = (high - low) or 1.0

    def place(value: float) -> float:
        return 6 + 108 * (value - low) / span

    a, b = (place(value) for value in interval)
    tick = ""
    if true_value is not None:
        x = place(true_value)
        tick = f'<line class="true" x1="{x:.1f}" x2="{x:.1f}" y1="2" y2="16"/>'
    return (
        '<svg class="interval" viewBox="0 0 120 18" aria-hidden="true">'
        f'<line class="bar" x1="{a:.1f}" x2="{b:.1f}" y1="9" y2="9"/>{tick}'
        f'<circle cx="{place(estimate):.1f}" cy="9" r="3.5"/></svg>'
    )
