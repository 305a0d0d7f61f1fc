"""Restitution of each engine's own law of contact over the speed: which of them have `velocity_restitution` themselves.

    python -m real_like.restitution            # from benchmarks/

A ball comes down without spin on level ground, and what is left of its speed is measured, with nothing hidden. Where
the restitution at `FAST_M_S` is less than 1 - `LEAST_FALL` of that at `SLOW_M_S`, the engine's law has one that falls
with the speed, and `velocity_restitution` counts neither way there: what is so in the motion is no wrong name for it,
and none for what was hidden. The least fall is a fifth of what restitution loses between these speeds by v^-1/4.
"""

from __future__ import annotations

import sys

import numpy as np
from cgwm.datasets.synthetic.hidden_effects import Case
from cgwm.datasets.synthetic.hidden_effects.mechanics import Mechanics, Start
from cgwm.datasets.synthetic.hidden_effects.things import Thing

from .engines import GROUPS, missing

SLOW_M_S, FAST_M_S = 1.0, 3.0
LEAST_FALL = 0.05
SPEEDS_M_S = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
_ABOVE_M = 1e-3


def rebound(group: str, thing: Thing, speed_m_s: float) -> float:
    """Return the restitution of a ball that comes down without spin at a speed, as an engine makes it.

    Args:
        group: Of `GROUPS`.
        thing: The ball.
        speed_m_s: Its speed at the ground.
    """
    engine, law = GROUPS[group]
    radius = float(thing.half_extents_m[2])
    start = Start(
        np.array([0.0, 0.0, radius + _ABOVE_M]), np.array([1.0, 0, 0, 0]), np.array([0.0, 0, -speed_m_s]), np.zeros(3)
    )
    motion = engine.simulate(Mechanics.of(thing, law), [], start, 0.08)
    time, height = motion.time_s, motion.position_m[:, 2]
    lowest = int(np.argmax(np.diff(height) > 0))  # of the first impact
    # a parabola through what flies up again, so that no step's own kind of velocity matters
    free = np.flatnonzero((np.arange(len(time)) > lowest) & (height > radius + 1e-4))
    free = free[: int(np.argmax(np.diff(free, append=len(time) + 1) > 1)) + 1]  # until it comes down again
    if free.size < 4:
        return 0.0
    since = time[free] - time[free[0]]
    up = np.polyfit(since, height[free] + 0.5 * 9.81 * since**2, 1)[0]
    went_up = up**2 + 2 * 9.81 * (height[free[0]] - radius)
    came_down = speed_m_s**2 + 2 * 9.81 * _ABOVE_M
    return float(np.sqrt(went_up / came_down))


def has_fall(group: str, thing: Thing) -> bool:
    """Return whether the restitution of an engine falls with the speed of an impact."""
    return rebound(group, thing, FAST_M_S) < (1 - LEAST_FALL) * rebound(group, thing, SLOW_M_S)


def ball(seed: int = 0) -> Thing:
    """Return a drawn ball."""
    return Case(name="rebound", thing="ball", effects=(), seed=seed).drawn_thing()


def main() -> int:
    """Print the curves."""
    thing = ball()
    print("| motions | " + " | ".join(f"{speed:g} m/s" for speed in SPEEDS_M_S) + " | restitution falls | declared |")
    print("|---" * (len(SPEEDS_M_S) + 3) + "|")
    for group in GROUPS:
        if missing(group):
            print(f"{group} is not run: {missing(group)} is not installed.", file=sys.stderr)
            continue
        found = [rebound(group, thing, speed) for speed in SPEEDS_M_S]
        falls = "yes" if has_fall(group, thing) else "no"
        declared = "yes" if "velocity_restitution" in GROUPS[group][0].facts(thing)["comes_with"] else "no"
        print(f"| {group} | " + " | ".join(f"{one:.3f}" for one in found) + f" | {falls} | {declared} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
