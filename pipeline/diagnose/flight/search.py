"""Forward selection of effects in flight, as long as each improves the predictions of held-out episodes.

A score may be significant where an effect only compensates an error in the law of another: an isotropic drag of a box
leaves a small residual that a shifted centre of mass fits. A second effect therefore has to improve held-out
predictions, and to explain most of the residual or to repeat from episode to episode beside their scatter; otherwise
the residual stays unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...physics.world import World
from ...segments.candidates import Candidate, without_effects
from ...segments.prepare import Prepared
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ..evidence.cross_validation import held_out_loss
from ..evidence.effect_selection import SelectionStep, repeats, select_next
from ..thresholds import THRESHOLDS
from .coupled_effects import DRAGS, drag_in_wind

LIMITS = THRESHOLDS.flight


def flight_search(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], scatter: float
) -> tuple[list[SelectionStep], World, Segments | None]:
    """Select effects in flight one after the other.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All candidates.
        scatter: Factor by which variances exceed those of the noise.

    Returns:
        The selection steps (without a selected effect the one step that selected none), the world with the best effect
        of each step, and the flight segments with states fitted by it; None without flight.
    """
    if prepared.flight is None:
        return [], world, None
    steps, losses, current, flight = _forward_selection(prepared, prepared.flight, world, candidates, scatter)
    if len(steps) < 2:
        return steps, current, flight
    coupled = _coupled(prepared, world, steps, candidates, scatter)
    if coupled is not None and held_out_loss(coupled[2], coupled[1]) < losses[0]:
        return coupled
    return reselected(prepared, steps[:-1], steps[-1:], (current, flight), candidates, scatter)


def _forward_selection(
    prepared: Prepared, flight: Segments, world: World, candidates: Sequence[Candidate], scatter: float
) -> tuple[list[SelectionStep], list[float], World, Segments]:
    """Select effects until none is significant, or one explains or predicts too little.

    Returns:
        The steps; the held-out losses before the second effect and after each effect from the second on; the world
        with the selected effects; and the segments with states fitted by it.
    """
    steps: list[SelectionStep] = []
    losses: list[float] = []
    current = world
    while len(steps) < LIMITS.most_effects:
        step = select_next(flight, current, candidates, prepared.groups, prepared.has_orientation, scatter)
        refitted = step.best.refitted if step.flagged else None
        if refitted is None:
            steps = steps or [step]
            break
        before = steps[-1].best.refitted if steps else None
        if before is not None:
            excess = before.cost - float(flight.dof.sum()) * scatter
            if before.cost - refitted.cost < LIMITS.share * excess and not _is_sure(step):
                break
            losses = losses or [held_out_loss(flight, current)]
            losses.append(held_out_loss(refitted.segments[0], refitted.world))
            if not losses[-1] < losses[-2]:
                break
        steps.append(step)
        current, flight = refitted.world, refitted.segments[0]
    return steps, losses, current, flight


def _is_sure(step: SelectionStep) -> bool:
    """Return whether an effect repeats from episode to episode, whatever else is left.

    What the first effect's law misses differs with each motion, and bursts or tilts of single episodes, which are most
    of what is left in tracks of real systems, ask for no more effects.
    """
    return repeats(step.best, len(step.evidence))


def reselected(
    prepared: Prepared,
    steps: Sequence[SelectionStep],
    others: Sequence[SelectionStep],
    found: tuple[World, Segments],
    candidates: Sequence[Candidate],
    scatter: float,
) -> tuple[list[SelectionStep], World, Segments]:
    """Select each of some effects again, in the presence of all the others that are selected now.

    Args:
        prepared: The episodes.
        steps: The steps that are taken again.
        others: The other steps, which stay.
        found: World with all selected effects, and the flight segments with states fitted by it.
        candidates: All candidates.
        scatter: Factor by which variances exceed those of the noise.
    """
    current, flight = found
    chosen = list(steps)
    for place, old in enumerate(steps):
        without = without_effects(current, old.best.name)
        if len(without.effects) < len(current.effects) - 1:
            continue  # another effect acts through this one
        states = fit_states(flight.in_world(without))
        step = select_next(states, without, candidates, prepared.groups, prepared.has_orientation, scatter)
        refitted = step.best.refitted if step.flagged else None
        if refitted is not None:
            chosen[place] = step
            current, flight = refitted.world, refitted.segments[0]
    return [*chosen, *others], current, flight


def _coupled(
    prepared: Prepared, world: World, steps: Sequence[SelectionStep], candidates: Sequence[Candidate], scatter: float
) -> tuple[list[SelectionStep], World, Segments] | None:
    """Return a drag in wind in place of the selected effects; None where it does not explain the flights better."""
    last = steps[-1].best.refitted
    if prepared.flight is None or last is None or not any(step.best.name in DRAGS for step in steps):
        return None
    count = float(prepared.flight.dof.sum())
    present = {a.effect.name for a in world.effects}
    kept = [candidate for candidate in candidates if candidate.effect.name not in present]
    coupled = drag_in_wind(prepared.flight, world, kept, count, scatter)
    size = sum(len(step.best.candidate.effect.parameters) for step in steps)
    if coupled is None or coupled.total > last.cost / scatter + size * math.log(count) - LIMITS.alias_chi2:
        return None
    rest = steps[0].evidence
    selected = [SelectionStep((one, *rest), (one,), True) for one in (coupled.drag, coupled.wind)]
    return selected, coupled.refitted.world, coupled.refitted.segments[0]
