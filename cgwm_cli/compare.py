"""The verb `cgwm compare`: compare models, and show where each of them fails."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit, loading
from .options import AcceptUnits, AnyDevice, Overwrite, TrustEffects, require_models_first, require_warmup, trust
from .verb import verb

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..schemas import CompareResult, ModelComparison, PairedDifference


@verb
def compare(
    emit: Emit,
    models: Annotated[
        list[Path],
        typer.Argument(metavar="MODEL...", help="Directories of models, the base first.", show_default=False),
    ],
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture with tracks.", show_default=False)],
    split: Annotated[str, typer.Option("--split", metavar="NAME", help="The episodes to predict.")] = "test",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="The page to write (compare-MODEL-....html beside the first model; one of the same models and capture "
            "is replaced).",
            show_default=False,
        ),
    ] = None,
    warmup_s: Annotated[
        float, typer.Option("--warmup-s", help="Length of the start that the models may see [s].")
    ] = 0.1,
    device: AnyDevice = "auto",
    overwrite: Overwrite = False,
    trust_effects: TrustEffects = "",
    accept_units: AcceptUnits = False,
) -> None:
    """Compare models on measured motion: where and when each fails, as figures and as an HTML page."""
    trust(trust_effects)
    with loading():
        from ..pipeline.compare import compare as work
    require_warmup(warmup_s)
    require_models_first("compare", models, capture)
    from ..pipeline.compare.page import default_page

    page = out or default_page(models, split)
    emit(work(models, capture, split, page, warmup_s, device, overwrite, accept_units), _summary)


def _summary(result: CompareResult) -> str:
    from .output import table, warnings

    header = ["", *(model.model for model in result.models)]
    rows = [*_error_rows(result.models), *_chi2_rows(result.models)]
    lines = [result.verdict, table(rows, header), *(_pair(pair) for pair in result.pairs)]
    said = [*result.warnings, *dict.fromkeys(words for model in result.models for words in model.warnings)]
    return "\n".join([*lines, *warnings(said), *([f"Page: {result.report}"] if result.report else [])])


def _error_rows(models: Sequence[ModelComparison]) -> list[list[str]]:
    """Return one row for each median error that at least one model has."""
    return [
        [name, *(_figure(model, key, scale) for model in models)]
        for name, key, scale in (
            ("translation error, median [mm]", "translation_error_m", 1e3),
            ("rotation error, median [deg]", "rotation_error_deg", 1.0),
            ("PSNR, object, median [dB]", "psnr_object_db", 1.0),
            ("state-fitted residual, median [mm]", "state_fitted_residual_m", 1e3),
            ("noise of the start alone, median [mm]", "state_noise_floor_m", 1e3),
        )
        if any(getattr(model, key) is not None for model in models)
    ]


def _chi2_rows(models: Sequence[ModelComparison]) -> list[list[str]]:
    """Return the reduced chi2 of short predictions, in total and in each phase that occurs."""
    rows = [["short predictions, reduced chi2", *(_number(model.reduced_chi2) for model in models)]]
    for phase in models[0].by_phase:
        found = [model.by_phase[phase] for model in models]
        if any(figures is not None for figures in found):
            rows.append([f"  in {phase}", *(_number(figures.reduced_chi2 if figures else None) for figures in found)])
    return rows


def _figure(model: ModelComparison, key: str, scale: float) -> str:
    summary = getattr(model, key)
    return "-" if summary is None else f"{summary.median * scale:.1f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _pair(pair: PairedDifference) -> str:
    change = f"median difference {pair.median_difference_m * 1e3:+.1f} mm"
    if pair.interval_95_m is not None:
        low, high = (1e3 * value for value in pair.interval_95_m)
        change += f" (95 %: {low:+.1f} to {high:+.1f})"
    return f"{pair.model} against {pair.than}: better in {pair.better} of {pair.episodes} episodes, {change}."
