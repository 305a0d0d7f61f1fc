"""What a result of a benchmark on captures of the tabletop is measured on, in the order of the stored keys."""

from __future__ import annotations

from dataclasses import dataclass

from store import Keyed

from .capture import Task


@dataclass(frozen=True)
class CaptureJob(Keyed):
    """One capture."""

    task: Task
    object: str
    material: str
    engine: str
    seed: int


@dataclass(frozen=True)
class ObjectJob(Keyed):
    """An object on a ground in an engine."""

    engine: str
    object: str
    material: str
    seed: int
