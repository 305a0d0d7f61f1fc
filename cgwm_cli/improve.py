"""The verb `cgwm improve`: fit, diagnose, add and refit until nothing helps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit, loading
from .options import AcceptUnits, ConfigFile, Device, Overwrite, Seed, Settings, TrustEffects, trust
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import ErrorRatio, ImproveResult, ImproveStep, ImproveTestStep, ImproveTrial


@verb
def improve(
    emit: Emit,
    capture: Annotated[
        Path, typer.Argument(metavar="CAPTURE", help="The capture, with tracks.", show_default=False)
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="DIR", help="The directory to write: all models and a page.",
                     show_default=False),
    ],
    parent: Annotated[
        Path | None, typer.Option("--from", metavar="MODEL", help="Start from a fitted model, which is not changed.")
    ] = None,
    split: Annotated[str, typer.Option("--split", metavar="NAME", help="The episodes that decide.")] = "train",
    steps: Annotated[
        int | None, typer.Option("--steps", metavar="N", show_default="6", help="Largest number of added models.")
    ] = None,
    candidates: Annotated[
        str,
        typer.Option("--candidates", metavar="FILE.py:CLASS,...",
                     help="Custom effects, in addition to the built-in ones.", show_default=False),
    ] = "",
    throws: Annotated[
        Path | None,
        typer.Option("--throws", metavar="FILE",
                     help="Candidates for the next throw: a TOML file of [[throws]] tables.",
                     show_default="about 30 that can be thrown by hand"),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted ladder of DIR; keep a finished one.")
    ] = False,
    seed: Seed = None,
    device: Device = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
    set_: Settings = None,
    trust_effects: TrustEffects = "",
    accept_units: AcceptUnits = False,
) -> None:  # fmt: skip
    """Fit a model, diagnose it, add what helps to predict unseen episodes, and repeat until nothing does."""
    trust(trust_effects)
    with loading():
        from ..pipeline.improve import improve as work
    from ..schemas import ImproveConfig, PhysConfig, SplatConfig
    from .settings import StageSettings

    settings = StageSettings({"improve": ImproveConfig, "sg-gs": SplatConfig, "phys-geo": PhysConfig}, config, set_)
    numbers = settings.configure("improve", ImproveConfig, steps=steps)
    splats = settings.configure("sg-gs", SplatConfig, seed=seed, device=device)
    physics = settings.configure("phys-geo", PhysConfig, seed=seed, device=device)
    wanted = [name.strip() for name in candidates.split(",") if name.strip()]
    result = work(
        capture, out, parent, split, numbers, splats, physics, wanted, throws, overwrite, resume, accept_units
    )
    emit(result, lambda found: _summary(found, out, capture))


def _summary(result: ImproveResult, out: Path, capture: Path) -> str:
    from ..pipeline.improve.wording import not_added_words, remaining_words
    from .output import next_line, table, warnings

    rows = [[result.models[0], "", "", ""]]
    rows += [_row(step, result) for step in result.steps if step.added]
    last = result.steps[-1] if result.steps else None
    lines = [
        result.sentence,
        table(rows, ["model", "added", "error after / before, unseen", "the same, test"]),
    ]
    if last is not None and not last.added:
        lines.append(" ".join([f"{last.model}: {last.sentence}", *not_added_words(last)]))
        lines.append(f"left: {' '.join(remaining_words(last))}")
    lines += _recordings(result)
    lines += [*warnings(result.warnings), f"Page: {out / result.page}"]
    if len(result.models) > 1:
        lines.append(next_line("cgwm", "compare", out / result.models[0], out / result.models[-1], capture))
    return "\n".join(lines)


def _recordings(result: ImproveResult) -> list[str]:
    """Return what to measure next: the throw that separates rivals, and the motions in contact."""
    from ..pipeline.report.page import listed

    lines = []
    next_ = next((one for step in reversed(result.steps) if (one := step.next_experiment) is not None), None)
    if next_ is not None:
        why = f", to distinguish {listed(next_.separates)}" if next_.initial_state else ""
        lines.append(f"Measure next{why}: {next_.what}.")
    if result.steps and (motions := result.steps[-1].next_motions) is not None:
        lines.append("Record next, for contact:")
        lines += [f"  {place}. {motion.what}" for place, motion in enumerate(motions.motions, 1)]
    return lines


def _row(step: ImproveStep, result: ImproveResult) -> list[str]:
    judged = next((one for one in step.tried if one.helps and one.effects == step.added), None)
    tests = result.test.steps if result.test is not None else ()
    tested = next((one for one in tests if (one.model, one.than) == (step.next_model, step.model)), None)
    return [step.next_model or "", ", ".join(step.added), _ratios(judged), _ratios(tested)]


def _ratios(found: ImproveTrial | ImproveTestStep | None) -> str:
    """Return the ratios of errors in flight and in contact, with their intervals."""
    if found is None:
        return "-"
    known = [(kind, one) for kind, one in (("flight", found.flight), ("contact", found.contact)) if one is not None]
    return ", ".join(f"{kind} {_ratio(one)}" for kind, one in known) or "-"


def _ratio(ratio: ErrorRatio) -> str:
    span = ratio.interval_95
    return f"{ratio.ratio:.2f}" + (f" ({span[0]:.2f} to {span[1]:.2f})" if span else "")
