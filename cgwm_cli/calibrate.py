"""The verb `cgwm calibrate`: estimate cameras from photos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .execution import Emit
from .options import ConfigFile, Overwrite, Seed, Settings
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import TargetSheet


@verb
def calibrate(
    emit: Emit,
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE",
            help="The capture's directory. With --target: a folder of photos of the board, or the board to write.",
            show_default=False,
        ),
    ],
    target: Annotated[
        Literal["charuco"] | None,
        typer.Option(
            "--target",
            help="Write the board (CAPTURE is a .pdf or .svg), or measure intrinsics from photos "
            "of it (CAPTURE is their folder).",
            show_default=False,
        ),
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            "--intrinsics",
            metavar="FILE",
            help="Known intrinsics: intrinsics.json of a target, or cameras.json of an earlier calibration.",
            show_default=False,
        ),
    ] = None,
    seed: Seed = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
    set_: Settings = None,
) -> None:
    """Estimate cameras from photos: poses, lens, metric scale, and a verdict for each image."""
    from ..schemas import CalibrateConfig, UsageError
    from .settings import StageSettings

    settings = StageSettings({"calibrate": CalibrateConfig}, config, set_).configure(
        "calibrate", CalibrateConfig, seed=seed
    )
    if target is None:
        from ..pipeline.calibrate import calibrate as work

        emit(work(capture, settings, overwrite, intrinsics), str)
        return
    if intrinsics is not None:
        raise UsageError("--target measures intrinsics; --intrinsics gives them.", todo="leave one of the two out.")
    from ..pipeline.calibrate import calibrate_target, print_target

    if capture.suffix.lower() in (".pdf", ".svg") and not capture.is_dir():
        emit(print_target(capture, overwrite), _printed)
    else:
        emit(calibrate_target(capture, overwrite), lambda file: f"{file}\n{_use(capture)}")


def _printed(sheet: TargetSheet) -> str:
    return (
        f"{sheet.path}: a board of {sheet.width_mm:g} x {sheet.height_mm:g} mm on A4. Print it, lay it flat on "
        "something stiff, take 15 to 30 photos of it from all sides, tilted by 30 to 45 degrees and in all corners of "
        "the picture, then: cgwm calibrate PHOTOS --target charuco"
    )


def _use(folder: Path) -> str:
    from ..pipeline.calibrate.target.intrinsics import INTRINSICS_NAME
    from ..schemas.printable import typed_path

    return f"use them: cgwm calibrate CAPTURE --intrinsics {typed_path(folder / INTRINSICS_NAME)}"
