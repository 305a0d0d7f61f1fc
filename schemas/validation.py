"""What `cgwm validate` reports."""

from __future__ import annotations

from typing import Any, Literal

from .base import FileModel


class ValidationReport(FileModel):
    """The outcome of a validation: what was measured, and what is wrong."""

    path: str
    kind: Literal["capture", "model", "dataset"]
    facts: dict[str, Any] = {}
    """What was found: counts, units, measured accuracies."""
    faults: tuple[str, ...] = ()
    """One sentence a fault, with the place and the numbers; empty: all checks passed."""

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return not self.faults
