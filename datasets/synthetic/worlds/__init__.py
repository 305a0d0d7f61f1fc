"""Synthetic worlds with fixed surfaces: five objects in a bin, a block and a ball on a ramp, as tracked captures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ....schemas import UsageError, did_you_mean
from ....schemas.quantities import MOST_SEED
from ...io.atomic import new_directory
from .bin import plan_bin
from .ramp import plan_ramp
from .record import TRUTH_FILE, record
from .scene import WorldPlan

__all__ = ["TRUTH_FILE", "WORLDS", "WorldPlan", "make_world", "plan_world"]

_PLANNERS: dict[str, Callable[[int], WorldPlan]] = {"bin": plan_bin, "ramp": plan_ramp}
WORLDS = tuple(_PLANNERS)
"""Names of the worlds."""


def plan_world(name: str, seed: int = 0) -> WorldPlan:
    """Draw the bodies, the true physics and the starts of every episode of a world, without simulating it.

    Args:
        name: One of `WORLDS`.
        seed: Any integer from 0 to `MOST_SEED`.

    Raises:
        UsageError: If the name or the seed is not allowed.
    """
    if name not in _PLANNERS:
        raise UsageError(
            f"unknown scene '{name}'.", ", ".join(WORLDS) + "." + did_you_mean(name, WORLDS), "name one of these."
        )
    if not 0 <= seed <= MOST_SEED:
        raise UsageError(f"the seed is {seed}.", f"integers from 0 to {MOST_SEED}.", "pass another --seed.")
    return _PLANNERS[name](seed)


def make_world(name: str, out: Path | str, seed: int = 0, overwrite: bool = False) -> WorldPlan:
    """Write the capture of a world: meshes, surfaces, materials, tracks and `truth.json`; return its plan.

    Args:
        name: One of `WORLDS`.
        out: Directory of the capture.
        seed: Seed of the bodies, their friction, the starts and the noise.
        overwrite: Replace what is at `out`.

    Raises:
        UsageError: If a name or a number is not allowed, or `out` exists.
    """
    plan = plan_world(name, seed)
    with new_directory(Path(out), "capture", overwrite) as directory:
        record(plan, directory)
    return plan
