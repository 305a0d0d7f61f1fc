"""Where a field stands in a TOML or JSON text."""

from __future__ import annotations

import re

_KEY = r"""(?:"(?:[^"\\]|\\.)*"|'[^']*'|[A-Za-z0-9_-]+)"""
LONGEST_KEY = 1000
"""Longest key that is searched for in a JSON text [characters]; longer ones take seconds to compile a pattern of."""
_DOTTED = rf"{_KEY}(?:\s*\.\s*{_KEY})*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_DOTTED})\s*\]\]?\s*(?:#.*)?")
_ASSIGNMENT = re.compile(rf"\s*({_DOTTED})\s*=")


def find_line(text: str, location: tuple, suffix: str = ".toml") -> int | None:
    """Return the line (from 1) of the field at `location`, of what holds it, or None where that is uncertain.

    Args:
        text: The document.
        location: Keys and list indices from the top level down.
        suffix: The file's, `.toml` or `.json`.
    """
    if not text or not location:
        return None
    return _json_line(text, location) if suffix == ".json" else _toml_line(text, location)


def _toml_line(text: str, location: tuple) -> int | None:
    table: tuple = ()
    counts: dict[tuple, int] = {}
    best, depth = None, 0
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.fullmatch(line):
            table = _keys(header[2])
            if header[1] == "[[":
                # what it holds is counted anew
                counts = {key: n for key, n in counts.items() if key == table or key[: len(table)] != table}
                counts[table] = counts.get(table, -1) + 1
            place = table = _indexed(table, counts)
        elif assignment := _ASSIGNMENT.match(line):
            place = table + _keys(assignment[1])
        else:
            continue
        shared = min(len(place), len(location))
        if shared > depth and location[:shared] == place[:shared]:
            best, depth = number, shared
    return best


def _indexed(table: tuple, counts: dict[tuple, int]) -> tuple:
    """Insert the running numbers of the arrays of tables that a header's keys pass through."""
    place: list = []
    for k, key in enumerate(table, 1):
        place.append(key)
        if table[:k] in counts:
            place.append(counts[table[:k]])
    return tuple(place)


def _keys(dotted: str) -> tuple:
    return tuple(key[1:-1] if key[0] in "\"'" else key for key in re.findall(_KEY, dotted))


def _json_line(text: str, location: tuple) -> int | None:
    """Return the only line with the innermost key of `location`; None if several hold one of that name."""
    names = [part for part in location if isinstance(part, str)]
    if not names or len(names[-1]) > LONGEST_KEY:
        return None
    pattern = re.compile(rf'"{re.escape(names[-1])}"\s*:')
    lines = [number for number, line in enumerate(text.splitlines(), 1) if pattern.search(line)]
    return lines[0] if len(lines) == 1 else None
