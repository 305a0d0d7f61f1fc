"""Registry of the hidden effects: bodies, magnitudes, and the draw of their true parameter values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .mechanics import Hidden
from .things import Array, Kind, Thing

Size = Literal["small", "large"]
Acts = Literal["flight", "contact", "measurement", "unknown"]
Draw = Callable[[Thing, float, np.random.Generator], Hidden]
BOTH: tuple[Kind, ...] = ("cube", "ball")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """An effect that can be hidden in a capture.

    Args:
        name: Name in `cgwm effects list`, or a separate one if `acts` is "unknown".
        acts: Where it acts; "unknown": in flight, and in no library.
        small: Small magnitude by body, in the unit of the effect; only bodies on which it is meaningful.
        large: Large magnitude, likewise.
        draw: Draws the true parameter values for a magnitude.
    """

    name: str
    acts: Acts
    small: dict[Kind, float]
    large: dict[Kind, float]
    draw: Draw

    @property
    def things(self) -> tuple[Kind, ...]:
        """Bodies on which the effect is meaningful."""
        return tuple(self.small)


EFFECTS: dict[str, Entry] = {}
"""All of them, by name."""


def hidden_effect(
    name: str, acts: Acts, small: float | dict[Kind, float], large: float | dict[Kind, float]
) -> Callable[[Draw], Draw]:
    """Return a decorator that registers an effect; a single magnitude applies to both bodies."""

    def by_thing(value: float | dict[Kind, float]) -> dict[Kind, float]:
        return dict(value) if isinstance(value, dict) else dict.fromkeys(BOTH, float(value))

    def enter(draw: Draw) -> Draw:
        EFFECTS[name] = Entry(name=name, acts=acts, small=by_thing(small), large=by_thing(large), draw=draw)
        return draw

    return enter


def draw_effect(name: str, thing: Thing, size: Size, rng: np.random.Generator) -> Hidden:
    """Return an effect with true parameter values drawn for a body.

    Raises:
        ValueError: If the effect is not defined for that body.
    """
    entry = EFFECTS[name]
    if thing.kind not in entry.small:
        raise ValueError(f"{name} on a {thing.kind}; allowed: {', '.join(entry.things)}")
    return entry.draw(thing, (entry.small if size == "small" else entry.large)[thing.kind], rng)


def horizontal(rng: np.random.Generator) -> Array:
    """Draw a horizontal unit vector, uniform in direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def direction(rng: np.random.Generator) -> Array:
    """Draw a unit vector, uniform on the sphere."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def sign(rng: np.random.Generator) -> float:
    """Draw 1 or -1."""
    return float(rng.choice([-1.0, 1.0]))
