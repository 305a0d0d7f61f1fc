"""Runs as they are kept beside the output until it is complete: those that ended, and the end of the present one.

What ended lets an interrupted command go on, what is going on lets `cgwm view --run` show it meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch

from ...datasets.rollouts.control_file import RunTables
from ..runtime.checkpoint import Slot
from .loop import Recording, Watch
from .runner import Runner

NOW = "now"
"""Name of the slot of the run that is going on."""
KEPT_S, EVERY_S = 10.0, 1.0
"""Time of that run that is kept, and wall time between two notes of it [s]."""
SHARE = 0.05
"""Largest share of the wall time that notes take."""


def seed_slot(seed: int) -> str:
    """Return the name of the slot of a run that ended."""
    return f"seed {seed}"


def kept_tables(tables: RunTables, source: str) -> dict[str, Any]:
    """Return the arrays of a run for a checkpoint, with the file of its task."""
    return {
        "seed": tables.seed,
        "ended": tables.ended,
        "arrays": {name: torch.as_tensor(values) for name, values in tables.arrays.items()},
        "robot": tables.robot,
        "joints": list(tables.joints),
        "source": source,
    }


def tables_kept(kept: Mapping[str, Any]) -> RunTables:
    """Return the arrays of a run from a checkpoint."""
    arrays = {name: values.numpy() for name, values in kept["arrays"].items()}
    return RunTables(
        seed=kept["seed"], ended=kept["ended"], arrays=arrays, robot=kept["robot"], joints=tuple(kept["joints"])
    )


def noting(runner: Runner, slot: Slot, source: str) -> Watch:
    """Return what keeps the last seconds of a run in a slot, now and then."""
    due_s = time.monotonic() + EVERY_S
    rows = max(1, round(KEPT_S / runner.controller.interval_s))

    def note(recording: Recording) -> None:
        nonlocal due_s
        begun_s = time.monotonic()
        if begun_s < due_s:
            return
        slot.write(kept_tables(runner.tables(recording.last(rows), True), source))
        ended_s = time.monotonic()
        due_s = ended_s + max(EVERY_S, (ended_s - begun_s) / SHARE)

    return note


def version(slot: Slot) -> int | None:
    """Return when a slot was last written [ns]; None where it is not there."""
    try:
        return slot.path.stat().st_mtime_ns
    except OSError:
        return None
