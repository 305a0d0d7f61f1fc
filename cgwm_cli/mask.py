"""The verb `cgwm mask`: masks of a body in photos or videos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit
from .options import Overwrite
from .verb import verb

if TYPE_CHECKING:
    from ..schemas.masks import MasksReport


@verb
def mask(
    emit: Emit,
    source: Annotated[
        Path, typer.Argument(metavar="CAPTURE|PHOTOS", help="A capture, or a folder of photos.", show_default=False)
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="DIR", help="The directory to write; of a capture usually CAPTURE/masks.",
                     show_default=False),
    ],
    box: Annotated[
        str | None,
        typer.Option("--box", metavar="X0,Y0,X1,Y1",
                     help="Borders of the body in one photo [px], as a viewer shows it: left, upper, right, lower. "
                     "Without it, the body is what stands before one colour, or turns before surroundings that stand.",
                     show_default=False),
    ] = None,
    photo: Annotated[
        str | None,
        typer.Option("--photo", metavar="NAME", help="The photo that --box is about.", show_default="the first"),
    ] = None,
    body: Annotated[
        str | None,
        typer.Option("--body", metavar="NAME", help="The body of the capture.", show_default="the only one"),
    ] = None,
    empty: Annotated[
        str | None,
        typer.Option("--empty", metavar="EPISODE",
                     help="Mask the videos of a capture instead of its photos: each camera filmed the place without "
                     "the body in this episode. DIR is usually CAPTURE/video_masks.", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
) -> None:  # fmt: skip
    """Write masks of a body in photos or videos, as calibrate and fit read them: 0 behind the body, its label on it."""
    from ..schemas import UsageError

    if empty is not None:
        if box is not None or photo is not None:
            raise UsageError(
                "--empty is about videos, --box and --photo about photos.", todo="mask photos and videos in two calls."
            )
        from ..pipeline.mask import mask_videos

        return emit(mask_videos(source, out, empty, body, overwrite), str)

    if photo is not None and box is None:
        raise UsageError("--photo names the photo of a box, and there is no --box.", todo="give both or neither.")
    borders = None if box is None else _borders(box)
    from ..pipeline.mask import mask as work

    return emit(work(source, out, borders, photo, body, overwrite), lambda report: _summary(report, source))


def _summary(report: MasksReport, source: Path) -> str:
    manifest = source / "capture.toml"
    if report.body or not manifest.is_file():
        return str(report)
    return f'{report}\n{manifest} names no body yet: add a line [[bodies]], and under it name = "object"'


def _borders(text: str) -> tuple[float, float, float, float]:
    import math

    from ..schemas import UsageError

    try:
        left, upper, right, lower = (float(word) for word in text.split(","))
    except ValueError:
        left = upper = right = lower = math.nan
    if not all(map(math.isfinite, (left, upper, right, lower))):
        raise UsageError(
            f"--box {text}: not four numbers.",
            "x0,y0,x1,y1 in pixels, for example 120,80,520,430.",
            "read the four numbers off the picture, in pixels.",
        )
    return left, upper, right, lower
