"""The page of a comparison: one self-contained HTML file with the verdict, the error ladder, a player and tables."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...schemas import PHASES, CompareResult, ErrorSummary, ModelComparison, PairedDifference
from ..report.page import cautions, facts, fixed, number, page, paragraph, section, table, text
from ..report.page_file import made_of, page_beside
from ..trajectories.thresholds import TRACK_THRESHOLDS
from .error_ladder import LADDER_WORDS, error_ladder
from .model_comparison import ComparedModel
from .paired_difference import LEAST_EPISODES
from .player import REPLAY_SCRIPT, REPLAY_STYLE, Replay, replay_of
from .short_horizon_errors import FREEDOMS
from .wrench_chart import wrench_data, wrench_section

CUTS = TRACK_THRESHOLDS.segmentation
_MM = 1e3
HOTTEST = 5.0
"""Residual, in units of the noise, that is drawn in full colour."""


def default_page(models: Sequence[Path], split: str = "test") -> Path:
    """Return the page's path by default: beside the first model, named after the models."""
    return page_beside(models, "compare", *([split] if split != "test" else []))


def mark_of(page: Path, models: Sequence[Path], capture: Path, split: str) -> str:
    """Return by what the page of a comparison is recognised, see `page_file.made_of`."""
    return made_of(page, "compare", [*models, capture], split)


def comparison_html(
    result: CompareResult,
    models: Sequence[ComparedModel],
    footage: Mapping[str, list[dict[str, Any]]],
    files: Sequence[tuple[str, str]] = (),
    mark: str = "",
) -> str:
    """Return the HTML page of a comparison.

    Args:
        result: The figures.
        models: The models that they come from, in the same order.
        footage: Sheets of frames by episode, see `frames.footage_of`.
        files: What lies beside the page, with links, see `page_file.links_beside`.
        mark: By what the page is recognised, see `mark_of`.
    """
    names = [one.short_name for one in models]
    replay = replay_of(models, _by_interest(result, footage))
    data = {**replay.data, "video": footage, "wrench": wrench_data(models)}
    warned = [*result.warnings, *_warned(result, names)]
    body = [
        f"<h1>cgwm compare · {text(result.capture)} · split {text(result.split)}</h1>",
        f'<p class="verdict">{text(result.verdict)}</p>',
        f'<div class="cards">{"".join(_card(m, n) for m, n in zip(result.models, names, strict=True))}</div>',
        cautions(warned),
        _ladder(result, names),
        _player(replay, bool(footage)),
        _worst(result, names),
        _phases(result, names),
        _episodes(result, models),
        wrench_section(models),
        section("Files", facts(files)) if files else "",
        _provenance(result, models),
        f'<script type="application/json" id="replay-data">{_embedded(data)}</script>',
    ]
    title = f"cgwm compare: {', '.join(names)} on {Path(result.capture).name or result.capture}"
    return page(title, [part for part in body if part], REPLAY_STYLE, REPLAY_SCRIPT, mark)


def _embedded(data: object) -> str:
    """Return JSON that cannot end the script element that holds it."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _by_interest(result: CompareResult, footage: Mapping[str, object]) -> list[str]:
    """Order the episodes: filmed ones first, then those with the worst moments, then the others."""
    everything = [e.episode for model in result.models for e in model.per_episode]
    worst = [moment.episode for model in result.models for moment in model.worst]
    return list(dict.fromkeys([*footage, *worst, *everything]))


def _warned(result: CompareResult, names: Sequence[str]) -> list[str]:
    """Return the warnings of the evaluations; a warning that all models share appears once, without their names."""
    found: dict[str, list[str]] = {}
    for model, name in zip(result.models, names, strict=True):
        for words in model.warnings:
            found.setdefault(words, []).append(name)
    return [words if len(warned) == len(names) else f"{', '.join(warned)}: {words}" for words, warned in found.items()]


def _card(model: ModelComparison, name: str) -> str:
    rows = [("mean", f"{fixed(model.translation_error_m.mean, 1, _MM)} mm")]
    if model.rotation_error_deg is not None:
        rows.append(("rotation, median", f"{model.rotation_error_deg.median:.1f} deg"))
    rows.append(("short predictions", "–" if not model.reduced_chi2 else f"{model.reduced_chi2**0.5:.1f} × noise"))
    if model.psnr_object_db is not None:
        rows.append(("PSNR within the object", f"{model.psnr_object_db.median:.1f} dB"))
    listed = "".join(f"<dt>{label}</dt><dd>{value}</dd>" for label, value in rows)
    effects = f'<div class="soft">with {text(", ".join(model.effects))}</div>' if model.effects else ""
    return (
        f'<div class="card"><div>{text(name)}: median error</div>'
        f'<div class="value">{fixed(model.translation_error_m.median, 1, _MM)} mm</div>{effects}<dl>{listed}</dl></div>'
    )


# From model to model


def _ladder(result: CompareResult, names: Sequence[str]) -> str:
    return section(
        "From model to model",
        *error_ladder(result, names),
        _models(result, names),
        paragraph(LADDER_WORDS, "soft"),
        _pairs(result, names),
    )


def _median_mm(summary: ErrorSummary | None) -> float | None:
    return None if summary is None else summary.median * _MM


def _models(result: CompareResult, names: Sequence[str]) -> str:
    header = ["model", "effects", "median [mm]", "mean [mm]", "at the end [mm]", "rotation [deg]", "PSNR object [dB]"]
    header += ["state-fitted [mm]", "start's noise [mm]", "reduced χ²"]
    rows = [
        _model_row(model, f"<b>{text(name)}</b>" if model.model == result.best else text(name))
        for model, name in zip(result.models, names, strict=True)
    ]
    rows += [_baseline_row(name, figures) for name, figures in result.models[0].baselines.items()]
    shown = [k for k in range(len(header)) if k < 2 or any(row[k] != "–" for row in rows)]
    header, rows = [header[k] for k in shown], [[row[k] for k in shown] for row in rows]
    return table(header, rows, range(2, len(header)), sorts=True)


def _model_row(model: ModelComparison, name: str) -> list[str]:
    turn, image = model.rotation_error_deg, model.psnr_object_db
    return [
        name,
        text(", ".join(model.effects)) or "–",
        fixed(model.translation_error_m.median, 2, _MM),
        fixed(model.translation_error_m.mean, 2, _MM),
        fixed(model.translation_error_m.final, 2, _MM),
        fixed(turn.median if turn else None, 2),
        fixed(image.median if image else None),
        fixed(_median_mm(model.state_fitted_residual_m), 2),
        fixed(_median_mm(model.state_noise_floor_m), 2),
        number(model.reduced_chi2),
    ]


def _baseline_row(name: str, figures: Mapping[str, Any]) -> list[str]:
    move, turn = (figures.get(key) or {} for key in ("translation_error_m", "rotation_error_deg"))
    values = [fixed(move.get(key), 2, _MM) for key in ("median", "mean", "final")]
    return [f"({name} object)", "–", *values, fixed(turn.get("median"), 2), "–", "–", "–", "–"]


def _pairs(result: CompareResult, names: Sequence[str]) -> str:
    if not result.pairs:
        return ""
    called = {model.model: name for model, name in zip(result.models, names, strict=True)}
    rows = [
        [
            f"{text(called[pair.model])} against {text(called[pair.than])}",
            f"{pair.better} of {pair.episodes}",
            fixed(pair.median_difference_m, 2, _MM),
            _interval(pair),
        ]
        for pair in result.pairs
    ]
    words = (
        "Difference of the translation error, episode by episode; negative is better. The interval is that of the "
        "median, from resampling the episodes (bootstrap). It assumes that the episodes are independent draws of the "
        "motions to be predicted, and is somewhat too short if they are few."
    )
    header = ["paired", "better in", "median difference [mm]", "95 % interval [mm]"]
    return table(header, rows, numeric=(1, 2, 3)) + paragraph(words, "soft")


def _interval(pair: PairedDifference) -> str:
    if pair.interval_95_m is None:
        return f"– (fewer than {LEAST_EPISODES} episodes)"
    low, high = pair.interval_95_m
    return f"{fixed(low, 2, _MM)} to {fixed(high, 2, _MM)}"


# The player


def _player(replay: Replay, filmed: bool) -> str:
    phases = "".join(f'<span><i style="background:var(--{name})"></i>{name}</span>' for name in PHASES)
    curves = "".join(
        f'<div><svg class="chart" data-part="{name}" viewBox="0 0 520 {height}" role="img" aria-label="{label}"></svg>'
        "</div>"
        for name, height, label in (
            ("move", 150, "translation error over time"),
            ("turn", 150, "rotation error over time"),
            ("z", 150, "short predictions over time"),
            ("phase", 18, "phase over time"),
        )
    )
    left_out = ""
    if replay.left_out:
        left_out = f"To keep the page small, the player omits the episodes {', '.join(replay.left_out)}."
    words = (
        "Without colour: measured. In colour: predicted, open loop from the warm-up (shaded). The lower curve shows "
        f"the residuals of short predictions: segments of at most {CUTS.contact_s:g} s in contact and "
        f"{CUTS.flight_s:g} s in flight, each from the start that fits it best; the dashed line is the noise. Click or "
        "drag on a curve to move in time."
    )
    if filmed:
        words += " Below: video frames after the warm-up; the difference is amplified four times."
    return section(
        "Motion, measured and predicted",
        paragraph(words),
        '<div id="replay"><div class="controls"><label>Episode <select data-part="episode" aria-label="episode">'
        '</select></label><div class="toggles" data-part="models"></div></div>'
        '<div class="replay"><div><h3>From the side [m]; along the motion, <span data-part="bearing"></span>° from x, '
        'and up</h3><canvas data-part="side"></canvas><h3>From above [m]; along the motion and across</h3>'
        f'<canvas data-part="top"></canvas></div><div>{curves}<div class="phases">{phases}</div></div></div>'
        '<div class="controls"><button type="button" data-part="play">Play</button><select data-part="speed" '
        'aria-label="speed"><option value="1">real time</option><option value="0.25" selected>4 times slower</option>'
        '<option value="0.05">20 times slower</option></select><input type="range" min="0" value="0" '
        'data-part="slider" aria-label="time"><output data-part="clock"></output></div>'
        '<div class="soft" data-part="values"></div><div class="film" data-part="film"></div></div>',
        paragraph(left_out, "soft") if left_out else "",
    )


def _go(episode: str, time_s: float) -> str:
    """Return a button that moves the player to a moment."""
    place = f'data-episode="{text(episode)}" data-time="{time_s:.6g}"'
    return f'<button type="button" class="go" {place}>show</button>'


# Tables


def _worst(result: CompareResult, names: Sequence[str]) -> str:
    header = ["", "model", "episode", "from [s]", "to [s]", "phase", "quantity", "residual / noise"]
    rows = [
        [
            _go(moment.episode, moment.t0_s),
            text(name),
            text(moment.episode),
            f"{moment.t0_s:.3f}",
            f"{moment.t1_s:.3f}",
            moment.phase,
            text(moment.quantity),
            number(moment.z),
        ]
        for model, name in zip(result.models, names, strict=True)
        for moment in model.worst
    ]
    if not rows:
        return ""
    words = (
        "The segments of the motion with the largest residuals of short predictions. x, y, z: position in the world "
        "frame; rx, ry, rz: rotation about the body's axes. Click a heading to sort."
    )
    return section("Worst moments", paragraph(words), table(header, rows, (3, 4, 7), sorts=True))


def _phases(result: CompareResult, names: Sequence[str]) -> str:
    header = ["phase", "model", "frames", "reduced χ²", "position rms [mm]", "rotation rms [deg]", *FREEDOMS]
    rows = []
    for phase in PHASES:
        for model, name in zip(result.models, names, strict=True):
            figures = model.by_phase.get(phase)
            if figures is None:
                continue
            rows.append(
                [
                    f'<i style="background:var(--{phase});display:inline-block;width:12px;height:12px"></i> {phase}',
                    text(name),
                    str(figures.frames),
                    number(figures.reduced_chi2),
                    fixed(figures.position_rms_m, 2, _MM),
                    fixed(figures.rotation_rms_deg, 2),
                    *(_heat(figures.sigmas.get(freedom)) for freedom in FREEDOMS),
                ]
            )
    if not rows:
        return ""
    noise = f"{fixed(result.measurement_std['position_m'], 2, _MM)} mm"
    if any(model.rotation_error_deg is not None for model in result.models):
        noise += f" and {number(math.degrees(result.measurement_std['rotation_rad']), 2)} deg"
    words = (
        f"Short predictions by phase, in units of the noise ({noise} per axis). "
        "Reduced χ² is the mean square, corrected for the fitted starts: about 1 where the model explains the data. "
        "Residuals of one impact are correlated, so their χ² is not a test. The last columns are the root mean square "
        "residuals of each degree of freedom; because the starts are fitted, they are below 1 where the model is "
        "complete. Noise that the manifest does not give is estimated from the roughness of the tracks, which "
        "underestimates it for smoothed tracks."
    )
    return section(
        "By phase and degree of freedom", paragraph(words), table(header, rows, range(2, len(header)), sorts=True)
    )


def _heat(value: float | None) -> str:
    """Return a cell's number with the strength of its colour, a variable of the style sheet."""
    if value is None:
        return "–"
    strength = min(max((value - 1) / (HOTTEST - 1), 0.0), 1.0) * 0.6
    return f'<span class="heat" style="--heat:{strength:.2f}">{number(value, 2)}</span>'


def _episodes(result: CompareResult, models: Sequence[ComparedModel]) -> str:
    names = [one.short_name for one in models]
    header = ["", "episode", "length [s]"]
    for name in names:
        header += [f"{name} [mm]", f"{name} [deg]", f"{name} χ²"]
    errors = [{e.episode: e for e in model.per_episode} for model in result.models]
    rows = []
    for episode in dict.fromkeys(name for by_episode in errors for name in by_episode):
        first = next(by_episode[episode] for by_episode in errors if episode in by_episode)
        row = [_go(episode, 0.0), text(episode), f"{first.duration_s:.2f}"]
        for by_episode, model in zip(errors, models, strict=True):
            one = by_episode.get(episode)
            row += [
                fixed(one.translation_error_m if one else None, 2, _MM),
                fixed(one.rotation_error_deg if one else None, 2),
                number(model.episode_chi2(episode)),
            ]
        rows.append(row)
    words = "Open-loop errors, averaged over the frames after the warm-up; χ²: reduced χ² of the short predictions."
    return section("By episode", paragraph(words), table(header, rows, range(2, len(header)), sorts=True))


def _provenance(result: CompareResult, models: Sequence[ComparedModel]) -> str:
    rows = [("capture", text(result.capture)), ("split", f"{text(result.split)}, {result.episodes} episodes")]
    for one in models:
        source = one.model.file.provenance
        fitted = ", ".join(f"{name} {version}" for name, version in source.versions.items())
        rows.append((f"model {one.short_name}", f"{text(one.name)}; seed {source.seed}; {text(fitted)}"))
    return section("Provenance", facts(rows))
