"""What `cgwm validate` reports."""

from __future__ import annotations

from typing import Any, Literal

from .base import FileModel


class Failure(FileModel):
    """A fault in a rollout of a dataset, in numbers."""

    check: str
    """For example `momentum`, `reprojection`, `finite`."""
    shard: str
    demo: str
    frame: int | None = None
    """Of several, the worst one."""
    camera: str | None = None
    body: str | None = None
    value: float | None = None
    """What was found, and the limit that it breaks; the unit is in the text."""
    limit: float | None = None
    text: str


class ValidationReport(FileModel):
    """The outcome of a validation: what was measured, and what is wrong."""

    path: str
    kind: Literal["capture", "model", "dataset", "ladder", "run", "masks", "intrinsics"]
    facts: dict[str, Any] = {}
    """What was found: counts, units, measured accuracies."""
    faults: tuple[str, ...] = ()
    """One sentence a fault, with the place and the numbers; empty: all checks passed."""
    failures: tuple[Failure, ...] = ()
    """Of a dataset: the faults of its rollouts, all of them, in numbers."""

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return not self.faults
