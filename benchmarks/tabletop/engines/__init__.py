"""The engines whose motions are the truth of Fall, Push and Tip; Bullet and PhysX are held out.

Each has a law of contact of its own. Given are a ground's friction and the restitution of a ball on it; what else an
engine wants to know is its own, and stands in its module.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module

from cgwm.datasets.synthetic.dynamics import ContactTruth
from cgwm.datasets.synthetic.objects import SolidObject

from . import dart_engine, drake_engine, mujoco_engine, own_engine, rapier_engine
from .stepper import Engine

Maker = Callable[[SolidObject, ContactTruth, bool], Engine]
"""Makes an engine of an object, its contact, and whether there is a fingertip."""


@dataclass(frozen=True)
class Entry:
    """An engine: what makes it, the module that it needs, and whether it takes solids whose parts are no boxes."""

    make: Maker
    module: str
    any_solid: bool = True


ENGINES: dict[str, Entry] = {
    "mujoco": Entry(mujoco_engine.Coulomb, "mujoco"),
    "mujoco_pyramid": Entry(mujoco_engine.Pyramid, "mujoco"),
    "mujoco_default": Entry(mujoco_engine.Default, "mujoco"),
    "drake": Entry(drake_engine.Drake, "pydrake"),
    "dart": Entry(dart_engine.Dart, "dartpy", any_solid=False),
    "rapier": Entry(rapier_engine.Rapier, "rapier3d"),
    "cgwm": Entry(own_engine.Own, "torch"),
}
"""By name; `mujoco` is the truth of the older tables."""
PARTS = ("cgwm", "mujoco_pyramid")
"""cgwm's own, which only an error budget takes as the truth, and what differs from another by one part of its law."""
JUDGES = tuple(name for name in ENGINES if name not in PARTS)
"""The engines that judge."""


def refusal(name: str, solid: SolidObject) -> str | None:
    """Return why an engine cannot simulate a solid, or None where it can."""
    entry = ENGINES[name]
    if not entry.any_solid and not all(dart_engine.is_box(part) for part in solid.parts):
        return "its collision detector knows no convex parts but boxes"
    return _missing(entry.module)


@cache
def _missing(module: str) -> str | None:
    """Return why a module cannot be imported: it is not installed, or a library of the system that it needs is not."""
    try:
        import_module(module)
    except ImportError as error:
        return f"{module} cannot be imported: {error} (pip install --no-deps -r benchmarks/requirements.txt)"
    return None
