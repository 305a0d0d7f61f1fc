"""The rows of the benchmark's table: who competes, and with how much time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cgwm.datasets.scenes.objects import SolidObject

from .base import Contender
from .cem_mujoco import CemMujoco
from .cgwm_default import Cgwm
from .zeros import Ballistic, Frozen

REFERENCE = "cgwm"
"""The row whose measured fit time is the others' budget, in the same cell."""


@dataclass(frozen=True)
class Row:
    """A contender, and its budget in units of the reference's fit time; None: it takes the time that it takes."""

    make: Callable[[], Contender]
    budget: float | None = None


def true_solid(capture: Path) -> SolidObject:
    """Return the true object of a capture of the benchmark."""
    from tabletop import read_solid

    return read_solid(capture)


ROWS: dict[str, Row] = {
    REFERENCE: Row(Cgwm),
    "cgwm, geometry fixed": Row(lambda: Cgwm("cgwm, geometry fixed", {"geometry": False})),
    **{
        f"{name}, {factor}x": Row(lambda name=name, solid=solid: CemMujoco(name, solid), factor)
        for name, solid in (
            ("CEM + MuJoCo + R, true mesh", true_solid),
            ("CEM + MuJoCo + R, learned shape", None),
        )
        for factor in (1, 4)
    },
    "frozen": Row(Frozen),
    "ballistic": Row(Ballistic),
}
