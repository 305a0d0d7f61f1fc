"""What a contender that names missing effects is given, and what it must return; see `missing_effects.py`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol


@dataclass(frozen=True, kw_only=True)
class Named:
    """What a contender says of a capture.

    named: effects by the names of `cgwm effects list`, with `@episode` or `@group` where their numbers differ; aliases:
    groups that it says it cannot tell apart; unexplained: it sees something that it has no name for; details: JSON.
    """

    named: tuple[str, ...] = ()
    aliases: tuple[tuple[str, ...], ...] = ()
    unexplained: bool = False
    details: dict[str, Any] = field(default_factory=dict)


class EffectNamer(Protocol):
    """One row of the benchmark."""

    @property
    def name(self) -> str:
        """The row's name in the table."""
        ...

    def missing(self) -> str | None:
        """Return the package that is needed and not installed, or None."""
        ...

    def names(self, capture: Path) -> Named:
        """Return what the training split of a capture shows; nothing else of it is read."""
        ...
