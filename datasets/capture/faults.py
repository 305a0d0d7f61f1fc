"""Faults of a capture, collected until all checks have run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...schemas import InputDataError


class Faults:
    """The faults found so far, each once: a directory that cannot be listed is met by several checks."""

    def __init__(self) -> None:
        self.found: list[InputDataError] = []
        self._told: set[str] = set()

    def attempt(self, check: Callable[..., Any], *arguments: object) -> Any:
        """Return what a check returns; None, and its fault is added, if it refuses."""
        try:
            return check(*arguments)
        except InputDataError as fault:
            if str(fault) not in self._told:
                self.found.append(fault)
            self._told.add(str(fault))
            return None

    def listed(self, names: Callable[..., list[str]], *arguments: object) -> list[str]:
        """Return the names that a function returns; none if it refuses."""
        return self.attempt(names, *arguments) or []
