"""Sliding test: is a contact effect missing while the body slides, rolls or spins on the ground?

Every candidate is refitted to the same sliding segments from the same starts, together with one friction for all of
them, and the candidates are compared by their residuals. The contact law hardly matters during sliding, so data without
an effect leave little more than noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...optimization.uncertainty import chi2_tail
from ...physics.contact_law import ContactLaw
from ...physics.effects.effect import ActiveEffect
from ...physics.world import World
from ...segments.candidates import (
    Candidate,
    Variant,
    admissible,
    variants_of,
)
from ...segments.prepare import Prepared
from ...segments.sliding_descent import SlidingFit
from ...segments.sliding_fit import StartedSliding, fit_sliding
from ..effect_selection import Evidence
from ..score_test import ScoreTest

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


@dataclass(frozen=True, kw_only=True)
class SlidingEvidence:
    """Evidence for a candidate in sliding segments."""

    evidence: Evidence
    """Evidence with estimates."""
    score: float
    """Fall of chi2 in units of the residual of the best candidate, less the penalty of BIC."""
    friction: float
    """Friction coefficient fitted jointly [1]."""
    left: float
    """Chi2 per degree of freedom with the candidate."""
    share: float
    """Share of the excess of chi2 over its mean that the candidate explains."""
    others: float = math.inf
    """Fall of chi2 without the episode in which it falls most; infinite where it was not computed."""


def sliding_evidence(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], least: float, started: StartedSliding | None
) -> list[SlidingEvidence]:
    """Return the evidence of the candidates that act in contact, the best first; empty where none can reach a score.

    Where the flights are too short to show a force of the size of friction, candidates that act in flight are tested,
    too: along the ground a drag slows a ball much as rolling resistance does.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All candidates.
        least: Minimum score of interest.
        started: The sliding segments and their fit without candidates; None without any.
    """
    kept, _ = admissible(world, candidates, prepared.has_orientation)
    asked = {"contact", "flight"} if prepared.least_force_m_s2 > FLIGHT_TELLS_M_S2 else {"contact"}
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if v.active.effect.phase in asked]
    if started is None or not variants:
        return []
    known, base = started.flight_parameters, started.base
    soft_world = started.segments.world
    degrees = float(started.segments.dof.sum())
    if base.cost - (degrees - SURPLUS_SIGMAS * math.sqrt(2 * degrees)) < least:
        return []
    found = _fits(variants, started, least)
    # the model alone, fitted again from the states of the best candidate: what both gain is no sign of an effect
    _, best = min(found, key=lambda one: one[1].cost)
    own = best.values[0, : base.values.shape[1]]
    least_cost = min(base.cost, fit_sliding(soft_world, [], [(best.segments, own)], known)[0].cost)
    return _ranked(found, kept, base, least_cost, degrees)


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


def with_effect(world: World, found: SlidingEvidence) -> World:
    """Return the world with an effect and the friction, both as estimated from the sliding segments."""
    evidence, law = found.evidence, world.contact
    assert isinstance(law, ContactLaw)  # sliding segments are fitted under no other law
    values = evidence.constants | {name: value for name, (value, _) in evidence.estimates.items()}
    active = ActiveEffect.of(evidence.candidate.effect, values, world.gravity[0, :1])
    contact = replace(law, friction=torch.full_like(law.friction, found.friction))
    return replace(world, contact=contact, effects=(*world.effects, active))


def _ranked(
    found: Sequence[tuple[Variant, SlidingFit]],
    kept: Sequence[Candidate],
    alone: SlidingFit,
    base: float,
    degrees: float,
) -> list[SlidingEvidence]:
    """Return the evidence of the fits, the best first.

    Args:
        found: Variants with their fits.
        kept: Admissible candidates.
        alone: Fit without candidates.
        base: Smallest chi2 without candidates.
        degrees: Degrees of freedom of the sliding segments.
    """
    tries: dict[int, int] = {}
    for variant, _ in found:
        tries[variant.place] = tries.get(variant.place, 0) + 1
    spread = max(1.0, min(fit.cost for _, fit in found) / degrees)
    episode = np.array([item.episode for item in alone.segments.items])
    best: dict[int, SlidingEvidence] = {}
    for variant, fit in found:
        candidate, values = kept[variant.place], fit.values[0, -len(variant.parameters) :].numpy().astype(np.float64)
        gain, number = max(0.0, (base - fit.cost) / spread), len(values)
        covariance = torch.linalg.pinv(fit.information[0], hermitian=True)[-number:, -number:].numpy() * spread
        p_value = chi2_tail(gain, number)
        test = ScoreTest(
            statistic=gain,
            dof=number,
            p_value=p_value,
            estimate=values,
            covariance=covariance,
            admissible=bool((values != 0).any()),
        )
        names = [p.name for p in candidate.effect.parameters]
        deviations = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        estimates = {name: (float(v), float(s)) for name, v, s in zip(names, values, deviations, strict=True)}
        corrected = min(1.0, p_value * tries[variant.place])
        evidence = Evidence(
            candidate=candidate, constants=variant.constants, test=test, p_value=corrected, numbers=estimates
        )
        score = gain - number * math.log(max(degrees, 2.0)) - 2 * math.log(tries[variant.place])
        share = (base - fit.cost) / max(base - degrees, 1.0)
        falls = (alone.chi2 - fit.chi2).numpy()
        by_episode = [float(falls[episode == own].sum()) for own in np.unique(episode)]
        others = (sum(by_episode) - max(by_episode)) / spread
        one = SlidingEvidence(
            evidence=evidence,
            score=score,
            friction=float(fit.values[0, 0].exp()),
            left=fit.cost / degrees,
            share=share,
            others=others,
        )
        if variant.place not in best or score > best[variant.place].score:
            best[variant.place] = one
    return sorted(best.values(), key=lambda one: (-one.score, one.evidence.name))
