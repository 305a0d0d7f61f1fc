"""The report of a demo: a self-contained HTML page, and its figures as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...schemas import ComparedParameter, DemoResult, DemoTarget, EvalResult
from ..rendering.contact_sheets import FrameStrip, RolloutTile, depth_colors, jpeg_uri, label_colors, png_uri
from ..report.charts import interval_svg
from ..report.page import cautions, facts, fixed, number, page, paragraph, section, table, text, unit_text, way_link
from .episode_section import curves_section, film_section
from .verdict import shown

REPORT_HTML = "report.html"
REPORT_JSON = "report.json"

_MM = 1e3


@dataclass(frozen=True)
class ReportPictures:
    """Pictures of the page."""

    strips: Sequence[FrameStrip] = ()
    """Test episodes, real and predicted, by camera."""
    rollouts: Sequence[RolloutTile] = ()
    """One moment of each synthesized rollout."""


def write_report(folder: Path, result: DemoResult, pictures: ReportPictures) -> None:
    """Write `report.html` and `report.json` into a directory.

    Args:
        folder: The directory, which exists.
        result: The figures.
        pictures: The pictures, which only the page contains.
    """
    (folder / REPORT_JSON).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
    (folder / REPORT_HTML).write_text(report_html(result, pictures), encoding="utf-8")


def report_html(result: DemoResult, pictures: ReportPictures) -> str:
    """Return the HTML page of the report."""
    film, style = film_section(pictures.strips)
    body = [
        f"<h1>cgwm demo · scene {text(result.scene)} · seed {result.seed}</h1>",
        f'<p class="verdict">{text(result.verdict)}</p>',
        f'<div class="cards">{"".join(_card(target) for target in result.targets)}</div>',
        cautions(result.warnings),
        film,
        curves_section(result.curves),
        _errors(result.evaluation, result.selection),
        _parameters(result.parameters),
        _images_only(result),
        _calibration(result),
        _splats(result),
        _rollouts(result, pictures.rollouts),
        _timings(result),
        _files(result),
        _provenance(result),
    ]
    return page(f"cgwm demo: {result.scene}, seed {result.seed}", [part for part in body if part], style)


def _card(target: DemoTarget) -> str:
    verb = "below" if target.better == "below" else "at least"
    mark = '<span class="good">met</span>' if target.met else '<span class="bad">missed</span>'
    rows = [("target", f"{verb} {shown(target, target.target)}, {mark}")]
    rows += [
        (name, shown(target, value))
        for name, value in (("frozen object", target.frozen), ("ballistic object", target.ballistic))
        if value is not None
    ]
    listed = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows)
    return (
        f'<div class="card"><div>{text(target.name)}</div>'
        f'<div class="value{"" if target.met else " bad"}">{shown(target, target.value)}</div><dl>{listed}</dl></div>'
    )


def _errors(evaluation: EvalResult, selection: str) -> str:
    header = ["", "translation [mm]", "at the end [mm]", "rotation [deg]", "at the end [deg]"]
    header += ["PSNR object [dB]", "PSNR frame [dB]", "state-fitted [mm]", "start's noise [mm]"]
    rows = [
        [
            f"episode {text(e.episode)}, {e.duration_s:.2f} s",
            fixed(e.translation_error_m, 1, _MM),
            fixed(e.translation_final_m, 1, _MM),
            fixed(e.rotation_error_deg),
            fixed(e.rotation_final_deg),
            fixed(e.psnr_object_db),
            fixed(e.psnr_db),
            fixed(e.state_fitted_residual_m, 1, _MM),
            fixed(e.state_noise_floor_m, 1, _MM),
        ]
        for e in evaluation.per_episode
    ]
    episodes = len(rows)
    rows.append(_summary_row("median", evaluation.model_dump()))
    rows += [_summary_row(f"{name} object, median", figures) for name, figures in evaluation.baselines.items()]
    words = (
        "Errors are averaged over the frames after the warm-up. State-fitted: the start is fitted to the whole "
        "episode, so the residual is what the model cannot follow. Start's noise: the error of a perfect model due to "
        "the uncertainty of the start."
    )
    return section(
        "Errors by episode",
        table(header, rows, numeric=range(1, len(header)), strong=[episodes]),
        paragraph(words, "soft"),
        paragraph(selection, "soft") if selection else "",
        cautions(evaluation.warnings),
    )


def _summary_row(name: str, figures: dict) -> list[str]:
    def of(key: str, which: str, scale: float = 1.0) -> str:
        return fixed((figures.get(key) or {}).get(which), 1, scale)

    return [
        text(name),
        of("translation_error_m", "median", _MM),
        of("translation_error_m", "final", _MM),
        of("rotation_error_deg", "median"),
        of("rotation_error_deg", "final"),
        of("psnr_object_db", "median"),
        of("psnr_db", "median"),
        of("state_fitted_residual_m", "median", _MM),
        of("state_noise_floor_m", "median", _MM),
    ]


# Parameters


def _parameters(parameters: Sequence[ComparedParameter]) -> str:
    judged = [p.covered for p in parameters if p.covered is not None]
    words = (
        "True values are known only because the scene is simulated; the fit never sees them. The simulator's "
        "contact law (MuJoCo's soft constraints) differs from the model's, so even a perfect fit need not return its "
        "parameters."
    )
    if judged:
        words += f" {sum(judged)} of {len(judged)} intervals contain the true value."
    return section("Parameters", _parameter_table(parameters), paragraph(words, "soft"))


def _parameter_table(parameters: Sequence[ComparedParameter]) -> str:
    rows = []
    for compared in parameters:
        p = compared.parameter
        span = f"{number(p.interval_95[0])} to {number(p.interval_95[1])}" if p.interval_95 else "–"
        drawn = interval_svg(p.estimate, p.interval_95, compared.true_value) if p.interval_95 else ""
        state = text(p.state.replace("_", " "))
        rows.append(
            [
                f"<code>{text(p.name)}</code>",
                number(p.estimate),
                span,
                drawn,
                number(compared.true_value),
                unit_text(p.unit),
                f'<span class="bad">{state}</span>' if p.state in ("on_bound", "not_observable") else state,
                f"{p.bounds[0]:g} to {p.bounds[1]:g}".replace("-", "−") if p.bounds else "–",
                "" if p.state == "fitted" else text(p.note),
            ]
        )
    header = ["parameter", "estimate", "95 % interval", "", "true value", "unit", "state", "bounds", "note"]
    return table(header, rows, numeric=(1, 2, 4, 7))


def _images_only(result: DemoResult) -> str:
    fit = result.images_only
    title = "Physics from the video frames alone"
    intro = (
        "The same model fitted without the pose track, by comparing rendered and recorded frames of the training "
        "video. It has no target."
    )
    if fit.evaluation is None:
        return section(title, paragraph(intro), paragraph(f"It did not converge: {fit.message}", "bad"))
    rows = [_summary_row("from images alone", fit.evaluation.model_dump())]
    rows.append(_summary_row("from the pose track", result.evaluation.model_dump()))
    header = ["medians over the test episodes", "translation [mm]", "at the end [mm]"]
    header += ["rotation [deg]", "at the end [deg]"]
    fitted = [p for p in fit.parameters if p.parameter.state not in ("given", "derived")]
    return section(
        title,
        paragraph(intro),
        table(header, [row[: len(header)] for row in rows], numeric=range(1, len(header))),
        _parameter_table(fitted) if fitted else "",
    )


# The stages


def _calibration(result: DemoResult) -> str:
    check = result.calibration
    std = "" if check.scale_std is None else f"; stated standard error {number(100 * check.scale_std, 2)} %"
    rows = [
        ("photos registered", f"{check.photos_registered} of {check.photos}"),
        ("video cameras registered", f"{check.video_cameras_registered} of {check.video_cameras}"),
        (
            "camera centres against the true ones",
            f"median {fixed(check.center_error_median_m, 2, _MM)} mm, "
            f"at most {fixed(check.center_error_max_m, 2, _MM)} mm",
        ),
        ("scale against the true one", f"{100 * check.scale_error:+.3f} %{std}"),
        ("scale from", text(check.scale_source)),
        ("self-check against verified matches", "passed" if check.self_check else '<span class="bad">failed</span>'),
        ("mean reprojection error", f"{check.reprojection_error_px:.2f} px"),
    ]
    return section("Cameras", facts(rows))


def _splats(result: DemoResult) -> str:
    check = result.splats
    iou = "–" if check.mask_iou is None else f"{check.mask_iou:.3f}"
    rows = [
        ("photos held out", str(check.held_out_photos)),
        (
            "PSNR on them",
            f"{fixed(check.psnr_db)} dB whole, {fixed(check.psnr_object_db)} dB within the object",
        ),
        ("overlap of the masks on them (IoU)", iou),
        ("spheres of the background", str(check.scene_spheres)),
    ]
    for body in check.bodies:
        rows += [
            (
                f"spheres of '{body.body}'",
                f"{body.visual_spheres} visual, {body.collision_spheres} for collision",
            ),
            (
                f"collision surface of '{body.body}' against the true one",
                f"mean {fixed(body.surface_error_mean_m, 2, _MM)} mm, 95 % within "
                f"{fixed(body.surface_error_95_m, 2, _MM)} mm; signed mean {fixed(-body.surface_bias_m, 2, _MM)} mm "
                f"({'too small' if body.surface_bias_m > 0 else 'too large'})",
            ),
        ]
    return section("Looks and shape", facts(rows))


def _rollouts(result: DemoResult, rollouts: Sequence[RolloutTile]) -> str:
    data = result.dataset
    words = (
        f"{data.rollouts} rollouts with parameters drawn from the fit's uncertainty: {data.frames} labelled images, "
        f"{data.contacts} contacts, {data.bytes / 1e6:.1f} MB of HDF5, {data.frames_per_s:.1f} images/s."
    )
    pieces = [paragraph(words), *(paragraph(f"Note: {note}", "soft") for note in data.notes)]
    if rollouts:
        depth = np.concatenate([tile.depth_m[tile.depth_m > 0] for tile in rollouts])
        near, far = (float(np.percentile(depth, q)) for q in (1, 99)) if depth.size else (0.0, 1.0)
        rows = [f"<span>{tile.rollout}: {tile.time_s:.2f} s</span>" for tile in rollouts]
        rows += [f'<img alt="image of rollout {t.rollout}" src="{jpeg_uri(t.image)}">' for t in rollouts]
        rows += [
            f'<img alt="depth of rollout {t.rollout}" src="{jpeg_uri(depth_colors(t.depth_m, near, far))}">'
            for t in rollouts
        ]
        rows += [f'<img alt="mask of rollout {t.rollout}" src="{png_uri(label_colors(t.mask))}">' for t in rollouts]
        columns = f' style="grid-template-columns:repeat({len(rollouts)},minmax(100px,1fr))"'
        caption = f"From top to bottom: image; depth, bright {near:.2f} m to dark {far:.2f} m; mask."
        strip = f'<div class="scroll"><div class="strip"{columns}>{"".join(rows)}</div></div>'
        pieces.append(f"<figure>{strip}<figcaption>{caption}</figcaption></figure>")
    return section("Synthesized rollouts", *pieces)


def _timings(result: DemoResult) -> str:
    longest = max(result.seconds.values(), default=1.0) or 1.0
    lines = "".join(
        f"<tr><td>{text(name)}</td><td class=num>{seconds:.1f} s</td>"
        f'<td class=wide><span class="bar" style="width:{100 * seconds / longest:.1f}%"></span></td></tr>'
        for name, seconds in result.seconds.items()
    )
    total = (
        f"{sum(result.seconds.values()):.0f} s in all, at most {result.peak_memory_bytes / 2**30:.2f} GiB of memory."
    )
    return section("Time", f'<div class="scroll"><table class="bars">{lines}</table></div>', paragraph(total))


def _files(result: DemoResult) -> str:
    rows = [(name, way_link(path, path)) for name, path in result.paths.items()]
    words = "In the same directory as this page. The README has the command that makes each of them."
    return section("Files", paragraph(words), facts(rows))


def _provenance(result: DemoResult) -> str:
    source = result.provenance
    rows = [
        ("scene, seed, renderer", f"{text(result.scene)}, {result.seed}, {text(result.renderer)}"),
        ("device", text(result.device)),
        ("versions", text(", ".join(f"{name} {version}" for name, version in source.versions.items()))),
        *(
            (f"SHA-256 of {name}", f'<code class="long">{digest}</code>')
            for name, digest in source.input_sha256.items()
        ),
        ("settings of the fit", _code(json.dumps(source.config))),
    ]
    return section("Provenance", facts(rows))


def _code(words: str) -> str:
    return f'<code class="long">{text(words)}</code>'
