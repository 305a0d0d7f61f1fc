"""The verb `cgwm fit`: fit a world model to a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .execution import Emit, loading
from .options import AcceptUnits, ConfigFile, Device, Overwrite, Seed, Settings, TrustEffects, trust
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import FittedParameter, ModelFile


@verb
def fit(
    emit: Emit,
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="The capture's directory.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="MODEL", help="The directory to write.", show_default=False)
    ],
    stage: Annotated[
        Literal["all", "sg-gs", "phys-geo"],
        typer.Option("--stage", help="all: the stages that the capture has inputs for."),
    ] = "all",
    parent: Annotated[
        Path | None, typer.Option("--from", metavar="MODEL", help="Start from a fitted model, which is not changed.")
    ] = None,
    supervise: Annotated[
        Literal["tracks", "images", "both"] | None,
        typer.Option("--supervise", show_default="tracks", help="Measurement that the motion is fitted to."),
    ] = None,
    split: Annotated[str, typer.Option("--split", metavar="NAME", help="The episodes to fit.")] = "train",
    effects: Annotated[
        str | None,
        typer.Option(
            "--effects",
            metavar="NAME,NAME",
            help="Effects to add and fit ('cgwm effects list'), or custom ones: file.py:Class.",
            show_default=False,
        ),
    ] = None,
    spheres: Annotated[
        int | None,
        typer.Option("--spheres", metavar="N", help="Fit the background with up to N spheres, placed where needed."),
    ] = None,
    joint: Annotated[
        bool | None,
        typer.Option(
            "--joint/--two-step",
            show_default=False,
            help="Fit geometry and colours of bodies together, or geometry first (the default with geometry maps).",
        ),
    ] = None,
    exposure: Annotated[
        bool | None, typer.Option("--exposure", help="Estimate exposure and white balance of every photo.")
    ] = None,
    refine_poses: Annotated[
        bool | None, typer.Option("--refine-poses", help="Refine the poses of the photos' cameras first.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted fit of MODEL; keep a finished one.")
    ] = False,
    collision: Annotated[
        Literal["distilled", "visual"] | None,
        typer.Option(
            "--collision", show_default="distilled", help="Collision spheres: a small set, or the visual spheres."
        ),
    ] = None,
    seed: Seed = None,
    device: Device = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
    set_: Settings = None,
    trust_effects: TrustEffects = "",
    accept_units: AcceptUnits = False,
) -> None:
    """Fit a world model to a capture: shape and appearance (sg-gs), then physics (phys-geo)."""
    trust(trust_effects)
    with loading():
        from ..pipeline.fit import fit_or_keep as work
    from ..schemas import PhysConfig, SplatConfig
    from .settings import StageSettings

    settings = StageSettings({"sg-gs": SplatConfig, "phys-geo": PhysConfig}, config, set_)
    looks = {
        "spheres": spheres,
        "joint": joint,
        "exposure": exposure,
        "refine_poses": refine_poses,
        "collision": collision,
    }
    names = None if effects is None else [name.strip() for name in effects.split(",")]
    motion = {"supervise": supervise, "effects": names}
    splats = settings.configure("sg-gs", SplatConfig, seed=seed, device=device, **looks)
    physics = settings.configure("phys-geo", PhysConfig, seed=seed, device=device, **motion)
    fitted, kept = work(capture, out, stage, parent, split, splats, physics, overwrite, resume, accept_units)
    emit(fitted, lambda model: _summary(model, out, kept))


def _summary(model: ModelFile, out: Path, kept: bool = False) -> str:
    from .output import table, warnings

    bodies = ", ".join(f"{body.name} ({body.motion})" for body in model.bodies) or "the background, no bodies"
    state = "with physics" if model.contact else "shape and appearance only, without physics"
    head = f"{out} is already the result of this command" if kept else f"Fitted {out}"
    useless = [] if model.not_described is None else [model.not_described.sentence]
    lines = [*useless, f"{head}: {bodies}; {state}."]
    if model.parameters:
        lines.append(
            table([_row(p) for p in model.parameters], ["parameter", "estimate", "95 % interval", "unit", "state"])
        )
    if model.choice is not None:
        lines.append(model.choice.sentence)
    return "\n".join([*lines, *warnings(model.warnings)])


def _row(parameter: FittedParameter) -> list[str]:
    from .output import quantity

    interval = parameter.interval_95
    span = f"{interval[0]:.4g} to {interval[1]:.4g}" if interval else "-"
    state = parameter.state.replace("_", " ")
    return [parameter.name, quantity(parameter.estimate, digits=4), span, parameter.unit, state]
