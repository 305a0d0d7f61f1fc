"""Glides against impacts: is the friction of what glides that of what strikes?

A ground that pulls presses a gliding body harder than its weight, so that glides show a larger friction, by the factor
1 + F / m g; in an impact the pull is nothing beside the impulse. Every candidate is fitted to the glides beside a
friction; what brings that to the one of impacts, which is known to the share by which the two differ where nothing is
missing, is named. Not for a ball: its impacts end sticking as a rule, and tell no friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..physics.parameters import CONTACT_PARAMETERS, Parameter
from ..physics.world import World
from ..tails import chi2_tail
from .candidates import Candidate, Variant, admissible, variants_of
from .cuts import Segment
from .glide_fits import GlideFit
from .glide_stage import (
    FIRST_ITERATIONS,
    SURPLUS_SIGMAS,
    GlideEvidence,
    StartedGlides,
    batches,
    fitted_glides,
)
from .phases import is_round
from .prepared import Prepared
from .refit import refit
from .score import ScoreTest
from .segments import Segments
from .slots import Evidence

SPREAD = 0.13
"""Frictions of glides and of impacts differ by this share (root mean square of the logarithm; at most 0.33 of 14) on
development seeds where nothing is missing: no law of contact is exact in an impact."""
SCORE, RESOLVED = 8.0, 0.75
"""An effect is named above this score, and where it takes away this share of what lies between the frictions. Nothing
is fitted where those alone differ by less [chi2]: on development seeds 6 without one at most, 13 to 29 with one."""
LEAD = 6.0
"""Another one within this score of it leaves the two unseparated."""
FEWEST = 6
"""So many segments with impacts are the fewest that tell a friction."""


@dataclass(frozen=True)
class _Struck:
    """The friction that impacts tell: value [1], the width of its logarithm, and by what chi2 of glides is divided."""

    friction: float
    width: float
    spread: float

    def joint(self, fit: GlideFit) -> float:
        """Return chi2 of glides, and of their friction as far as they tell it apart from the fitted effect."""
        return fit.cost / self.spread + self.between(fit)

    def between(self, fit: GlideFit) -> float:
        """Return chi2 of the two frictions alone."""
        variance = float(self.covariance(fit)[0, 0])
        return self.apart(fit.values[0, 0]) ** 2 / (self.width**2 + variance)

    def apart(self, value: Tensor) -> float:
        """Return by how much the logarithm of a friction exceeds that of impacts."""
        return float(value) - math.log(self.friction)

    def covariance(self, fit: GlideFit) -> Tensor:
        """Return the covariance (P, P) of what was fitted to glides."""
        return torch.linalg.pinv(fit.information[0], hermitian=True) * self.spread


def grip_evidence(
    prepared: Prepared,
    world: World,
    contact: Segments,
    candidates: Sequence[Candidate],
    started: StartedGlides | None,
) -> list[GlideEvidence]:
    """Return the evidence of candidates that glides and impacts together tell, the best first; mostly none.

    Args:
        prepared: The episodes.
        world: The model's world.
        contact: Its contact segments with fitted states.
        candidates: All of them.
        started: Its glides.
    """
    if started is None or is_round(world.bodies[world.free[0]]):
        return []
    glides, own, known = started.segments, started.friction, started.told
    hits = [k for k, item in enumerate(contact.items) if not _within(item, glides.items)]
    if len(hits) < FEWEST:
        return []
    soft = glides.world
    told, error = refit([contact.select(hits)], world, CONTACT_PARAMETERS).number("friction")
    struck = _Struck(told, math.hypot(SPREAD, error / told), 1.0)
    if (struck.apart(own) / struck.width) ** 2 < SCORE:
        return []
    alone = fitted_glides(soft, [], [(glides, own[None])], known)[0]
    degrees = float(glides.dof.sum())
    struck = replace(struck, spread=max(1.0, alone.cost / degrees))
    kept, _ = admissible(world, candidates, prepared.turned)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if v.active.effect.phase == "contact"]
    # no fit of glides falls further below its mean by chance
    surplus = alone.cost - degrees + SURPLUS_SIGMAS * math.sqrt(2 * degrees)
    most = (struck.apart(own) / struck.width) ** 2 + surplus / struck.spread
    variants = [v for v in variants if len(v.parameters) * math.log(degrees) + SCORE < most]
    found = _fits(soft, variants, alone, struck, known)
    if not found:
        return []
    # what the friction alone gains from where the best one ended is no sign of an effect
    _, ended = min(found, key=lambda one: struck.joint(one[1]))
    again = fitted_glides(soft, [], [(ended.segments, own[None])], known)[0]
    least = min((alone, again), key=struck.joint)
    return _ranked(found, kept, least, degrees, struck)


def _fits(
    soft: World, variants: Sequence[Variant], alone: GlideFit, struck: _Struck, known: Sequence[Parameter]
) -> list[tuple[Variant, GlideFit]]:
    """Return the fits of the variants, those that are far behind after some steps only to there."""
    own = alone.values[0]
    pulls = [v for v in variants if len(v.parameters) == 1 and v.active.effect.has("wrench")]
    found: list[tuple[Variant, GlideFit]] = []
    for part in batches([v for v in variants if v not in pulls]):
        tried = fitted_glides(soft, part, [(alone.segments, own)] * len(part), known, FIRST_ITERATIONS)
        costs = [struck.joint(fit) for fit in tried]
        for variant, fit, cost in zip(part, tried, costs, strict=True):
            close = cost == min(costs)
            again = fitted_glides(soft, [variant], [(fit.segments, fit.values[0])], known)[0] if close else fit
            found.append((variant, again))
    # what pulls does to a glide just what more friction does: the fit of that, with the friction of impacts
    body = soft.bodies[soft.free[0]]
    press = float(body.mass[0] * soft.gravity[0].norm()) * math.expm1(struck.apart(own[0]))
    for variant in pulls if press > 0 else []:
        start = torch.cat([own, torch.tensor([press]).to(own)])
        start[0] = math.log(struck.friction)
        found.append((variant, fitted_glides(soft, [variant], [(alone.segments, start)], known, FIRST_ITERATIONS)[0]))
    return found


def _ranked(
    found: Sequence[tuple[Variant, GlideFit]],
    kept: Sequence[Candidate],
    alone: GlideFit,
    degrees: float,
    struck: _Struck,
) -> list[GlideEvidence]:
    """Return the evidence of what was fitted; its share is that of what lies between the two frictions."""
    best: dict[int, GlideEvidence] = {}
    for variant, fit in found:
        candidate, number = kept[variant.place], len(variant.parameters)
        gain = max(0.0, struck.joint(alone) - struck.joint(fit))
        spread = struck.covariance(fit)
        # what is left between the two frictions is shared among all that was fitted
        share = spread[:, 0] / (struck.width**2 + spread[0, 0])
        moved = fit.values[0] - share * struck.apart(fit.values[0, 0])
        spread = spread - share[:, None] * spread[0]
        values = moved[-number:].numpy().astype(np.float64)
        covariance = spread[-number:, -number:].numpy().astype(np.float64)
        p_value = chi2_tail(gain, number)
        test = ScoreTest(gain, number, p_value, values, covariance, bool((values != 0).any()))
        deviations = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        names = [p.name for p in candidate.effect.parameters]
        numbers = {name: (float(v), float(s)) for name, v, s in zip(names, values, deviations, strict=True)}
        evidence = Evidence(candidate, variant.constants, test, p_value, numbers=numbers)
        score = gain - number * math.log(degrees)
        resolved = 1 - struck.between(fit) / struck.between(alone)
        one = GlideEvidence(evidence, score, float(moved[0].exp()), fit.cost / degrees, resolved)
        if variant.place not in best or score > best[variant.place].score:
            best[variant.place] = one
    return sorted(best.values(), key=lambda one: (-one.score, one.evidence.name))


def named_by_grip(evidence: Sequence[GlideEvidence]) -> list[GlideEvidence]:
    """Return the effect that brings glides and impacts together, and its equals; none where there is none."""
    fit = [one for one in evidence if one.evidence.test.admissible]
    if not fit or fit[0].score < SCORE or fit[0].share < RESOLVED:
        return []
    return [one for one in fit if one.score > fit[0].score - LEAD and one.share >= RESOLVED]


def _within(item: Segment, glides: Sequence[Segment]) -> bool:
    """Whether a contact segment lies in a glide, to a frame."""
    return any(item.episode == g.episode and item.first >= g.first - 1 and item.last <= g.last + 1 for g in glides)
