"""`cgwm synthesize`: a world model to labelled rollouts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import ConfigFile, Debug, Device, Json, Overwrite, Quiet, Seed, Settings
from .run import running

if TYPE_CHECKING:
    from ..schemas import DatasetSummary


def synthesize(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="The model's directory.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DATASET", help="The directory to write.", show_default=False)
    ],
    rollouts: Annotated[
        int | None, typer.Option("--rollouts", show_default="8", help="Number of rollouts, of all shards together.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", show_default="0/1", help="Make shard I of N; I runs from 0 to N-1."),
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview/--no-preview", help="Write preview.png and preview.webm beside the first shard.")
    ] = True,
    seed: Seed = None,
    device: Device = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
    set_: Settings = None,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """A model to labelled rollouts in HDF5: images, depth, masks, poses, contacts, parameters."""
    with running(json=json, quiet=quiet, debug=debug) as emit:
        from ..pipeline.synthesize import synthesize as work
        from ..schemas import SynthesizeConfig
        from .settings import StageSettings

        index, count = _shard(shard) if shard is not None else (None, None)
        settings = StageSettings({"synthesize": SynthesizeConfig}, config, set_).configure(
            "synthesize", SynthesizeConfig, rollouts=rollouts, shard=index, shards=count, seed=seed, device=device
        )
        emit(work(model, out, settings, overwrite, preview=preview), _summary)


def _shard(text: str) -> tuple[int, int]:
    from ..schemas import UsageError

    index, slash, count = text.partition("/")
    if not (slash and index.isdecimal() and count.isdecimal()) or int(index) >= int(count):
        raise UsageError(f"--shard {text}: no shard.", "I/N with 0 <= I < N, for example 3/64.")
    return int(index), int(count)


def _summary(summary: DatasetSummary) -> str:
    from .output import table, warnings

    rows = [
        ["rollouts", str(summary.rollouts)],
        ["frames", str(summary.frames)],
        ["contacts", str(summary.contacts)],
        ["size", f"{summary.bytes / 1e6:.1f} MB"],
        ["speed", f"{summary.frames_per_s:.1f} frames/s"],
        ["time", f"{summary.seconds:.1f} s"],
    ]
    cameras = ", ".join(summary.cameras) or "none"
    head = f"Wrote {summary.dataset}/{summary.shard}; cameras: {cameras}."
    look = [f"To look at: {', '.join(f'{summary.dataset}/{name}' for name in summary.preview)}"]
    return "\n".join([head, table(rows), *(look if summary.preview else []), *warnings(summary.notes)])
