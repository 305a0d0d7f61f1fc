"""Test in contact segments: does the model's contact law show an effect, beside what slides have shown?

No contact law is exact, and its error is the same in all episodes: restitution that depends on the speed, a pull at the
ground or a friction by direction describe how another law differs from the model's, repeat from episode to episode, and
predict held-out ones. So segments alone name an effect only where its score is far above what it reaches in data
without effects, and restitution by speed never. Where slides rank the same effect first, that is one hypothesis from
other data, and a small score confirms it. A torque about the normal is no error of such a law, which has none at a
point. Every segment has its own deviations of the contact parameters, segments that no candidate explains are
downweighted, and the effect has to improve held-out episodes and to exceed its scatter between episodes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ...physics.effects.effect import ActiveEffect
from ...physics.world import World
from ...segments.candidates import Candidate, Variant, base_parameters, base_values
from ...segments.linearization import linearize
from ...segments.segment_fit import refit
from ...segments.segments import Segments
from ..effect_selection import repeats
from ..evidence import Evidence
from ..robust_fit import RobustFit, robust_fit, robust_gains, robust_repetition, with_segment_parameters
from ..thresholds import THRESHOLDS, SegmentsThresholds
from .contact_test import Bar, ContactData, ContactTest, Lead, fitted_evidence, ranked, tries_of, variant_of

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
        linear = linearize(data.segments, data.world, variants, data.prepared.groups, robust=True)
        linear = with_segment_parameters(linear)
        base = list(range(linear.base))
        without, tries = robust_fit(linear, base), tries_of(variants)
        penalty = math.log(max(linear.dof.sum(), 2.0))
        found = []
        for variant in variants:
            fit = robust_fit(linear, [*base, *linear.columns(variant.parameters)])
            candidate = candidates[variant.place]
            found.append(_judged(candidate, variant, fit, without, penalty, tries[variant.place]))
        results, shown, effects = [], _first_of_slides(data), len(tries)
        for one in ranked(found):
            columns = linear.columns(variant_of(one, variants, candidates).parameters)
            gains = robust_gains(linear, base, columns)
            score = one.score if one.test.admissible else -math.inf
            # what slides rank first is the only hypothesis; without them the best of all effects is looked at
            tried = 1 if shown is not None and shown.name == one.name else effects
            repeated = robust_repetition(linear, base, columns, tried) if score > 0 else None
            results.append(replace(one, gains=tuple(gains.tolist()), score=score, repetition=repeated))
        return ranked(results)

    def leads(self, best: Evidence) -> tuple[Lead, ...]:
        """Return the lead in score over effects that improve held-out episodes."""
        return (Lead(share=self.limits.lead_share, rival=Bar(gain_t=self.limits.gain_t)),)

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bars of an effect: where slides show it, too, and where segments alone do."""
        best, shown, slides = equals[0], _first_of_slides(data), THRESHOLDS.sliding
        if len(best.candidate.effect.parameters) > self.limits.few_parameters or not repeats(best, 1):
            return ()
        if best.falls_at_rest:
            return ()
        found, hidden = [], best.name in (*slides.in_impacts_alone, *slides.as_friction)
        if shown is not None and shown.name == best.name and shown.score > self.limits.shown_score and not hidden:
            found.append(Bar(score=self.limits.agreed_score, gain_t=self.limits.gain_t))
        alone = dict(self.limits.alone).get(best.name)
        # what is unexplained in flight acts on the ground, too, and the law of a named effect is never exactly true
        clear = data.explained and not data.flown
        if alone is not None and (clear or best.name in self.limits.unlike_laws):
            found.append(Bar(score=alone, gain_t=self.limits.alone_t))
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


def _acts_near_ground(variant: Variant) -> bool:
    """Return whether an effect acts in contact, or in flight by the distance from the ground."""
    effect = variant.active.effect
    return effect.phase == "contact" or "ground" in effect.needs


def _judged(
    candidate: Candidate, variant: Variant, fit: RobustFit, without: RobustFit, penalty: float, tries: int
) -> Evidence:
    """Return the evidence of a fit; its p-value treats the robust loss as twice a negative log-likelihood."""
    count = len(without.value)
    one = fitted_evidence(
        candidate,
        variant,
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
