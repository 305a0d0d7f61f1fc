"""The search in contact: which of several equals in flight it leaves, and which effect of contact is missing.

The stages come in the order of what they take for granted: glides, where the law of contact hardly matters; impacts of
a ball, without any; glides against impacts; and the segments of contact under the model's law, last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ..physics.effects.effect import ActiveEffect
from ..physics.effects.registry import CONTACT_ALIASES
from ..physics.world import World
from .candidates import Candidate, base_parameters, base_values, without_effect
from .contact_limits import ContactLimit, contact_limits
from .contact_stage import ContactEvidence, contact_evidence, fitted_contact, separated
from .glide_stage import GlideEvidence, StartedGlides, glide_evidence, with_effect
from .grip_stage import grip_evidence, named_by_grip
from .impact_stage import ImpactEvidence, impact_evidence, named_by_impacts, with_impact_effect
from .prepared import Prepared
from .refit import refit
from .segments import Segments
from .slots import Evidence, Slot

GLIDE_SCORE, GLIDE_EXPLAINED = 220.0, 0.5
"""An effect in glides is named above this score, if it explains at least this share of what the noise does not ..."""
FEW_NUMBERS, GLIDE_SCORE_FLEXIBLE = 1, 400.0
"""... one of more numbers, or beside an effect of flight, above that, as it fits more by chance ..."""
GLIDE_SURE, GLIDE_SHARE_SURE = 80.0, 0.78
"""... or above this, if it leaves next to nothing: what stands in for something else explains a part. On development
seeds what was not there reached a score of 165 at a share of 0.69, and any share up to a score of 50; friction by
direction 179 at 0.94 beside a drag in wind, so that beside effects of flight this does not count for more numbers."""
MANY_NUMBERS = 4
"""That holds for none of more numbers than this: a map fits about anything."""
GLIDE_LEAST = 0.3
"""No effect is named whose numbers all are below this share of their usual sizes: engines differ by as much."""
GLIDE_OTHERS = 80.0
"""Beside an effect of flight chi2 falls by this much in other episodes than the one that says most, too: along a single
slide the law of what was found in flight may be off. Balls in wind had false friction by direction with scores of 823
and 1044, of which the others say 33 and 18; of true ones 114 to 34,000, but for one that fell silent (26)."""
GLIDE_LEAD, GLIDE_SHARE = 12.0, 0.1
"""Another one within this score of it, or this share of it, leaves the two unseparated ..."""
MISLED, RIVAL_SHARE = 165.0, 0.5
"""... and so does one behind by less than what a wrong one has reached, if it explains this share of what the best one
does: how friction falls with the speed, how it grows and where it changes are much the same along a single slide."""
BRAKED_OTHERWISE = ("torsional_friction",)
"""What a map of friction explains as well is the spin of a sliding body that engines brake otherwise, below the score
of maps: of four such names on report4 to report6 three were false (101 to 260), the fourth stood beside a drag."""
CONTACT_SCORE, CONTACT_T = 22.0, 1.0
"""Under the law of contact an effect is named above this score, where the mean gain of held-out episodes is above so
many of its standard errors ..."""
AGREED_SCORE = 40.0
"""... one that glides could have seen above this, and only where it is the first in glides, too, with as much ..."""
ALONE_SCORE = 120.0
"""... or above this where there are no glides to ask: friction by direction has reached 113 where there was none."""
IN_IMPACTS_ALONE = ("velocity_restitution",)
"""What glides cannot see."""
CONTACT_LEAD = 0.5
"""Another effect in contact with this share of the best one's score leaves the two unseparated."""
CONFIRMED = 2.0
"""And where a refit leaves it this many standard errors away from nothing."""


@dataclass(frozen=True)
class Chosen:
    """An effect that was selected, and its equals (itself the first); where: which motion its evidence is from."""

    evidence: Evidence
    equals: tuple[Evidence, ...]
    where: Literal["flight", "contact"]


@dataclass(frozen=True)
class ContactFindings:
    """What flight and contact say together.

    chosen: the selected effects, those of flight first; evidence: of contact; world: with them; chi2: per degree of
    freedom of the segments of contact, None without contact; segments: those; limits: what contact could have shown,
    where it shows nothing.
    """

    chosen: list[Chosen]
    evidence: list[ContactEvidence]
    world: World
    chi2: float | None = None
    segments: Segments | None = None
    limits: tuple[ContactLimit, ...] = ()


def with_contact(
    prepared: Prepared,
    world: World,
    after_flight: World,
    slots: Sequence[Slot],
    candidates: Sequence[Candidate],
    flight: Segments | None,
    explained: bool,
) -> ContactFindings:
    """Return what contact leaves of the equals of flight, and what it names itself."""
    filled = [slot for slot in slots if slot.flagged]
    open_slots = [slot for slot in filled if len(slot.equals) > 1]
    clear_world = after_flight
    for slot in open_slots:
        clear_world = without_effect(clear_world, slot.best.name)
    fitted = fitted_contact(prepared, clear_world)
    if fitted is None:
        chosen = [Chosen(slot.best, slot.equals, "flight") for slot in filled]
        return ContactFindings(chosen, [], after_flight)
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
    started = StartedGlides.of(prepared, base.world, flight)
    glides = glide_evidence(prepared, base.world, candidates, GLIDE_SURE, started)
    alike = equal_in_glides(glides, explained, bool(chosen))
    if alike:
        told = [ContactEvidence(one.evidence, one.score, None, None) for one in glides]
        return ContactFindings([*chosen, _chosen(alike)], told, with_effect(base.world, alike[0]), chi2, contact)
    impacts = impact_evidence(prepared, base.world, candidates)
    struck = named_by_impacts(impacts)
    if struck:
        told = [ContactEvidence(one.evidence, one.score, one.gain, one.t) for one in impacts]
        found = with_impact_effect(base.world, struck[0])
        return ContactFindings([*chosen, _chosen(struck)], told, found, chi2, contact)
    gripped = named_by_grip(grip_evidence(prepared, base.world, contact, candidates, started))
    if gripped:
        told = [ContactEvidence(one.evidence, one.score, None, None) for one in gripped]
        return ContactFindings([*chosen, _chosen(gripped)], told, with_effect(base.world, gripped[0]), chi2, contact)
    evidence = contact_evidence(contact, base.world, candidates, prepared.groups, prepared.turned)
    named = _named(evidence, glides)
    if named:
        found, numbers = _added(base.world, contact, named[0].evidence)
        if any(abs(value) > CONFIRMED * error for value, error in numbers.values()):
            first = replace(named[0], evidence=replace(named[0].evidence, numbers=numbers))
            return ContactFindings([*chosen, _chosen([first, *named[1:]])], evidence, found, chi2, contact)
    # what impacts alone show is left out where there are impacts
    asked = [c for c in candidates if not impacts or c.effect.name not in IN_IMPACTS_ALONE]
    scores = (GLIDE_SCORE, GLIDE_SCORE_FLEXIBLE)
    limits = contact_limits(started, base.world, asked, scores, prepared.turned, IN_IMPACTS_ALONE)
    final = replace(final, contact=base.world.contact)
    return ContactFindings(chosen, evidence, final, chi2, contact, tuple(limits))


def _chosen(equals: Sequence[GlideEvidence | ImpactEvidence | ContactEvidence]) -> Chosen:
    """Return the first of what a stage names, with its equals."""
    every = tuple(one.evidence for one in equals)
    return Chosen(every[0], every, "contact")


def equal_in_glides(evidence: Sequence[GlideEvidence], explained: bool, flown: bool) -> list[GlideEvidence]:
    """Return the effect that glides name and its equals; none where they name none.

    Args:
        evidence: The best first.
        explained: Whether flights are explained to the noise.
        flown: Whether an effect of flight was found, whose law is never quite the true one.
    """
    fit = [one for one in evidence if one.evidence.test.admissible]
    if not fit or not _told_by_glides(fit[0], flown):
        return []
    if not explained and fit[0].share < GLIDE_SHARE_SURE:
        return []  # what flights leave unexplained acts here, too
    alike = fit[0].score - max(GLIDE_LEAD, GLIDE_SHARE * fit[0].score)
    rival, share = fit[0].score - MISLED, RIVAL_SHARE * fit[0].share
    equals = [one for one in fit if one.score > alike or (one.score > rival and one.share > share)]
    mapped = any(len(one.evidence.candidate.effect.parameters) > MANY_NUMBERS for one in equals)
    if mapped and fit[0].evidence.name in BRAKED_OTHERWISE and fit[0].score < GLIDE_SCORE_FLEXIBLE:
        return []
    return equals


def _told_by_glides(one: GlideEvidence, flown: bool) -> bool:
    parameters, numbers = one.evidence.candidate.effect.parameters, one.evidence.numbers
    assert numbers is not None
    if all(abs(numbers[p.name][0]) < GLIDE_LEAST * p.scale for p in parameters):
        return False
    if flown and one.others < GLIDE_OTHERS:
        return False
    flexible = len(parameters) > FEW_NUMBERS
    least = GLIDE_SCORE_FLEXIBLE if flexible or flown else GLIDE_SCORE
    enough = one.score > least and one.share > GLIDE_EXPLAINED
    sure = one.score > GLIDE_SURE and one.share > GLIDE_SHARE_SURE and len(parameters) <= MANY_NUMBERS
    return enough or (sure and not (flexible and flown))


def _named(evidence: Sequence[ContactEvidence], glides: Sequence[GlideEvidence]) -> list[ContactEvidence]:
    """Return the effect that contact names and its equals; none where it names none, or glides speak against it."""
    fit = [one for one in evidence if one.evidence.test.admissible and (one.gain or 0) > 0 and (one.t or 0) > CONTACT_T]
    if not fit or fit[0] is not evidence[0] or fit[0].score < _least(fit[0], glides):
        return []
    return [one for one in fit if one.score > CONTACT_LEAD * fit[0].score]


def _least(one: ContactEvidence, glides: Sequence[GlideEvidence]) -> float:
    """Return the score above which contact may name an effect, by what glides say of it."""
    if one.evidence.candidate.effect.phase != "contact" or one.evidence.name in IN_IMPACTS_ALONE:
        return CONTACT_SCORE
    if not glides:
        return ALONE_SCORE
    first = next((other for other in glides if other.evidence.test.admissible), None)
    agreed = first is not None and first.evidence.name == one.evidence.name and first.score > AGREED_SCORE
    return AGREED_SCORE if agreed else float("inf")


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


def _with_aliases(kept: Sequence[Evidence], equals: Sequence[Evidence]) -> list[Evidence]:
    """Return what contact left of equals, with those that rigid contact cannot tell from it."""
    names = {one.name for one in kept}
    names |= {name for group in CONTACT_ALIASES if group & names for name in group}
    return [*kept, *(one for one in equals if one.name in names and one not in kept)]
