"""Stepwise selection over the library by BIC, with one noise: what a textbook would do with `effects_windows`.

Forwards: the effect that lowers n log(SS / n) + k log n most is added, as long as it does so by `LEAST_DROP` (Kass &
Raftery 1995 call 10 very strong evidence); then each is taken out again if BIC falls. Effects that would serve nearly
as well in the place of one are named as its aliases.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .effects_base import Named
from .effects_windows import Bench, Linear, fitted

LEAST_DROP = 10.0
NEARLY = 6.0
MOST = 4


class StepwiseBic:
    """Stepwise BIC on linearised rollouts of MuJoCo."""

    name: str = "bic"

    def missing(self) -> str | None:
        """Return None: it needs MuJoCo, which the package needs itself."""
        return None

    def names(self, capture: Path) -> Named:
        """Return the effects that BIC selects."""
        linear = fitted(Bench(capture))
        chosen: list[str] = []
        best = bic(linear, chosen)
        while len(chosen) < MOST:
            scores = {name: bic(linear, [*chosen, name]) for name in linear.columns if name not in chosen}
            name = min(scores, key=scores.__getitem__)
            if scores[name] > best - LEAST_DROP:
                break
            chosen, best = [*chosen, name], scores[name]
        for name in list(chosen):
            rest = [other for other in chosen if other != name]
            if bic(linear, rest) < best:
                chosen, best = rest, bic(linear, rest)
        aliases = tuple(equals(linear, chosen, name) for name in chosen)
        return Named(named=tuple(chosen), aliases=aliases, details={"bic": best - bic(linear, [])})


def bic(linear: Linear, names: Sequence[str]) -> float:
    """Return n log(SS / n) + k log n of a fit with effects, k without what all fits share."""
    count = len(linear.errors)
    squares, free = squares_of(linear, names)
    return count * float(np.log(squares / count)) + free * float(np.log(count))


def squares_of(linear: Linear, names: Sequence[str]) -> tuple[float, int]:
    """Return the sum of squares that effects leave, and how many parameters they have."""
    if not names:
        return float(linear.errors @ linear.errors), 0
    columns = np.hstack([linear.columns[name] for name in names])
    norms = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    values, _, rank, _ = np.linalg.lstsq(columns / norms, linear.errors, rcond=1e-6)
    left = linear.errors - columns / norms @ values
    return float(left @ left), int(rank)


def equals(linear: Linear, chosen: Sequence[str], name: str) -> tuple[str, ...]:
    """Return an effect and those that would do nearly as well in its place, best first."""
    rest = [other for other in chosen if other != name]
    own = bic(linear, chosen)
    scores = {other: bic(linear, [*rest, other]) for other in linear.columns if other not in chosen}
    return (name, *(o for o in sorted(scores, key=scores.__getitem__) if scores[o] < own + NEARLY))
