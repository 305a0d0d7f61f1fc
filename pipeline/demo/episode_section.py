"""Sections of a report on each episode: errors over time, and real and predicted frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...datasets.synthetic import TruthFile
from ...schemas import EpisodeCurves, ErrorCurve
from ..evaluate.prediction import BALLISTIC, FROZEN, MODEL, EpisodePrediction
from ..rendering.contact_sheets import TILE_WIDTH, FrameStrip, columns_and_rows, jpeg_uri, sprite, telling, tiles
from ..report.charts import Chart, Line, chart_svg, decades
from ..report.page import paragraph, section, text

_MICROMETRES, _MILLIDEGREES = 6, 3


def curves_of(predictions: Sequence[EpisodePrediction], truth: TruthFile) -> tuple[EpisodeCurves, ...]:
    """Return the errors over the time since each episode's start, averaged over the free bodies.

    The baselines begin at the end of the warm-up, because they predict nothing before it.
    """
    return tuple(
        EpisodeCurves(
            episode=one.episode,
            time_s=_rounded(one.time_s - one.time_s[0], _MICROMETRES),
            warmup_end_s=round(one.warmup_end_s - float(one.time_s[0]), _MICROMETRES),
            first_contact_s=truth.episodes[one.episode].first_contact_s,
            model=_curve(one, MODEL, one.time_s > -np.inf),
            frozen=_curve(one, FROZEN, one.time_s >= one.warmup_end_s),
            ballistic=_curve(one, BALLISTIC, one.time_s >= one.warmup_end_s),
        )
        for one in predictions
    )


def _curve(one: EpisodePrediction, method: str, shown: NDArray[np.bool_]) -> ErrorCurve:
    return ErrorCurve(
        translation_error_m=_mean(one.translation_error_m(method), shown, _MICROMETRES),
        rotation_error_deg=_mean(one.rotation_error_deg(method), shown, _MILLIDEGREES) if one.turned.any() else (),
    )


def _mean(error: NDArray[np.float64], shown: NDArray[np.bool_], decimals: int) -> tuple[float | None, ...]:
    """Return the mean over bodies of an error (T, bodies) at the shown frames; None at others or if unknown."""
    known = np.isfinite(error)
    count = known.sum(1)
    total = np.where(known, error, 0.0).sum(1)
    return tuple(
        round(float(value / n), decimals) if n and keep else None
        for value, n, keep in zip(total, count, shown, strict=True)
    )


def _rounded(values: NDArray[np.float64], decimals: int) -> tuple[float, ...]:
    return tuple(round(float(value), decimals) for value in values)


KINDS = ("model", "frozen", "ballistic")


_MM = 1e3


_MOST = 1e3


def curves_section(curves: Sequence[EpisodeCurves]) -> str:
    """Return a section with charts of translation and rotation error of the model and the baselines, by episode."""
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
    """Return one chart for each episode, all with the same scale."""
    low, high = decades([value for line in values.values() for value in line], floor)
    high = min(high, _MOST)  # the error of the ballistic object, which falls through the ground, would hide the others
    charts = []
    for curve in curves:
        lines = [Line(kind, kind, values[curve.episode, kind]) for kind in KINDS if values[curve.episode, kind]]
        title = f"episode {curve.episode}: {unit}"
        charts.append(
            chart_svg(
                Chart(
                    title=title,
                    times_s=curve.time_s,
                    lines=lines,
                    low=low,
                    high=high,
                    shaded_until_s=curve.warmup_end_s,
                    marked_s=curve.first_contact_s,
                )
            )
        )
    return f'<div class="charts">{"".join(charts)}</div>'


def _scaled(values: Sequence[float | None], scale: float) -> list[float | None]:
    return [None if value is None else value * scale for value in values]


SHEET_COLUMNS = 6


def film_section(strips: Sequence[FrameStrip]) -> tuple[str, str]:
    """Return the section with the frames, and the style rules that embed each of its pictures once."""
    if not strips:
        return "", ""
    rules, pieces = [], []
    for episode in dict.fromkeys(strip.episode for strip in strips):
        views = [strip for strip in strips if strip.episode == episode]
        names = [f"f{len(rules) + k}" for k in range(2 * len(views))]
        count = min(len(strip.real) for strip in views)
        columns, rows = columns_and_rows(count, TILE_WIDTH)
        for k, strip in enumerate(views):
            for name, frames in zip(names[2 * k : 2 * k + 2], tiles(strip), strict=True):
                picture = jpeg_uri(sprite(frames[:count]), 72)
                rules.append(f".{name}{{background-image:url({picture});background-size:{columns}00% {rows}00%}}")
        pieces += [f"<h3>Test episode {text(episode)}</h3>", _player(views, names, count), _sheet(views, names, count)]
    words = (
        "Above: recorded frames. Below: the model's prediction from the first 0.1 s of the pose track, rendered from "
        "its spheres. The yellow outline is the object's true silhouette. The frames are cropped to the motion."
    )
    return section("Real above predicted", paragraph(words), *pieces), "\n" + "\n".join(rules)


def _tile(name: str, frame: int, count: int, label: str) -> str:
    columns, rows = columns_and_rows(count, TILE_WIDTH)
    across, down = (100 * k / max(of - 1, 1) for k, of in ((frame % columns, columns), (frame // columns, rows)))
    style = f"background-position:{across:.3f}% {down:.3f}%"
    return f'<div class="tile {name}" role="img" aria-label="{text(label)}" style="{style}"></div>'


def _sheet(strips: Sequence[FrameStrip], names: Sequence[str], count: int) -> str:
    """Return rows of frames at equal time steps, real above predicted for each camera."""
    chosen = [k for k in telling(strips[0], SHEET_COLUMNS) if k < count]
    cells = ["<span></span>", *(f'<span class="time">{strips[0].times_s[k]:.2f} s</span>' for k in chosen)]
    cells += ["<span></span>"] * (SHEET_COLUMNS - len(chosen))
    for k, strip in enumerate(strips):
        cells += ['<span class="gap"></span>'] if k else []
        for kind, name in zip(("real", "predicted"), names[2 * k : 2 * k + 2], strict=True):
            cells.append(f"<span>{text(strip.camera)},<br>{kind}</span>")
            cells += [_tile(name, frame, count, f"{kind}, {strip.times_s[frame]:.2f} s") for frame in chosen]
            cells += ["<span></span>"] * (SHEET_COLUMNS - len(chosen))
    return f'<div class="scroll"><div class="sheet">{"".join(cells)}</div></div>'


def _player(strips: Sequence[FrameStrip], names: Sequence[str], count: int) -> str:
    """Return the real and predicted views side by side, with a slider for the frame."""
    columns = columns_and_rows(count, TILE_WIDTH)[0]
    times = ",".join(f"{time:.2f}" for time in strips[0].times_s[:count])
    views = "".join(
        f"<div>{_tile(names[2 * k + j], 0, count, kind)}{text(strip.camera)}, {kind}</div>"
        for k, strip in enumerate(strips)
        for j, kind in enumerate(("real", "predicted"))
    )
    return (
        f'<div data-frames="{count}" data-columns="{columns}" data-times="{times}"><div class="player">{views}</div>'
        f'<div class="controls"><button type="button">Play</button><input type="range" min="0" max="{count - 1}" '
        f'value="0" aria-label="frame"><output>{strips[0].times_s[0]:.2f} s</output></div></div>'
    )
