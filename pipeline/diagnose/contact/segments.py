"""Test in contact segments: does the model's contact law show an effect, beside what slides have shown?

No contact law is exact, and its error is the same in all episodes: restitution that depends on the speed, a pull at the
ground or a friction by direction describe how another law differs from the model's, repeat from episode to episode, and
predict held-out ones. So segments alone name an effect only where its score is far above what it reaches in data
without effects, and restitution by speed never. Where slides rank the same effect first, that is one hypothesis from
other data, and a small score confirms it. A torque about the normal is no error of such a law, which has none at a
point. Every segment has its own deviations of the contact parameters, segments that no candidate explains are
downweighted, and the effect has to improve held-out episodes and to exceed its scatter between episodes.

The segments are linearised without candidates first. Where one that can be named has a positive score there, it and its
rivals are fitted, and each is judged where it fits (`candidate_fit`), in states that all fits share: a large effect is
far from linear, and a state found without it hides it. Beside an effect of flight, what slides do not show, too, cannot
be named, whatever its fit explains, and is not fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ...physics.world import World
from ...segments.candidates import Candidate, Variant, base_parameters, base_values, with_added
from ...segments.linearization import Linearization, linearize, linearize_contact
from ...segments.segment_fit import refit
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ..evidence.effect_selection import repeats
from ..evidence.evidence import Evidence
from ..evidence.robust_fit import (
    RobustFit,
    losses_by_others,
    robust_fit,
    robust_fits,
    robust_repetition,
    with_segment_parameters,
)
from ..thresholds import THRESHOLDS, SegmentsThresholds
from .candidate_fit import CandidateFit, candidate_fits
from .contact_test import Bar, ContactData, ContactTest, Lead, fitted_evidence, ranked, selected, tries_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SegmentsTest(ContactTest):
    """Comparison of candidates by the robust loss that they leave in all contact segments."""

    name: ClassVar[str] = "segments"
    lists_all: ClassVar[bool] = True

    limits: SegmentsThresholds = THRESHOLDS.segments
    """What decides."""

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of the candidates, with gains in held-out episodes, the best first.

        Effects that act in flight near the ground are tested, too: flights hardly show them.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits.
        """
        variants = [v for v in data.variants(candidates, ("contact", "flight")) if _acts_near_ground(v)]
        if data.segments is None or not variants:
            return []
        groups = data.prepared.groups
        linear = linearize(data.segments, data.world, variants, groups, robust=True)
        plain = _ranked(_linear_tests(linear, candidates, variants), data)
        if not any(map(self._is_likely, plain)) or not any(self._can_be_named(one, data) for one in plain):
            return plain
        fitted = [one for one in plain if _can_be_fitted(one)]
        none, fits = candidate_fits(data.segments, data.world, fitted, groups)
        at = linearize_contact(none.segments.in_world(data.world), data.world, variants, groups, none.errors)
        tries = {candidates[place].effect.name: count for place, count in tries_of(variants).items()}

        def judged(
            linear: Linearization, of: Callable[[CandidateFit], Linearization], first: Mapping[str, float]
        ) -> list[Evidence]:
            tests = _linear_tests(linear, candidates, variants)
            tests += [tests[0].at(one, of(fits[one.name]), fits[one.name], tries[one.name]) for one in fitted]
            return [replace(one, first_score=first[one.name]) for one in _ranked(tests, data)]

        first = {one.name: one.score for one in plain}
        plain = judged(at.plain, lambda fit: fit.plain, first)
        if selected(self, plain, data):
            return plain
        absent = linearize_contact(data.segments, data.world, variants, groups).beside
        for one in _ranked(_linear_tests(absent, candidates, variants), data):
            first[one.name] = max(one.score, first[one.name])
        beside = judged(at.beside, lambda fit: fit.beside, first)
        return [replace(one, beside_errors=True) for one in beside] if selected(self, beside, data) else plain

    def _is_likely(self, one: Evidence) -> bool:
        """Return whether a nameable effect of one parameter has a score where it is absent; then effects are fitted."""
        single = len(one.candidate.effect.parameters) <= self.limits.few_parameters
        return single and one.name in dict(self.limits.alone) and one.score > self.limits.first_score

    def _can_be_named(self, one: Evidence, data: ContactData) -> bool:
        """Return whether an effect with a score where it is absent could pass a bar, whatever its fit explains."""
        return one.score > self.limits.first_score and (self._is_shown(one, data) or self._stands_alone(one, data))

    def _is_shown(self, one: Evidence, data: ContactData) -> bool:
        """Return whether slides show an effect, too, so that a small score confirms it."""
        shown, slides = _first_of_slides(data), THRESHOLDS.sliding
        hidden = one.name in (*slides.in_impacts_alone, *slides.as_friction)
        hidden = hidden or len(one.candidate.effect.parameters) > self.limits.few_parameters
        return shown is not None and shown.name == one.name and shown.score > self.limits.shown_score and not hidden

    def _stands_alone(self, one: Evidence, data: ContactData) -> bool:
        """Return whether segments alone may name an effect.

        What is unexplained in flight acts on the ground, too, and the law of a named effect is never exactly true.
        """
        clear = data.explained and not data.flown
        return one.name in dict(self.limits.alone) and (clear or one.name in self.limits.unlike_laws)

    def leads(self, best: Evidence) -> tuple[Lead, ...]:
        """Return the lead in score over effects that improve held-out episodes."""
        return (Lead(share=self.limits.lead_share, rival=Bar(gain_t=self.limits.gain_t)),)

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bars of an effect: where slides show it, too, and where segments alone do."""
        best, found = equals[0], []
        if best.falls_at_rest or not repeats(best, 1) or best.first_score <= self.limits.first_score:
            return ()
        if self._is_shown(best, data):
            found.append(Bar(score=self.limits.agreed_score, gain_t=self.limits.gain_t))
        if self._stands_alone(best, data):
            alone = dict(self.limits.alone)[best.name]
            found.append(Bar(score=alone, gain_t=self.limits.alone_t))
            found.append(Bar(score=self.limits.sure * alone, gain_t=self.limits.gain_t))
        return tuple(found)

    def added(self, data: ContactData, best: Evidence) -> tuple[World, Evidence] | None:
        """Return the world refitted with the effect, and the evidence with its estimates; None without a number."""
        assert data.segments is not None  # without contact segments there is no evidence
        world, estimates = _refitted(data.world, data.segments, best)
        if not any(abs(value) > self.limits.confirmed * error for value, error in estimates.values()):
            return None
        found = replace(best, numbers=estimates)
        return (world, found) if found.is_number else None


def _first_of_slides(data: ContactData) -> Evidence | None:
    """Return the evidence of the effect that ranks first among slides; None without any."""
    return next((one for one in data.earlier.get("sliding", ()) if one.test.admissible), None)


def _can_be_fitted(one: Evidence) -> bool:
    """Return whether a candidate is fitted: one of contact whose number of parameters a few sizes cover."""
    effect = one.candidate.effect
    return effect.phase == "contact" and len(effect.parameters) <= THRESHOLDS.segments.fitted_parameters


def _acts_near_ground(variant: Variant) -> bool:
    """Return whether an effect acts in contact, or in flight by the distance from the ground."""
    effect = variant.active.effect
    return effect.phase == "contact" or "ground" in effect.needs


@dataclass(frozen=True, eq=False, kw_only=True)
class _Test:
    """A candidate in linearised segments."""

    evidence: Evidence
    """Its evidence, without gains of held-out episodes."""
    linear: Linearization
    """The segments, linearised where the candidate is absent or at its fit."""
    columns: list[int]
    """Columns of the candidate's parameters."""
    start: Array
    """Parameters (P) that fits start from."""
    without: RobustFit
    """Fit without any candidate."""
    lost: Array
    """Loss of each held-out episode without any."""

    def at(self, one: Evidence, linear: Linearization, fit: CandidateFit, tries: int) -> _Test:
        """Return the test of another candidate in segments linearised at its fit, against the same fit without any."""
        found = robust_fit(linear, fit.every, fit.start)
        evidence = _judged(one.candidate, one.constants, found, self.without, _penalty(linear), tries)
        return replace(self, evidence=evidence, linear=linear, columns=list(fit.columns), start=fit.start)

    @property
    def every(self) -> list[int]:
        """Columns of the model's parameters and of the candidate's."""
        return [*range(self.linear.base), *self.columns]

    def told(self, tried: int, lost: Array) -> Evidence:
        """Return the evidence with the gains of held-out episodes, and the repetition where its score is positive.

        Args:
            tried: Number of effects among which it was looked for.
            lost: Loss of each held-out episode with the candidate.
        """
        base, gains = list(range(self.linear.base)), self.lost - lost
        score = self.evidence.score if self.evidence.test.admissible else -math.inf
        repeated = robust_repetition(self.linear, base, self.columns, tried, self.start) if score > 0 else None
        return replace(self.evidence, gains=tuple(gains.tolist()), score=score, repetition=repeated)


def _linear_tests(linear: Linearization, candidates: Sequence[Candidate], variants: Sequence[Variant]) -> list[_Test]:
    """Return the tests of all variants in segments linearised without any of them."""
    linear = with_segment_parameters(linear)
    base = list(range(linear.base))
    without, lost, tries = robust_fit(linear, base), losses_by_others(linear, [base])[0], tries_of(variants)
    penalty, tests = _penalty(linear), []
    every = [linear.columns(variant.parameters) for variant in variants]
    fits = robust_fits(linear, [[*base, *columns] for columns in every])
    for variant, columns, fit in zip(variants, every, fits, strict=True):
        one = _judged(candidates[variant.place], variant.constants, fit, without, penalty, tries[variant.place])
        start = np.zeros(len(linear.parameters))
        tests.append(_Test(evidence=one, linear=linear, columns=columns, start=start, without=without, lost=lost))
    return tests


def _ranked(tests: Sequence[_Test], data: ContactData) -> list[Evidence]:
    """Return each candidate once, by its best test, with gains of held-out episodes, the best first."""
    own = {id(one.evidence): one for one in tests}
    best = ranked(one.evidence for one in tests)
    shown = _first_of_slides(data)
    # what slides rank first is the only hypothesis; without them the best of all effects is looked at
    tried = [1 if shown is not None and shown.name == one.name else len(best) for one in best]
    tests = [own[id(one)] for one in best]
    return ranked(one.told(count, lost) for one, count, lost in zip(tests, tried, _held_out(tests), strict=True))


def _held_out(tests: Sequence[_Test]) -> list[Array]:
    """Return the loss (E,) of each held-out episode with the candidate of each test."""
    alike: dict[tuple[int, bytes], list[int]] = {}
    for k, one in enumerate(tests):
        alike.setdefault((id(one.linear), one.start.tobytes()), []).append(k)
    found: dict[int, Array] = {}
    for some in alike.values():
        first = tests[some[0]]
        lost = losses_by_others(first.linear, [tests[k].every for k in some], first.start)
        found |= dict(zip(some, lost, strict=True))
    return [found[k] for k in range(len(tests))]


def _penalty(linear: Linearization) -> float:
    """Return the penalty of BIC for each parameter."""
    return math.log(max(linear.dof.sum(), 2.0))


def _judged(
    candidate: Candidate,
    constants: dict[str, float],
    fit: RobustFit,
    without: RobustFit,
    penalty: float,
    tries: int,
) -> Evidence:
    """Return the evidence of a fit; its p-value treats the robust loss as twice a negative log-likelihood."""
    count = len(without.value)
    one = fitted_evidence(
        candidate,
        constants,
        gain=without.cost - fit.cost,
        values=fit.value[count:],
        covariance=np.linalg.inv(fit.information)[count:, count:].astype(np.float64),
        penalty=penalty,
        tries=tries,
    )
    return replace(one, numbers=None)  # the refit of a selected effect estimates them


def _refitted(world: World, contact: Segments, evidence: Evidence) -> tuple[World, dict[str, tuple[float, float]]]:
    """Return the world with an effect refitted in contact, and its parameters with estimate and standard error."""
    effect = evidence.candidate.effect
    added = with_added(world, effect, evidence.constants)
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
    own = [p for p in parameters if p.name.startswith(f"{effect.name}.")]
    at = fit_states(contact.in_world(added), parameters, start)
    found = refit([at], added, parameters, start, free=[p.name for p in own])
    estimates = {p.name.partition(".")[2]: found.number(p.name) for p in own}
    return found.world, estimates
