"""`cgwm demo`: the whole pipeline on a scene that it makes itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .options import Debug, DeviceName, Json, Overwrite, Quiet
from .run import running

if TYPE_CHECKING:
    from ..schemas import ComparedParameter, DemoResult, DemoTarget, ImagesOnlyFit


def demo(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The directory to write.", show_default=False)],
    scene: Annotated[
        Literal["fall", "push"],
        typer.Option("--scene", help="fall: an object dropped and bouncing; push: one pushed by a fingertip."),
    ] = "fall",
    renderer: Annotated[
        Literal["raycast"], typer.Option("--renderer", help="How the photos are made; raycast needs no OpenGL.")
    ] = "raycast",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Object, parameters and noise vary with it.")] = 0,
    device: Annotated[
        DeviceName, typer.Option("--device", help="auto takes a CUDA device where there is one.")
    ] = "auto",
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """The whole pipeline on a scene that it makes itself, with a report at the end."""
    with running(json=json, quiet=quiet, debug=debug) as emit:
        from ..pipeline.demo import run_demo

        emit(run_demo(out, scene, seed, renderer, device, overwrite), lambda result: _summary(result, out))


def _summary(result: DemoResult, out: Path) -> str:
    from .output import table, warnings

    target = [
        [t.name, *(_figure(value, t.unit) for value in (t.value, t.frozen, t.ballistic)), _wanted(t)]
        for t in result.targets
    ]
    parameters = [_row(p) for p in result.parameters if p.parameter.interval_95 is not None]
    lines = [
        result.verdict,
        table(target, ["medians over the test episodes", "model", "frozen", "ballistic", "target"]),
        table(parameters, ["parameter", "estimate", "95 % interval", "truth", "unit"]),
        _images_only(result.images_only),
        f"{sum(result.seconds.values()):.0f} s, at most {result.peak_memory_bytes / 2**30:.1f} GiB of memory.",
        *warnings(result.warnings),
        f"Report: {out / result.paths['report']}",
    ]
    return "\n".join(line for line in lines if line)


def _row(compared: ComparedParameter) -> list[str]:
    from .output import quantity

    parameter = compared.parameter
    low, high = parameter.interval_95 or (None, None)
    span = f"{quantity(low)} to {quantity(high)}"
    return [parameter.name, quantity(parameter.estimate), span, quantity(compared.true_value), parameter.unit]


def _images_only(fit: ImagesOnlyFit) -> str:
    from .output import millimetres

    if fit.evaluation is None:
        return f"Physics from the video frames alone did not converge: {fit.message}"
    turn = fit.evaluation.rotation_error_deg
    words = f"Physics from the video frames alone: {millimetres(fit.evaluation.translation_error_m.median)}"
    return words + (f" and {turn.median:.1f} deg" if turn else "") + " (medians; no target is set)."


def _wanted(target: DemoTarget) -> str:
    return f"{'<' if target.better == 'below' else '>='} {_figure(target.target, target.unit)}, " + (
        "met" if target.met else "missed"
    )


def _figure(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value * 1e3:.1f} mm" if unit == "m" else f"{value:.1f} {unit}"
