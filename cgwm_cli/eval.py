"""The verb `cgwm eval`: evaluate a model against measurements."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .execution import Emit, loading
from .options import AcceptUnits, AnyDevice, TrustEffects, require_warmup, trust
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import ErrorSummary, EvalResult


@verb
def evaluate(
    emit: Emit,
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="The model's directory.", show_default=False)],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="A capture with tracks, or a dataset.", show_default=False)
    ],
    split: Annotated[str, typer.Option("--split", metavar="NAME", help="The episodes to predict.")] = "test",
    warmup_s: Annotated[
        float, typer.Option("--warmup-s", help="Length of the start that the model may see [s].")
    ] = 0.1,
    device: AnyDevice = "auto",
    trust_effects: TrustEffects = "",
    accept_units: AcceptUnits = False,
) -> None:
    """Evaluate a model against measurements: open-loop errors of position, rotation and image."""
    trust(trust_effects)
    with loading():
        from ..pipeline.evaluate import evaluate as work
    require_warmup(warmup_s)
    emit(work(model, target, split, warmup_s, device, accept_units), _summary)


def _summary(result: EvalResult) -> str:
    from .output import millimetres, table, warnings

    move, turn = result.translation_error_m, result.rotation_error_deg
    count = f"{result.episodes} episode{'' if result.episodes == 1 else 's'}"
    head = f"{count}, open loop: {millimetres(move.median)}"
    head += f" and {turn.median:.1f} deg (medians)." if turn else " (median)."
    rows = [_row("translation error [mm]", move, 1e3)]
    rows += [
        _row(name, summary, scale)
        for name, summary, scale in (
            ("rotation error [deg]", turn, 1.0),
            ("PSNR, object [dB]", result.psnr_object_db, 1.0),
            ("PSNR, frame [dB]", result.psnr_db, 1.0),
            ("SSIM, frame [%]", result.ssim, 100.0),
            ("state-fitted residual [mm]", result.state_fitted_residual_m, 1e3),
            ("noise of the start alone [mm]", result.state_noise_floor_m, 1e3),
        )
        if summary is not None
    ]
    rows += [_baseline(name, figures) for name, figures in result.baselines.items()]
    return "\n".join([head, table(rows, ["", "mean", "median", "final"]), *warnings(result.warnings)])


def _row(name: str, summary: ErrorSummary, scale: float) -> list[str]:
    values = (summary.mean, summary.median, summary.final)
    return [name, *("-" if value is None else f"{value * scale:.1f}" for value in values)]


def _baseline(name: str, figures: dict[str, Any]) -> list[str]:
    errors = figures.get("translation_error_m") or {}
    values = (errors.get("mean"), errors.get("median"), errors.get("final"))
    return [f"({name}: translation [mm])", *("-" if value is None else f"{value * 1e3:.1f}" for value in values)]
