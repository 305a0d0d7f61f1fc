"""Forward selection of one effect in flight: score tests make a short list, refits decide between its candidates.

In flight, only noise separates the data from a complete model, so the textbook p-values apply: they are uniform where
nothing is missing (a test measures that).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...physics.parameters import Parameter
from ...physics.world import World
from ...segments.candidates import Candidate, Variant, acts_in, admissible, base_parameters, variants_of, with_added
from ...segments.linearization import Linearization
from ...segments.segment_fit import Refit, refit
from ...segments.segments import Segments
from ...trajectories.innovations import WHITE
from ..thresholds import THRESHOLDS
from .evidence import Evidence, prior_odds
from .falsification import repetitions
from .score_test import ScoreTest, canonical_correlation, gain_by_episode, score_test
from .session_scales import linearize_beside_scales

LIMITS = THRESHOLDS.flight


@dataclass(frozen=True)
class SelectionStep:
    """One step of forward selection: all candidates in addition to the effects selected before."""

    evidence: tuple[Evidence, ...]
    """Evidence of all candidates, the best first."""
    equals: tuple[Evidence, ...]
    """Candidates that explain the data equally well, the best first."""
    flagged: bool
    """Whether the best candidate is significant and is selected."""
    own_std: float | None = None
    """Standard deviation between episodes, of an effect with a value for each; None for one value in all."""

    @property
    def best(self) -> Evidence:
        """Evidence of the best candidate."""
        return self.equals[0]


def tested(
    linear: Linearization, candidates: Sequence[Candidate], variants: Sequence[Variant], dispersion: float = 1.0
) -> list[Evidence]:
    """Return the score test of each candidate at its best constants, the smallest p-value first.

    Args:
        linear: Linearization of the segments with all variants.
        candidates: The candidates.
        variants: Variants of the candidates, one for each choice of constants.
        dispersion: Factor by which variances exceed those of the noise.
    """
    found: dict[int, tuple[Variant, ScoreTest]] = {}
    tries: dict[int, int] = {}
    for variant in variants:
        test = score_test(linear, linear.columns(variant.parameters), dispersion=dispersion)
        tries[variant.place] = tries.get(variant.place, 0) + 1
        if variant.place not in found or test.p_value < found[variant.place][1].p_value:
            found[variant.place] = (variant, test)
    results = []
    for place, (variant, test) in found.items():
        corrected = min(1.0, test.p_value * tries[place])
        gains = gain_by_episode(linear, linear.columns(variant.parameters))
        results.append(
            Evidence(
                candidate=candidates[place],
                constants=variant.constants,
                test=test,
                p_value=corrected,
                gains=tuple(gains.tolist()),
            )
        )
    # ties are broken by name, so that the order of the candidates does not matter
    return sorted(results, key=lambda e: (e.p_value, -e.test.statistic, e.name))


def select_next(
    flight: Segments,
    world: World,
    candidates: Sequence[Candidate],
    groups: Sequence[int],
    turned: bool,
    dispersion: float = 1.0,
) -> SelectionStep:
    """Test all candidates as the next effect of a world in flight, and refit the most significant ones.

    Args:
        flight: Segments with states fitted by the world.
        world: The world, with the effects selected so far.
        candidates: All candidates.
        groups: Session of each episode.
        turned: Whether orientations were measured.
        dispersion: Factor by which variances exceed those of the noise.
    """
    kept, _ = admissible(world, candidates, turned, flight.observations.spin_rad_s is not None)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if acts_in(v, "flight")]
    linear = linearize_beside_scales(flight, world, variants, groups)
    evidence = tested(linear, kept, variants, dispersion)
    level = LIMITS.alpha / max(1, len(evidence))
    significant = [e for e in evidence if e.p_value < level]
    if not significant:
        return SelectionStep(tuple(evidence), tuple(evidence[:1]), False)
    done = _refitted_shortlist(significant, flight, world, linear, kept, variants, dispersion)
    every = list(range(linear.base, len(linear.parameters)))
    own = [linear.columns(_variant(e, kept, variants).parameters) for e in done]
    repeated = repetitions(linear, own, dispersion, every)
    done = [replace(e, repetition=found) for e, found in zip(done, repeated, strict=True)]
    if not done:
        return SelectionStep(tuple(evidence), tuple(evidence[:1]), False)
    names = {e.name: e for e in done}
    ranking = [*done, *(e for e in evidence if e.name not in names)]
    equals = _equals(done, linear, kept, variants, dispersion)
    if flight.noise_model != WHITE:
        equals = _with_unproven(equals, done, linear.episode)
    equals = _without_further(equals, linear, kept, variants, level, dispersion)
    equals = _simplest_within(equals, done, linear, kept, variants)
    told = len(equals) <= LIMITS.most_equals and not are_slight(equals)
    named = told and (
        flight.noise_model == WHITE or any(repeats(e, len(evidence)) for e in equals)  # the level is that of all tests
    )
    return SelectionStep(tuple(ranking), tuple(equals), named)


def _refitted_shortlist(
    significant: Sequence[Evidence],
    flight: Segments,
    world: World,
    linear: Linearization,
    candidates: Sequence[Candidate],
    variants: Sequence[Variant],
    dispersion: float,
) -> list[Evidence]:
    """Refit the most significant candidates and return those that lower BIC, each at its best constants, best first."""
    # a known sign that comes out wrong is not a detection, but the bounds may still admit the effect's other parameters
    most = max(e.test.statistic for e in significant)
    short = [e for e in significant if e.test.statistic >= LIMITS.shortlist_share * most]
    short = sorted(short, key=lambda e: (_penalty(e) * _log(linear) - e.test.statistic, e.name))[: LIMITS.shortlist + 2]
    before = refit([flight], world, base_parameters(world, "flight"))
    done = [refitted(e, [flight], world, before, math.exp(_log(linear)), dispersion) for e in short]
    enough = LIMITS.unfitted * float(linear.dof.sum()) * dispersion
    if all(e.refitted is not None and e.refitted.cost > enough for e in done):
        others = [e for one in short for e in _with_other_constants(one, linear, variants, candidates, dispersion)]
        done += [refitted(e, [flight], world, before, math.exp(_log(linear)), dispersion) for e in others]
    best: dict[int, Evidence] = {}  # each candidate at its best constants
    for e in sorted(done, key=lambda e: (e.delta_bic, e.name)):
        best.setdefault(id(e.candidate), e)
    return [e for e in best.values() if e.delta_bic is not None and e.delta_bic < 0]


def repeats(evidence: Evidence, tested: int) -> bool:
    """Return whether one of many effects is significant beside the scatter between episodes, and not by one alone.

    No model of correlated errors is exact: a burst, the smeared edge of a contact or the rest of a hand looks like a
    force, in its own episode. But one long throw may tell more of a drag than all others: where these do not contradict
    it, an effect counts that is far likelier than a misfit of that one episode, which can look like anything.
    """
    found, level = evidence.repetition, LIMITS.repeated_alpha / max(1, tested)
    if found is None or found.p_value >= level:
        return False
    clear = found.beyond_one > LIMITS.beyond_one and found.without_best < LIMITS.rather
    return clear or found.without_best < LIMITS.without_best


def _variant(evidence: Evidence, candidates: Sequence[Candidate], variants: Sequence[Variant]) -> Variant:
    """Return the variant of a candidate at the constants of its evidence."""
    return next(v for v in variants if candidates[v.place] is evidence.candidate and v.constants == evidence.constants)


def are_slight(equals: Sequence[Evidence]) -> bool:
    """Return whether effects that explain the data equally well are too small to be selected on their evidence.

    That is the evidence of the likeliest of them: what is small in one of them may be a large force of another kind.
    """
    small = any(
        all(abs(one.estimates[p.name][0]) < LIMITS.slight * p.scale for p in one.candidate.effect.parameters)
        for one in equals
    )
    known = [one.delta_bic for one in equals if one.delta_bic is not None]
    return small and bool(known) and min(known) > LIMITS.slight_bic


def _with_other_constants(
    evidence: Evidence,
    linear: Linearization,
    variants: Sequence[Variant],
    candidates: Sequence[Candidate],
    dispersion: float,
) -> list[Evidence]:
    """Return a candidate at each of its constants except those of its best score test.

    A score test uses the slope at the neutral value; the best constants there need not be the best ones at the estimate
    of a large effect.
    """
    mine = [v for v in variants if candidates[v.place] is evidence.candidate and v.constants != evidence.constants]
    tests = [score_test(linear, linear.columns(v.parameters), dispersion=dispersion) for v in mine]
    return [replace(evidence, constants=v.constants, test=test) for v, test in zip(mine, tests, strict=True)]


def refitted(
    evidence: Evidence, parts: Sequence[Segments], world: World, before: Refit, count: float, dispersion: float
) -> Evidence:
    """Refit the effect together with the model's parameters, and return the evidence with the refit.

    Args:
        evidence: Evidence of the effect.
        parts: The segments.
        world: The world without the effect.
        before: Refit of that world.
        count: Number of measured values, for the penalty of BIC.
        dispersion: Factor by which variances exceed those of the noise.
    """
    effect = evidence.candidate.effect
    added = with_added(world, effect, evidence.constants)
    kinds = {part.kind for part in parts}
    parameters = base_parameters(added, "contact" if "contact" in kinds else "flight")
    own = [p for p in parameters if p.name.partition(".")[0] == effect.name]
    start = [torch.tensor(value) for value in evidence.test.estimate.tolist()]
    values = torch.stack([_clamped(p, v) for p, v in zip(own, start, strict=False)]) if start else torch.zeros(0)
    rest = before.values.to(torch.float64)
    others = [p for p in parameters if p not in own]
    known = {p.name: rest[k] for k, p in enumerate(before.parameters)}
    initial = torch.stack([*(known[p.name] for p in others), *values.to(torch.float64)])
    after = refit(parts, added, [*others, *own], initial)
    found = {p.name.partition(".")[2]: after.number(p.name) for p in own}
    numbers = {name: (value, std * math.sqrt(dispersion)) for name, (value, std) in found.items()}
    bic = (after.cost - before.cost) / dispersion + len(own) * math.log(count)
    bic += prior_odds(effect, {name: value for name, (value, _) in numbers.items()})
    return replace(evidence, refitted=after, delta_bic=bic, numbers=numbers)


def _equals(
    done: Sequence[Evidence],
    linear: Linearization,
    candidates: Sequence[Candidate],
    variants: Sequence[Variant],
    dispersion: float,
) -> list[Evidence]:
    """Return the best refitted candidate and those that explain the data equally well."""
    best = done[0]
    if best.refitted is None or best.delta_bic is None:
        return [best]
    found = [best]
    for other in done[1:]:
        if other.refitted is None or other.delta_bic is None:
            continue
        worse = (other.refitted.cost - best.refitted.cost) / dispersion
        more = len(other.candidate.effect.parameters) > len(best.candidate.effect.parameters)
        close = other.delta_bic - best.delta_bic < LIMITS.alias_chi2 if more else worse < LIMITS.alias_chi2
        if more and not close and worse < LIMITS.alias_chi2:
            close = _contains(linear, candidates, variants, best, other)
        if close:
            found.append(other)
    return found


def _with_unproven(equals: Sequence[Evidence], done: Sequence[Evidence], episode: NDArray[np.int64]) -> list[Evidence]:
    """Return the equals with the rivals that are not worse in most episodes, the simplest of all first.

    Simplest is what acts alone, then what has the fewest parameters: a wind acts through a drag, a tilt does not.

    Beside correlated errors a difference counts where it is the same from episode to episode (a paired t-test), or
    large beside what the episodes scatter: no model of such errors is exact, and a misfit of one episode is one error,
    not one in each frame.

    Args:
        equals: The best refitted candidate and those that explain the data equally well.
        done: All refitted candidates.
        episode: Episode of each segment (B,).
    """
    best, found = equals[0], list(equals)
    names = {one.name for one in equals}
    for other in done:
        if other.name in names or other.refitted is None or best.refitted is None:
            continue
        worse = (other.refitted.by_segment[0] - best.refitted.by_segment[0]).numpy()
        own = np.array([worse[episode == one].sum() for one in np.unique(episode)])
        error = float(np.std(own, ddof=1)) / math.sqrt(len(own)) if len(own) > 1 else math.inf
        # what the better one gains by its further parameters in the data that they are fitted to is no evidence
        more = max(len(best.candidate.effect.parameters) - len(other.candidate.effect.parameters), 0)
        scatter = best.repetition.scatter if best.repetition is not None else math.inf
        differs = float(own.sum()) - more > LIMITS.paired_t**2 * scatter
        if not differs and float(own.mean()) - more / len(own) <= LIMITS.paired_t * error:
            found.append(other)
    return sorted(found, key=_complexity)


def _without_further(
    equals: Sequence[Evidence],
    linear: Linearization,
    candidates: Sequence[Candidate],
    variants: Sequence[Variant],
    level: float,
    dispersion: float,
) -> list[Evidence]:
    """Return the equals without effects that act beside the first one, for the next step to name.

    Two effects that explain as much as each other are rivals where one shows no more beside the other. Where each is
    significant beside the other, they explain different things, and both are needed.

    Args:
        equals: Effects that explain the data equally well, the first one to be named.
        linear: The linearization.
        candidates: The candidates.
        variants: Their variants.
        level: P-value below which an effect is significant.
        dispersion: Factor by which variances exceed those of the noise.
    """
    columns = [linear.columns(_variant(one, candidates, variants).parameters) for one in equals]
    base = list(range(linear.base))

    def shows(one: list[int], beside: list[int]) -> bool:
        return score_test(linear, one, [*base, *beside], dispersion).p_value < level

    first = columns[0]
    return [
        one
        for k, (one, own) in enumerate(zip(equals, columns, strict=True))
        if k == 0 or not (shows(own, first) and shows(first, own))
    ]


def _simplest_within(
    equals: Sequence[Evidence],
    done: Sequence[Evidence],
    linear: Linearization,
    candidates: Sequence[Candidate],
    variants: Sequence[Variant],
) -> list[Evidence]:
    """Return the equals with the best simpler effect, and its equals, that the best one contains as a special case.

    A constant force is a tilt and another gravity together, which no flight tells apart, and each of which comes alone:
    what the simpler one leaves is for the next step to name.
    """
    best, names = equals[0], {one.name for one in equals}
    size = len(best.candidate.effect.parameters)
    within = [
        other
        for other in done
        if len(other.candidate.effect.parameters) < size
        and "drag" not in best.candidate.effect.needs
        and _contains(linear, candidates, variants, other, best)
    ]
    # its two parts may explain as much as each other, and are no rivals: each is needed, and the next step names it
    near = [
        one
        for one in within
        if _told(one) - _told(within[0]) < LIMITS.alias_chi2
        and one.name not in names
        and _contains(linear, candidates, variants, one, within[0])
    ]
    return sorted([*equals, *near], key=_complexity) if near else list(equals)


def _bic(one: Evidence) -> float:
    """Return the change of BIC; infinite where it is unknown."""
    return math.inf if one.delta_bic is None else one.delta_bic


def _told(one: Evidence) -> float:
    """Return the change of BIC by the data alone: an implausible size is a reason to come last, not to be another."""
    return _bic(one) - one.odds


def _complexity(one: Evidence) -> tuple[bool, int, float, float, bool, str]:
    """Return what equals are ordered by: whether they act through another effect, their parameters, odds, and BIC.

    The odds of their sizes come before BIC, whose differences the data do not prove; to rounding, forces come first.
    """
    effect = one.candidate.effect
    found = _bic(one)
    near = round(found) if math.isfinite(found) else found
    return "drag" in effect.needs, len(effect.parameters), one.odds, near, effect.phase == "measurement", one.name


def _contains(
    linear: Linearization, candidates: Sequence[Candidate], variants: Sequence[Variant], best: Evidence, other: Evidence
) -> bool:
    """Return whether another effect, with more parameters, can imitate the best one."""
    columns = [linear.columns(_variant(one, candidates, variants).parameters) for one in (best, other)]
    return canonical_correlation(linear, columns[0], columns[1]) > LIMITS.contained


def _clamped(parameter: Parameter, value: torch.Tensor) -> torch.Tensor:
    """Return a value clamped to the bounds of its parameter."""
    return value.clamp(*parameter.bounds)


def _penalty(evidence: Evidence) -> int:
    """Return the number of parameters that BIC counts."""
    return evidence.test.dof


def _log(linear: Linearization) -> float:
    """Return the logarithm of the number of measured values."""
    return float(np.log(max(linear.dof.sum(), 2.0)))
