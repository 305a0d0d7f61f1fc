"""What impacts say: is an effect of contact missing where a ball meets the ground and leaves it again?

Every candidate is fitted to the same impacts beside one restitution and one friction of all of them (`impact_law.py`).
Their velocities before and after are those of the flights (`impacts.py`), so that no law of contact enters. A friction
is told only by impacts through which the point that touches slides; one that sticks has the same end whatever the
friction, and effects that no impact tells are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.contact import ContactLaw
from ..physics.effects.effect import ActiveEffect
from ..physics.parameters import Parameter
from ..physics.world import World
from ..tails import f_tail
from .candidates import Candidate, Variant, admissible, base_values, variants_of, with_variants
from .glide_stage import own_numbers
from .impact_fits import BASE, ImpactFit, ImpactProblem, fit_impacts
from .impacts import Impacts, measured_impacts
from .prepared import Prepared
from .score import ScoreTest
from .slots import Evidence

Array = NDArray[np.float64]

LEAST = 4
"""So many impacts are the fewest that tell more than a restitution."""
TOLD = 1.0
"""Impacts tell an effect where one of a size that matters moves them by more than this [chi2]."""
WEIGH_AGAIN = 2
"""So many times the base is fitted, each with weights from the one before."""
SCORE, SIZE, EXPLAINED, HELD_OUT_T = 6.0, 0.35, 0.5, 1.0
"""An effect in impacts is named above this score, this size in scales that matter, this share of the excess of chi2
that it explains, and where held-out episodes gain, by more than so many standard errors of their mean. On development
seeds the largest scores of 30 balls without an effect were 4.1 and 2.7, of effects of sizes 0.26 and 0.33."""
LEAD, LEAD_SHARE = 6.0, 0.1
"""Another one within this score of it, or this share of it, leaves the two unseparated if it has a size, too."""


@dataclass(frozen=True)
class ImpactEvidence:
    """A candidate in impacts.

    score: by how much chi2 falls, in units of what the best candidate leaves, less the penalty of BIC; evidence, with
    its numbers and held-out gains; fit: of the base and the effect; size: of the largest of its numbers, in scales that
    matter; gain, t: of the held-out episodes together, and their mean in its standard errors, of the best alone and
    where it stands out; share: of the excess of chi2 that it explains, in the part (rebounds, or the rest) that it acts
    on.
    """

    evidence: Evidence
    score: float
    fit: ImpactFit
    size: float
    gain: float
    t: float
    share: float


def impact_evidence(prepared: Prepared, world: World, candidates: Sequence[Candidate]) -> list[ImpactEvidence]:
    """Return the evidence of the candidates that impacts tell, the best first; none where no ball meets the ground.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All of them.
    """
    if not isinstance(world.contact, ContactLaw):
        return []
    impacts = measured_impacts(prepared, world)
    if impacts is None or len(impacts) < LEAST:
        return []
    kept, _ = admissible(world, candidates, prepared.turned)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if v.active.effect.phase == "contact"]
    base = ImpactBase.of(world, impacts)
    found = []
    for variant in variants:
        problem, start = base.beside(variant)
        if _told(problem, start, len(base.parameters)):
            found.append((variant, fit_impacts(problem, start, centre=base.centre_of(start))))
    return _ranked(base, found, kept)


def with_impact_effect(world: World, found: ImpactEvidence) -> World:
    """Return the world with an effect and the restitution beside it as impacts tell them.

    The friction stays: that of impacts is seldom told, and what glides and other contacts tell was fitted.
    """
    evidence, law = found.evidence, world.contact
    assert isinstance(law, ContactLaw) and evidence.numbers is not None
    values = evidence.constants | {name: value for name, (value, _) in evidence.numbers.items()}
    active = ActiveEffect.of(evidence.candidate.effect, values, world.gravity[0, :1])
    place = [p.name for p in BASE].index("damping_ratio")
    ratio = torch.full_like(law.damping_ratio, float(np.exp(found.fit.values[place])))
    return replace(world, contact=replace(law, damping_ratio=ratio), effects=(*world.effects, active))


def named_by_impacts(evidence: Sequence[ImpactEvidence]) -> list[ImpactEvidence]:
    """Return the effect that impacts name and its equals; none where they name none."""
    if not evidence or not _stands_out(evidence[0]) or evidence[0].gain <= 0 or evidence[0].t < HELD_OUT_T:
        return []
    lead = max(LEAD, LEAD_SHARE * evidence[0].score)
    fit = [one for one in evidence if one.evidence.test.admissible and one.size > SIZE and one.score > 0]
    return [one for one in fit if one.score > evidence[0].score - lead]


def _stands_out(one: ImpactEvidence) -> bool:
    """Whether the best effect is worth a look at held-out episodes, which takes most of the time."""
    return one.evidence.test.admissible and one.size > SIZE and one.score >= SCORE and one.share >= EXPLAINED


@dataclass(frozen=True, eq=False)
class ImpactBase:
    """The world without a candidate, fitted to the impacts: what every candidate starts from and is compared with."""

    problem: ImpactProblem
    centre: torch.Tensor
    fit: ImpactFit

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Numbers of the contact and of the effects that the world has."""
        return self.problem.parameters

    @staticmethod
    def of(world: World, impacts: Impacts) -> ImpactBase:
        """Fit what a world has to impacts."""
        known = own_numbers(world)
        # not where the model's fit put them: an effect that it lacks has pulled them
        usual = torch.tensor([p.encode(p.prior[0]) for p in BASE]).to(world.gravity)
        parameters, centre = (*BASE, *known), torch.cat([usual, base_values(world, known)])
        problem, value = ImpactProblem(world, parameters, impacts), centre
        for _ in range(WEIGH_AGAIN):
            problem = problem.whitened(value)
            fit = fit_impacts(problem, value, centre=centre)
            value = torch.as_tensor(fit.values)
        return ImpactBase(problem, centre, fit)

    def beside(self, variant: Variant) -> tuple[ImpactProblem, torch.Tensor]:
        """Return the problem with a candidate, and values to start from."""
        world, own = with_variants(self.problem.world, [variant], "contact")
        zero = torch.zeros(len(own)).to(self.centre)
        problem = replace(self.problem, world=world, parameters=(*self.parameters, *own))
        return problem, torch.cat([torch.as_tensor(self.fit.values), zero])

    def centre_of(self, start: torch.Tensor) -> torch.Tensor:
        """Return the centre of the priors of a problem with a candidate."""
        return torch.cat([self.centre, torch.zeros_like(start[len(self.centre) :])])

    def gains(self, problem: ImpactProblem, value: Array) -> Array:
        """Return by how much chi2 of each episode falls when the others tell an effect's numbers."""
        episode = self.problem.impacts.episode
        start = torch.as_tensor(value)
        gains = []
        for own in np.unique(episode):
            others = (episode != own).astype(np.float64)
            without = fit_impacts(self.problem, torch.as_tensor(self.fit.values), others, self.centre)
            fitted = fit_impacts(problem, start, others, self.centre_of(start))
            parts = [(fit.rows[episode == own] ** 2).sum() for fit in (without, fitted)]
            gains.append(float(parts[0] - parts[1]))
        return np.array(gains)


def _told(problem: ImpactProblem, start: torch.Tensor, base: int) -> bool:
    """Whether an effect of a size that matters, either way where that may be, moves the impacts."""
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
    if not found:
        return []
    tries: dict[int, int] = {}
    for variant, _ in found:
        tries[variant.place] = tries.get(variant.place, 0) + 1
    count = len(base.problem.impacts)
    degrees = np.array([count - 1, 5 * count - 1], dtype=float)
    # what is left by the best of all, in rebounds and in the rest; impacts that scatter more count less
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
        test = ScoreTest(fall, number, p_value, values, covariance, bool((values != 0).any()))
        numbers = {
            p.name: (float(v), float(s))
            for p, v, s in zip(candidate.effect.parameters, values, np.sqrt(np.diag(covariance)), strict=True)
        }
        size = float(np.max([abs(v) / p.scale for p, v in zip(candidate.effect.parameters, values, strict=True)]))
        score = fall - number * math.log(count) - 2 * math.log(tries[variant.place])
        corrected = min(1.0, p_value * tries[variant.place])
        evidence = Evidence(candidate, variant.constants, test, corrected, numbers=numbers)
        one = ImpactEvidence(evidence, score, fit, size, 0.0, 0.0, share)
        if variant.place not in best or score > best[variant.place].score:
            best[variant.place] = one
    order = sorted(best.values(), key=lambda one: (-one.score, one.evidence.name))
    return [_held_out(base, order[0], found, kept, spread), *order[1:]] if _stands_out(order[0]) else order


def _held_out(
    base: ImpactBase,
    one: ImpactEvidence,
    found: Sequence[tuple[Variant, ImpactFit]],
    kept: Sequence[Candidate],
    spread: Array,
) -> ImpactEvidence:
    """Return the evidence with what it gains in episodes that it was not fitted to."""
    own = one.evidence
    variant = next(v for v, _ in found if kept[v.place] is own.candidate and v.constants == own.constants)
    gains = base.gains(base.beside(variant)[0], one.fit.values) / float(spread.max())
    error = gains.std(ddof=1) / math.sqrt(len(gains)) if len(gains) > 1 else math.inf
    t = float(gains.mean() / error) if error > 0 else 0.0
    return replace(one, evidence=replace(own, gains=tuple(gains.tolist())), gain=float(gains.sum()), t=t)
