"""Which effect fills a gap best in flight: score tests find those in question, refits decide between them.

The p-values here are the textbook's, for nothing but noise is between a flight and its model: uniform where nothing is
missing (a test measures that).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..physics.effects.effect import ActiveEffect
from ..physics.parameters import Parameter
from ..physics.world import World
from .candidates import Candidate, Variant, acts_in, admissible, base_parameters, variants_of
from .refit import Refit, refit
from .score import Picture, ScoreTest, canonical_correlation, gain_by_episode, picture, score_test
from .segments import Segments

ALPHA = 0.002
"""Level of all flight tests of a diagnosis together (Bonferroni over the candidates and their grids)."""
SHORTLIST = 5
"""So many candidates are refitted."""
SHORTLIST_SHARE = 0.4
"""Those whose score statistic is at least this share of the largest."""
UNFITTED = 1.5
"""Where every refit leaves more than this [chi2 / dof], constants are tried that the score test did not choose."""
ALIAS_CHI2 = 6.0
"""An effect that fits worse by less than this [chi2, at equal numbers] explains the data equally: odds of 20."""
SLIGHT, SLIGHT_BIC = 0.15, -20.0
"""An effect whose numbers all are below this share of their usual sizes is named only if BIC falls by more than this,
and so is its class: small things are explained by much. On development seeds two such names were false (sizes 0.08 and
0.10, BIC -15 and -8), as were two of report5 (0.06, 0.11; -10, -12) and one of report7 (0.03; 0); the smallest of the
true ones was 0.22."""
CONTAINED = 0.995
"""An effect with more numbers is an alias where it can imitate the best one to this correlation."""


@dataclass(frozen=True)
class Evidence:
    """What one candidate has for it, beside a model, in one kind of segments.

    test: of its best constants; p_value: corrected for the grid of constants; delta_bic: of the refit, against the
    model without it, None where it was not refitted; gains: linearised gain of each held-out episode; numbers: estimate
    and standard error by parameter.
    """

    candidate: Candidate
    constants: dict[str, float]
    test: ScoreTest
    p_value: float
    gains: tuple[float, ...] = ()
    refitted: Refit | None = None
    delta_bic: float | None = None
    numbers: dict[str, tuple[float, float]] | None = None

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.candidate.effect.name


@dataclass(frozen=True)
class Slot:
    """All candidates for one gap, the best first; equals: those that explain it equally, the best among them.

    flagged: whether one is significant.
    """

    evidence: tuple[Evidence, ...]
    equals: tuple[Evidence, ...]
    flagged: bool

    @property
    def best(self) -> Evidence:
        """The best one."""
        return self.equals[0]


def tested(
    seen: Picture, candidates: Sequence[Candidate], variants: Sequence[Variant], dispersion: float = 1.0
) -> list[Evidence]:
    """Return the score test of each candidate at its best constants."""
    found: dict[int, tuple[Variant, ScoreTest]] = {}
    tries: dict[int, int] = {}
    for variant in variants:
        test = score_test(seen, seen.columns(variant.parameters), dispersion=dispersion)
        tries[variant.place] = tries.get(variant.place, 0) + 1
        if variant.place not in found or test.p_value < found[variant.place][1].p_value:
            found[variant.place] = (variant, test)
    results = []
    for place, (variant, test) in found.items():
        corrected = min(1.0, test.p_value * tries[place])
        gains = gain_by_episode(seen, seen.columns(variant.parameters))
        results.append(Evidence(candidates[place], variant.constants, test, corrected, tuple(gains.tolist())))
    # names, not places, break ties: the order in which candidates are given shall not matter
    return sorted(results, key=lambda e: (e.p_value, -e.test.statistic, e.name))


def fill(
    flight: Segments,
    world: World,
    candidates: Sequence[Candidate],
    groups: Sequence[int],
    turned: bool,
    dispersion: float = 1.0,
) -> Slot:
    """Return what the candidates have for them as the next effect of a world, in flight.

    Args:
        flight: Segments with states fitted by the world.
        world: The world, with the effects found so far.
        candidates: All candidates.
        groups: Session of each episode.
        turned: Whether orientations were measured.
        dispersion: By what factor variances exceed those of the noise.
    """
    kept, _ = admissible(world, candidates, turned)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if acts_in(v, "flight")]
    seen = picture(flight, world, variants, groups, robust=False)
    evidence = tested(seen, kept, variants, dispersion)
    level = ALPHA / max(1, len(evidence))
    significant = [e for e in evidence if e.p_value < level]
    if not significant:
        return Slot(tuple(evidence), tuple(evidence[:1]), False)
    # a known sign that comes out wrong is no discovery, but bounds may still leave the rest of an effect's numbers
    most = max(e.test.statistic for e in significant)
    short = [e for e in significant if e.test.statistic >= SHORTLIST_SHARE * most]
    short = sorted(short, key=lambda e: (_penalty(e) * _log(seen) - e.test.statistic, e.name))[: SHORTLIST + 2]
    before = refit([flight], world, base_parameters(world, "flight"))
    done = [refitted(e, [flight], world, before, math.exp(_log(seen)), dispersion) for e in short]
    enough = UNFITTED * float(seen.dof.sum()) * dispersion
    if all(e.refitted is not None and e.refitted.cost > enough for e in done):
        others = [e for one in short for e in _with_other_constants(one, seen, variants, kept, dispersion)]
        done += [refitted(e, [flight], world, before, math.exp(_log(seen)), dispersion) for e in others]
    best: dict[int, Evidence] = {}  # each candidate at its best constants
    for e in sorted(done, key=lambda e: (e.delta_bic, e.name)):
        best.setdefault(id(e.candidate), e)
    done = [e for e in best.values() if e.delta_bic is not None and e.delta_bic < 0]
    if not done:
        return Slot(tuple(evidence), tuple(evidence[:1]), False)
    names = {e.name: e for e in done}
    ranking = [*done, *(e for e in evidence if e.name not in names)]
    equals = _equals(done, seen, kept, variants, dispersion)
    return Slot(tuple(ranking), tuple(equals), not any(is_slight(e) for e in equals))


def is_slight(evidence: Evidence) -> bool:
    """Whether a refitted effect is too small for its evidence to be named."""
    numbers = evidence.numbers or {}
    small = all(abs(numbers[p.name][0]) < SLIGHT * p.scale for p in evidence.candidate.effect.parameters)
    return small and evidence.delta_bic is not None and evidence.delta_bic > SLIGHT_BIC


def _with_other_constants(
    evidence: Evidence,
    seen: Picture,
    variants: Sequence[Variant],
    candidates: Sequence[Candidate],
    dispersion: float,
) -> list[Evidence]:
    """Return a candidate at each of its constants but those it was tested best with.

    A score test looks at the first step from neutral; of a large effect the constants that are best there need not be
    the best ones where it ends.
    """
    mine = [v for v in variants if candidates[v.place] is evidence.candidate and v.constants != evidence.constants]
    tests = [score_test(seen, seen.columns(v.parameters), dispersion=dispersion) for v in mine]
    return [replace(evidence, constants=v.constants, test=test) for v, test in zip(mine, tests, strict=True)]


def refitted(
    evidence: Evidence, parts: Sequence[Segments], world: World, before: Refit, count: float, dispersion: float
) -> Evidence:
    """Return the evidence with a refit of the effect beside the model's numbers.

    Args:
        evidence: Of the effect.
        parts: The segments.
        world: The world without it.
        before: The refit of that.
        count: Number of measured numbers, for the penalty of BIC.
        dispersion: By what factor variances exceed those of the noise.
    """
    effect = evidence.candidate.effect
    like = world.gravity[0, :1]
    added = replace(world, effects=(*world.effects, ActiveEffect.of(effect, evidence.constants, like)))
    kinds = {part.kind for part in parts}
    parameters = base_parameters(added, "contact" if "contact" in kinds else "flight")
    own = [p for p in parameters if p.name.partition(".")[0] == effect.name]
    start = [torch.tensor(value) for value in evidence.test.estimate.tolist()]
    values = torch.stack([_clamped(p, v) for p, v in zip(own, start, strict=False)]) if start else torch.zeros(0)
    rest = before.values.to(torch.float64)
    others = [p for p in parameters if p not in own]
    known = {p.name: rest[k] for k, p in enumerate(before.parameters)}
    begun = torch.stack([*(known[p.name] for p in others), *values.to(torch.float64)])
    after = refit(parts, added, [*others, *own], begun)
    bic = (after.cost - before.cost) / dispersion + len(own) * math.log(count)
    found = {p.name.partition(".")[2]: after.number(p.name) for p in own}
    numbers = {name: (value, std * math.sqrt(dispersion)) for name, (value, std) in found.items()}
    return replace(evidence, refitted=after, delta_bic=bic, numbers=numbers)


def _equals(
    done: Sequence[Evidence],
    seen: Picture,
    candidates: Sequence[Candidate],
    variants: Sequence[Variant],
    dispersion: float,
) -> list[Evidence]:
    """Return the best and what explains the data as well as it."""
    best = done[0]
    assert best.refitted is not None and best.delta_bic is not None
    found = [best]
    for other in done[1:]:
        assert other.refitted is not None and other.delta_bic is not None
        worse = (other.refitted.cost - best.refitted.cost) / dispersion
        more = len(other.candidate.effect.parameters) > len(best.candidate.effect.parameters)
        close = other.delta_bic - best.delta_bic < ALIAS_CHI2 if more else worse < ALIAS_CHI2
        if more and not close and worse < ALIAS_CHI2:
            close = _contains(seen, candidates, variants, best, other)
        if close:
            found.append(other)
    return found


def _contains(
    seen: Picture, candidates: Sequence[Candidate], variants: Sequence[Variant], best: Evidence, other: Evidence
) -> bool:
    columns = []
    for one in (best, other):
        mine = [v for v in variants if candidates[v.place] is one.candidate and v.constants == one.constants]
        columns.append(seen.columns(mine[0].parameters))
    return canonical_correlation(seen, columns[0], columns[1]) > CONTAINED


def _clamped(parameter: Parameter, value: torch.Tensor) -> torch.Tensor:
    return value.clamp(*parameter.bounds)


def _penalty(evidence: Evidence) -> int:
    return evidence.test.dof


def _log(seen: Picture) -> float:
    return float(np.log(max(seen.dof.sum(), 2.0)))
