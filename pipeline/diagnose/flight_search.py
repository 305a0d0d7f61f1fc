"""The search in flight: effects one after the other, each beside those found before, as long as they predict better.

A score may be significant where an effect only patches up the law of another: a drag that is the same from all sides,
of a box, leaves a little for a shifted centre of mass. So what comes second has to predict held-out episodes, and to
explain most of what the first one leaves; else that stays unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..physics.world import World
from .bundles import DRAGS, drag_in_wind
from .candidates import Candidate, without_effect
from .forecast import held_out_loss
from .prepared import Prepared
from .segment_states import fit_states
from .segments import Segments
from .slots import ALIAS_CHI2, Slot, fill

MOST_EFFECTS = 3
"""So many effects are looked for in flight, one after the other."""

SHARE = 0.6
"""What comes second explains at least this share of the excess of chi2 that is left. On development seeds true ones
explain 0.83 or more, and those that patch up the law of a drag 0.42 at most, where there is anything to explain."""


def flight_search(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], scatter: float
) -> tuple[list[Slot], World, Segments | None]:
    """Return the slots that effects fill in flight, the world with the best of each, and the segments there."""
    flight, slots, current = prepared.flight, [], world
    if flight is None:
        return [], world, None
    losses: list[float] = []
    while len(slots) < MOST_EFFECTS:
        slot = fill(flight, current, candidates, prepared.groups, prepared.turned, scatter)
        if not slot.flagged:
            slots = slots or [slot]
            break
        refitted = slot.best.refitted
        assert refitted is not None
        if slots:
            before = slots[-1].best.refitted
            assert before is not None  # it was flagged
            excess = before.cost - float(flight.dof.sum()) * scatter
            if before.cost - refitted.cost < SHARE * excess:
                break
            losses = losses or [held_out_loss(flight, current)]
            losses.append(held_out_loss(refitted.segments[0], refitted.world))
            if not losses[-1] < losses[-2]:
                break
        slots.append(slot)
        current, flight = refitted.world, refitted.segments[0]
    filled = [slot for slot in slots if slot.flagged]
    if len(filled) > 1:
        bundled = _bundled(prepared, world, filled, candidates, scatter)
        if bundled is not None and held_out_loss(bundled[2], bundled[1]) < losses[0]:
            return bundled
        for place in range(len(filled) - 1):  # the first were chosen before the others were known
            without = without_effect(current, filled[place].best.name)
            if len(without.effects) < len(current.effects) - 1:
                continue  # another effect acts through this one
            states = fit_states(flight.in_world(without))
            slot = fill(states, without, candidates, prepared.groups, prepared.turned, scatter)
            refitted = slot.best.refitted
            if slot.flagged and refitted is not None:
                filled[place] = slot
                current, flight = refitted.world, refitted.segments[0]
        slots = filled
    return slots, current, flight


def _bundled(
    prepared: Prepared, world: World, filled: Sequence[Slot], candidates: Sequence[Candidate], scatter: float
) -> tuple[list[Slot], World, Segments] | None:
    """Return a drag in wind in place of what was found, where that explains the flights better."""
    last = filled[-1].best.refitted
    if prepared.flight is None or last is None or not any(slot.best.name in DRAGS for slot in filled):
        return None
    count = float(prepared.flight.dof.sum())
    present = {a.effect.name for a in world.effects}
    kept = [candidate for candidate in candidates if candidate.effect.name not in present]
    bundle = drag_in_wind(prepared.flight, world, kept, count, scatter)
    numbers = sum(len(slot.best.candidate.effect.parameters) for slot in filled)
    if bundle is None or bundle.total > last.cost / scatter + numbers * math.log(count) - ALIAS_CHI2:
        return None
    rest = filled[0].evidence
    slots = [Slot((one, *rest), (one,), True) for one in (bundle.drag, bundle.wind)]
    return slots, bundle.refitted.world, bundle.refitted.segments[0]
