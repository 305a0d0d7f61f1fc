"""The tables of what has to be refused and of what has to be accepted, and how they are judged."""

from __future__ import annotations

from pathlib import Path

from . import accepted, oracle, refused, refused_control, refused_datasets, refused_models, refused_surfaces
from .cases import Trial
from .client import Seen
from .edits import Row


def must_refuse() -> list[Row]:
    """Return the lines of what has to be refused."""
    modules = (refused, refused_models, refused_datasets, refused_surfaces, refused_control)
    return [row for module in modules for row in module.rows()]


def must_accept() -> list[Row]:
    """Return the lines of what has to be accepted."""
    return list(accepted.rows())


def judged(trial: Trial, row: Row, refuse: bool) -> tuple[Seen, list[tuple[str, str]]]:
    """Run a line and return what was seen and what is wrong with it."""

    def prepare(root: Path) -> None:
        row.edit(root)

    seen, found = trial.run_on(row.subject, prepare, row.words)
    if row.kind == "outputs":  # a folder that must not be written is named as a folder
        found = [fault for fault in found if fault[0] != "names only the folder"]
    if refuse and seen.code == 0 and not seen.timed_out:
        found.insert(0, ("accepted", oracle.first(seen.stdout)))
    if not refuse and seen.code != 0:
        found.insert(0, ("refused", oracle.first(seen.stderr + seen.stdout)))
    return seen, found
