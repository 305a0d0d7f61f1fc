"""The verdict: what is missing, what else it could be, whether something remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ..physics.world import World
from .candidates import Candidate
from .consistency import consistency
from .contact_limits import ContactLimit
from .contact_search import Chosen, with_contact
from .contact_stage import ContactEvidence
from .flight_search import flight_search
from .forecast import held_out_errors
from .other_laws import OtherLaw, other_laws
from .prepared import Prepared
from .segments import Segments
from .slots import Evidence, Slot
from .wrench import Omnibus, ResidualWrenches, dispersion, omnibus, residual_wrenches

VerdictName = Literal["missing_effect", "none_missing", "unexplained", "not_separable"]

OMNIBUS_S = (0.3, 0.15)
"""Lengths of the pieces of flight whose residual wrench tells whether anything is left: slow forces and short ones."""
OMNIBUS_LIMIT, OMNIBUS_P = 1.6, 1e-4
"""Something is left where the mean chi2 of a residual wrench is above this and its p-value below. On data without an
effect the statistic was 1.0 +- 0.2 (study of diagnosis, section 0)."""
ENOUGH_SHARE = 0.9
"""What is left beside an effect that explains this share of the excess is a detail of its law; of less, a stranger."""


@dataclass(frozen=True)
class Findings:
    """All that a diagnosis finds.

    before, after: the omnibus statistics of flight, the worst over the lengths of pieces; None without flight; ranking:
    candidates, the best first; contact: all contact evidence; world: with the selected effects; base: without them;
    errors: of predictions in episodes that the effect was not fitted to, without it and with it [m], by effect;
    as_good: other laws that explain the flights as well as those of effects found; limits: what contact could have
    shown, where it shows nothing.
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
    as_good: tuple[OtherLaw, ...] = ()
    limits: tuple[ContactLimit, ...] = ()

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
    slots, after_flight, flight = flight_search(prepared, world, candidates, scatter)
    flown = _worst_omnibus(_pieces(prepared, after_flight), scatter)
    touched = with_contact(prepared, world, after_flight, slots, candidates, flight, explained=not _is_left(flown))
    chosen, final = touched.chosen, touched.world
    after = _worst_omnibus(_pieces(prepared, final), scatter) if chosen else before
    in_flight = [slot.best.name for slot in slots if slot.flagged]
    alike = None if flight is None else consistency(flight, after_flight, in_flight, prepared.groups, scatter)
    others = [] if flight is None else other_laws(flight, after_flight, in_flight, scatter)
    doubtful = (alike is not None and alike.doubtful) or any(one.better for one in others)
    left = _is_left(after)
    remaining = left or doubtful
    verdict: VerdictName = "none_missing"
    if doubtful or (left and _explained(before, after) < ENOUGH_SHARE):
        verdict = "unexplained"
    elif any(len(one.equals) > 1 for one in chosen):
        verdict = "not_separable"
    elif chosen:
        verdict = "missing_effect"
    ranking = _ranking(chosen, slots, touched.evidence)
    errors = {}
    for one in chosen if verdict != "unexplained" else []:
        segments = flight if one.where == "flight" else touched.segments
        if segments is not None:
            errors[one.evidence.name] = held_out_errors(segments, final, one.evidence.name)
    return Findings(
        verdict,
        tuple(chosen),
        remaining,
        before,
        after,
        tuple(ranking),
        tuple(touched.evidence),
        final,
        touched.chi2,
        world,
        errors,
        tuple(one for one in others if one.as_good),
        touched.limits,
    )


def _pieces(prepared: Prepared, world: World) -> list[tuple[Segments, ResidualWrenches]]:
    """Return the flights in pieces of each length of `OMNIBUS_S` with their residual wrenches; none without flight."""
    cut = [pieces for longest_s in OMNIBUS_S if (pieces := prepared.pieces(world, longest_s)) is not None]
    return [(pieces, residual_wrenches(pieces)) for pieces in cut]


def _worst_omnibus(pieces: Sequence[tuple[Segments, ResidualWrenches]], scatter: float) -> Omnibus | None:
    """Return the omnibus statistic of flight over all lengths of pieces, the one with the smallest p-value."""
    found = [omnibus(wrenches, scatter) for _, wrenches in pieces]
    return min(found, key=lambda one: (one.p_value, -one.statistic), default=None)


def _is_left(found: Omnibus | None) -> bool:
    return found is not None and found.statistic > OMNIBUS_LIMIT and found.p_value < OMNIBUS_P


def _explained(before: Omnibus | None, after: Omnibus | None) -> float:
    """Return the share of the omnibus statistic's excess that is gone."""
    if before is None or after is None or before.statistic <= 1:
        return 0.0
    return 1 - (after.statistic - 1) / (before.statistic - 1)


def _ranking(chosen: Sequence[Chosen], slots: Sequence[Slot], contact: Sequence[ContactEvidence]) -> list[Evidence]:
    """Return all candidates once: selected ones and their equals first, then by where they were judged."""
    found: dict[str, Evidence] = {}
    everything = [e for one in chosen for e in one.equals]
    everything += [e for slot in slots[:1] for e in slot.evidence]
    everything += [one.evidence for one in contact if one.evidence.candidate.effect.phase == "contact"]
    for evidence in everything:
        found.setdefault(evidence.name, evidence)
    return list(found.values())
