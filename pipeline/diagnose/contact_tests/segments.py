"""Test in contact segments: separation of flight equals, and a missing contact effect under the model's contact law.

No contact law is exact, so a textbook p-value finds an effect in most data without one. Therefore every contact segment
has its own deviations of the contact parameters, segments that no candidate explains are downweighted, the effect has
to improve held-out episodes, and the threshold is the score that data without an effect reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...optimization.uncertainty import chi2_tail
from ...physics.parameters import GROUND_SHIFT
from ...physics.world import World
from ...segments.candidates import Candidate, Variant, admissible, base_parameters, variants_of
from ...segments.linearization import Linearization, linearize
from ...segments.prepare import Prepared
from ...segments.segment_fit import Refit, refit, robust_excess
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ..effect_selection import Evidence
from ..robust_fit import RobustFit, robust_fit, robust_gains, with_segment_parameters
from ..score_test import ScoreTest, score_test

Array = NDArray[np.float64]

SEPARATE_CHI2 = 12.0
"""Minimum excess of cost over the best equal for contact to rule out a flight equal: odds of 400."""
SEPARATE_T = 1.5
"""Minimum mean of the differences between episodes, in its standard errors, for contact to rule out a flight equal."""
BLIND = 1.0
"""Maximum standard error of an effect in flight, in usual sizes. Above it flight cannot show the effect, and contact
segments may select it."""


@dataclass(frozen=True)
class ContactEvidence:
    """Evidence for an effect in contact."""

    evidence: Evidence
    """The evidence."""
    score: float
    """Fall of the robust loss less the penalty of BIC; in other tests than that of contact segments, their score."""
    gain: float | None
    """Gain of all held-out episodes together; None where the evidence comes from sliding segments."""
    t: float | None
    """Mean gain of the held-out episodes in its standard errors; None as for `gain`."""


def fitted_contact(prepared: Prepared, world: World) -> tuple[Refit, Segments] | None:
    """Return the contact parameters refitted to the contact segments, and the segments; None without contact.

    The height of the ground stays at its given value: it is projected out later and must not bend the states here.
    """
    contact = prepared.contact(world)
    return None if contact is None else _fitted(contact, world)


def refitted_contact(contact: Segments, world: World) -> tuple[Refit, Segments]:
    """Return the contact parameters refitted in another world, and the segments, from states fitted before."""
    return _fitted(fit_states(contact.in_world(world), iterations=4, search=False), world)


def _fitted(contact: Segments, world: World) -> tuple[Refit, Segments]:
    """Refit the contact parameters, without the height of the ground and the effects, and return the segments, too."""
    own = {f"{a.effect.name}." for a in world.effects}
    parameters = [
        p
        for p in base_parameters(world, "contact")
        if p is not GROUND_SHIFT and not any(p.name.startswith(name) for name in own)
    ]
    found = refit([contact], world, parameters)
    return found, found.segments[0]


def separated(
    equals: Sequence[Evidence], contact: Segments, world: World, groups: Sequence[int]
) -> tuple[list[Evidence], dict[str, float]]:
    """Return the flight equals that contact does not rule out, the best first, and the gain of each in contact.

    Each effect has the parameters estimated in flight, which contact may move within their standard errors; the contact
    parameters are fitted jointly. Without this freedom, poorly known parameters would reflect their errors rather than
    the effects.

    Args:
        equals: Evidence of the equals, refitted in flight.
        contact: Contact segments with states fitted by the world without any of them.
        world: That world.
        groups: Session of each episode.
    """
    chosen = [e.candidate for e in equals]
    variants = variants_of(chosen, world.gravity[0, :1])
    picked = [
        next(v for v in variants if chosen[v.place] is e.candidate and v.constants == e.constants) for e in equals
    ]
    linear = linearize(contact, world, picked, groups, robust=False)
    linear = reweighted(linear, [k for v in picked for k in linear.columns(v.parameters)])
    # the misfit of the contact law itself is no evidence against an effect
    misfit = max(1.0, float((linear.weight * linear.chi2).sum() / (linear.weight * linear.dof).sum()))
    gains, total = [], np.array([float(e.refitted.cost) if e.refitted else math.inf for e in equals])
    for k, (evidence, variant) in enumerate(zip(equals, picked, strict=True)):
        known = np.array([evidence.estimates[p.name] for p in evidence.candidate.effect.parameters])
        by_episode, moved = _gains_near(linear, linear.columns(variant.parameters), known[:, 0], known[:, 1], misfit)
        gains.append(by_episode / misfit)
        total[k] += moved - gains[k].sum()
    kept = _not_ruled_out(equals, gains, total, linear)
    return kept, {e.name: float(g.sum()) for e, g in zip(equals, gains, strict=True)}


def _not_ruled_out(
    equals: Sequence[Evidence], gains: Sequence[Array], total: Array, linear: Linearization
) -> list[Evidence]:
    """Return the equals that contact does not rule out, the best first.

    Args:
        equals: The equals.
        gains: Gain of each in each episode (E,).
        total: Cost of each in flight and contact together.
        linear: Linearization of the contact segments, for the penalty of BIC.
    """
    order = sorted(range(len(equals)), key=lambda k: (total[k] + _bic(equals[k], linear), equals[k].name))
    best = min(order, key=lambda k: total[k])
    kept = []
    for k in order:
        worse = gains[best] - gains[k]
        spread = worse.std(ddof=1) / math.sqrt(len(worse)) if len(worse) > 1 else math.inf
        out = total[k] - total[best] > SEPARATE_CHI2 and worse.mean() > SEPARATE_T * spread
        if not out:
            kept.append(equals[k])
    return kept


def contact_evidence(
    contact: Segments,
    world: World,
    candidates: Sequence[Candidate],
    groups: Sequence[int],
    turned: bool,
    flight: Linearization | None = None,
) -> list[ContactEvidence]:
    """Return the evidence of every candidate that contact segments may select, the best first.

    Args:
        contact: Contact segments with fitted states.
        world: World in which they were fitted.
        candidates: All candidates.
        groups: Session of each episode.
        turned: Whether orientations were measured.
        flight: Linearization of the flights, with the same candidates; None without flight.
    """
    kept, _ = admissible(world, candidates, turned)
    variants = variants_of(kept, world.gravity[0, :1])
    variants = [v for v in variants if v.active.effect.phase == "contact" or _blind(v, flight)]
    if not variants:
        return []
    linear = with_segment_parameters(linearize(contact, world, variants, groups, robust=True))
    base = list(range(linear.base))
    without = robust_fit(linear, base)
    penalty = math.log(max(linear.dof.sum(), 2.0))
    best: dict[int, tuple[float, Variant, RobustFit]] = {}
    tries: dict[int, int] = {}
    for variant in variants:
        columns = linear.columns(variant.parameters)
        found = robust_fit(linear, [*base, *columns])
        tries[variant.place] = tries.get(variant.place, 0) + 1
        score = without.cost - found.cost - (len(found.value) - len(without.value)) * penalty
        if variant.place not in best or score > best[variant.place][0]:
            best[variant.place] = (score, variant, found)
    results = []
    for place, (score, variant, found) in best.items():
        test = _test(found, without)
        gains = robust_gains(linear, base, linear.columns(variant.parameters))
        p_value = min(1.0, test.p_value * tries[place])
        evidence = Evidence(
            candidate=kept[place], constants=variant.constants, test=test, p_value=p_value, gains=tuple(gains.tolist())
        )
        spread = gains.std(ddof=1) / math.sqrt(len(gains)) if len(gains) > 1 else math.inf
        t = float(gains.mean() / spread) if spread > 0 else 0.0
        lowered = score - 2 * math.log(tries[place]) if test.admissible else -math.inf
        results.append(ContactEvidence(evidence, lowered, float(gains.sum()), t))
    return sorted(results, key=lambda one: (-one.score, one.evidence.name))


def _test(found: RobustFit, without: RobustFit) -> ScoreTest:
    """Return the test of a fitted effect; its p-value treats the robust loss as twice a negative log-likelihood."""
    count = len(without.value)
    estimate, statistic = found.value[count:], max(0.0, without.cost - found.cost)
    covariance = np.linalg.inv(found.information)[count:, count:].astype(np.float64)
    # at a bound the effect vanishes: its estimate would have the wrong sign
    acts = bool((estimate != 0.0).any())
    return ScoreTest(
        statistic=statistic,
        dof=len(estimate),
        p_value=chi2_tail(statistic, len(estimate)),
        estimate=estimate,
        covariance=covariance,
        admissible=acts,
    )


def reweighted(linear: Linearization, columns: Sequence[int]) -> Linearization:
    """Return the linearization with robust weights from the residual of fits to single segments.

    A segment that a candidate explains has full weight; one that none explains is downweighted.
    """
    chosen = [*range(linear.base), *columns]
    width = np.array([linear.parameters[k].prior[1] for k in chosen])
    information = linear.information[:, chosen][:, :, chosen] * np.outer(width, width)
    score = linear.score[:, chosen] * width
    step = np.linalg.solve(information + np.eye(len(chosen)), score[..., None])[..., 0]
    left = linear.chi2 - np.einsum("bi,bi->b", score, step) - linear.dof
    weight = robust_excess(torch.as_tensor(left))[1].numpy()
    return replace(linear, weight=weight)


def _gains_near(
    linear: Linearization, columns: Sequence[int], value: Array, std: Array, misfit: float
) -> tuple[Array, float]:
    """Return the gain of each episode (E,) with an effect near known parameters, and chi2 of their change.

    Args:
        linear: Linearization of the contact segments.
        columns: Columns of the effect's parameters.
        value: Their known values (k,).
        std: Standard errors of these (k,).
        misfit: Factor by which chi2 in contact exceeds that of noise.
    """
    base, count = list(range(linear.base)), linear.base
    chosen = [*base, *columns]
    known = misfit / np.maximum(std, 1e-12) ** 2
    m = (linear.information * linear.weight[:, None, None]).sum(0)[np.ix_(chosen, chosen)]
    g = (linear.score * linear.weight[:, None]).sum(0)[chosen]
    prior = np.concatenate([linear.prior[:count], known])
    with_effect = np.linalg.solve(m + np.diag(prior), g + np.concatenate([np.zeros(count), known * value]))
    without = np.linalg.solve(m[:count, :count] + np.diag(prior[:count]), g[:count])
    both = [with_effect, np.concatenate([without, np.zeros_like(value)])]
    gains = []
    for episode in np.unique(linear.episode):
        mine = linear.weight * (linear.episode == episode)
        own = (linear.information * mine[:, None, None]).sum(0)[np.ix_(chosen, chosen)]
        slope = (linear.score * mine[:, None]).sum(0)[chosen]
        gains.append(np.subtract(*[2 * slope @ x - x @ own @ x for x in both]))
    return np.array(gains), float((known / misfit) @ (with_effect[count:] - value) ** 2)


def _bic(evidence: Evidence, linear: Linearization) -> float:
    """Return the penalty of BIC."""
    return len(evidence.candidate.effect.parameters) * math.log(max(linear.dof.sum(), 2.0))


def _blind(variant: Variant, flight: Linearization | None) -> bool:
    """Return whether flight could not show an effect of the usual size that depends on the ground."""
    effect = variant.active.effect
    if effect.phase != "flight" or "ground" not in effect.needs:
        return False
    if flight is None:
        return True
    columns = flight.columns(variant.parameters)
    test = score_test(flight, columns)
    scale = np.array([p.scale for p in effect.parameters])
    return test.dof < len(columns) or bool((np.sqrt(np.diag(test.covariance)) > BLIND * scale).any())
