"""The verdict: what is missing, what else it could be, whether something remains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ..physics.effects.effect import ActiveEffect
from ..physics.effects.registry import CONTACT_ALIASES
from ..physics.world import World
from .bundles import DRAGS, drag_in_wind
from .candidates import Candidate, base_parameters, base_values, without_effect
from .consistency import consistency
from .contact_stage import ContactEvidence, contact_evidence, fitted_contact, separated
from .forecast import held_out_errors
from .glide_stage import GlideEvidence, glide_evidence, with_effect
from .grip_stage import grip_evidence, named_by_grip
from .impact_stage import impact_evidence, named_by_impacts, with_impact_effect
from .prepared import Prepared
from .refit import refit
from .segment_states import fit_states
from .segments import Segments, world_for
from .slots import ALIAS_CHI2, Evidence, Slot, fill
from .wrench import Omnibus, ResidualWrenches, dispersion, omnibus, residual_wrenches

VerdictName = Literal["missing_effect", "none_missing", "unexplained", "not_separable"]

MOST_EFFECTS = 3
"""So many effects are looked for in flight, one after the other."""
OMNIBUS_S = (0.3, 0.15)
"""Lengths of the pieces of flight whose residual wrench tells whether anything is left: slow forces and short ones."""
OMNIBUS_LIMIT, OMNIBUS_P = 1.6, 1e-4
"""Something is left where the mean chi2 of a residual wrench is above this and its p-value below. On data without an
effect the statistic was 1.0 +- 0.2 (study of diagnosis, section 0)."""
ENOUGH_SHARE = 0.9
"""What is left beside an effect that explains this share of the excess is a detail of its law; of less, a stranger."""
CONTACT_SCORE = 22.0
"""An effect in contact is named above this score. On development data of another engine (MuJoCo, 6 episodes of 1 s, two
contact laws) the largest of 29 captures without an effect were 18.9 and 15.6 (Stribeck friction); those of effects of a
size that matters 29 to 713 where they were right."""
CONTACT_T = 1.0
"""And where the mean gain of held-out episodes is above this many of its standard errors."""
GLIDE_SCORE = 220.0
"""An effect in glides is named above this score ... On development seeds the largest of 13 captures without one was 170
(friction against spinning, of a cube); those that were named rightly had 278 to 91813."""
FEW_NUMBERS, GLIDE_SCORE_FLEXIBLE = 1, 400.0
"""... one of more numbers than this above that: a map of friction (score 270) and friction by direction (240) fit what
a box leaves without any. The lowest score of a direction that was there is 1104."""
GLIDE_EXPLAINED = 0.5
"""And where it explains at least this share of what the noise does not: of less, it stands in for a stranger."""
GLIDE_LEAD, GLIDE_SHARE = 12.0, 0.1
"""Another one within this score of it, or this share of it, leaves the two unseparated."""
CONFIRMED = 2.0
"""And where a refit leaves it this many standard errors away from nothing."""
CONTACT_LEAD = 0.5
"""Another effect in contact with this share of the best one's score leaves the two unseparated."""


@dataclass(frozen=True)
class Chosen:
    """An effect that was selected, and its equals (itself the first); acts_in: where its evidence is from."""

    evidence: Evidence
    equals: tuple[Evidence, ...]
    where: Literal["flight", "contact"]


@dataclass(frozen=True)
class Findings:
    """All that a diagnosis finds.

    before, after: the omnibus statistics of flight, the worst over the lengths of pieces; None without flight; ranking:
    candidates, the best first; contact: all contact evidence; world: with the selected effects; base: without them;
    errors: of predictions in episodes that the effect was not fitted to, without it and with it [m], by effect.
    """

    verdict: VerdictName
    chosen: tuple[Chosen, ...]
    remaining: bool
    before: Omnibus | None
    after: Omnibus | None
    ranking: tuple[Evidence, ...]
    contact: tuple[ContactEvidence, ...]
    world: World
    contact_chi2: float | None
    base: World
    errors: dict[str, tuple[float, float]]

    @property
    def judged_in_contact(self) -> set[str]:
        """Names of the effects whose evidence is from contact."""
        return {one.evidence.name for one in self.contact} | {
            c.evidence.name for c in self.chosen if c.where != "flight"
        }


def find(prepared: Prepared, world: World, candidates: Sequence[Candidate]) -> Findings:
    """Return what is missing of a world, from prepared episodes alone."""
    pieces = _pieces(prepared, world)
    scatter = max(prepared.slow, dispersion(*pieces[-1])) if pieces else 1.0
    before = _worst_omnibus(pieces, scatter)
    slots, after_flight, flight = _flight_search(prepared, world, candidates, scatter)
    chosen, contact, final, chi2, fitted = _with_contact(prepared, world, after_flight, slots, candidates, flight)
    after = _worst_omnibus(_pieces(prepared, final), scatter) if chosen else before
    in_flight = [slot.best.name for slot in slots if slot.flagged]
    alike = None if flight is None else consistency(flight, after_flight, in_flight, prepared.groups, scatter)
    doubtful = alike is not None and alike.doubtful
    left = after is not None and after.statistic > OMNIBUS_LIMIT and after.p_value < OMNIBUS_P
    remaining = left or doubtful
    verdict: VerdictName = "none_missing"
    if doubtful or (left and _explained(before, after) < ENOUGH_SHARE):
        verdict = "unexplained"
    elif any(len(one.equals) > 1 for one in chosen):
        verdict = "not_separable"
    elif chosen:
        verdict = "missing_effect"
    ranking = _ranking(chosen, slots, contact)
    errors = {}
    for one in chosen if verdict != "unexplained" else []:
        segments = flight if one.where == "flight" else fitted
        if segments is not None:
            errors[one.evidence.name] = held_out_errors(segments, final, one.evidence.name)
    return Findings(
        verdict,
        tuple(chosen),
        remaining,
        before,
        after,
        tuple(ranking),
        tuple(contact),
        final,
        chi2,
        world,
        errors,
    )


def _pieces(prepared: Prepared, world: World) -> list[tuple[Segments, ResidualWrenches]]:
    """Return the flights in pieces of each length of `OMNIBUS_S` with their residual wrenches; none without flight."""
    cut = [pieces for longest_s in OMNIBUS_S if (pieces := prepared.pieces(world, longest_s)) is not None]
    return [(pieces, residual_wrenches(pieces)) for pieces in cut]


def _worst_omnibus(pieces: Sequence[tuple[Segments, ResidualWrenches]], scatter: float) -> Omnibus | None:
    """Return the omnibus statistic of flight over all lengths of pieces, the one with the smallest p-value."""
    found = [omnibus(wrenches, scatter) for _, wrenches in pieces]
    return min(found, key=lambda one: (one.p_value, -one.statistic), default=None)


def _explained(before: Omnibus | None, after: Omnibus | None) -> float:
    """Return the share of the omnibus statistic's excess that is gone."""
    if before is None or after is None or before.statistic <= 1:
        return 0.0
    return 1 - (after.statistic - 1) / (before.statistic - 1)


def _flight_search(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], scatter: float
) -> tuple[list[Slot], World, Segments | None]:
    """Return the slots that effects fill in flight, the world with the best of each, and the segments there."""
    flight, slots, current = prepared.flight, [], world
    if flight is None:
        return [], world, None
    while len(slots) < MOST_EFFECTS:
        slot = fill(flight, current, candidates, prepared.groups, prepared.turned, scatter)
        if not slot.flagged:
            slots = slots or [slot]
            break
        refitted = slot.best.refitted
        assert refitted is not None
        slots.append(slot)
        current, flight = refitted.world, refitted.segments[0]
    filled = [slot for slot in slots if slot.flagged]
    if len(filled) > 1:
        bundled = _bundled(prepared, world, filled, candidates, scatter)
        if bundled is not None:
            return bundled
        for place in range(len(filled) - 1):  # the first were chosen before the others were known
            without = without_effect(current, filled[place].best.name)
            if len(without.effects) < len(current.effects) - 1:
                continue  # another effect acts through this one
            states = fit_states(replace(flight, world=world_for("flight", without)))
            slot = fill(states, without, candidates, prepared.groups, prepared.turned, scatter)
            refitted = slot.best.refitted
            if slot.flagged and refitted is not None:
                filled[place] = slot
                current, flight = refitted.world, refitted.segments[0]
        slots = filled
    return slots, current, flight


def _with_aliases(kept: Sequence[Evidence], equals: Sequence[Evidence]) -> list[Evidence]:
    """Return what contact left of equals, with those that rigid contact cannot tell from it."""
    names = {one.name for one in kept}
    names |= {name for group in CONTACT_ALIASES if group & names for name in group}
    return [*kept, *(one for one in equals if one.name in names and one not in kept)]


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


def _with_contact(
    prepared: Prepared,
    world: World,
    after_flight: World,
    slots: Sequence[Slot],
    candidates: Sequence[Candidate],
    flight: Segments | None,
) -> tuple[list[Chosen], list[ContactEvidence], World, float | None, Segments | None]:
    """Return the selected effects, the evidence of contact, the world with them, chi2 / dof and segments of contact."""
    filled = [slot for slot in slots if slot.flagged]
    open_slots = [slot for slot in filled if len(slot.equals) > 1]
    clear_world = after_flight
    for slot in open_slots:
        clear_world = without_effect(clear_world, slot.best.name)
    fitted = fitted_contact(prepared, clear_world)
    if fitted is None:
        chosen = [Chosen(slot.best, slot.equals, "flight") for slot in filled]
        return chosen, [], after_flight, None, None
    base, contact = fitted
    final, chosen = after_flight, []
    for slot in filled:
        equals = list(slot.equals)
        if len(equals) > 1:
            kept, _ = separated(equals, contact, base.world, prepared.groups)
            equals = _with_aliases(kept, equals)
            final = _replaced(final, slot.best, equals[0])
        chosen.append(Chosen(equals[0], tuple(equals), "flight"))
    final = replace(final, contact=base.world.contact)
    if filled and open_slots:
        again = fitted_contact(prepared, final, contact)
        assert again is not None  # there was contact before
        base, contact = again
    rows = contact.residuals([], contact.observations.times_s.new_zeros(0), jacobian=False)[0]
    chi2 = float(rows.square().sum() / contact.dof.sum())
    glides = glide_evidence(prepared, base.world, candidates, GLIDE_SCORE, flight)
    alike = _equal_in_glides(glides)
    if alike:
        first = tuple(one.evidence for one in alike)
        told = [ContactEvidence(one.evidence, one.score, None, None) for one in glides]
        return [*chosen, Chosen(first[0], first, "contact")], told, with_effect(base.world, alike[0]), chi2, contact
    impacts = impact_evidence(prepared, base.world, candidates)
    struck = named_by_impacts(impacts)
    if struck:
        first = tuple(one.evidence for one in struck)
        told = [ContactEvidence(one.evidence, one.score, one.gain, one.t) for one in impacts]
        found = with_impact_effect(base.world, struck[0])
        return [*chosen, Chosen(first[0], first, "contact")], told, found, chi2, contact
    gripped = named_by_grip(grip_evidence(prepared, base.world, contact, candidates, flight))
    if gripped:
        first = tuple(one.evidence for one in gripped)
        told = [ContactEvidence(one.evidence, one.score, None, None) for one in gripped]
        return [*chosen, Chosen(first[0], first, "contact")], told, with_effect(base.world, gripped[0]), chi2, contact
    evidence = contact_evidence(contact, base.world, candidates, prepared.groups, prepared.turned)
    named = _named(evidence)
    if named:
        found, numbers = _added(base.world, contact, named[0].evidence)
        if any(abs(value) > CONFIRMED * error for value, error in numbers.values()):
            first = replace(named[0].evidence, numbers=numbers)
            equals = (first, *(one.evidence for one in named[1:]))
            return [*chosen, Chosen(first, equals, "contact")], evidence, found, chi2, contact
    return chosen, evidence, replace(final, contact=base.world.contact), chi2, contact


def _equal_in_glides(evidence: Sequence[GlideEvidence]) -> list[GlideEvidence]:
    """Return the effect that glides name and its equals; none where they name none."""
    fit = [one for one in evidence if one.evidence.test.admissible]
    if not fit or fit[0].share < GLIDE_EXPLAINED:
        return []
    flexible = len(fit[0].evidence.candidate.effect.parameters) > FEW_NUMBERS
    if fit[0].score < (GLIDE_SCORE_FLEXIBLE if flexible else GLIDE_SCORE):
        return []
    lead = max(GLIDE_LEAD, GLIDE_SHARE * fit[0].score)
    return [one for one in fit if one.score > fit[0].score - lead]


def _named(evidence: Sequence[ContactEvidence]) -> list[ContactEvidence]:
    """Return the effect that contact names and its equals; none where it names none."""
    fit = [one for one in evidence if one.evidence.test.admissible and (one.gain or 0) > 0 and (one.t or 0) > CONTACT_T]
    if not fit or fit[0] is not evidence[0] or fit[0].score < CONTACT_SCORE:
        return []
    return [one for one in fit if one.score > CONTACT_LEAD * fit[0].score]


def _added(world: World, contact: Segments, evidence: Evidence) -> tuple[World, dict[str, tuple[float, float]]]:
    """Return the world with an effect refitted in contact, and its parameters with estimate and standard error."""
    effect = evidence.candidate.effect
    added = replace(
        world,
        effects=(*world.effects, ActiveEffect.of(effect, evidence.constants, world.gravity[0, :1])),
    )
    parameters = [
        p for p in base_parameters(added, "contact") if "." not in p.name or p.name.startswith(f"{effect.name}.")
    ]
    known = dict(zip((p.name for p in effect.parameters), evidence.test.estimate.tolist(), strict=False))
    start = base_values(added, parameters)
    for k, p in enumerate(parameters):
        if p.name.startswith(f"{effect.name}."):  # from the score test's step: a rough valley hides it from neutral
            start[k] = min(max(known[p.name.partition(".")[2]], p.bounds[0]), p.bounds[1])
    found = refit([contact], added, parameters, start)
    own = [p for p in parameters if p.name.startswith(f"{effect.name}.")]
    numbers = {p.name.partition(".")[2]: found.number(p.name) for p in own}
    return found.world, numbers


def _replaced(world: World, old: Evidence, new: Evidence) -> World:
    """Return the world with one effect in the place of another, at its refitted numbers."""
    if old.name == new.name or new.refitted is None:
        return world
    own = next(a for a in new.refitted.world.effects if a.effect.name == new.name)
    return replace(world, effects=(*without_effect(world, old.name).effects, own))


def _ranking(chosen: Sequence[Chosen], slots: Sequence[Slot], contact: Sequence[ContactEvidence]) -> list[Evidence]:
    """Return all candidates once: selected ones and their equals first, then by where they were judged."""
    found: dict[str, Evidence] = {}
    everything = [e for one in chosen for e in one.equals]
    everything += [e for slot in slots[:1] for e in slot.evidence]
    everything += [one.evidence for one in contact if one.evidence.candidate.effect.phase == "contact"]
    for evidence in everything:
        found.setdefault(evidence.name, evidence)
    return list(found.values())
