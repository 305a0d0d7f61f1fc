"""Sizes of hidden effects, so that they move the body by a drawn multiple of the slow error.

The ratio is log-uniform between 3 and 100. What an effect moves is the motion with it minus the same motion without it,
less what it is at the first frame, at its largest; in places [m] over the slow error of a coordinate, or, where larger
and orientations are measured, in angles over the slow error about an axis. Looked at are

- effects of flight, of the measurement and in no library: from the release to the first touch;
- effects of contact: all of the episodes that begin on the ground (slides, a ball's rolls); for restitution and
  adhesion 0.2 s from the first touch on, since a tumbling body forgets where it came from;

what comes with an effect, as the drag with the wind, is in both motions, or the drag alone would reach the ratio of a
wind of millimetres in a second. The ratio of a capture is that of its second strongest training episode, of the
strongest where fewer than three are looked at. No draw is discarded: where a ratio cannot be reached (a friction cannot
be negative), the effect has its largest or smallest size and the truth the ratio that it reached.

Sizes of effects of contact are bounded by what surfaces do. Below: friction of one pair of surfaces differs by 5 % and
more from day to day and place to place (measured pushes of one plate on one board: 0.289 to 0.326, docs/real-data.md),
so that an effect of less, a tenth of a usual large one, is none. Above: friction at rest exceeds sliding friction by at
most 0.3 in tables of dry pairs; restitution falls with speed as v^-1/4 (Johnson, Contact Mechanics, 11.5), at 3 m/s to
three quarters of its value at 1 m/s; a face of 10 cm with friction 0.5 brakes its spin by 0.02 m times its load; and a
body that a surface holds by more than its weight sticks to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.hidden_effects import EFFECTS
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Mechanics, Motion, Start, build
from cgwm.datasets.synthetic.hidden_effects.record import poses
from cgwm.datasets.synthetic.hidden_effects.things import Array, Thing

from .errors import Errors, between

LEAST_RATIO, MOST_RATIO = 3.0, 100.0
MOST_SIZE = {"anisotropic_friction": 1.0, "inertia_shape": 1.8, "friction_patch": 1.3, "com_offset": 2.0}
MOST_SIZE |= {"marker_offset": 1.5}
MOST_SIZE |= {"stribeck_friction": 1.2, "velocity_restitution": 1.0, "torsional_friction": 1.3, "adhesion": 1.0}
"""The largest size, in usual large ones; 3 for all others."""
LEAST_SIZE, LEAST_CONTACT = 1e-3, 0.1
"""The smallest size, in usual large ones, and that of effects of contact."""
_LOOKED_AT = 4
_STEPS = 4
_CLOSE = 0.1
_IMPACTS = ("velocity_restitution", "adhesion")
_AFTER_TOUCH_S = 0.2
_GRID_S = 0.004


@dataclass(frozen=True, eq=False, kw_only=True)
class Bench:
    """What a size is tried on: a body, its engine, training episodes (kind of motion and start), and its errors."""

    thing: Thing
    world: Mechanics
    simulate: Callable[[Mechanics, Sequence[Hidden], Start, float], Motion]
    episodes: Sequence[tuple[str, Start]]
    length_s: float
    errors: Errors
    turned: bool


@dataclass(frozen=True, eq=False)
class Sized:
    """An effect, its size, the ratio that was drawn and the one that it reaches."""

    effect: Hidden
    size: float
    drawn_ratio: float
    ratio: float

    def facts(self) -> dict[str, Any]:
        """Return the numbers for the truth."""
        return {"size": self.size, "drawn_ratio": self.drawn_ratio, "ratio": self.ratio}


def sized_effect(name: str, bench: Bench, seed: Sequence[int]) -> Sized:
    """Return an effect whose size moves the body by a drawn multiple of the slow error; see the module.

    Args:
        name: The effect.
        bench: What it is tried on.
        seed: Of the ratio, and of the directions and signs of the effect, which do not depend on its size.
    """
    entry = EFFECTS[name]
    wanted = between(np.random.default_rng([*seed, 1]), LEAST_RATIO, MOST_RATIO)
    large = entry.large[bench.thing.kind]
    least, most = (LEAST_CONTACT if entry.acts == "contact" else LEAST_SIZE) * large, MOST_SIZE.get(name, 3.0) * large

    def drawn(size: float) -> Hidden:
        return entry.draw(bench.thing, size, np.random.default_rng([*seed, 2]))

    looked_at, along = _episodes(name, bench), [drawn(0.0)] if drawn(min(large, most)).comes_with else []
    beside = build(bench.world, along)
    plain = [bench.simulate(beside, along, start, bench.length_s) for start in looked_at]
    windows = [_window(name, motion, bench.length_s) for motion in plain]
    size, best = min(large, most), (np.inf, 0.0, 0.0)
    for _ in range(_STEPS):
        ratio = _ratio(drawn(size), bench, looked_at, plain, windows)
        off = abs(np.log(max(ratio, 1e-9) / wanted))
        best = min(best, (off, size, ratio))
        if off < _CLOSE or (size >= most and ratio <= wanted) or (size <= least and ratio >= wanted):
            break
        size = float(np.clip(size * wanted / max(ratio, 1e-3 * wanted), least, most))
    _, size, ratio = best
    return Sized(drawn(size), size, wanted, ratio)


def _episodes(name: str, bench: Bench) -> list[Start]:
    """Return the starts of the episodes in which an effect is looked at."""
    every = [start for _, start in bench.episodes]
    grounded = ("slide", "roll") if bench.thing.kind == "ball" else ("slide",)
    airborne = [start for kind, start in bench.episodes if kind in ("throw", "drop")]
    if EFFECTS[name].acts == "contact" and name not in _IMPACTS:
        chosen = [start for kind, start in bench.episodes if kind in grounded]
    else:
        chosen = airborne
    return (chosen or every)[:_LOOKED_AT]


def _window(name: str, motion: Motion, length_s: float) -> Array:
    """Return the times at which an effect is looked at."""
    touched = motion.time_s[motion.touching]
    first = float(touched[0]) if touched.size else length_s
    begin, end = 0.0, first
    if EFFECTS[name].acts == "contact":
        begin, end = (first, first + _AFTER_TOUCH_S) if name in _IMPACTS else (0.0, length_s)
    grid = np.arange(0.0, length_s, _GRID_S)
    inside = grid[(grid >= begin) & (grid <= end)]
    return inside if inside.size > 1 else grid


def _ratio(
    effect: Hidden, bench: Bench, starts: Sequence[Start], plain: Sequence[Motion], windows: Sequence[Array]
) -> float:
    world = build(bench.world, [effect])
    ratios = []
    for start, without, times in zip(starts, plain, windows, strict=True):
        motion = bench.simulate(world, [effect], start, float(times[-1]) + 2 * _GRID_S)
        # what is measured at a time is what happened at time / clock
        position, rotation = poses(motion, times / effect.clock)
        if effect.observe:
            position, rotation = effect.observe(position, rotation)
        true_position, true_rotation = poses(without, times)
        moved = position - true_position
        far = float(np.linalg.norm(moved - moved[0], axis=1).max()) / bench.errors.slow_m
        if bench.turned:
            far = max(far, _turned(rotation, true_rotation) / bench.errors.slow_rad)
        ratios.append(far)
    return sorted(ratios)[-2 if len(ratios) > 2 else -1]


def _turned(rotation: Array, without: Array) -> float:
    """Return the largest angle [rad] between two sequences of rotations (T, 3, 3), less that at their first."""
    gap = np.einsum("tji,tjk->tik", without, rotation)
    since = np.einsum("tij,kj->tik", gap, gap[0])
    return float(np.arccos(((np.trace(since, axis1=1, axis2=2) - 1) / 2).clip(-1, 1)).max())
