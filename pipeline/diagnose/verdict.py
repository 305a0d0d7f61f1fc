"""Verdict of a diagnosis: the missing effects, their equals, and whether a residual remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ...datasets.io.progress import note
from ...schemas import PhaseMisfit
from ..physics.world import World
from ..segments.candidates import Candidate, without_effects
from ..segments.prepare import Prepared
from ..segments.sliding.fit import StartedSliding
from ..segments.sliding.residuals import soft_world
from .contact.contact_test import ContactTest
from .contact.detection_limits import DetectionLimit
from .contact.search import TESTS, Chosen, ContactFindings, with_contact
from .evidence.cross_validation import held_out_errors, held_out_fall
from .evidence.effect_selection import SelectionStep
from .evidence.evidence import Evidence
from .flight.findings import FlightFindings, flight_findings
from .flight.omnibus import is_significant
from .flight.other_forms import OtherForms
from .remaining import bad_ones, misfits_of, slides_of
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

VerdictName = Literal["missing_effect", "none_missing", "unexplained", "not_separable", "law_inexact"]


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Result of all tests of a diagnosis."""

    verdict: VerdictName
    """The verdict."""
    chosen: tuple[Chosen, ...]
    """Selected effects with their equals, those of flight first."""
    remaining: bool
    """Whether a residual remains in addition to the selected effects, or one of these is doubtful."""
    flight: FlightFindings
    """What flights show."""
    ranking: tuple[Evidence, ...]
    """Evidence of the candidates, the best first."""
    contact: tuple[Evidence, ...]
    """Evidence of the candidates in contact."""
    world: World
    """World with the selected effects."""
    contact_chi2: float | None
    """Chi2 per degree of freedom of the contact segments; None without contact."""
    base: World
    """World without the selected effects."""
    errors: dict[str, tuple[float, float]]
    """Held-out prediction errors without and with each selected effect [m], by effect name."""
    as_good: tuple[OtherForms, ...] = ()
    """Other forms of the selected effects that explain the flights as well."""
    limits: tuple[DetectionLimit, ...] = ()
    """Detection limits of the contact effects, where contact selected none."""
    sliding: StartedSliding | None = None
    """The sliding segments and their fit without effects of contact; None without any."""
    as_pyramid: tuple[str, ...] = ()
    """Effects that slides show no better than a friction pyramid does, so that none is selected."""
    as_line: tuple[str, ...] = ()
    """The same for a friction that changes at a line across the ground."""
    misfits: tuple[PhaseMisfit, ...] = ()
    """How the law of contact describes each phase, the worst first; none where contact selected an effect."""

    @property
    def judged_in_contact(self) -> set[str]:
        """Names of the effects whose evidence comes from contact."""
        return {one.name for one in self.contact} | {c.evidence.name for c in self.chosen if c.where != "flight"}


def find(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], tests: Sequence[ContactTest] = TESTS
) -> Findings:
    """Search prepared episodes for the effects that a world lacks, in flight and then in contact.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All candidates.
        tests: The contact tests, in the order in which they run.
    """
    note("diagnose: flights")
    flown = flight_findings(prepared, world, candidates)
    note("diagnose: contacts")
    prepared = prepared.with_own(flown.world)  # contact is judged with the values that episodes have of their own
    explained = not is_significant(flown.after)
    contact = with_contact(prepared, world, flown.world, flown.steps, candidates, flown.segments, explained, tests)
    note("diagnose: held-out episodes")
    errors = _errors(contact, flown)
    # what flights show may be what contact imitates
    limits = THRESHOLDS.segments
    contact = _without_useless(contact, limits.confirmed if flown.remains or flown.own else -limits.worse_t)
    in_contact = any(one.where == "contact" for one in contact.chosen)
    misfits = [] if contact.segments is None or in_contact else misfits_of(contact.segments)
    if not in_contact:
        misfits = sorted([*misfits, *slides_of(contact.sliding)], key=lambda one: -one.reduced_chi2)
    verdict = _verdict(contact.chosen, flown)
    if verdict == "none_missing" and bad_ones(misfits):
        verdict = "law_inexact"
    return Findings(
        verdict=verdict,
        chosen=tuple(contact.chosen),
        remaining=flown.remains or flown.doubtful,
        flight=flown,
        ranking=tuple(_ranking(contact.chosen, flown.steps, contact.evidence)),
        contact=tuple(contact.evidence),
        world=contact.world,
        contact_chi2=contact.chi2,
        base=world,
        errors={} if verdict == "unexplained" else errors,
        as_good=tuple(one for one in flown.others if one.as_good),
        limits=contact.limits,
        sliding=contact.sliding,
        as_pyramid=contact.as_pyramid,
        as_line=contact.as_line,
        misfits=tuple(misfits),
    )


def _verdict(chosen: Sequence[Chosen], flown: FlightFindings) -> VerdictName:
    """Return the verdict from the selected effects and the findings in flight.

    What is left in flight is physics or an error of the tracking, of which no model is exact. Effects that predict
    episodes that they were not fitted to have to explain what repeats from episode to episode; all others nearly all.
    Effects of contact alone explain no flight, and stand where nothing repeats there.
    """
    if not (flown.in_flight or flown.own or flown.doubtful or flown.recurs) and chosen:
        return "not_separable" if any(len(one.equals) > 1 for one in chosen) else "missing_effect"
    too_little = is_significant(flown.after) and flown.explained_share < LIMITS.enough_share
    errors = flown.slow is not None or (flown.predicts and not (flown.repeats or flown.untold))
    if flown.doubtful or (too_little and not errors):
        return "unexplained"
    if not chosen and flown.remains and not flown.differs:
        return "unexplained"
    if any(len(one.equals) > 1 for one in chosen):
        return "not_separable"
    return "missing_effect" if chosen else "none_missing"


def _without_useless(contact: ContactFindings, least: float) -> ContactFindings:
    """Return the findings without the effects of contact that lower the error of held-out episodes too little.

    What whole pieces on fixed surfaces show has predicted held-out ones; short pieces do not show it.

    Args:
        contact: The findings.
        least: Least mean fall of an episode's error, in its standard errors.
    """
    if contact.segments is None:
        return contact
    present = {active.effect.name for active in contact.world.effects}
    short = [one.evidence for one in contact.chosen if one.where == "contact" and one.evidence.way_share is None]
    named = {one.name for one in short} & present
    falls = {name: held_out_fall(contact.segments, contact.world, name) for name in named}
    useless = {name for name, fall in falls.items() if fall < least}
    world = without_effects(contact.world, *useless)
    return replace(contact, chosen=[one for one in contact.chosen if one.evidence.name not in useless], world=world)


def _errors(contact: ContactFindings, flown: FlightFindings) -> dict[str, tuple[float, float]]:
    """Return the held-out errors [m] without and with each selected effect, in the motion that showed it."""
    errors, present = {}, {active.effect.name for active in contact.world.effects}
    # the world has the mean of the values that episodes have of their own, whose error says nothing of these
    own = {step.best.name for step in flown.steps if step.own_std is not None}
    for one in contact.chosen:
        if one.evidence.name in own:
            continue
        segments = flown.segments if one.where == "flight" else contact.segments
        if one.evidence.way_share is not None and contact.sliding is not None:
            whole = contact.sliding.base.segments
            errors[one.evidence.name] = held_out_errors(whole, soft_world(contact.world), one.evidence.name)
            continue
        if segments is not None and one.evidence.name in present:
            errors[one.evidence.name] = held_out_errors(segments, contact.world, one.evidence.name)
    return errors


def _ranking(chosen: Sequence[Chosen], steps: Sequence[SelectionStep], contact: Sequence[Evidence]) -> list[Evidence]:
    """Return each candidate once: the selected effects and their equals, then flight, then contact."""
    found: dict[str, Evidence] = {}
    everything = [e for one in chosen for e in one.equals]
    everything += [e for step in steps[:1] for e in step.evidence]
    everything += [one for one in contact if one.candidate.effect.phase == "contact"]
    for evidence in everything:
        found.setdefault(evidence.name, evidence)
    return list(found.values())
