"""Fits of candidates to sliding segments, from starts and with as many steps as their valleys need."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...physics.parameters import FRICTION
from ...physics.state import State
from ..candidates import Variant
from ..contact_phases import is_round
from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS
from .descent import ITERATIONS, SlidingFit
from .fit import StartedSliding, better_starts, fit_sliding
from .separate_starts import separate_starts
from .support import on_surfaces

FIRST_ITERATIONS = 3
"""Number of iterations after which fits that are far behind are not continued."""
MOST_PASSES = 5
"""Maximum number of continuations of the fits that are close. A slide that ends within a segment allows small steps
only, and a fit that has not converged would lose against one that needs fewer."""
STALLED = 30.0
"""How many times as large as in the best fit of all the chi2 of a segment is that stalled."""
GRIP = 0.3
"""Friction with which a ball rolls down a surface of up to 46 degrees, from which fits start, too."""
MANY = 4
"""Maximum number of parameters of a candidate that is fitted in a batch with smaller ones. The longest fit determines
the time of a batch."""


def fits_of_variants(
    variants: Sequence[Variant], started: StartedSliding, least: float, close_share: float, converged: float
) -> list[tuple[Variant, SlidingFit]]:
    """Return the fit of each variant; those that are far behind after the first iterations do not converge.

    Args:
        variants: The variants.
        started: The sliding segments and their fit without the variants.
        least: Smallest fall of chi2 of interest.
        close_share: Share of the largest fall from which on a fit is continued.
        converged: Fall of chi2 by a continuation below which it is the last one.
    """
    soft_world, base, known = started.segments.world, started.base, started.flight_parameters
    found: dict[int, tuple[Variant, SlidingFit]] = {}
    for part in batches(variants):
        tried = fit_sliding(soft_world, part, _starts(part, started), known, FIRST_ITERATIONS)
        if on_surfaces(soft_world):
            # without an effect the fit may let a ball slip that rolls
            gripped = (started.separate.segments, torch.tensor([FRICTION.encode(GRIP)]).to(base.values))
            others = fit_sliding(soft_world, part, [gripped] * len(part), known, FIRST_ITERATIONS)
            tried = [min(pair, key=lambda fit: fit.cost) for pair in zip(tried, others, strict=True)]
        found |= {len(found) + k: one for k, one in enumerate(zip(part, tried, strict=True))}
    found = _continued(found, started, FIRST_ITERATIONS)
    gains = {k: base.cost - fit.cost for k, (_, fit) in found.items()}
    bar = max(least, close_share * max(gains.values()))
    close = {k: found[k] for k, gain in gains.items() if gain > bar}
    for _ in range(MOST_PASSES):
        again = _continued(close, started, ITERATIONS)
        found |= again
        fell = [k for k in close if close[k][1].cost - again[k][1].cost > converged]
        close = {k: again[k] for k in fell if len(again[k][0].parameters) <= MANY}
    return _unstuck(list(found.values()), started)


def _unstuck(found: list[tuple[Variant, SlidingFit]], started: StartedSliding) -> list[tuple[Variant, SlidingFit]]:
    """Return fits, those continued from the best states of all whose cost is mostly that of segments that stalled.

    The state of one segment at a wrong minimum would decide against an effect that explains all others.
    """
    chi2 = torch.stack([fit.chi2 for _, fit in found])
    best, owner = chi2.min(0)
    count, every = chi2.shape[1], State.joined(*(fit.segments.observations.state for _, fit in found))
    place, done = torch.arange(count), list(found)
    for k, (variant, fit) in enumerate(found):
        stuck = fit.chi2 > STALLED * best
        if float((fit.chi2 - best)[stuck].sum()) < 0.5 * fit.cost:
            continue
        states = every.at(torch.where(stuck, owner, k) * count + place)
        start = fit.segments.with_state(states), fit.values[0]
        again = fit_sliding(started.segments.world, [variant], [start], started.flight_parameters, ITERATIONS)[0]
        if again.cost < fit.cost:
            done[k] = variant, again
    return done


def _starts(part: Sequence[Variant], started: StartedSliding) -> list[tuple[Segments, Tensor]]:
    """Return where the fits of variants start: at the fit without them, or nearer where that one stalled."""
    base = started.base
    known = [(base.segments, base.values[0])] * len(part)
    if base.cost < SEGMENT_THRESHOLDS.sliding_data.well_fitted * float(started.segments.dof.sum()):
        return known
    separate = {
        id(v): one
        for some in batches(part, alike=False)
        for v, one in zip(some, separate_starts(started, some), strict=True)
    }
    found = (separate[id(variant)] for variant in part)
    return [one[:2] if one[2] < base.cost else other for one, other in zip(found, known, strict=True)]


def _continued(
    some: dict[int, tuple[Variant, SlidingFit]], started: StartedSliding, iterations: int
) -> dict[int, tuple[Variant, SlidingFit]]:
    """Return fits of variants continued from better starts, by the same keys."""
    world, known = started.segments.world, started.flight_parameters
    rolls = on_surfaces(world) and is_round(world.bodies[started.segments.observations.free[0]])
    done: dict[int, tuple[Variant, SlidingFit]] = {}
    for part in batches([variant for variant, _ in some.values()]):
        mine = {k: fit for k, (variant, fit) in some.items() if any(variant is one for one in part)}
        many = len(part[0].parameters) > MANY
        plain = [(fit.segments, fit.values[0]) for fit in mine.values()]
        # a ball that rolls down a surface does not come to rest by friction: there are no valleys
        starts = plain if many or rolls else better_starts(world, part, list(mine.values()), known)
        again = fit_sliding(world, part, starts, known, iterations)
        done |= {k: (variant, fit) for k, variant, fit in zip(mine, part, again, strict=True)}
    return done


def batches(variants: Sequence[Variant], alike: bool = True) -> list[list[Variant]]:
    """Split variants into batches that are computed at once, in order.

    The fused kernel takes one effect of a kind; variants of many parameters slow a batch down and are kept apart.

    Args:
        variants: The variants.
        alike: Whether a batch may have a candidate with several values of its constants, one for each item.
    """
    parts: list[list[Variant]] = []
    for variant in variants:
        part = next((part for part in parts if all(_go_together(one, variant, alike) for one in part)), None)
        if part is None:
            parts.append([variant])
        else:
            part.append(variant)
    return parts


def _go_together(one: Variant, other: Variant, alike: bool) -> bool:
    """Return whether two variants may be in one batch."""
    if (len(one.parameters) > MANY) != (len(other.parameters) > MANY):
        return False
    return type(one.active.effect) is not type(other.active.effect) or (alike and one.place == other.place)
