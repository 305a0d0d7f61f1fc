"""Plots with linear axes as inline SVG, and bars as HTML, without fonts or scripts; for charts over time see charts."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from .page import number, text

_LEFT, _RIGHT, _TOP, _BOTTOM = 54, 12, 26, 40
_TICKS = 5
_MARGIN = 0.04
"""Share of the range that is left free at either end of an axis."""
_LARGEST_ERROR = 2.0
"""Error bars are in the range up to this many times the median; longer ones are drawn to its end."""
_TALLEST, _FLATTEST = 1.2, 0.3
"""Limits of height over width of a plot with equal scales."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One bar of a ranking."""

    name: str
    """Name, plain text."""
    value: float
    """Length of the bar; negative ones have none."""
    words: str
    """The figure, as it is to be read."""
    strong: bool = False
    """Whether it stands out."""
    note: str = ""
    """A second line."""


def bars(rows: Sequence[Bar], full: float | None = None) -> str:
    """Return bars below each other, with their figures.

    Args:
        rows: The bars.
        full: Value of a bar of full length; None for the largest.
    """
    full = full or max((row.value for row in rows if row.value > 0), default=1.0)
    lines = []
    for row in rows:
        width = 100 * min(max(row.value / full, 0.0), 1.0)
        mark = " strong" if row.strong else ""
        lines.append(
            f'<div class="row"><span class="name{mark}">{text(row.name)}</span><span class="track{mark}">'
            f'<i style="width:{width:.1f}%"></i></span><span class="value{mark}">{text(row.words)}</span>'
        )
        lines.append(f'<span class="note">{text(row.note)}</span></div>' if row.note else "</div>")
    return f'<div class="barlist">{"".join(lines)}</div>'


@dataclass(frozen=True, kw_only=True)
class Series:
    """Points of a plot that belong together."""

    name: str
    """Name, which browsers show on hovering, and the legend."""
    points: Points
    """Coordinates, in order."""
    color: str = "m0"
    """Name of a variable of the style sheet: m0 to m5, ink, soft, frozen, good, bad."""
    kind: Literal["line", "dashed", "dots", "binned"] = "line"
    """How they are drawn; binned: a line with a dot at each point."""
    errors: Sequence[float] = ()
    """Standard error of each point's y; empty for none."""


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Points and lines on linear axes."""

    title: str
    """What is drawn, with its unit."""
    x: str
    """What the horizontal axis shows, with its unit."""
    series: Sequence[Series]
    """The series; the last is drawn on top."""
    equal: bool = False
    """Whether both axes have the same scale, as in a drawing."""
    zero: bool = False
    """Whether the vertical axis includes zero and marks it."""
    ground: Points = ()
    """A line of the ground."""
    width: int = 480
    """Width of the drawing, in its units."""
    height: int = 300
    """Its height; with equal scales it follows from the ranges."""


@dataclass(frozen=True)
class _Axes:
    """Ranges of a plot and how they are placed."""

    low: tuple[float, float]
    high: tuple[float, float]
    width: int
    height: int

    def x(self, value: float) -> float:
        """Return the place of a value on the horizontal axis."""
        return _LEFT + (self.width - _LEFT - _RIGHT) * self._share(value, 0)

    def y(self, value: float) -> float:
        """Return the place of a value on the vertical axis."""
        return self.height - _BOTTOM - (self.height - _BOTTOM - _TOP) * self._share(value, 1)

    def _share(self, value: float, axis: int) -> float:
        low, high = self.low[axis], self.high[axis]
        return min(max((value - low) / (high - low), 0.0), 1.0)


def plot_svg(plot: Plot) -> str:
    """Return a plot as an SVG element that scales with its container; empty if nothing finite is to be drawn."""
    axes = _axes(plot)
    if axes is None:
        return ""
    bottom, right = axes.height - _BOTTOM, axes.width - _RIGHT
    parts = [
        f'<svg class="chart plot" viewBox="0 0 {axes.width} {axes.height}" role="img" '
        f'aria-label="{html.escape(plot.title)}">',
        f'<text class="title" x="{_LEFT}" y="15">{text(plot.title)}</text>',
        *_grid(axes),
        f'<text x="{right}" y="{axes.height - 4}" text-anchor="end">{text(plot.x)}</text>',
    ]
    if plot.zero:
        parts.append(f'<line class="zero" x1="{_LEFT}" x2="{right}" y1="{axes.y(0):.1f}" y2="{axes.y(0):.1f}"/>')
    if plot.ground:
        parts.append(f'<path class="line ground" d="{_path(plot.ground, axes)}"/>')
    parts.append(f'<path class="line zero" d="M{_LEFT} {bottom}H{right}"/>')
    for series in plot.series:
        parts += _drawn(series, axes)
    return "".join([*parts, "</svg>"])


def legend(series: Sequence[Series]) -> str:
    """Return the legend of a plot."""
    return (
        '<div class="legend">'
        + "".join(
            f'<span><i style="border-color:var(--{s.color}){";border-top-style:dashed" if s.kind == "dashed" else ""}">'
            f"</i>{text(s.name)}</span>"
            for s in series
        )
        + "</div>"
    )


def _axes(plot: Plot) -> _Axes | None:
    """Return the axes that hold all finite points with their errors; None without points."""
    columns: tuple[list[float], list[float]] = ([], [])
    for series in plot.series:
        errors = series.errors or [0.0] * len(series.points)
        most = _LARGEST_ERROR * sorted(errors)[len(errors) // 2] if errors else 0.0
        for (x, y), error in zip(series.points, errors, strict=True):
            if math.isfinite(x) and math.isfinite(y):
                columns[0].append(x)
                size = min(error, most) if math.isfinite(error) else 0.0
                columns[1].extend([y - size, y + size])
    if not columns[0]:
        return None
    columns[1].extend([0.0] * plot.zero + [y for _, y in plot.ground])
    ranges = []
    for values in columns:
        low, high = min(values), max(values)
        margin = _MARGIN * (high - low) or abs(high) * _MARGIN or 1.0
        ranges.append([low - margin, high + margin])
    height = _equalised(ranges, plot.width) if plot.equal else plot.height
    (x0, x1), (y0, y1) = ranges
    return _Axes((x0, y0), (x1, y1), plot.width, height)


def _equalised(ranges: list[list[float]], width: int) -> int:
    """Widen one of two ranges until both have the same scale, and return the height of the drawing."""
    wide, tall = (high - low for low, high in ranges)
    ratio = min(max(tall / wide, _FLATTEST), _TALLEST)
    scale = max(wide, tall / ratio)  # metres over the whole width
    for axis, size in ((0, scale), (1, scale * ratio)):
        middle = 0.5 * sum(ranges[axis])
        ranges[axis] = [middle - 0.5 * size, middle + 0.5 * size]
    return round((width - _LEFT - _RIGHT) * ratio) + _TOP + _BOTTOM


def _grid(axes: _Axes) -> list[str]:
    bottom, right = axes.height - _BOTTOM, axes.width - _RIGHT
    parts = []
    for value in ticks(axes.low[1], axes.high[1]):
        y = axes.y(value)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_short(value)}</text>')
    for value in ticks(axes.low[0], axes.high[0]):
        x = axes.x(value)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{bottom}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{_short(value)}</text>')
    return parts


def ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers within a range.

    >>> ticks(-0.3, 2.1)
    [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    power = 10.0 ** math.floor(math.log10((high - low) / _TICKS))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= (high - low) / _TICKS - 1e-12)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _short(value: float) -> str:
    return f"{value:.4g}".replace("-", "−") if value else "0"


def _drawn(series: Series, axes: _Axes) -> list[str]:
    stroke, name = f"stroke:var(--{series.color})", f"<title>{text(series.name)}</title>"
    fill = f"fill:var(--{series.color})"
    known = [k for k, (x, y) in enumerate(series.points) if math.isfinite(x) and math.isfinite(y)]
    parts = []
    for k in known if series.errors else ():
        x, y = series.points[k]
        if math.isfinite(series.errors[k]):
            a, b = axes.y(y - series.errors[k]), axes.y(y + series.errors[k])
            parts.append(f'<path class="error" style="{stroke}" d="M{axes.x(x):.1f} {a:.1f}V{b:.1f}"/>')
    if series.kind != "dots":
        mark = " dashed" if series.kind == "dashed" else ""
        line = _path(series.points, axes)
        parts.append(f'<path class="line{mark}" style="{stroke};stroke-width:2" d="{line}">{name}</path>')
    if series.kind in ("dots", "binned"):
        size = 4 if series.kind == "binned" else 2.4
        for k in known:
            x, y = series.points[k]
            said = f"<title>{text(series.name)}: {number(x)}, {number(y)}</title>"
            place = f'cx="{axes.x(x):.1f}" cy="{axes.y(y):.1f}" r="{size}"'
            parts.append(f'<circle class="dots" style="{fill}" {place}>{said}</circle>')
    return parts


def _path(points: Points, axes: _Axes) -> str:
    """Return the path through points, interrupted where one is not finite."""
    parts, joined = [], False
    for x, y in points:
        if not (math.isfinite(x) and math.isfinite(y)):
            joined = False
            continue
        parts.append(f"{'L' if joined else 'M'}{axes.x(x):.1f} {axes.y(y):.1f}")
        joined = True
    return "".join(parts)
