"""Declaration of an array of a rollout: shape, type, unit, frame, order, allowed values and description."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

ATTRIBUTES = ("unit", "frame", "order", "shape_meaning", "description")
"""Attributes of every array."""


@dataclass(frozen=True, kw_only=True)
class ArrayEntry:
    """An array of a rollout. `{camera}`, `{parameter}` and other words in braces differ from array to array."""

    name: str
    """Name below the rollout, for example ``cameras/{camera}/K``."""
    dtype: str
    """Kind and size of its numbers; S is text of any length. Of several, separated by spaces, one."""
    axes: str
    """Its shape, for example ``(T, B, 3)``; see `SYMBOLS`."""
    unit: str = "-"
    """Its unit."""
    frame: str = "-"
    """Frame of its numbers."""
    order: str = "-"
    """Order of its last axis."""
    text: str
    """Description, as a sentence."""
    note: str = ""
    """What the documentation adds to it."""
    low: str = ""
    """Smallest allowed value; empty: any."""
    high: str = ""
    """Largest allowed value; empty: any."""
    words: tuple[str, ...] = ()
    """Allowed texts; empty: any."""
    unit_norm: bool = False
    """Whether its last axis has the length 1."""
    presence: Literal["always", "cameras", "joints", "optional"] = "always"
    """Whether every rollout has it, each with cameras, each with jointed bodies, or some."""

    @property
    def group(self) -> str:
        """The group that contains it, empty for the rollout itself."""
        return self.name.rpartition("/")[0]

    @cached_property
    def last_name(self) -> str:
        """Its name within that group."""
        return self.name.rpartition("/")[2]

    @property
    def templates(self) -> tuple[str, ...]:
        """The values of `ATTRIBUTES`, with words in braces."""
        return self.unit, self.frame, self.order, self.axes, self.text

    @cached_property
    def shape(self) -> tuple[str, ...]:
        """Sizes of the axes, as terms for :func:`value_of`."""
        return () if self.axes == "scalar" else tuple(part.strip() for part in self.axes.strip("()").split(",") if part)

    @property
    def values_text(self) -> str:
        """Which values it may have, in words; empty: any finite number."""
        if self.words:
            return ", ".join(self.words)
        if self.unit_norm:
            return "length 1"
        if self.low and self.high:
            return f"{self.low} to {self.high}" if self.low != self.high else self.low
        return f"{self.low} or more" if self.low else ""

    def texts(self, words: Mapping[str, str]) -> tuple[str, ...]:
        """Return the values of `ATTRIBUTES` for the given words."""
        return tuple(template.format_map(words) for template in self.templates)

    def known_texts(self, words: Mapping[str, str]) -> dict[str, str]:
        """Return those values of `ATTRIBUTES`, by attribute, whose words are all known."""
        pairs = zip(ATTRIBUTES, self.templates, strict=True)
        return {key: text.format_map(words) for key, text in pairs if _fields(text) <= words.keys()}


SYMBOLS = {
    "T": "frames",
    "B": "bodies",
    "C": "cameras",
    "N": "contacts of all frames together",
    "J": "joints that move",
    "D": "1 + 13 x free bodies, jointed ones by their root, + 2 J",
    "A": "3 x driven bodies, 1 if there are none",
    "H x W": "size of the camera's images",
}
"""Meaning of the letters in shapes and bounds. `camera` and `body` stand for C and B."""


@cache
def _fields(template: str) -> frozenset[str]:
    return frozenset(field for _, field, _, _ in string.Formatter().parse(template) if field)


def value_of(term: str, symbols: Mapping[str, int]) -> int | None:
    """Return the value of a size or bound, or None where a symbol has none.

    >>> value_of("13 B", {"B": 2}), value_of("T + 1", {"T": 5}), value_of("2^B - 1", {"B": 3}), value_of("k", {})
    (26, 6, 7, None)
    """
    total, sign, product = 0, 1, 1
    for token in term.split():
        if token in ("+", "-"):
            total, sign, product = total + sign * product, 1 if token == "+" else -1, 1
            continue
        base, _, power = token.rpartition("^")
        factor = int(power) if power.lstrip("-").isdigit() else symbols.get(power)
        if factor is None:
            return None
        product *= int(base) ** factor if base else factor
    return total + sign * product
