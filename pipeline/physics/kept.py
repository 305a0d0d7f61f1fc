"""Results that depend on an immutable object alone, kept with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

S = TypeVar("S", bound="Kept")
T = TypeVar("T")


class Kept:
    """An immutable object with which such results are kept."""

    def once(self: S, make: Callable[[S], T]) -> T:
        """Return `make(self)`, made at the first call and kept with the object; for what depends on nothing else."""
        kept: dict[object, object] = self.__dict__.setdefault("_kept", {})
        if make not in kept:
            kept[make] = make(self)
        return cast(T, kept[make])
