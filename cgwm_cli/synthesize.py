"""The verb `cgwm synthesize`: make labelled rollouts of a world model."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit, loading, typed
from .options import ConfigFile, Device, Overwrite, Seed, Settings, TrustEffects, trust
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import DatasetSummary, ShardsSummary, SynthesizeConfig


@verb
def synthesize(
    emit: Emit,
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="The model's directory.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DATASET", help="The directory to write.", show_default=False)
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan", metavar="FILE", help="Distributions to draw from (TOML); printed as resolved.", show_default=False
        ),
    ] = None,
    print_plan: Annotated[
        bool, typer.Option("--print-plan", help="Only print the plan for this model as TOML, to edit.")
    ] = False,
    rollouts: Annotated[
        int | None, typer.Option("--rollouts", show_default="8", help="Number of rollouts in all shards together.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", show_default="0/1", help="Make shard I of N; I runs from 0 to N-1."),
    ] = None,
    shards: Annotated[
        int | None,
        typer.Option("--shards", min=1, metavar="N", help="Make all of N shards.", show_default=False),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(
            "--ray",
            metavar="[ADDRESS]",
            help="Make the shards on a Ray cluster: its address, local, or (without a value) the running one.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option("--workers", min=1, metavar="K", help="Make K shards at a time, in processes on this machine."),
    ] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep complete shards; with --overwrite remake damaged ones.")
    ] = False,
    preview: Annotated[
        bool, typer.Option("--preview/--no-preview", help="Write preview.png and preview.webm next to the first shard.")
    ] = True,
    seed: Seed = None,
    device: Device = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
    set_: Settings = None,
    trust_effects: TrustEffects = "",
) -> None:
    """Make labelled rollouts of a model, in HDF5: images, depth, masks, poses, contacts, parameters."""
    trust(trust_effects)
    from .. import schemas
    from ..schemas import UsageError, plan_toml
    from .settings import StageSettings

    _refuse_contradictions(shard, shards, ray, workers)
    index, count = _shard(shard) if shard is not None else (None, shards)
    settings = StageSettings({"synthesize": schemas.SynthesizeConfig}, config, set_).configure(
        "synthesize", schemas.SynthesizeConfig, rollouts=rollouts, shard=index, shards=count, seed=seed, device=device
    )
    if plan is not None:
        settings = _with_plan(settings, plan)
    if print_plan:
        from ..pipeline.synthesize.job import resolved_plan

        emit(resolved_plan(model, settings.plan), plan_toml)
    elif out is None:
        raise UsageError("--out is missing.", todo="name the directory to write: --out DATASET.")
    elif shards is None and ray is None and workers == 1:
        with loading():
            from ..pipeline.synthesize import synthesize as work

        done = work(model, out, settings, overwrite, resume, preview)
        emit(done, lambda found: (_plan(found) if plan is not None else "") + _summary(found, settings.shards))
    else:
        from ..pipeline.synthesize.shards import default_shards, synthesize_shards

        if "shards" not in settings.model_fields_set:
            settings = settings.model_copy(update={"shards": default_shards(settings.rollouts)})
        made = synthesize_shards(model, out, settings, overwrite, resume, ray, preview, workers)
        emit(made, lambda found: (_plan(found) if plan is not None else "") + _shards_summary(found))


def _with_plan(settings: SynthesizeConfig, plan: Path) -> SynthesizeConfig:
    """Return the settings with a plan from a file."""
    from ..schemas import UsageError, read_plan

    if "plan" in settings.model_fields_set:
        raise UsageError(
            "--plan and synthesize.plan in the settings were given.", "one of the two.", "leave one of the two out."
        )
    return settings.model_copy(update={"plan": read_plan(plan)})


def _refuse_contradictions(shard: str | None, shards: int | None, ray: str | None, workers: int) -> None:
    from ..schemas import UsageError

    if shard is not None and (shards is not None or ray is not None):
        other = "--shards" if shards is not None else "--ray"
        raise UsageError(
            f"--shard {shard} is one shard, {other} makes all.", "one of the two.", "leave one of the two out."
        )
    if workers > 1 and (shard is not None or ray is not None):
        other = "--shard makes one" if shard is not None else "--ray has its own workers"
        raise UsageError(
            f"--workers {workers} makes several shards at a time here; {other}.",
            "one of the two.",
            "leave one of the two out.",
        )


def _shard(text: str) -> tuple[int, int]:
    from ..schemas import UsageError

    index, slash, count = text.partition("/")
    if not (slash and index.isdecimal() and count.isdecimal()) or int(index) >= int(count):
        raise UsageError(f"--shard {text}: not a shard.", "I/N with 0 <= I < N, for example 3/64.", "pass --shard I/N.")
    return int(index), int(count)


def _plan(summary: DatasetSummary | ShardsSummary) -> str:
    from ..schemas import plan_toml

    return f"The plan, resolved:\n\n{plan_toml(summary.plan, comments=False)}\n"


def _summary(summary: DatasetSummary, count: int = 1) -> str:
    from ..schemas.printable import typed_path
    from .output import table, warnings

    rows = [
        ["rollouts", str(summary.rollouts)],
        ["frames", str(summary.frames)],
        ["contacts", str(summary.contacts)],
        ["size", f"{summary.bytes / 1e6:.1f} MB"],
    ]
    rows += _rejected(summary)
    if not summary.up_to_date:
        rows += [["speed", f"{summary.frames_per_s:.1f} frames/s"], ["time", f"{summary.seconds:.1f} s"]]
    cameras = ", ".join(summary.cameras) or "none"
    place = f"{summary.dataset}/{summary.shard}"
    head = f"{place} is up to date" if summary.up_to_date else f"Wrote {place}"
    lines = [f"{head}; cameras: {cameras}.", table(rows), *_preview(summary)]
    if count > 1 and "SLURM_JOB_ID" not in os.environ:
        lines += [
            f"all {count} on SLURM: {_slurm_line(typed(), count)}",
            f"then: cgwm merge {typed_path(summary.dataset)}",
        ]
    return "\n".join([*lines, *warnings(summary.notes)])


def _rejected(summary: DatasetSummary | ShardsSummary) -> list[list[str]]:
    if not summary.rejected:
        return []
    total = sum(summary.rejected.values())
    rules = ", ".join(f"{rule} {count}" for rule, count in summary.rejected.items())
    return [["rejected", f"{total} of {total + summary.rollouts} draws: {rules}"]]


def _preview(summary: DatasetSummary | ShardsSummary) -> list[str]:
    if not summary.preview:
        return []
    return [f"To look at: {', '.join(f'{summary.dataset}/{name}' for name in summary.preview)}"]


def _slurm_line(arguments: list[str], count: int) -> str:
    """Return the command that submits all shards to SLURM, from the command that made one of them.

    >>> _slurm_line(["synthesize", "m", "--shard", "3/9", "-o", "data"], 9)
    "sbatch --array=0-8 --wrap 'cgwm synthesize m --shard $SLURM_ARRAY_TASK_ID/9 -o data --resume'"
    """
    words = ["cgwm"]
    for before, word in zip(["", *arguments], arguments, strict=False):
        if before == "--shard" or word.startswith("--shard="):
            words.append(f"{'--shard=' if word.startswith('--shard=') else ''}$SLURM_ARRAY_TASK_ID/{count}")
        else:
            words.append(shlex.quote(word))
    line = " ".join(words + ["--resume"] * ("--resume" not in arguments))
    return f"sbatch --array=0-{count - 1} --wrap {shlex.quote(line)}"


def _shards_summary(summary: ShardsSummary) -> str:
    from ..schemas.printable import typed_path
    from .output import table, warnings

    kept = summary.shards - summary.made
    rows = [
        ["shards", str(summary.shards)],
        ["rollouts", str(summary.rollouts)],
        ["frames", str(summary.frames)],
        ["size", f"{summary.bytes / 1e6:.1f} MB"],
        *_rejected(summary),
    ]
    if summary.made:
        rows += [["speed", f"{summary.frames_per_s:.1f} frames/s"], ["time", f"{summary.seconds:.1f} s"]]
    others = "; the others were up to date" if kept else ""
    head = f"Wrote {summary.made} of {summary.shards} shards of {summary.dataset}{others}"
    if not summary.made:
        head = f"{summary.dataset} is up to date"
    lines = [f"{head}.", table(rows), *_preview(summary)]
    if summary.shards > 1:
        lines.append(f"to read it as one file: cgwm merge {typed_path(summary.dataset)}")
    return "\n".join([*lines, *warnings(summary.notes)])
