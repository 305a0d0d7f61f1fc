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
        Path | None, typer.Option("--out", "-o", metavar="DATASET", help="The directory to write.", show_default=False)
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan", metavar="FILE", help="What to draw from (TOML); printed as resolved.", show_default=False
        ),
    ] = None,
    print_plan: Annotated[
        bool, typer.Option("--print-plan", help="Print the plan for this model as TOML, to edit; make nothing.")
    ] = False,
    rollouts: Annotated[
        int | None, typer.Option("--rollouts", show_default="8", help="Number of rollouts, of all shards together.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", show_default="0/1", help="Make shard I of N; I runs from 0 to N-1."),
    ] = None,
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
        from ..schemas import SynthesizeConfig, UsageError, plan_toml, read_plan
        from .settings import StageSettings

        index, count = _shard(shard) if shard is not None else (None, None)
        settings = StageSettings({"synthesize": SynthesizeConfig}, config, set_).configure(
            "synthesize", SynthesizeConfig, rollouts=rollouts, shard=index, shards=count, seed=seed, device=device
        )
        if plan is not None:
            if "plan" in settings.model_fields_set:
                raise UsageError("--plan, and synthesize.plan in the settings.", "one of the two.")
            settings = settings.model_copy(update={"plan": read_plan(plan)})
        if print_plan:
            from ..pipeline.synthesize import resolved_plan

            emit(resolved_plan(model, settings.plan), plan_toml)
        elif out is None:
            raise UsageError("--out is missing.", todo="name the directory to write: --out DATASET.")
        else:
            shown = plan is not None
            emit(work(model, out, settings, overwrite), lambda done: (_plan(done) if shown else "") + _summary(done))


def _shard(text: str) -> tuple[int, int]:
    from ..schemas import UsageError

    index, slash, count = text.partition("/")
    if not (slash and index.isdecimal() and count.isdecimal()) or int(index) >= int(count):
        raise UsageError(f"--shard {text}: no shard.", "I/N with 0 <= I < N, for example 3/64.")
    return int(index), int(count)


def _plan(summary: DatasetSummary) -> str:
    from ..schemas import plan_toml

    return f"The plan, resolved:\n\n{plan_toml(summary.plan, comments=False)}\n"


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
    if summary.rejected:
        total = sum(summary.rejected.values())
        rules = ", ".join(f"{rule} {count}" for rule, count in summary.rejected.items())
        rows.append(["rejected", f"{total} of {total + summary.rollouts} draws: {rules}"])
    cameras = ", ".join(summary.cameras) or "none"
    head = f"Wrote {summary.dataset}/{summary.shard}; cameras: {cameras}."
    return "\n".join([head, table(rows), *warnings(summary.notes)])
