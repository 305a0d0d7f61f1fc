"""Search for a missing effect in contact, and separation of flight equals by the contact data.

The tests run in the order of what they assume: sliding segments, where the contact law hardly matters; impacts of a
ball, which need no contact law; friction in sliding against friction in impacts; and last the contact segments under
the model's contact law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ..physics.effects.effect import ActiveEffect
from ..physics.effects.registry import CONTACT_ALIASES
from ..physics.world import World
from ..segments.candidates import Candidate, base_parameters, base_values, without_effect
from ..segments.prepare import Prepared
from ..segments.segment_fit import refit
from ..segments.segments import Segments
from ..segments.sliding_fit import StartedSliding
from .contact_tests.friction_consistency import friction_consistency_evidence, selected_by_friction_consistency
from .contact_tests.impact import ImpactEvidence, impact_evidence, selected_in_impacts, with_impact_effect
from .contact_tests.segments import ContactEvidence, contact_evidence, fitted_contact, refitted_contact, separated
from .contact_tests.sliding import SlidingEvidence, sliding_evidence, with_effect
from .detection_limits import DetectionLimit, detection_limits
from .effect_selection import Evidence, SelectionStep

SLIDING_SCORE, SLIDING_EXPLAINED = 220.0, 0.5
"""Thresholds of the sliding test: minimum score, and minimum share of the excess of chi2 over the noise that the effect
explains. They hold for an effect of one parameter where no effect was selected in flight."""
FEW_NUMBERS, SLIDING_SCORE_FLEXIBLE = 1, 400.0
"""Maximum number of parameters for which `SLIDING_SCORE` applies, and the minimum score of effects with more
parameters,
or of any effect after one was selected in flight: these fit more by chance."""
SLIDING_SURE, SLIDING_SHARE_SURE = 80.0, 0.78
"""Lower minimum score in the sliding test for an effect that explains at least this share of the excess. On the
development cases absent effects reached a score of 165 at a share of 0.69, any share up to a score of 50, and
(directional friction with a drag in wind) a score of 179 at a share of 0.94. For this last reason the lower score does
not apply to effects of several parameters after one was selected in flight."""
MANY_NUMBERS = 4
"""Maximum number of parameters for which `SLIDING_SURE` applies. A friction map has more and fits almost anything."""
SLIDING_LEAST = 0.3
"""Minimum size in the sliding test: an effect is not selected if all its parameters are below this share of their usual
sizes. Simulators differ by as much."""
SLIDING_OTHERS = 80.0
"""Minimum fall of chi2 without the episode that contributes most, required where an effect was selected in flight,
because the law of that effect may be slightly wrong along a single slide. On balls in wind, false directional friction
had scores of 823 and 1044, of which 33 and 18 came from the other episodes; true effects had 114 to 34,000, except for
one at 26, which is no longer detected."""
SLIDING_LEAD, SLIDING_SHARE = 12.0, 0.1
"""Another effect counts as equal in the sliding test if its score is lower by less than the first value, or by less
than this share of the best score."""
MISLED, RIVAL_SHARE = 165.0, 0.5
"""Another effect also counts as equal if its score is lower by less than the first value, the largest score that an
absent effect reached, and if it explains at least this share of what the best one explains. Friction that falls with
the speed, that grows, and that changes with the place are nearly the same along a single slide."""
BRAKED_OTHERWISE = ("torsional_friction",)
"""Effects that are not selected where a friction map fits equally well and the score is below `SLIDING_SCORE_FLEXIBLE`.
The simulators disagree about the spin of a sliding body: of four such detections three were false (scores 101 to 260),
and the fourth came with a drag."""
CONTACT_SCORE, CONTACT_T = 22.0, 1.0
"""Thresholds of the test in contact segments: minimum score, and minimum mean gain of held-out episodes in its standard
errors."""
AGREED_SCORE = 40.0
"""Minimum score in contact segments of an effect that sliding segments can show. It must also have the highest score in
the sliding test, above this value."""
ALONE_SCORE = 120.0
"""Minimum score in contact segments where sliding segments are missing. Directional friction has reached 113 where it
was absent."""
IN_IMPACTS_ALONE = ("velocity_restitution",)
"""Effects that sliding segments cannot show."""
CONTACT_LEAD = 0.5
"""Another effect counts as equal in contact segments if its score is at least this share of the best score."""
CONFIRMED = 2.0
"""Minimum distance of a parameter from zero after the refit, in its standard errors, for an effect to be confirmed in
contact segments."""


@dataclass(frozen=True)
class Chosen:
    """Selected effect and its equals."""

    evidence: Evidence
    """Evidence of the selected effect."""
    equals: tuple[Evidence, ...]
    """Effects that explain the data equally well, the selected one first."""
    where: Literal["flight", "contact"]
    """Motion that the evidence comes from."""


@dataclass(frozen=True, kw_only=True)
class ContactFindings:
    """Result of the searches in flight and contact together."""

    chosen: list[Chosen]
    """Selected effects, those of flight first."""
    evidence: list[ContactEvidence]
    """Evidence of the candidates in contact."""
    world: World
    """World with the selected effects."""
    chi2: float | None = None
    """Chi2 per degree of freedom of the contact segments; None without contact."""
    segments: Segments | None = None
    """Contact segments with fitted states; None without contact."""
    limits: tuple[DetectionLimit, ...] = ()
    """Detection limits of the contact effects, where contact selected none."""


def with_contact(
    prepared: Prepared,
    world: World,
    after_flight: World,
    steps: Sequence[SelectionStep],
    candidates: Sequence[Candidate],
    flight: Segments | None,
    explained: bool,
) -> ContactFindings:
    """Resolve the flight equals with the contact data, then return the first contact effect that a test selects.

    The tests run in the order of what they assume: sliding segments, impacts, friction consistency, and last the
    contact segments under the model's contact law. The first that selects an effect ends the search.

    Args:
        prepared: The episodes.
        world: The model's world.
        after_flight: The world with the effects selected in flight.
        steps: Selection steps of the flight search.
        candidates: All candidates.
        flight: Flight segments with fitted states; None without flight.
        explained: Whether the flight segments are explained down to the noise.
    """
    data = _resolved_flight(prepared, after_flight, steps)
    if data is None:
        chosen = [Chosen(step.best, step.equals, "flight") for step in steps if step.flagged]
        return ContactFindings(chosen=chosen, evidence=[], world=after_flight)
    started = StartedSliding.of(prepared, data.world, flight)
    sliding = sliding_evidence(prepared, data.world, candidates, SLIDING_SURE, started)
    found = _by_sliding(data, sliding, explained)
    if found is not None:
        return found
    impacts = impact_evidence(prepared, data.world, candidates)
    found = _by_impacts(data, impacts)
    if found is not None:
        return found
    friction = friction_consistency_evidence(prepared, data.world, data.segments, candidates, started)
    found = _by_friction_consistency(data, friction)
    if found is not None:
        return found
    evidence = contact_evidence(data.segments, data.world, candidates, prepared.groups, prepared.has_orientation)
    found = _by_segments(data, evidence, sliding)
    if found is not None:
        return found
    # effects that only impacts show are left out where impacts were measured
    asked = [c for c in candidates if not impacts or c.effect.name not in IN_IMPACTS_ALONE]
    scores = (SLIDING_SCORE, SLIDING_SCORE_FLEXIBLE)
    limits = detection_limits(started, data.world, asked, scores, prepared.has_orientation, IN_IMPACTS_ALONE)
    final = replace(data.after_flight, contact=data.world.contact)
    return ContactFindings(
        chosen=data.chosen, evidence=evidence, world=final, chi2=data.chi2, segments=data.segments, limits=tuple(limits)
    )


@dataclass(frozen=True, kw_only=True)
class _ContactData:
    """Inputs of the contact tests, after the flight equals are resolved."""

    chosen: list[Chosen]
    """Effects selected in flight, with the equals that contact leaves."""
    after_flight: World
    """World with these effects."""
    world: World
    """The same with the contact parameters refitted."""
    segments: Segments
    """Contact segments with states fitted by `world`."""
    chi2: float
    """Chi2 per degree of freedom of the contact segments."""

    def found(
        self,
        equals: Sequence[SlidingEvidence | ImpactEvidence | ContactEvidence],
        evidence: list[ContactEvidence],
        world: World,
    ) -> ContactFindings:
        """Return the findings with an effect selected in contact.

        Args:
            equals: The selected effect and its equals, the selected one first.
            evidence: Evidence of all candidates in the test that selected it.
            world: World with the selected effect.
        """
        every = tuple(one.evidence for one in equals)
        return ContactFindings(
            chosen=[*self.chosen, Chosen(every[0], every, "contact")],
            evidence=evidence,
            world=world,
            chi2=self.chi2,
            segments=self.segments,
        )


def _resolved_flight(prepared: Prepared, after_flight: World, steps: Sequence[SelectionStep]) -> _ContactData | None:
    """Fit the contact segments and keep the flight equals that they admit; None without contact."""
    flagged = [step for step in steps if step.flagged]
    ambiguous = [step for step in flagged if len(step.equals) > 1]
    neutral = after_flight
    for step in ambiguous:
        neutral = without_effect(neutral, step.best.name)
    fitted = fitted_contact(prepared, neutral)
    if fitted is None:
        return None
    base, contact = fitted
    final, chosen = after_flight, []
    for step in flagged:
        equals = list(step.equals)
        if len(equals) > 1:
            kept, _ = separated(equals, contact, base.world, prepared.groups)
            equals = _with_aliases(kept, equals)
            final = _replaced(final, step.best, equals[0])
        chosen.append(Chosen(equals[0], tuple(equals), "flight"))
    final = replace(final, contact=base.world.contact)
    if ambiguous:
        base, contact = refitted_contact(contact, final)
    rows = contact.residuals([], contact.observations.times_s.new_zeros(0), jacobian=False)[0]
    chi2 = float(rows.square().sum() / contact.dof.sum())
    return _ContactData(chosen=chosen, after_flight=final, world=base.world, segments=contact, chi2=chi2)


def _by_sliding(data: _ContactData, evidence: Sequence[SlidingEvidence], explained: bool) -> ContactFindings | None:
    """Return the findings of the sliding test; None where it selects no effect."""
    selected = selected_in_sliding(evidence, explained, bool(data.chosen))
    if not selected:
        return None
    listed = [ContactEvidence(one.evidence, one.score, None, None) for one in evidence]
    return data.found(selected, listed, with_effect(data.world, selected[0]))


def _by_impacts(data: _ContactData, evidence: Sequence[ImpactEvidence]) -> ContactFindings | None:
    """Return the findings of the impact test; None where it selects no effect."""
    selected = selected_in_impacts(evidence)
    if not selected:
        return None
    listed = [ContactEvidence(one.evidence, one.score, one.gain, one.t) for one in evidence]
    return data.found(selected, listed, with_impact_effect(data.world, selected[0]))


def _by_friction_consistency(data: _ContactData, evidence: Sequence[SlidingEvidence]) -> ContactFindings | None:
    """Return the findings of the friction consistency test; None where it selects no effect."""
    selected = selected_by_friction_consistency(evidence)
    if not selected:
        return None
    listed = [ContactEvidence(one.evidence, one.score, None, None) for one in selected]
    return data.found(selected, listed, with_effect(data.world, selected[0]))


def _by_segments(
    data: _ContactData, evidence: list[ContactEvidence], sliding: Sequence[SlidingEvidence]
) -> ContactFindings | None:
    """Return the findings of the contact segments; None where they select no effect or a refit does not confirm it."""
    selected = _selected_in_segments(evidence, sliding)
    if not selected:
        return None
    world, parameters = _added(data.world, data.segments, selected[0].evidence)
    if not any(abs(value) > CONFIRMED * error for value, error in parameters.values()):
        return None
    first = replace(selected[0], evidence=replace(selected[0].evidence, numbers=parameters))
    return data.found([first, *selected[1:]], evidence, world)


def selected_in_sliding(evidence: Sequence[SlidingEvidence], explained: bool, flown: bool) -> list[SlidingEvidence]:
    """Return the effect that the sliding test selects and its equals; empty where it selects none.

    Args:
        evidence: Evidence in sliding segments, the best first.
        explained: Whether the flight segments are explained down to the noise.
        flown: Whether an effect was selected in flight, whose law is never exactly the true one.
    """
    fit = [one for one in evidence if one.evidence.test.admissible]
    if not fit or not _selected_effects_in_sliding(fit[0], flown):
        return []
    if not explained and fit[0].share < SLIDING_SHARE_SURE:
        return []  # what is unexplained in flight also acts during sliding
    alike = fit[0].score - max(SLIDING_LEAD, SLIDING_SHARE * fit[0].score)
    rival, share = fit[0].score - MISLED, RIVAL_SHARE * fit[0].share
    equals = [one for one in fit if one.score > alike or (one.score > rival and one.share > share)]
    mapped = any(len(one.evidence.candidate.effect.parameters) > MANY_NUMBERS for one in equals)
    if mapped and fit[0].evidence.name in BRAKED_OTHERWISE and fit[0].score < SLIDING_SCORE_FLEXIBLE:
        return []
    return equals


def _selected_effects_in_sliding(one: SlidingEvidence, flown: bool) -> bool:
    """Return whether an effect is large enough, and its evidence strong enough, to be selected in sliding segments."""
    parameters, estimates = one.evidence.candidate.effect.parameters, one.evidence.estimates
    if all(abs(estimates[p.name][0]) < SLIDING_LEAST * p.scale for p in parameters):
        return False
    if flown and one.others < SLIDING_OTHERS:
        return False
    flexible = len(parameters) > FEW_NUMBERS
    least = SLIDING_SCORE_FLEXIBLE if flexible or flown else SLIDING_SCORE
    enough = one.score > least and one.share > SLIDING_EXPLAINED
    sure = one.score > SLIDING_SURE and one.share > SLIDING_SHARE_SURE and len(parameters) <= MANY_NUMBERS
    return enough or (sure and not (flexible and flown))


def _selected_in_segments(
    evidence: Sequence[ContactEvidence], sliding: Sequence[SlidingEvidence]
) -> list[ContactEvidence]:
    """Return the effect that contact segments select and its equals; empty where none passes or sliding contradicts."""
    fit = [one for one in evidence if one.evidence.test.admissible and (one.gain or 0) > 0 and (one.t or 0) > CONTACT_T]
    if not fit or fit[0] is not evidence[0] or fit[0].score < _threshold(fit[0], sliding):
        return []
    return [one for one in fit if one.score > CONTACT_LEAD * fit[0].score]


def _threshold(one: ContactEvidence, sliding: Sequence[SlidingEvidence]) -> float:
    """Return the minimum score of an effect in contact segments, given its evidence in sliding segments."""
    if one.evidence.candidate.effect.phase != "contact" or one.evidence.name in IN_IMPACTS_ALONE:
        return CONTACT_SCORE
    if not sliding:
        return ALONE_SCORE
    first = next((other for other in sliding if other.evidence.test.admissible), None)
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
        if p.name.startswith(
            f"{effect.name}."
        ):  # from the estimate of the score test: the cost is too rough near neutral
            start[k] = min(max(known[p.name.partition(".")[2]], p.bounds[0]), p.bounds[1])
    found = refit([contact], added, parameters, start)
    own = [p for p in parameters if p.name.startswith(f"{effect.name}.")]
    estimates = {p.name.partition(".")[2]: found.number(p.name) for p in own}
    return found.world, estimates


def _replaced(world: World, old: Evidence, new: Evidence) -> World:
    """Return the world with one effect replaced by another at its refitted parameters."""
    if old.name == new.name or new.refitted is None:
        return world
    own = next(a for a in new.refitted.world.effects if a.effect.name == new.name)
    return replace(world, effects=(*without_effect(world, old.name).effects, own))


def _with_aliases(kept: Sequence[Evidence], equals: Sequence[Evidence]) -> list[Evidence]:
    """Return the remaining equals, with the original ones that rigid contact cannot distinguish from them."""
    names = {one.name for one in kept}
    names |= {name for group in CONTACT_ALIASES if group & names for name in group}
    return [*kept, *(one for one in equals if one.name in names and one not in kept)]
