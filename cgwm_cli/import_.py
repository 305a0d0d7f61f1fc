"""`cgwm import`: other people's recordings to a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .options import Debug, Json, Overwrite, Quiet
from .run import running

if TYPE_CHECKING:
    from ..schemas import ImportResult


def import_capture(
    format_: Annotated[
        Literal["contactnets", "pinwm"],
        typer.Argument(
            metavar="FORMAT",
            help="contactnets: tosses of a cube (.pt files or .npz); pinwm: pushes of a block, with frames and masks.",
            show_default=False,
        ),
    ],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="What to import.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="CAPTURE", help="The directory to write.", show_default=False)
    ],
    train: Annotated[
        int | None,
        typer.Option(
            "--train",
            min=1,
            help="contactnets: episodes of the split 'train' (50); pinwm: frames of each of them (12).",
            show_default=False,
        ),
    ] = None,
    test: Annotated[
        int | None,
        typer.Option("--test", min=0, help="contactnets: episodes of the split 'test' (100).", show_default=False),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", min=0, help="contactnets: seed of the permutation before splitting (0).", show_default=False
        ),
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Recordings in another format to a capture."""
    from ..schemas import UsageError

    with running(json=json, quiet=quiet, debug=debug) as emit:
        if format_ == "pinwm":
            from ..datasets.pinwm import import_pinwm

            if test is not None or seed is not None:
                raise UsageError(
                    f"{'--test' if test is not None else '--seed'} with pinwm: nothing is drawn at random there.",
                    "--train, the number of frames to fit on.",
                    "leave it out.",
                )
            emit(import_pinwm(source, out, 12 if train is None else train, overwrite), _summary)
        else:
            from ..datasets.contactnets import import_contactnets

            counts = (50 if train is None else train, 100 if test is None else test)
            emit(import_contactnets(source, out, *counts, seed or 0, overwrite), _summary)


def _summary(result: ImportResult) -> str:
    splits = ", ".join(f"{name} {count}" for name, count in result.splits.items())
    return f"Wrote {result.capture}: {result.episodes} episodes ({splits}) with {result.samples} poses."
