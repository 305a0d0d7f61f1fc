"""The engines that make real-like captures; none of them is cgwm's, Bullet or PhysX, which are held out.

A group is an engine with one setting of its contacts. `missing(group)` tells what is not installed.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from cgwm.datasets.synthetic.hidden_effects import mujoco_engine
from hidden_effects import drake_engine

from . import dart_engine, mujoco_soft, rapier_engine

GROUPS: dict[str, tuple[Any, int]] = {
    "mujoco_hard": (mujoco_engine, 1),
    "mujoco_graded": (mujoco_engine, 2),
    "mujoco_soft": (mujoco_soft, 1),
    "drake": (drake_engine, 1),
    "dart": (dart_engine, 1),
    "rapier": (rapier_engine, 1),
}
"""Module and law of contact of each group; a module has `simulate`, `facts` and, if it cannot all, `possible`."""
ENGINE_OF = {name: name.split("_")[0] for name in GROUPS}
_PACKAGES = {
    "drake": ("drake", "pydrake"),
    "dart": ("dartpy", "dartpy"),
    "rapier": ("rapier3d", "rapier3d"),
    "mujoco": ("mujoco", "mujoco"),
}
"""Of each engine: what pip calls its package, and what Python does."""


@cache
def missing(group: str) -> str | None:
    """Return the package that a group's engine needs and that is not installed, or lacks a library, or None."""
    package, module = _PACKAGES[ENGINE_OF[group]]
    try:
        import_module(module)
    except ImportError:
        return package
    return None


def can_hide(group: str, name: str) -> bool:
    """Return whether a group can hide an effect: some need the friction or the normal force of every step."""
    limited: dict[str, tuple[str, ...]] = {"mujoco_hard": (), "mujoco_graded": ()}
    touching = ("stribeck_friction", "friction_patch", "velocity_restitution")
    forces = ("rolling_resistance", "torsional_friction", "anisotropic_friction")
    only_stiff = ("velocity_restitution",)
    limited["mujoco_soft"] = only_stiff
    return name not in limited.get(group, (*touching, *forces))
