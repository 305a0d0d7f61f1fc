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
        Literal["contactnets"],
        typer.Argument(metavar="FORMAT", help="contactnets: tosses of a cube (.pt files or .npz).", show_default=False),
    ],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="What to import.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="CAPTURE", help="The directory to write.", show_default=False)
    ],
    train: Annotated[int, typer.Option("--train", min=1, help="Number of episodes of the split 'train'.")] = 50,
    test: Annotated[int, typer.Option("--test", min=0, help="Number of episodes of the split 'test'.")] = 100,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the permutation before splitting.")] = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Recordings in another format to a capture."""
    with running(json=json, quiet=quiet, debug=debug) as emit:
        from ..datasets.contactnets import import_contactnets

        emit(import_contactnets(source, out, train, test, seed, overwrite), _summary)


def _summary(result: ImportResult) -> str:
    splits = ", ".join(f"{name} {count}" for name, count in result.splits.items())
    return f"Wrote {result.capture}: {result.episodes} episodes ({splits}) with {result.samples} poses."
