"""The verb `cgwm calibrate`: estimate cameras from photos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit
from .options import ConfigFile, Overwrite, Seed, Settings
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import CalibrationReport


@verb
def calibrate(
    emit: Emit,
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="The capture's directory.", show_default=False)],
    seed: Seed = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
    set_: Settings = None,
) -> None:
    """Estimate cameras from photos: poses, lens, metric scale, and a verdict for each image."""
    from ..pipeline.calibrate import calibrate as work
    from ..schemas import CalibrateConfig
    from .settings import StageSettings

    settings = StageSettings({"calibrate": CalibrateConfig}, config, set_).configure(
        "calibrate", CalibrateConfig, seed=seed
    )
    emit(work(capture, settings, overwrite), _summary)


def _summary(report: CalibrationReport) -> str:
    return str(report)
