"""Pairs of materials, and the names of the contact parameters that belong to them."""

from __future__ import annotations

from collections.abc import Iterable


def repeated(names: Iterable[str]) -> str | None:
    """Return the first name that stands twice, or None."""
    seen: set[str] = set()
    return next((name for name in names if name in seen or seen.add(name)), None)


def pair_of(first: str, second: str) -> tuple[str, str]:
    """Return the pair of two materials, the same for either order."""
    return (first, second) if first <= second else (second, first)


def of_pair(name: str, pair: tuple[str, str] | None) -> str:
    """Return the name of a contact parameter of a pair of materials, as `friction[steel,wood]`.

    Without a pair, it is the parameter of all pairs that have no law of their own.
    """
    return name if pair is None else f"{name}[{','.join(pair_of(*pair))}]"
