"""The rows of the benchmark's table: who competes, and with how much time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .base import Contender
from .cgwm_default import Cgwm
from .zeros import Ballistic, Frozen

REFERENCE = "cgwm"
"""The row whose measured fit time is the others' budget, in the same cell."""


@dataclass(frozen=True)
class Row:
    """A contender, and its budget in units of the reference's fit time; None: it takes the time that it takes."""

    make: Callable[[], Contender]
    budget: float | None = None


ROWS: dict[str, Row] = {
    REFERENCE: Row(Cgwm),
    "cgwm, geometry fixed": Row(lambda: Cgwm("cgwm, geometry fixed", {"geometry": False})),
    "frozen": Row(Frozen),
    "ballistic": Row(Ballistic),
}
