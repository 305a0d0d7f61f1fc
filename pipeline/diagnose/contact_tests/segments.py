"""What contact says: which of several equals in flight it leaves, and whether an effect of contact is missing.

No contact law is exact, so that a textbook p-value finds an effect in most data that have none. Every contact has
numbers of its own about those of all, segments that no candidate helps count less, the effect has to help episodes that
it was not fitted to, and the threshold is what data without an effect reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.parameters import GROUND_SHIFT
from ..physics.world import World
from ..tails import chi2_tail
from .candidates import Candidate, Variant, admissible, base_parameters, variants_of
from .linear import robust_excess
from .prepared import Prepared
from .refit import Refit, refit
from .robust import RobustFit, robust_fit, robust_gains, with_own_numbers
from .score import Picture, ScoreTest, picture, score_test
from .segment_states import fit_states
from .segments import Segments
from .slots import Evidence

Array = NDArray[np.float64]

SEPARATE_CHI2 = 12.0
"""Contact rules out an equal in flight that it makes worse by more than this, as odds of 400 ..."""
SEPARATE_T = 1.5
"""... in most episodes: the mean of their differences, in its standard errors."""
BLIND = 1.0
"""Flight is blind to an effect whose standard error there is above this many scales: then contact may name it."""


@dataclass(frozen=True)
class ContactEvidence:
    """An effect in contact: its evidence, and what the decision rests on.

    score: the fall of the robust loss, less the penalty of BIC; gain: of all held-out episodes together; t: their mean
    in its standard errors; both None where glides tell (`glide_stage.py`), whose score is that there.
    """

    evidence: Evidence
    score: float
    gain: float | None
    t: float | None


def fitted_contact(prepared: Prepared, world: World, start: Segments | None = None) -> tuple[Refit, Segments] | None:
    """Return the contact's numbers refitted to its segments, and the segments; None where there is no contact.

    The ground stays where it was said to be: it is projected out later, and not let bend the states here.
    """
    contact = prepared.contact(world) if start is None else _again(start, world)
    if contact is None:
        return None
    own = {f"{a.effect.name}." for a in world.effects}
    parameters = [
        p
        for p in base_parameters(world, "contact")
        if p is not GROUND_SHIFT and not any(p.name.startswith(name) for name in own)
    ]
    found = refit([contact], world, parameters)
    return found, found.segments[0]


def _again(start: Segments, world: World) -> Segments:
    return fit_states(start.in_world(world), iterations=4, search=False)


def separated(
    equals: Sequence[Evidence], contact: Segments, world: World, groups: Sequence[int]
) -> tuple[list[Evidence], dict[str, float]]:
    """Return those of several equals in flight that contact leaves, the best first, and the gain of each there.

    Each has the numbers that flight gave it, moved as far as their standard errors let contact move them; the contact's
    own numbers follow. Numbers that flight hardly knows would say more of their errors than of the effects.

    Args:
        equals: Refitted in flight.
        contact: Segments with states fitted by the world without any of them.
        world: That world.
        groups: Session of each episode.
    """
    chosen = [e.candidate for e in equals]
    variants = variants_of(chosen, world.gravity[0, :1])
    picked = [
        next(v for v in variants if chosen[v.place] is e.candidate and v.constants == e.constants) for e in equals
    ]
    seen = picture(contact, world, picked, groups, robust=False)
    seen = reweighted(seen, [k for v in picked for k in seen.columns(v.parameters)])
    # what the contact law misses anyway says nothing against an effect
    misfit = max(1.0, float((seen.weight * seen.chi2).sum() / (seen.weight * seen.dof).sum()))
    gains, total = [], np.array([float(e.refitted.cost) if e.refitted else math.inf for e in equals])
    for k, (evidence, variant) in enumerate(zip(equals, picked, strict=True)):
        assert evidence.numbers is not None
        known = np.array([evidence.numbers[p.name] for p in evidence.candidate.effect.parameters])
        by_episode, moved = _gains_near(seen, seen.columns(variant.parameters), known[:, 0], known[:, 1], misfit)
        gains.append(by_episode / misfit)
        total[k] += moved - gains[k].sum()
    order = sorted(range(len(equals)), key=lambda k: (total[k] + _bic(equals[k], seen), equals[k].name))
    best = min(order, key=lambda k: total[k])
    kept = []
    for k in order:
        worse = gains[best] - gains[k]
        spread = worse.std(ddof=1) / math.sqrt(len(worse)) if len(worse) > 1 else math.inf
        out = total[k] - total[best] > SEPARATE_CHI2 and worse.mean() > SEPARATE_T * spread
        if not out:
            kept.append(equals[k])
    return kept, {e.name: float(g.sum()) for e, g in zip(equals, gains, strict=True)}


def contact_evidence(
    contact: Segments,
    world: World,
    candidates: Sequence[Candidate],
    groups: Sequence[int],
    turned: bool,
    flight: Picture | None = None,
) -> list[ContactEvidence]:
    """Return the evidence of every candidate that contact may name, the best first.

    Args:
        contact: Segments with fitted states.
        world: In which they were fitted.
        candidates: All of them.
        groups: Session of each episode.
        turned: Whether orientations were measured.
        flight: The picture of the flights, with the same candidates; None where there are none.
    """
    kept, _ = admissible(world, candidates, turned)
    variants = variants_of(kept, world.gravity[0, :1])
    variants = [v for v in variants if v.active.effect.phase == "contact" or _blind(v, flight)]
    if not variants:
        return []
    seen = with_own_numbers(picture(contact, world, variants, groups, robust=True))
    base = list(range(seen.base))
    without = robust_fit(seen, base)
    penalty = math.log(max(seen.dof.sum(), 2.0))
    best: dict[int, tuple[float, Variant, RobustFit]] = {}
    tries: dict[int, int] = {}
    for variant in variants:
        columns = seen.columns(variant.parameters)
        found = robust_fit(seen, [*base, *columns])
        tries[variant.place] = tries.get(variant.place, 0) + 1
        score = without.cost - found.cost - (len(found.value) - len(without.value)) * penalty
        if variant.place not in best or score > best[variant.place][0]:
            best[variant.place] = (score, variant, found)
    results = []
    for place, (score, variant, found) in best.items():
        test = _test(found, without)
        gains = robust_gains(seen, base, seen.columns(variant.parameters))
        p_value = min(1.0, test.p_value * tries[place])
        evidence = Evidence(kept[place], variant.constants, test, p_value, tuple(gains.tolist()))
        spread = gains.std(ddof=1) / math.sqrt(len(gains)) if len(gains) > 1 else math.inf
        t = float(gains.mean() / spread) if spread > 0 else 0.0
        lowered = score - 2 * math.log(tries[place]) if test.admissible else -math.inf
        results.append(ContactEvidence(evidence, lowered, float(gains.sum()), t))
    return sorted(results, key=lambda one: (-one.score, one.evidence.name))


def _test(found: RobustFit, without: RobustFit) -> ScoreTest:
    """Return the fit of an effect as a test; its p-value takes the robust loss for twice a log-likelihood."""
    count = len(without.value)
    estimate, statistic = found.value[count:], max(0.0, without.cost - found.cost)
    covariance = np.linalg.inv(found.information)[count:, count:].astype(np.float64)
    # at a bound an effect does nothing: its sign would have to be the other
    acts = bool((estimate != 0.0).any())
    return ScoreTest(statistic, len(estimate), chi2_tail(statistic, len(estimate)), estimate, covariance, acts)


def reweighted(seen: Picture, columns: Sequence[int]) -> Picture:
    """Return the picture with robust weights from the misfit that is left when every segment has its own numbers.

    A segment that a candidate explains counts fully; one that nothing explains counts little.
    """
    chosen = [*range(seen.base), *columns]
    width = np.array([seen.parameters[k].prior[1] for k in chosen])
    information = seen.information[:, chosen][:, :, chosen] * np.outer(width, width)
    score = seen.score[:, chosen] * width
    step = np.linalg.solve(information + np.eye(len(chosen)), score[..., None])[..., 0]
    left = seen.chi2 - np.einsum("bi,bi->b", score, step) - seen.dof
    weight = robust_excess(torch.as_tensor(left))[1].numpy()
    return replace(seen, weight=weight)


def _gains_near(seen: Picture, columns: Sequence[int], value: Array, std: Array, misfit: float) -> tuple[Array, float]:
    """Return the gain of each episode with an effect near values with standard errors, and the chi2 of moving them.

    The model's numbers follow; misfit: by what factor chi2 in contact exceeds that of noise.
    """
    base, count = list(range(seen.base)), seen.base
    chosen = [*base, *columns]
    known = misfit / np.maximum(std, 1e-12) ** 2
    m = (seen.information * seen.weight[:, None, None]).sum(0)[np.ix_(chosen, chosen)]
    g = (seen.score * seen.weight[:, None]).sum(0)[chosen]
    prior = np.concatenate([seen.prior[:count], known])
    with_effect = np.linalg.solve(m + np.diag(prior), g + np.concatenate([np.zeros(count), known * value]))
    without = np.linalg.solve(m[:count, :count] + np.diag(prior[:count]), g[:count])
    both = [with_effect, np.concatenate([without, np.zeros_like(value)])]
    gains = []
    for episode in np.unique(seen.episode):
        mine = seen.weight * (seen.episode == episode)
        own = (seen.information * mine[:, None, None]).sum(0)[np.ix_(chosen, chosen)]
        slope = (seen.score * mine[:, None]).sum(0)[chosen]
        gains.append(np.subtract(*[2 * slope @ x - x @ own @ x for x in both]))
    return np.array(gains), float((known / misfit) @ (with_effect[count:] - value) ** 2)


def _bic(evidence: Evidence, seen: Picture) -> float:
    return len(evidence.candidate.effect.parameters) * math.log(max(seen.dof.sum(), 2.0))


def _blind(variant: Variant, flight: Picture | None) -> bool:
    """Whether flight could not see an effect of a size that matters, which contact may then name."""
    effect = variant.active.effect
    if effect.phase != "flight" or "ground" not in effect.needs:
        return False
    if flight is None:
        return True
    columns = flight.columns(variant.parameters)
    test = score_test(flight, columns)
    scale = np.array([p.scale for p in effect.parameters])
    return test.dof < len(columns) or bool((np.sqrt(np.diag(test.covariance)) > BLIND * scale).any())
