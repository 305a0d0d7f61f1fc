"""`cgwm demo`: the whole pipeline on a scene that it makes itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .options import Debug, DeviceName, Json, Overwrite, Quiet
from .run import running

if TYPE_CHECKING:
    from ..schemas import DemoResult


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

        emit(run_demo(out, scene, seed, renderer, device, overwrite), _summary)


def _summary(result: DemoResult) -> str:
    return str(result)
