"""What contact tests have in common: their data, the evidence of a fitted candidate, and the rule that selects one.

A test is a class with the methods of `ContactTest`, in a file of its own, and an entry in `search.TESTS`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ...optimization.tails import chi2_tail
from ...physics.world import World
from ...segments.candidates import Candidate, Variant, variants_of, with_added
from ...segments.prepare import Prepared
from ...segments.segments import Segments
from ...segments.sliding.fit import StartedSliding
from ..evidence.evidence import Evidence
from ..evidence.score_test import ScoreTest

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ContactData:
    """Motions and model that all contact tests share."""

    prepared: Prepared
    """The episodes."""
    world: World
    """The model's world with the effects selected in flight and refitted contact parameters."""
    segments: Segments | None
    """Contact segments with states fitted by `world`; None without contact."""
    sliding: StartedSliding | None
    """Sliding segments and their fit without candidates; None without any."""
    flown: bool = False
    """Whether an effect was selected in flight, whose law is never exactly the true one."""
    explained: bool = True
    """Whether the flight segments are explained down to the noise."""
    earlier: Mapping[str, Sequence[Evidence]] = field(default_factory=dict)
    """Evidence of the tests that selected no effect, by their names."""

    def variants(self, candidates: Sequence[Candidate], phases: Iterable[str] = ("contact",)) -> list[Variant]:
        """Return the variants of the candidates that act in given phases."""
        every = variants_of(candidates, self.world.gravity[0, :1])
        return [variant for variant in every if variant.active.effect.phase in phases]


@dataclass(frozen=True, kw_only=True)
class Bar:
    """Minima that the evidence for an effect has to reach, all of them."""

    score: float = -math.inf
    """Fall of the loss less the penalty of BIC."""
    share: float = -math.inf
    """Share of what was unexplained that the effect explains."""
    size: float = 0.0
    """Size of the largest parameter, in usual sizes."""
    without_best: float = -math.inf
    """Fall of chi2 without the episode in which it falls most."""
    without_share: float = 0.0
    """The same as a share of the score."""
    gain_t: float | None = None
    """Mean gain of held-out episodes in its standard errors, which then has to be positive; None demands no gain."""
    carriers: int = 0
    """Fewest held-out episodes of which each has the share `carries` of the gain, where it was computed; without the
    one that gains most, the others have to gain together, too."""
    carries: float = 0.0
    """See `carriers`."""

    def passed(self, one: Evidence) -> bool:
        """Return whether the evidence reaches the minima."""
        predicts = self.gain_t is None or (one.gain > 0 and one.gain_t >= self.gain_t)
        enough = one.score >= self.score and one.share >= self.share and one.size >= self.size
        others = max(self.without_best, self.without_share * one.score)
        return enough and one.without_best >= others and predicts and self._carried(one)

    def _carried(self, one: Evidence) -> bool:
        """Return whether enough held-out episodes carry the effect; True where their gains were not computed."""
        if not (self.carriers and one.gains):
            return True
        return one.gain > max(one.gains) and sum(gain > self.carries * one.gain for gain in one.gains) >= self.carriers


@dataclass(frozen=True, kw_only=True)
class Lead:
    """How far an effect has to be ahead of another one to be separable from it."""

    score: float = 0.0
    """Minimum difference of the scores."""
    share: float = 0.0
    """Minimum difference of the scores, as a share of the better one."""
    rival: Bar = Bar()
    """What the other one has to reach to be a rival at all."""

    def shared(self, best: Evidence, one: Evidence) -> bool:
        """Return whether the other one is not separable from the best."""
        return one.score > best.score - max(self.score, self.share * best.score) and self.rival.passed(one)


class ContactTest(Protocol):
    """One way to judge candidates in contact."""

    name: ClassVar[str]
    """Name under which later tests find its evidence."""
    lists_all: ClassVar[bool]
    """Whether a report lists all candidates of the test, or only the selected effect and its equals."""

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of the candidates that the test can judge, the best first.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits; they are fitted in batches and judged by the best residual
                of all, hence all at once.
        """
        ...

    def leads(self, best: Evidence) -> Sequence[Lead]:
        """Return the leads over the best effect's rivals; without any of them the two are equals."""
        ...

    def outdone(self, best: Evidence, one: Evidence) -> bool:
        """Return whether a rival within a lead is none, as what its numbers could do is more than it does."""
        return False

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> Sequence[Bar]:
        """Return the bars of which the best effect, the first of the equals, has to pass one."""
        ...

    def added(self, data: ContactData, best: Evidence) -> tuple[World, Evidence] | None:
        """Return the world with a selected effect and its final evidence; None where a refit does not confirm it.

        Without a refit, the world has the effect and the contact parameters as the test fitted them.
        """
        return with_effect(data.world, best), best


def selected(test: ContactTest, evidence: Sequence[Evidence], data: ContactData) -> list[Evidence]:
    """Return the effect that a test selects and its equals, the selected one first; empty where it selects none.

    Where the best effect is one without a number, no other one is selected in its place: it explains less.

    Args:
        test: The test.
        evidence: Its evidence, the best first.
        data: Motions and model.
    """
    admissible = [one for one in evidence if one.test.admissible]
    if not admissible:
        return []
    best = admissible[0]
    if not best.is_number:
        return []
    leads = test.leads(best)
    equals = [best, *(one for one in admissible[1:] if any(lead.shared(best, one) for lead in leads))]
    if not any(bar.passed(best) for bar in test.bars(equals, data)):
        return []
    return [best, *(one for one in equals[1:] if not test.outdone(best, one))]


def fitted_evidence(
    candidate: Candidate,
    constants: dict[str, float],
    gain: float,
    values: Array,
    covariance: Array,
    penalty: float,
    tries: int = 1,
    p_value: float | None = None,
) -> Evidence:
    """Return the evidence of a candidate that was fitted jointly with the contact parameters.

    Args:
        candidate: The candidate.
        constants: Its constants.
        gain: Fall of the loss by the candidate.
        values: Its fitted parameters (k,).
        covariance: Their covariance (k, k).
        penalty: Penalty of BIC for each parameter.
        tries: Number of combinations of constants that were tried; its logarithm is a penalty, too.
        p_value: Probability of a larger gain without the effect; None for that of chi2.
    """
    number, statistic = len(values), max(0.0, gain)
    tail = chi2_tail(statistic, number) if p_value is None else p_value
    test = ScoreTest(
        statistic=statistic,
        dof=number,
        p_value=tail,
        estimate=values,
        covariance=covariance,
        # at a bound an effect vanishes: its estimate would have the wrong sign
        admissible=bool((values != 0).any()),
    )
    deviations = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    names = [p.name for p in candidate.effect.parameters]
    return Evidence(
        candidate=candidate,
        constants=constants,
        test=test,
        p_value=min(1.0, tail * tries),
        numbers={name: (float(v), float(s)) for name, v, s in zip(names, values, deviations, strict=False)},
        score=gain - number * penalty - 2 * math.log(tries),
    )


def tries_of(variants: Iterable[Variant]) -> Counter[int]:
    """Return the number of variants of each candidate, by the place of the candidate."""
    return Counter(variant.place for variant in variants)


def variant_of(evidence: Evidence, variants: Iterable[Variant], candidates: Sequence[Candidate]) -> Variant:
    """Return the variant at whose constants the evidence of a candidate was found."""
    own = (v for v in variants if candidates[v.place] is evidence.candidate)
    return next(v for v in own if v.constants == evidence.constants)


def ranked(evidence: Iterable[Evidence]) -> list[Evidence]:
    """Return each candidate once, at the constants of its highest score, the highest score first."""
    best: dict[str, Evidence] = {}
    for one in evidence:
        if one.name not in best or one.score > best[one.name].score:
            best[one.name] = one
    return sorted(best.values(), key=lambda one: (-one.score, one.name))


def with_effect(world: World, found: Evidence) -> World:
    """Return the world with an effect, and with the contact parameters that were fitted jointly with it."""
    values = found.constants | {name: value for name, (value, _) in found.estimates.items()}
    law = vars(world.contact)
    fitted = {name: torch.full_like(law[name], value) for name, value in found.contact.items()}
    contact = replace(world.contact, **fitted) if fitted else world.contact
    return with_added(replace(world, contact=contact), found.candidate.effect, values)
