"""Impact test: is a contact effect missing where a ball meets the ground and leaves it again?

Every candidate is fitted to the same impacts, together with one restitution and one friction for all of them
(`impact_law.py`). The velocities before and after an impact are those of the flights (`impact_velocities.py`), so no
contact law enters. Only impacts whose contact point slides show the friction; one that sticks ends the same whatever
the friction is. Effects that no impact shows are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...optimization.uncertainty import f_tail
from ...physics.contact_law import ContactLaw
from ...physics.effects.effect import ActiveEffect
from ...physics.world import World
from ...segments.candidates import Candidate, Variant, admissible, variants_of
from ...segments.impact_fit import BASE, LEAST, ImpactBase, ImpactFit, ImpactProblem, fit_impacts
from ...segments.impact_velocities import measured_impacts
from ...segments.prepare import Prepared
from ..effect_selection import Evidence
from ..score_test import ScoreTest

Array = NDArray[np.float64]

TOLD = 1.0
"""Minimum change of the impacts [chi2] by an effect of the usual size for the effect to be tested."""
SCORE, SIZE, EXPLAINED, HELD_OUT_T = 6.0, 0.35, 0.5, 1.0
"""Thresholds of the impact test: minimum score, minimum size in usual sizes of the parameters, minimum share of the
excess of chi2 that the effect explains, and minimum mean gain of held-out episodes in its standard errors. On the
development cases the largest scores of 30 balls without an effect were 4.1 and 2.7, of effects of sizes 0.26 and
0.33."""
LEAD, LEAD_SHARE = 6.0, 0.1
"""Another effect counts as equal if its score is lower by less than the first value, or by less than this share of the
best score, and its size is above `SIZE`."""


@dataclass(frozen=True, kw_only=True)
class ImpactEvidence:
    """Evidence for a candidate in impacts."""

    evidence: Evidence
    """Evidence with estimates and held-out gains."""
    score: float
    """Fall of chi2 in units of the residual of the best candidate, less the penalty of BIC."""
    fit: ImpactFit
    """Fit of restitution, friction and the effect."""
    size: float
    """Size of the largest parameter, in usual sizes."""
    gain: float
    """Gain of all held-out episodes together; 0 except for the best candidate above the other thresholds."""
    t: float
    """Mean gain of the held-out episodes in its standard errors; 0 where `gain` is not computed."""
    share: float
    """Share of the excess of chi2 that it explains, in the part (rebounds, or the rest) that it acts on."""


def impact_evidence(prepared: Prepared, world: World, candidates: Sequence[Candidate]) -> list[ImpactEvidence]:
    """Return the evidence of the candidates that impacts show, the best first; empty without enough impacts of a ball.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All candidates.
    """
    if not isinstance(world.contact, ContactLaw):
        return []
    impacts = measured_impacts(prepared, world)
    if impacts is None or len(impacts) < LEAST:
        return []
    kept, _ = admissible(world, candidates, prepared.has_orientation)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if v.active.effect.phase == "contact"]
    base = ImpactBase.of(world, impacts)
    found = []
    for variant in variants:
        problem, start = base.beside(variant)
        if _is_shown(problem, start, len(base.parameters)):
            found.append((variant, fit_impacts(problem, start, centre=base.centre_of(start))))
    return _ranked(base, found, kept)


def with_impact_effect(world: World, found: ImpactEvidence) -> World:
    """Return the world with an effect and the restitution, both as estimated from the impacts.

    The friction keeps its value: impacts seldom show it, and it was fitted to sliding and other contacts.
    """
    evidence, law = found.evidence, world.contact
    assert isinstance(law, ContactLaw)  # impacts are tested under no other law
    values = evidence.constants | {name: value for name, (value, _) in evidence.estimates.items()}
    active = ActiveEffect.of(evidence.candidate.effect, values, world.gravity[0, :1])
    place = [p.name for p in BASE].index("damping_ratio")
    ratio = torch.full_like(law.damping_ratio, float(np.exp(found.fit.values[place])))
    return replace(world, contact=replace(law, damping_ratio=ratio), effects=(*world.effects, active))


def selected_in_impacts(evidence: Sequence[ImpactEvidence]) -> list[ImpactEvidence]:
    """Return the effect that the impact test selects and its equals; empty where it selects none."""
    if not evidence or not _is_candidate(evidence[0]) or evidence[0].gain <= 0 or evidence[0].t < HELD_OUT_T:
        return []
    lead = max(LEAD, LEAD_SHARE * evidence[0].score)
    fit = [one for one in evidence if one.evidence.test.admissible and one.size > SIZE and one.score > 0]
    return [one for one in fit if one.score > evidence[0].score - lead]


def _is_candidate(one: ImpactEvidence) -> bool:
    """Return whether an effect passes all thresholds but those of held-out episodes, which take most of the time."""
    return one.evidence.test.admissible and one.size > SIZE and one.score >= SCORE and one.share >= EXPLAINED


def _is_shown(problem: ImpactProblem, start: torch.Tensor, base: int) -> bool:
    """Return whether an effect of the usual size, of either sign where both are allowed, changes the impacts."""
    moves = []
    for place, parameter in enumerate(problem.parameters[base:], base):
        scale = parameter.prior[1] / 5
        for sign in (1.0,) if parameter.bounds[0] == 0 else (1.0, -1.0):
            moved = start.clone()
            moved[place] += sign * scale
            moves.append(moved)
    rows = problem.rows(torch.stack([start, *moves]))
    return float((rows[1:] - rows[:1]).square().sum((1, 2)).max()) > TOLD


def _ranked(
    base: ImpactBase, found: Sequence[tuple[Variant, ImpactFit]], kept: Sequence[Candidate]
) -> list[ImpactEvidence]:
    """Return the evidence of the fits, the best first and with its held-out gains."""
    if not found:
        return []
    tries: dict[int, int] = {}
    for variant, _ in found:
        tries[variant.place] = tries.get(variant.place, 0) + 1
    count = len(base.problem.impacts)
    degrees = np.array([count - 1, 5 * count - 1], dtype=float)
    # smallest residuals of all fits, in rebounds and in the rest: impacts with more scatter have less weight
    left = np.min([fit.chi2 for _, fit in found], axis=0)
    spread = np.maximum(1.0, left / degrees)
    best: dict[int, ImpactEvidence] = {}
    for variant, fit in found:
        candidate, number = kept[variant.place], len(variant.parameters)
        values = fit.values[-number:]
        falls = base.fit.chi2 - fit.chi2
        fall = max(0.0, float((falls / spread).sum()) + base.fit.prior - fit.prior)
        part = int(np.argmax(falls / spread))
        share = float(falls[part] / max(base.fit.chi2[part] - degrees[part], 1.0))
        freedom = max(float(degrees.sum()) - number, 1.0)
        p_value = f_tail(fall / number, number, freedom)
        covariance = np.linalg.inv(fit.information)[-number:, -number:] * spread[part]
        test = ScoreTest(
            statistic=fall,
            dof=number,
            p_value=p_value,
            estimate=values,
            covariance=covariance,
            admissible=bool((values != 0).any()),
        )
        estimates = {
            p.name: (float(v), float(s))
            for p, v, s in zip(candidate.effect.parameters, values, np.sqrt(np.diag(covariance)), strict=True)
        }
        size = float(np.max([abs(v) / p.scale for p, v in zip(candidate.effect.parameters, values, strict=True)]))
        score = fall - number * math.log(count) - 2 * math.log(tries[variant.place])
        corrected = min(1.0, p_value * tries[variant.place])
        evidence = Evidence(
            candidate=candidate, constants=variant.constants, test=test, p_value=corrected, numbers=estimates
        )
        one = ImpactEvidence(evidence=evidence, score=score, fit=fit, size=size, gain=0.0, t=0.0, share=share)
        if variant.place not in best or score > best[variant.place].score:
            best[variant.place] = one
    order = sorted(best.values(), key=lambda one: (-one.score, one.evidence.name))
    return [_held_out(base, order[0], found, kept, spread), *order[1:]] if _is_candidate(order[0]) else order


def _held_out(
    base: ImpactBase,
    one: ImpactEvidence,
    found: Sequence[tuple[Variant, ImpactFit]],
    kept: Sequence[Candidate],
    spread: Array,
) -> ImpactEvidence:
    """Return the evidence with its gains in held-out episodes."""
    own = one.evidence
    variant = next(v for v, _ in found if kept[v.place] is own.candidate and v.constants == own.constants)
    gains = base.gains(base.beside(variant)[0], one.fit.values) / float(spread.max())
    error = gains.std(ddof=1) / math.sqrt(len(gains)) if len(gains) > 1 else math.inf
    t = float(gains.mean() / error) if error > 0 else 0.0
    return replace(one, evidence=replace(own, gains=tuple(gains.tolist())), gain=float(gains.sum()), t=t)
