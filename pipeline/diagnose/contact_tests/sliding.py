"""What glides say: is an effect of contact missing while the body slides, rolls or spins on the ground?

Every candidate is refitted to the same glides from the same starts, beside one friction of all of them, and compared by
what is left. The law of contact hardly matters there, so that data without an effect leave little more than noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..physics.contact import ContactLaw
from ..physics.effects.effect import ActiveEffect
from ..physics.parameters import FRICTION, GROUND_SHIFT, Parameter, effect_parameters
from ..physics.world import State, World
from ..tails import chi2_tail
from .candidates import Candidate, Variant, admissible, base_parameters, base_values, variants_of, with_variants
from .glide_fits import ITERATIONS, GlideFit, fit_groups, soft_world
from .glides import glides_of, settled
from .prepared import Prepared
from .score import ScoreTest, picture, sums
from .segments import Segments, line_state
from .slots import Evidence

START_FRAMES = (4, 7)
START_FRICTION = (0.15, 0.35)
FLIGHT_TELLS_M_S2 = 0.3
"""Where flights show no force of this size, a tenth of usual friction, what acts in flight is a rival in glides."""
WELL_KNOWN = 100.0
"""Information on the logarithm of the friction from which one glide tells it, to a tenth."""
WELL_FITTED = 4.0
"""And where it fits to this chi2 / dof."""
SURPLUS_SIGMAS = 3.0
"""Of chi2 in glides that a candidate explains: so far below its mean it may come to lie by chance."""
FIRST_ITERATIONS, CLOSE_SHARE = 3, 0.3
"""After so many steps only candidates are followed that explain this share of what the best one does."""
MANY = 4
"""Candidates of more numbers than this are fitted in a batch of their own: all of a batch pay for the longest."""


@dataclass(frozen=True)
class GlideEvidence:
    """A candidate in glides.

    score: by how much chi2 falls, in units of what the best candidate leaves, less the penalty of BIC; evidence, with
    its numbers; friction: beside it; left: chi2 / dof; share: of the excess of chi2 over its mean, that it explains;
    others: by how much chi2 falls without the episode in which it falls most, infinite where that was not looked at.
    """

    evidence: Evidence
    score: float
    friction: float
    left: float
    share: float
    others: float = math.inf


@dataclass(frozen=True)
class StartedGlides:
    """Glides, each with a start fitted with a friction of its own, before any effect is looked for.

    segments: in the world with the soft contact; friction (1,): logarithm of the one that most tell; base: their fit by
    what the model has, with one friction for all; told: parameters of what acts in flight, with the standard errors
    that flights leave them as priors. It acts in glides, too, and is known no better there: an error of half a
    thousandth of a radian in a tilt is a millimetre in a slide of half a second.
    """

    segments: Segments
    friction: Tensor
    base: GlideFit
    told: tuple[Parameter, ...]

    @staticmethod
    def of(prepared: Prepared, world: World, flight: Segments | None) -> StartedGlides | None:
        """Find and start the glides of all episodes; None where there are none.

        Args:
            prepared: The episodes.
            world: The model's world.
            flight: Flights with fitted states; None where there are none.
        """
        if not isinstance(world.contact, ContactLaw) or not prepared.turned:
            return None
        items = glides_of(world, prepared.whole, prepared.clear, prepared.noise)
        if not items:
            return None
        soft = soft_world(world)
        glides = prepared.segments("contact", soft, items)
        glides, friction = _started(glides, float(world.contact.friction[0]))
        told = _told_by_flight(flight, soft, prepared.groups)
        base = _base(glides, (friction, world.contact.friction[0].log().to(friction)), told)
        return StartedGlides(glides, friction, base, told)


def glide_evidence(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], least: float, started: StartedGlides | None
) -> list[GlideEvidence]:
    """Return the evidence of the candidates that act in contact, the best first; none where none can reach a score.

    Where flights show no force of the size of friction, those that act in flight are asked, too: along the ground a
    drag brakes a ball much as rolling resistance does.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All of them.
        least: The score that matters.
        started: Its glides.
    """
    kept, _ = admissible(world, candidates, prepared.turned)
    asked = {"contact", "flight"} if prepared.least_force_m_s2 > FLIGHT_TELLS_M_S2 else {"contact"}
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if v.active.effect.phase in asked]
    if started is None or not variants:
        return []
    glides, told, base = started.segments, started.told, started.base
    soft = glides.world
    degrees = float(glides.dof.sum())
    if base.cost - (degrees - SURPLUS_SIGMAS * math.sqrt(2 * degrees)) < least:
        return []
    start = (base.segments, base.values[0])
    found: dict[int, tuple[Variant, GlideFit]] = {}
    for part in batches(variants):
        tried = fitted_glides(soft, part, [start] * len(part), told, FIRST_ITERATIONS)
        found |= {len(found) + k: one for k, one in enumerate(zip(part, tried, strict=True))}
    # what is far behind after some steps is not worth the others
    gains = {k: base.cost - fit.cost for k, (_, fit) in found.items()}
    close = [k for k, gain in gains.items() if gain > least and gain > CLOSE_SHARE * max(gains.values())]
    for part in batches([found[k][0] for k in close]):
        mine = [(k, found[k]) for k in close if found[k][0] in part]
        again = fitted_glides(soft, part, [(fit.segments, fit.values[0]) for _, (_, fit) in mine], told)
        found |= {k: (variant, fit) for (k, (variant, _)), fit in zip(mine, again, strict=True)}
    # the model alone once more from where the best one ended: what both gain by that is no sign of an effect
    _, best = min(found.values(), key=lambda one: one[1].cost)
    own = best.values[0, : base.values.shape[1]]
    least_cost = min(base.cost, fitted_glides(soft, [], [(best.segments, own)], told)[0].cost)
    return _ranked(list(found.values()), kept, base, least_cost, degrees)


def _base(glides: Segments, frictions: Sequence[Tensor], told: Sequence[Parameter]) -> GlideFit:
    """Return the best fit of what the model has, from logarithms of frictions: that which most glides tell, its law's.

    A single glide may mislead the former, and a wrong friction is a valley of its own.
    """
    tried = (fitted_glides(glides.world, [], [(glides, one)], told)[0] for one in frictions)
    return min(tried, key=lambda fit: fit.cost)


def batches(variants: Sequence[Variant]) -> list[list[Variant]]:
    """Return candidates in parts to be fitted at once, in order.

    The fused kernel takes one effect of a kind; all of a batch pay for those of many numbers, which are kept apart.
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


def with_effect(world: World, found: GlideEvidence) -> World:
    """Return the world with an effect and the friction beside it as glides tell them."""
    evidence, law = found.evidence, world.contact
    assert isinstance(law, ContactLaw) and evidence.numbers is not None
    values = evidence.constants | {name: value for name, (value, _) in evidence.numbers.items()}
    active = ActiveEffect.of(evidence.candidate.effect, values, world.gravity[0, :1])
    contact = replace(law, friction=torch.full_like(law.friction, found.friction))
    return replace(world, contact=contact, effects=(*world.effects, active))


def _started(glides: Segments, known: float) -> tuple[Segments, Tensor]:
    """Return glides each fitted with a friction of its own, and the logarithm of the friction that most tell."""
    count = len(glides.items)
    states = [settled(glides, line_state(glides, frames)) for frames in START_FRAMES]
    every = glides.in_states(states * len(START_FRICTION))
    values = torch.tensor([[FRICTION.encode(mu)] for mu in START_FRICTION]).repeat_interleave(len(states) * count, 0)
    values = values.to(glides.world.gravity)
    group = torch.arange(len(values))
    found = fit_groups(every, [FRICTION], values, torch.zeros(len(values), 1, dtype=torch.long), group)
    best = found.chi2.unflatten(0, (-1, count)).argmin(0) * count + torch.arange(count)
    told = found.information[best, 0, 0] - 1 / FRICTION.prior[1] ** 2
    good = (told > WELL_KNOWN) & (found.chi2[best] < WELL_FITTED * glides.dof)
    own = found.values[best, 0]
    friction = own[good].median() if bool(good.any()) else torch.full_like(own[0], FRICTION.encode(known))
    return glides.with_state(found.segments.observations.state.at(best)), friction


def fitted_glides(
    world: World,
    variants: Sequence[Variant],
    starts: Sequence[tuple[Segments, Tensor]],
    told: Sequence[Parameter],
    iterations: int = ITERATIONS,
) -> list[GlideFit]:
    """Return the fit of each variant beside a friction; of the friction alone without variants.

    Args:
        world: With the soft contact.
        variants: To fit, all in one batch.
        starts: Of each, glides with states, and the values of a fit without it or with it to start from, or as many of
            the first as are known.
        told: What flights tell, with their standard errors as priors.
        iterations: Most steps.
    """
    beside, own = with_variants(world, variants, "contact")
    known = fitted_along(world, told)
    parameters = [*known, *own]
    place = {p.name: k for k, p in enumerate(parameters)}
    shared = list(range(len(known)))
    rows = [[*shared, *(place[name] for name in v.parameters)] for v in variants] or [shared]
    size, count = max(map(len, rows)), len(starts[0][0].items)
    free = torch.tensor([row + [-1] * (size - len(row)) for row in rows])
    values = base_values(beside, parameters).repeat(len(rows), 1)
    middle = values.clone()
    for k, (row, (_, value)) in enumerate(zip(rows, starts, strict=True)):
        given = value.reshape(-1)
        values[k, row[: len(given)]] = given
    free_start = [k for k, p in enumerate(parameters) if p not in told]
    middle[:, free_start] = values[:, free_start]
    glides = starts[0][0]
    every = glides.in_world(beside).select(list(range(count)) * len(rows))
    every = every.with_state(State.joined(*(segments.observations.state for segments, _ in starts)))
    group = torch.arange(len(rows)).repeat_interleave(count)
    found = fit_groups(every, parameters, values, free, group, iterations, middle)
    fits = []
    for k, row in enumerate(rows):
        chosen = slice(k * count, (k + 1) * count)
        states = found.segments.observations.state.at(torch.arange(k * count, (k + 1) * count))
        information = found.information[k : k + 1, : len(row), : len(row)]
        fits.append(GlideFit(glides.with_state(states), found.chi2[chosen], found.values[k : k + 1, row], information))
    return fits


def fitted_along(world: World, told: Sequence[Parameter]) -> list[Parameter]:
    """Return what is fitted in glides beside a candidate: friction, height, the model's effects, what flights tell."""
    return [FRICTION, GROUND_SHIFT, *own_numbers(world), *told]


def own_numbers(world: World) -> list[Parameter]:
    """Return the parameters of what the model already has in contact, which are fitted along."""
    own = {a.effect.name for a in world.effects if a.effect.phase == "contact"}
    return [p for p in effect_parameters(world) if p.name.partition(".")[0] in own]


def _told_by_flight(flight: Segments | None, world: World, groups: Sequence[int]) -> tuple[Parameter, ...]:
    """Return the parameters of what acts in flight, with the standard errors that flights leave them as priors."""
    parameters = base_parameters(world, "flight")
    if flight is None or not parameters:
        return ()
    seen = picture(flight, world, (), groups, robust=False)
    information, _ = sums(seen, range(seen.base))
    deviations = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    return tuple(replace(p, prior=(p.prior[0], float(s))) for p, s in zip(parameters, deviations, strict=True))


def _ranked(
    found: Sequence[tuple[Variant, GlideFit]], kept: Sequence[Candidate], alone: GlideFit, base: float, degrees: float
) -> list[GlideEvidence]:
    """Return the evidence of fits, the best first; alone: the fit without them, base: the least chi2 without them."""
    tries: dict[int, int] = {}
    for variant, _ in found:
        tries[variant.place] = tries.get(variant.place, 0) + 1
    spread = max(1.0, min(fit.cost for _, fit in found) / degrees)
    episode = np.array([item.episode for item in alone.segments.items])
    best: dict[int, GlideEvidence] = {}
    for variant, fit in found:
        candidate, values = kept[variant.place], fit.values[0, -len(variant.parameters) :].numpy().astype(np.float64)
        gain, number = max(0.0, (base - fit.cost) / spread), len(values)
        covariance = torch.linalg.pinv(fit.information[0], hermitian=True)[-number:, -number:].numpy() * spread
        p_value = chi2_tail(gain, number)
        test = ScoreTest(gain, number, p_value, values, covariance, bool((values != 0).any()))
        names = [p.name for p in candidate.effect.parameters]
        deviations = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        numbers = {name: (float(v), float(s)) for name, v, s in zip(names, values, deviations, strict=True)}
        corrected = min(1.0, p_value * tries[variant.place])
        evidence = Evidence(candidate, variant.constants, test, corrected, numbers=numbers)
        score = gain - number * math.log(max(degrees, 2.0)) - 2 * math.log(tries[variant.place])
        share = (base - fit.cost) / max(base - degrees, 1.0)
        falls = (alone.chi2 - fit.chi2).numpy()
        by_episode = [float(falls[episode == own].sum()) for own in np.unique(episode)]
        others = (sum(by_episode) - max(by_episode)) / spread
        one = GlideEvidence(evidence, score, float(fit.values[0, 0].exp()), fit.cost / degrees, share, others)
        if variant.place not in best or score > best[variant.place].score:
            best[variant.place] = one
    return sorted(best.values(), key=lambda one: (-one.score, one.evidence.name))
