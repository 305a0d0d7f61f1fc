"""Verdict of a diagnosis: the missing effects, their equals, and whether a residual remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ..physics.world import World
from ..segments.candidates import Candidate
from ..segments.prepare import Prepared
from ..segments.residual_wrench import Omnibus, ResidualWrenches, dispersion, omnibus, residual_wrenches
from ..segments.segments import Segments
from .alternative_laws import OtherLaw, other_laws
from .contact_search import TESTS, Chosen, ContactFindings, with_contact
from .contact_tests.contact_test import ContactTest
from .cross_validation import held_out_errors
from .detection_limits import DetectionLimit
from .effect_selection import SelectionStep
from .evidence import Evidence
from .falsification import consistency
from .flight_search import flight_search
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

VerdictName = Literal["missing_effect", "none_missing", "unexplained", "not_separable"]


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Result of all tests of a diagnosis."""

    verdict: VerdictName
    """The verdict."""
    chosen: tuple[Chosen, ...]
    """Selected effects with their equals, those of flight first."""
    remaining: bool
    """Whether a residual remains in addition to the selected effects, or one of these is doubtful."""
    before: Omnibus | None
    """Omnibus statistic of flight without the selected effects, the worst over window lengths; None without flight."""
    after: Omnibus | None
    """The same with the selected effects."""
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
    as_good: tuple[OtherLaw, ...] = ()
    """Alternative laws that explain the flights as well as those of the selected effects."""
    limits: tuple[DetectionLimit, ...] = ()
    """Detection limits of the contact effects, where contact selected none."""

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
    windows = _flight_windows(prepared, world)
    scatter = max(prepared.slow, dispersion(*windows[-1])) if windows else 1.0
    before = _worst_omnibus(windows, scatter)
    steps, after_flight, flight = flight_search(prepared, world, candidates, scatter)
    after_search = _worst_omnibus(_flight_windows(prepared, after_flight), scatter)
    explained = not _is_significant(after_search)
    contact = with_contact(prepared, world, after_flight, steps, candidates, flight, explained, tests)
    chosen, final = contact.chosen, contact.world
    after = _worst_omnibus(_flight_windows(prepared, final), scatter) if chosen else before
    in_flight = [step.best.name for step in steps if step.flagged]
    agreement = None if flight is None else consistency(flight, after_flight, in_flight, prepared.groups, scatter)
    others = [] if flight is None else other_laws(flight, after_flight, in_flight, scatter)
    doubtful = (agreement is not None and agreement.doubtful) or any(one.better for one in others)
    verdict = _verdict(chosen, before, after, doubtful)
    return Findings(
        verdict=verdict,
        chosen=tuple(chosen),
        remaining=_is_significant(after) or doubtful,
        before=before,
        after=after,
        ranking=tuple(_ranking(chosen, steps, contact.evidence)),
        contact=tuple(contact.evidence),
        world=final,
        contact_chi2=contact.chi2,
        base=world,
        errors={} if verdict == "unexplained" else _errors(contact, flight),
        as_good=tuple(one for one in others if one.as_good),
        limits=contact.limits,
    )


def _verdict(chosen: Sequence[Chosen], before: Omnibus | None, after: Omnibus | None, doubtful: bool) -> VerdictName:
    """Return the verdict from the selected effects and the omnibus statistics.

    Args:
        chosen: The selected effects.
        before: Omnibus statistic of flight without them.
        after: Omnibus statistic of flight with them.
        doubtful: Whether an effect selected in flight changes between units or follows another law.
    """
    if doubtful or (_is_significant(after) and _explained(before, after) < LIMITS.enough_share):
        return "unexplained"
    if any(len(one.equals) > 1 for one in chosen):
        return "not_separable"
    return "missing_effect" if chosen else "none_missing"


def _errors(contact: ContactFindings, flight: Segments | None) -> dict[str, tuple[float, float]]:
    """Return the held-out errors [m] without and with each selected effect, in the motion that showed it."""
    errors = {}
    for one in contact.chosen:
        segments = flight if one.where == "flight" else contact.segments
        if segments is not None:
            errors[one.evidence.name] = held_out_errors(segments, contact.world, one.evidence.name)
    return errors


def _flight_windows(prepared: Prepared, world: World) -> list[tuple[Segments, ResidualWrenches]]:
    """Cut the flights into windows of each length of the omnibus test and estimate their residual wrenches."""
    cut = [windows for longest_s in LIMITS.omnibus_s if (windows := prepared.pieces(world, longest_s)) is not None]
    return [(windows, residual_wrenches(windows)) for windows in cut]


def _worst_omnibus(windows: Sequence[tuple[Segments, ResidualWrenches]], scatter: float) -> Omnibus | None:
    """Return the omnibus statistic with the smallest p-value over all window lengths; None without flight."""
    found = [omnibus(wrenches, scatter) for _, wrenches in windows]
    return min(found, key=lambda one: (one.p_value, -one.statistic), default=None)


def _is_significant(found: Omnibus | None) -> bool:
    """Return whether a residual wrench exceeds the noise by both thresholds; False without flight."""
    return found is not None and found.statistic > LIMITS.omnibus_limit and found.p_value < LIMITS.omnibus_p


def _explained(before: Omnibus | None, after: Omnibus | None) -> float:
    """Return the share of the excess of the omnibus statistic over 1 that the selected effects explain."""
    if before is None or after is None or before.statistic <= 1:
        return 0.0
    return 1 - (after.statistic - 1) / (before.statistic - 1)


def _ranking(chosen: Sequence[Chosen], steps: Sequence[SelectionStep], contact: Sequence[Evidence]) -> list[Evidence]:
    """Return each candidate once: the selected effects and their equals, then flight, then contact."""
    found: dict[str, Evidence] = {}
    everything = [e for one in chosen for e in one.equals]
    everything += [e for step in steps[:1] for e in step.evidence]
    everything += [one for one in contact if one.candidate.effect.phase == "contact"]
    for evidence in everything:
        found.setdefault(evidence.name, evidence)
    return list(found.values())
