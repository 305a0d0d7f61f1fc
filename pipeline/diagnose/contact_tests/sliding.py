"""Sliding test: is a contact effect missing while the body slides, rolls or spins on the ground?

Every candidate is refitted to the same sliding segments from the same starts, together with one friction for all of
them, and the candidates are compared by their residuals. The contact law hardly matters during sliding, so data without
an effect leave little more than noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch

from ...segments.candidates import Candidate, Variant
from ...segments.sliding_descent import SlidingFit
from ...segments.sliding_fit import StartedSliding, fit_sliding
from ..evidence import Evidence
from .contact_test import Bar, ContactData, ContactTest, Lead, fitted_evidence, ranked, tries_of

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
FLIGHT_TELLS_M_S2 = 0.3
"""Threshold on the smallest force per mass that the flights show [m/s^2], a tenth of usual friction. Above it, effects
that act in flight are tested in sliding segments, too."""
SURPLUS_SIGMAS = 3.0
"""Distance below its mean, in standard deviations, that chi2 of sliding segments with the right effect may reach by
chance."""
FIRST_ITERATIONS, CLOSE_SHARE = 3, 0.3
"""Number of iterations after which a fit is continued only if it explains at least this share of what the best one
explains."""
MANY = 4
"""Maximum number of parameters of a candidate that is fitted in a batch with smaller ones. The longest fit determines
the time of a batch."""


class SlidingTest(ContactTest):
    """Comparison of candidates by their residuals in sliding segments."""

    name: ClassVar[str] = "sliding"
    lists_all: ClassVar[bool] = True

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of the candidates, the best first; empty where none can reach a score.

        Where the flights are too short to show a force of the size of friction, candidates that act in flight are
        tested, too: along the ground a drag slows a ball much as rolling resistance does.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits.
        """
        asked = {"contact", "flight"} if data.prepared.least_force_m_s2 > FLIGHT_TELLS_M_S2 else {"contact"}
        started, variants = data.sliding, data.variants(candidates, asked)
        if started is None or not variants:
            return []
        base, degrees = started.base, float(started.segments.dof.sum())
        if base.cost - (degrees - SURPLUS_SIGMAS * math.sqrt(2 * degrees)) < SLIDING_SURE:
            return []
        found = _fits(variants, started, SLIDING_SURE)
        # the model alone, fitted again from the states of the best candidate: what both gain is no sign of an effect
        _, best = min(found, key=lambda one: one[1].cost)
        again = (best.segments, best.values[0, : base.values.shape[1]])
        least = min(base.cost, fit_sliding(started.segments.world, [], [again], started.flight_parameters)[0].cost)
        return ranked(_judged(found, candidates, base, least, degrees))

    def leads(self, best: Evidence) -> tuple[Lead, ...]:
        """Return the leads in score, the second over effects that explain nearly as much."""
        return (
            Lead(score=SLIDING_LEAD, share=SLIDING_SHARE),
            Lead(score=MISLED, rival=Bar(share=RIVAL_SHARE * best.share)),
        )

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bars for an effect, and for one that leaves next to nothing unexplained."""
        best = equals[0]
        parameters = len(best.candidate.effect.parameters)
        flexible = parameters > FEW_NUMBERS
        mapped = any(len(one.candidate.effect.parameters) > MANY_NUMBERS for one in equals)
        doubted = mapped and best.name in BRAKED_OTHERWISE
        usual = Bar(
            score=SLIDING_SCORE_FLEXIBLE if flexible or data.flown or doubted else SLIDING_SCORE,
            # what is unexplained in flight also acts during sliding
            share=SLIDING_EXPLAINED if data.explained else SLIDING_SHARE_SURE,
            size=SLIDING_LEAST,
            without_best=SLIDING_OTHERS if data.flown else -math.inf,
        )
        if doubted or parameters > MANY_NUMBERS or (flexible and data.flown):
            return (usual,)
        return usual, replace(usual, score=SLIDING_SURE, share=SLIDING_SHARE_SURE)


def _fits(variants: Sequence[Variant], started: StartedSliding, least: float) -> list[tuple[Variant, SlidingFit]]:
    """Return the fit of each variant; those that are far behind after the first iterations are not continued.

    Args:
        variants: The variants.
        started: The sliding segments and their fit without the variants.
        least: The smallest gain of chi2 for which a fit is continued.
    """
    soft_world, base, known = started.segments.world, started.base, started.flight_parameters
    start = (base.segments, base.values[0])
    found: dict[int, tuple[Variant, SlidingFit]] = {}
    for part in batches(variants):
        tried = fit_sliding(soft_world, part, [start] * len(part), known, FIRST_ITERATIONS)
        found |= {len(found) + k: one for k, one in enumerate(zip(part, tried, strict=True))}
    gains = {k: base.cost - fit.cost for k, (_, fit) in found.items()}
    close = [k for k, gain in gains.items() if gain > least and gain > CLOSE_SHARE * max(gains.values())]
    for part in batches([found[k][0] for k in close]):
        mine = [(k, found[k]) for k in close if found[k][0] in part]
        again = fit_sliding(soft_world, part, [(fit.segments, fit.values[0]) for _, (_, fit) in mine], known)
        found |= {k: (variant, fit) for (k, (variant, _)), fit in zip(mine, again, strict=True)}
    return list(found.values())


def batches(variants: Sequence[Variant]) -> list[list[Variant]]:
    """Split variants into batches that are fitted at once, in order.

    The fused kernel takes one effect of a kind; variants of many parameters slow a batch down and are kept apart.
    """
    parts: list[list[Variant]] = []
    for variant in variants:
        many = len(variant.parameters) > MANY
        fits = (
            part
            for part in parts
            if many == (len(part[0].parameters) > MANY)
            and all(type(other.active.effect) is not type(variant.active.effect) for other in part)
        )
        part = next(fits, None)
        if part is None:
            parts.append([variant])
        else:
            part.append(variant)
    return parts


def _judged(
    found: Sequence[tuple[Variant, SlidingFit]],
    candidates: Sequence[Candidate],
    alone: SlidingFit,
    base: float,
    degrees: float,
) -> Iterator[Evidence]:
    """Yield the evidence of the fits.

    Args:
        found: Variants with their fits.
        candidates: The candidates.
        alone: Fit without candidates.
        base: Smallest chi2 without candidates.
        degrees: Degrees of freedom of the sliding segments.
    """
    tries = tries_of(variant for variant, _ in found)
    spread = max(1.0, min(fit.cost for _, fit in found) / degrees)
    episode = np.array([item.episode for item in alone.segments.items])
    for variant, fit in found:
        number = len(variant.parameters)
        covariance = torch.linalg.pinv(fit.information[0], hermitian=True)[-number:, -number:].numpy() * spread
        one = fitted_evidence(
            candidates[variant.place],
            variant,
            gain=max(0.0, (base - fit.cost) / spread),
            values=fit.values[0, -number:].numpy().astype(np.float64),
            covariance=covariance,
            penalty=math.log(max(degrees, 2.0)),
            tries=tries[variant.place],
        )
        falls = (alone.chi2 - fit.chi2).numpy()
        by_episode = [float(falls[episode == own].sum()) for own in np.unique(episode)]
        yield replace(
            one,
            share=(base - fit.cost) / max(base - degrees, 1.0),
            without_best=(sum(by_episode) - max(by_episode)) / spread,
            contact={"friction": float(fit.values[0, 0].exp())},
        )
