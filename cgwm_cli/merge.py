"""The verb `cgwm merge`: join the shards of a dataset into one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit
from .options import Overwrite
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import MergeSummary


@verb
def merge(
    emit: Emit,
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET...",
            help="The directory of the dataset, or several that share its shards.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="The index (.h5) to write, or a directory for a dataset of links. [default: DATASET/index.h5]",
            show_default=False,
        ),
    ] = None,
    hashes: Annotated[
        bool, typer.Option("--hashes/--sizes", help="Check every byte of the shards, or only their sizes.")
    ] = True,
    overwrite: Overwrite = False,
) -> None:
    """Join the shards of a dataset into one HDF5 file of virtual datasets; nothing is copied."""
    from ..pipeline.synthesize import merge as work

    emit(work(datasets, out, overwrite, hashes), _summary)


def _summary(summary: MergeSummary) -> str:
    from .output import table, warnings

    rows = [
        ["shards", str(summary.shards)],
        ["rollouts", str(summary.rollouts)],
        ["frames", str(summary.frames)],
        ["index", f"{summary.bytes / 1e6:.1f} MB"],
        ["shards' size", f"{summary.shard_bytes / 1e6:.1f} MB"],
    ]
    verdict = "is up to date" if summary.up_to_date else "written"
    return "\n".join([f"{summary.index}: {verdict}.", table(rows), *warnings(summary.notes)])
