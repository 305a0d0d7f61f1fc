"""The verb `cgwm validate`: check a capture, model, dataset, ladder, run or masks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .execution import running
from .options import AcceptUnits, Debug, Json, Quiet, Seed

if TYPE_CHECKING:
    from ..schemas import ValidationReport


def validate(
    thing: Annotated[
        Path,
        typer.Argument(metavar="THING", help="A capture, model, dataset, ladder, run or masks.", show_default=False),
    ],
    sample: Annotated[
        int | None,
        typer.Option(
            "--sample", metavar="N", help="Check only N rollouts of a dataset, drawn at random.", show_default="all"
        ),
    ] = None,
    seed: Seed = None,
    accept_units: AcceptUnits = False,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Check a capture, a model, a dataset, a ladder, a run or masks: schema, units, finite numbers, hashes."""
    with running(json=json, quiet=quiet, debug=debug) as emit:
        from ..pipeline.validate import validate as work

        report = work(thing, sample, seed or 0, accept_units)
        emit(report, _summary)
    if report.faults:
        raise typer.Exit(1)


_SENTENCES = {"warnings": "warning", "inconsistencies": "inconsistency"}
"""Facts that are lists of sentences, each of which has a line of its own, and the word before it."""


def _summary(report: ValidationReport) -> str:
    from .output import table

    count = len(report.faults)
    verdict = f"{count} fault{'s' if count > 1 else ''}" if count else "no faults"
    faults = [f"  fault: {fault}" for fault in report.faults]
    sentences = [name for name, value in report.facts.items() if name in _SENTENCES and value]
    said = [f"  {_SENTENCES[name]}: {text}" for name in sentences for text in report.facts[name]]
    facts = table([[name.replace("_", " "), _text(v)] for name, v in report.facts.items() if name not in sentences])
    return "\n".join(part for part in [f"{report.kind} {report.path}: {verdict}.", *faults, *said, facts] if part)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(entry)}" for name, entry in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value)) or "none"
    return str(value)
