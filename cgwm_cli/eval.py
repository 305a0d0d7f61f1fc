"""The verb `cgwm eval`: evaluate a model against measurements."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .execution import Emit, loading
from .options import AcceptUnits, AnyDevice, Overwrite, TrustEffects, require_models_first, require_warmup, trust
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import EpisodeErrors, ErrorSummary, EvalResult

Reference = Literal["auto", "tracks", "images"]


@verb
def evaluate(
    emit: Emit,
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="The model's directory.", show_default=False)],
    target: Annotated[
        Path,
        typer.Argument(metavar="TARGET", help="A capture with tracks or videos, or a dataset.", show_default=False),
    ],
    split: Annotated[str, typer.Option("--split", metavar="NAME", help="The episodes to predict.")] = "test",
    warmup_s: Annotated[
        float, typer.Option("--warmup-s", help="Length of the start that the model may see [s].")
    ] = 0.1,
    reference: Annotated[
        Reference,
        typer.Option(
            "--reference",
            help="Compare with measured tracks, or with poses found in the images of the videos; auto takes tracks "
            "where the split has any.",
        ),
    ] = "auto",
    page: Annotated[
        Path | None,
        typer.Option(
            "--page",
            metavar="FILE",
            help="Write a page with the figures over time and the frames; one of the same model and capture is "
            "replaced.",
            show_default=False,
        ),
    ] = None,
    device: AnyDevice = "auto",
    overwrite: Overwrite = False,
    trust_effects: TrustEffects = "",
    accept_units: AcceptUnits = False,
) -> None:
    """Evaluate a model against measurements: open-loop errors of position, rotation and image."""
    trust(trust_effects)
    with loading():
        from ..pipeline.evaluate import evaluate as work
    require_warmup(warmup_s)
    require_models_first("eval", [model], target)
    emit(work(model, target, split, warmup_s, device, accept_units, reference, page, overwrite), _summary)


def _summary(result: EvalResult) -> str:
    from .output import millimetres, table, warnings

    move, turn = result.translation_error_m, result.rotation_error_deg
    count = f"{result.episodes} episode{'' if result.episodes == 1 else 's'}"
    head = f"{count}, open loop: {millimetres(move.median)}"
    head += f" and {turn.median:.1f} deg (medians)." if turn else " (median)."
    rows = [_row(name, summary, scale) for name, summary, scale in _figures(result) if summary is not None]
    rows += [_baseline(name, figures) for name, figures in result.baselines.items()]
    lines = [head, table(rows, ["", "mean", "median", "final"]), *_by_images(result), *warnings(result.warnings)]
    return "\n".join([*lines, *([f"Page: {result.report}"] if result.report else [])])


def _figures(result: EvalResult) -> tuple[tuple[str, ErrorSummary | None, float], ...]:
    """Return what was measured: its name with the unit, the figures, and their factor to that unit."""
    return (
        ("translation error [mm]", result.translation_error_m, 1e3),
        ("rotation error [deg]", result.rotation_error_deg, 1.0),
        ("PSNR, object [dB]", result.psnr_object_db, 1.0),
        ("PSNR, frame [dB]", result.psnr_db, 1.0),
        ("SSIM, frame [%]", result.ssim, 100.0),
        ("IoU of silhouette and mask [%]", result.mask_iou, 100.0),
        ("their centroids apart [px]", result.centroid_error_px, 1.0),
        ("their outlines apart [px]", result.outline_error_px, 1.0),
        ("centroids, triangulated [mm]", result.centroid_error_m, 1e3),
        ("state-fitted residual [mm]", result.state_fitted_residual_m, 1e3),
        ("noise of the start alone [mm]", result.state_noise_floor_m, 1e3),
    )


def _by_images(result: EvalResult) -> list[str]:
    """Return the episodes with their intervals, and what these figures do not show; nothing for measured tracks."""
    if result.reference == "tracks":
        return []
    return [
        *map(_episode, result.per_episode),
        "Poses were found in the videos, with the model's shape and colours and the calibrated cameras: an error of "
        "the physics is in these figures, one of shape, scale or cameras is not. In brackets: 95 %.",
    ]


def _episode(one: EpisodeErrors) -> str:
    parts = [f"{_millimetres(one.translation_error_m, one.translation_interval_95_m)}"]
    if one.rotation_error_deg is not None:
        parts.append(f"{one.rotation_error_deg:.1f} deg" + _span(one.rotation_interval_95_deg, 1.0))
    if one.centroid_error_m is not None:
        parts.append(f"by masks alone {_millimetres(one.centroid_error_m, one.centroid_interval_95_m)}")
    return f"{one.episode}: {', '.join(parts)}"


def _millimetres(value_m: float, interval_m: tuple[float, float] | None) -> str:
    return f"{1e3 * value_m:.1f} mm" + _span(interval_m, 1e3)


def _span(interval: tuple[float, float] | None, scale: float) -> str:
    return "" if interval is None else f" ({interval[0] * scale:.1f} to {interval[1] * scale:.1f})"


def _row(name: str, summary: ErrorSummary, scale: float) -> list[str]:
    values = (summary.mean, summary.median, summary.final)
    return [name, *("-" if value is None else f"{value * scale:.1f}" for value in values)]


def _baseline(name: str, figures: dict[str, Any]) -> list[str]:
    errors = figures.get("translation_error_m") or {}
    values = (errors.get("mean"), errors.get("median"), errors.get("final"))
    return [f"({name}: translation [mm])", *("-" if value is None else f"{value * 1e3:.1f}" for value in values)]
