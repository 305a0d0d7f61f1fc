"""The rows of the benchmark's table: who competes, and with how much time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from cgwm.datasets.synthetic.objects import SolidObject
from rivals.dreamer import DreamerV3
from rivals.pinwm import PinWmItself

from .base import Contender
from .cem_mujoco import CemMujoco
from .cgwm_default import Cgwm
from .floor import Floor
from .latent import Latent
from .paper import Paper
from .pinwm import PinWm
from .true_parts import Part, TruePart
from .zeros import Ballistic, Frozen

REFERENCE = "cgwm"
"""The row whose measured fit time is the others' budget, in the same cell."""


@dataclass(frozen=True)
class Row:
    """A contender, and its budget in units of the reference's fit time; None: it takes the time that it takes.

    fetched: it is a rival's own code, which has to be fetched (docs/rivals.md), and runs where it is asked for alone.
    """

    make: Callable[[], Contender]
    budget: float | None = None
    fetched: bool = False


def true_solid(capture: Path) -> SolidObject:
    """Return the true object of a capture of the benchmark."""
    from tabletop import read_solid

    return read_solid(capture)


def _mujoco(shape: str, solid: Callable[[Path], SolidObject] | None, budget: float) -> tuple[str, Row]:
    name = f"CEM + MuJoCo + R, {shape}, {budget:g}x"
    return name, Row(lambda: CemMujoco(name, solid), budget)


def _pinwm(budget: float) -> tuple[str, Row]:
    name = f"in the manner of PIN-WM, {budget:g}x"
    return name, Row(lambda: PinWm(name), budget)


def _paper(budget: float) -> tuple[str, Row]:
    name = f"the paper's form, {budget:g}x"
    return name, Row(lambda: Paper(name), budget)


def _latent(data: str, solid: Callable[[Path], SolidObject] | None, budget: float) -> tuple[str, Row]:
    name = f"latent, {data}, {budget:g}x"
    return name, Row(lambda: Latent(name, solid), budget)


def _fetched(name: str, make: Callable[[str], Contender]) -> list[tuple[str, Row]]:
    """Return the rows of a rival itself: as long as it takes, and four times the reference's time."""
    rows = ((name, None), (f"{name}, 4x", 4.0))
    return [(shown, Row(partial(make, shown), budget, fetched=True)) for shown, budget in rows]


def _true(part: Part) -> tuple[str, Row]:
    name = f"{REFERENCE}, true {part}"
    return name, Row(lambda: TruePart(name, part))


FLOOR = Floor.name
REFINED = f"{REFERENCE}, geometry refined"
PUBLISHED = f"{REFERENCE}, contact_law=paper"
PUBLISHED_FIXED = f"{PUBLISHED}, geometry=false"

ROWS: dict[str, Row] = dict(
    (
        (REFERENCE, Row(Cgwm)),
        (REFINED, Row(lambda: Cgwm(REFINED, {"geometry": True}))),
        (PUBLISHED, Row(lambda: Cgwm(PUBLISHED, {"contact_law": "paper"}))),
        (PUBLISHED_FIXED, Row(lambda: Cgwm(PUBLISHED_FIXED, {"contact_law": "paper", "geometry": False}))),
        _paper(4),
        _mujoco("true mesh", true_solid, 1),
        _mujoco("true mesh", true_solid, 4),
        _mujoco("learned shape", None, 1),
        _mujoco("learned shape", None, 4),
        _pinwm(1),
        _pinwm(4),
        _latent("the same frames", None, 1),
        _latent("the same frames", None, 4),
        _latent("100 true trajectories", true_solid, 1),
        _latent("100 true trajectories", true_solid, 4),
        (Frozen.name, Row(Frozen)),
        (Ballistic.name, Row(Ballistic)),
        (Floor.name, Row(Floor)),
        _true("shape"),
        _true("mass"),
        _true("poses"),
        *_fetched("PIN-WM", PinWmItself),
        *_fetched("DreamerV3, 100 true trajectories", lambda name: DreamerV3(name, true_solid)),
    )
)
"""By name, in the table's order."""
