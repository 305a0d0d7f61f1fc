"""The verb `cgwm demo`: run the whole pipeline on a simulated scene, or search for a hidden effect."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .execution import Emit, loading
from .options import AnyDevice, Overwrite
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import (
        ComparedParameter,
        ControlDemoResult,
        DemoResult,
        DemoTarget,
        ImagesOnlyFit,
        MysteryResult,
        WorldDemoResult,
    )


@verb
def demo(
    emit: Emit,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The directory to write.", show_default=False)],
    scene: Annotated[
        Literal["fall", "push", "control", "bin", "ramp", "mystery"],
        typer.Option(
            "--scene",
            help="fall: an object falls and bounces; push: a fingertip pushes an object; "
            "control: a fitted model plans the pushes that bring its object to a pose; bin: five objects are dropped "
            "into a tray; ramp: a block slides and a ball rolls down onto a floor of another material; mystery: fit, "
            "compare and diagnose search for an effect that is hidden in the physics or the measurement.",
        ),
    ] = "fall",
    renderer: Annotated[
        Literal["raycast"], typer.Option("--renderer", help="Renderer of the photos; raycast needs no OpenGL.")
    ] = "raycast",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of object, parameters and noise.")] = 0,
    device: AnyDevice = "auto",
    overwrite: Overwrite = False,
) -> None:
    """Run the whole pipeline on a simulated scene, and write a report."""
    if scene == "mystery":
        with loading():
            from ..pipeline.demo import run_mystery

        emit(run_mystery(out, seed, device, overwrite), lambda result: _story(result, out))
        return
    if scene == "control":
        with loading():
            from ..pipeline.demo import run_control_demo

        emit(run_control_demo(out, seed, device, overwrite), lambda result: _fitted(result, out))
        return
    if scene in ("bin", "ramp"):
        with loading():
            from ..pipeline.demo import run_world

        emit(run_world(out, scene, seed, device, overwrite), lambda result: _world(result, out))
        return
    with loading():
        from ..pipeline.demo import run_demo

    emit(run_demo(out, scene, seed, renderer, device, overwrite), lambda result: _summary(result, out))


def _story(result: MysteryResult, out: Path) -> str:
    """Summarise the mystery in the order in which it was solved."""
    from .output import millimetres, quantity, warnings

    errors = [millimetres(model.translation_error_m.median) for model in result.comparison.models]
    lines = [
        f"fit       m0, from {result.train_episodes} episodes of a {result.body}",
        f"compare   m0: median error {errors[0]} on {result.test_episodes} episodes that it has not seen",
        f"diagnose  {result.diagnosis.sentence}",
    ]
    if result.diagnosis.selected:
        numbers = [c.parameter for c in result.parameters]
        listed = ", ".join(f"{p.name} = {quantity(p.estimate)} +- {quantity(p.std_error)} {p.unit}" for p in numbers)
        lines.append(f"add       m1, with {listed}")
        lines.append(f"compare   {result.comparison.verdict}")
    lines.append(f"hidden    {result.sentence}" + "".join(f" True: {words}." for words in _truth(result)))
    lines += [*warnings(result.warnings), f"{sum(result.seconds.values()):.0f} s."]
    return "\n".join([*lines, f"Report: {out / result.paths['report']}"])


def _truth(result: MysteryResult) -> list[str]:
    """Return the numbers of each hidden effect."""
    from .output import quantity

    return [
        ", ".join(f"{name} = {v if isinstance(v, list) else quantity(v)}" for name, v in effect.values.items())
        for effect in result.hidden
    ]


def _world(result: WorldDemoResult, out: Path) -> str:
    from .output import millimetres

    error = millimetres(result.evaluation.translation_error_m.median)
    return _fitted(result, out, f"{error} open-loop error on {result.evaluation.episodes} test episodes (median).")


def _fitted(result: ControlDemoResult | WorldDemoResult, out: Path, *figures: str) -> str:
    """Return verdict, fitted parameters beside the truth, further figures, time and warnings."""
    from .output import table, warnings

    rows = [_row(p) for p in result.parameters if p.parameter.state == "fitted"]
    lines = [
        result.verdict,
        table(rows, ["parameter", "estimate", "95 % interval", "truth", "unit"]),
        *figures,
        f"{sum(result.seconds.values()):.0f} s.",
        *warnings(result.warnings),
        f"Report: {out / result.paths['report']}",
    ]
    return "\n".join(lines)


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
    return words + (f" and {turn.median:.1f} deg" if turn else "") + " (medians; without a target)."


def _wanted(target: DemoTarget) -> str:
    return f"{'<' if target.better == 'below' else '>='} {_figure(target.target, target.unit)}, " + (
        "met" if target.met else "missed"
    )


def _figure(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value * 1e3:.1f} mm" if unit == "m" else f"{value:.1f} {unit}"
