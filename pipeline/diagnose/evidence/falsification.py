"""Consistency of effects: the same parameters in every episode and segment, or as far as episodes scatter.

A force that depends on time or place may look like one drag or tilt in one episode and like another in the next. With
the information M_u and score g_u of each unit u (an episode, a segment) at the fitted parameters, and their sums M and
g, the statistic sum_u g_u' M_u^-1 g_u - g' M^-1 g is distributed as chi2. Its degrees of freedom are the number of
parameters of all units less those of the common fit (Cochran's Q for several parameters).

The same statistic tells how far a noise model can be believed: an effect that is the same in all episodes leaves a Q of
its degrees of freedom where the model is right. Few episodes determine that ratio badly for one effect, but all effects
together have many such ratios, whose common value c is well known. So c counts for some more degrees of freedom, as in
moderated tests (Smyth 2004): with d of these, the scatter is (d c + Q) / (d + dof), and the statistic of an effect over
it is distributed as F.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import chi2_tail, f_tail
from ...optimization.uncertainty import few_covariance
from ...physics.world import World
from ...segments.candidates import Variant, base_values
from ...segments.linearization import Linearization, eliminate, layout, linearize, sums, widths
from ...segments.segments import Segments
from ..thresholds import THRESHOLDS
from .score_test import score_test, solved
from .session_scales import NAME, linearize_beside_scales

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Consistency:
    """Cochran's Q of the effects' parameters over units."""

    statistic: float
    """Cochran's Q in units of the dispersion."""
    dof: int
    """Degrees of freedom."""
    p_value: float
    """Probability of a larger statistic if all units share the parameters."""
    share: float
    """Share of what separate parameters explain that common parameters explain."""

    @property
    def doubtful(self) -> bool:
        """Whether the effects differ between units by more than a detail of their law."""
        return self.p_value < LIMITS.consistent_p and self.share < LIMITS.consistent_share


def consistency(
    flight: Segments, world: World, names: Sequence[str], groups: Sequence[int], dispersion: float
) -> Consistency | None:
    """Test the effects' parameters over episodes and over segments, and return the less consistent result.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        names: Names of the effects.
        groups: Session of each episode.
        dispersion: Factor by which variances exceed those of the noise.

    Returns:
        The result with the smaller p-value; None without effects.
    """
    if not names:
        return None
    linear = linearize_beside_scales(flight, world, (), groups)
    columns = [k for k, p in enumerate(linear.parameters) if p.name.partition(".")[0] in names]
    if not columns:
        return None
    linear = _beside(linear, [k for k, p in enumerate(linear.parameters) if p.name.partition(".")[0] == NAME], columns)
    values = base_values(world, [linear.parameters[k] for k in columns]).numpy()
    units = (linear.episode, np.arange(len(linear.episode)))
    return max((_over(linear, columns, values, unit, dispersion) for unit in units), key=lambda one: -one.p_value)


def _beside(linear: Linearization, nuisance: Sequence[int], columns: Sequence[int]) -> Linearization:
    """Return a linearization whose scores are those beside nuisance parameters, fitted jointly with some columns."""
    if not nuisance:
        return linear
    joint = [*nuisance, *columns]
    information, score = sums(linear, joint)
    fitted = solved(information, score, widths(linear, joint))[0][: len(nuisance)]
    return replace(linear, score=linear.score - linear.information[:, :, list(nuisance)] @ fitted)


def _over(
    linear: Linearization, columns: Sequence[int], values: Array, unit: NDArray[np.int64], dispersion: float
) -> Consistency:
    """Return Cochran's Q over units; unit (B,): index of each segment's unit."""
    chosen = list(columns)
    width = np.array([linear.parameters[k].prior[1] for k in chosen])
    information, score = linear.information[:, chosen][:, :, chosen], linear.score[:, chosen]
    places = np.unique(unit, return_inverse=True)[1]
    by_unit, slopes = np.zeros((places.max() + 1, len(chosen), len(chosen))), np.zeros((places.max() + 1, len(chosen)))
    np.add.at(by_unit, places, information)
    np.add.at(slopes, places, score)
    own = [solved(m, g, width)[2:] for m, g in zip(by_unit, slopes, strict=True)]
    common, rank = solved(by_unit.sum(0), slopes.sum(0), width)[2:]
    statistic = max(sum(q for q, _ in own) - common, 0.0) / dispersion
    dof = sum(k for _, k in own) - rank
    shared = float(values @ by_unit.sum(0) @ values) / dispersion
    excess = max(statistic - dof, 0.0)
    share = shared / (shared + excess) if shared + excess > 0 else 1.0
    return Consistency(statistic, dof, chi2_tail(statistic, dof) if dof > 0 else 1.0, share)


def fitted_numbers(
    flight: Segments,
    world: World,
    names: Sequence[str],
    groups: Sequence[int],
    dispersion: float,
    own: Sequence[tuple[Variant, bool]] = (),
) -> dict[str, dict[str, tuple[float, float]]]:
    """Return the parameters of effects of a world with standard errors that hold the scatter between episodes.

    The error of an effect's formula and what a session or a flight has of its own are common to all frames of an
    episode, so that the information of the frames alone makes intervals too narrow.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        names: Names of effects with one value for all episodes.
        groups: Session of each episode.
        dispersion: Factor by which variances exceed those of the noise.
        own: Effects that have a value for each episode, or else for each session, which are found beside the numbers.

    Returns:
        Value and standard error by parameter, by effect.
    """
    linear = linearize(flight, world, [variant for variant, _ in own], groups, robust=False) if names else None
    if linear is None:
        return {}
    beside = [linear.columns(variant.parameters) for variant, _ in own]
    every = [k for k in range(len(linear.parameters)) if all(k not in columns for columns in beside)]
    for columns, (_, by_episode) in zip(beside, own, strict=True):
        linear = _beside_own(linear, every, columns, by_episode, dispersion)
    bare = replace(linear, prior=np.zeros_like(linear.prior))
    information, score = sums(bare, every)
    scores = np.array([sums(bare.only_episode(int(one)), every)[1] for one in np.unique(linear.episode)])
    prior = sums(linear, every)[0] - information
    # an effect with values of their own may have been found after the others, and moves their numbers
    step = np.linalg.solve(information / dispersion + prior, score / dispersion) if own else np.zeros(len(score))
    # a fit that stopped early has a slope left, which is no scatter
    scores = (scores - score / len(scores)) / dispersion
    std = np.sqrt(np.diag(few_covariance(information / dispersion + prior, scores, prior)))
    own_names = [linear.parameters[k].name for k in every]
    place = {name: int(k) for name, k in zip(own_names, layout(linear, every)[0][0], strict=True)}
    return {
        active.effect.name: {
            p.name: (float(active.values[p.name][0]) + float(step[at]), float(std[at]))
            for p in active.effect.parameters
            for at in [place[f"{active.effect.name}.{p.name}"]]
        }
        for active in world.effects
        if active.effect.name in names
    }


def _beside_own(
    linear: Linearization, kept: Sequence[int], columns: Sequence[int], by_episode: bool, dispersion: float
) -> Linearization:
    """Return a linearization in which an effect is free in each episode or session, beside the parameters `kept`.

    Args:
        linear: The linearization.
        kept: Parameters whose information is what values of their own leave.
        columns: Parameters of the effect.
        by_episode: Whether each episode has a value, else each session.
        dispersion: Factor by which variances exceed those of the noise, in which the priors are given.
    """
    owner = linear.episode if by_episode else linear.group
    information, score = linear.information.copy(), linear.score.copy()
    rest = [*kept, *(k for k in range(len(linear.parameters)) if k not in (*kept, *columns))]
    for one in np.unique(owner):
        mine = np.flatnonzero(owner == one)
        weight = linear.weight[mine, None, None]
        shared = (information[mine] * weight).sum(0)
        own = shared[np.ix_(columns, columns)] + dispersion * np.diag(linear.prior[list(columns)])
        along = np.linalg.solve(own, shared[np.ix_(columns, rest)]).T
        # each flight without what the values of its owner explain of it
        between = information[mine][:, rest][:, :, columns]
        explained = between @ along.T
        inner = along @ information[mine][:, columns][:, :, columns] @ along.T
        cleaned = information[mine][:, rest][:, :, rest] - explained - explained.transpose(0, 2, 1) + inner
        information[mine[:, None, None], np.array(rest)[None, :, None], np.array(rest)[None, None, :]] = cleaned
        score[mine[:, None], np.array(rest)[None]] -= linear.score[mine][:, columns] @ along.T
    return replace(linear, information=information, score=score)


@dataclass(frozen=True)
class Repetition:
    """Whether an effect repeats from episode to episode beyond their scatter."""

    scatter: float
    """Factor by which variances between episodes exceed those of the noise; at least 1."""
    p_value: float
    """Probability of a larger statistic without the effect, with that scatter."""
    without_best: float
    """The same without the episode that speaks most for it; 1 where it is the only one."""
    beyond_one: float = -math.inf
    """Twice the logarithm of the odds of the effect against a misfit of one episode, of any kind."""


def repetition(
    linear: Linearization, columns: Sequence[int], dispersion: float, beside: Sequence[int] = ()
) -> Repetition:
    """Test an effect as `repetitions` does, whose arguments these are."""
    return repetitions(linear, [columns], dispersion, beside)[0]


def repetitions(
    linear: Linearization, effects: Sequence[Sequence[int]], dispersion: float, beside: Sequence[int] = ()
) -> list[Repetition]:
    """Test effects, each beside the scatter of its parameters between episodes.

    Args:
        linear: Linearization of the segments with the effects.
        effects: Columns of the parameters of each effect.
        dispersion: Factor by which variances exceed those of the noise.
        beside: Columns of all effects whose scatter tells the usual one; none where the noise model alone tells it.
    """
    names = [int(one) for one in np.unique(linear.episode)]
    parts = [linear, *(linear.without_episode(one) for one in names if len(names) > 1)]
    usual = [_usual(one, dispersion, beside) for one in parts]
    tests = []
    for columns in effects:
        found = [_beside_scatter(*one, columns, dispersion) for one in zip(parts, usual, strict=True)]
        (scatter, p_value), without = found[0], max((p_value for _, p_value in found[1:]), default=1.0)
        beyond = _beyond_one(linear, columns, beside, dispersion * scatter) if beside else -math.inf
        tests.append(Repetition(scatter, p_value, without, beyond))
    return tests


def _beyond_one(linear: Linearization, columns: Sequence[int], every: Sequence[int], dispersion: float) -> float:
    """Return twice the logarithm of the odds of an effect against a misfit of one episode, of any kind.

    Such a misfit is whatever all effects together can do, in one episode alone, each as large as it usually is. That
    can also look like the effect, but seldom looks like nothing else: the odds are those of marginal likelihoods.
    """
    base = list(range(linear.base))
    information, score = sums(linear, [*base, *columns])
    count = len(score) - len(widths(linear, columns))
    effect = _evidence(*eliminate(information, score, count), widths(linear, columns), dispersion)
    bare, fitted = replace(linear, prior=np.zeros_like(linear.prior)), np.zeros(0)
    if base:
        fitted = solved(*sums(linear, base), widths(linear, base))[0]
    width, misfits = widths(linear, every), []
    for episode in np.unique(linear.episode):
        matrix, slope = sums(bare.only_episode(int(episode)), [*base, *every])
        slope = slope[count:] - matrix[count:, :count] @ fitted
        misfits.append(_evidence(matrix[count:, count:], slope, width, dispersion))
    return effect - max(misfits)


def _evidence(information: Array, score: Array, width: Array, dispersion: float) -> float:
    """Return twice the logarithm of the likelihood of values with a prior of some widths against that of none."""
    values, vectors = np.linalg.eigh(information * np.outer(width, width) / dispersion)
    values = values.clip(0.0)
    along = vectors.T @ (score * width) / dispersion
    return float((along**2 / (values + 1)).sum() - np.log1p(values).sum())


def _usual(linear: Linearization, dispersion: float, beside: Sequence[int]) -> tuple[float, float]:
    """Return the usual scatter of effects between episodes, and for how many degrees of freedom it counts."""
    counts = LIMITS.model_counts
    if not beside:
        return 1.0, counts
    q, dof = _scatter(linear, beside, dispersion)
    # what a sum of squares falls below its expectation by is chance
    return max(1.0, (counts + q) / (counts + dof)), LIMITS.effects_count


def _beside_scatter(
    linear: Linearization, expected: tuple[float, float], columns: Sequence[int], dispersion: float
) -> tuple[float, float]:
    """Return the scatter between episodes, and the p-value of an effect beside it and the usual one."""
    usual, counts = expected
    q, dof = _scatter(linear, columns, dispersion)
    scatter = max(1.0, (counts * usual + q) / (counts + dof))
    test = score_test(linear, columns, dispersion=dispersion)
    if not test.dof or not test.admissible:
        return scatter, 1.0
    tail = f_tail(test.statistic / test.dof / scatter, test.dof, counts + dof)
    one_sided = test.dof == 1 and linear.parameters[columns[0]].bounds[0] == 0.0
    return scatter, 0.5 * tail if one_sided else tail


def _scatter(linear: Linearization, columns: Sequence[int], dispersion: float) -> tuple[float, int]:
    """Return Cochran's Q of parameters over episodes, and its degrees of freedom."""
    chosen = [*range(linear.base), *columns]
    width = widths(linear, columns)
    count = len(widths(linear, chosen)) - len(width)
    information, score = sums(linear, chosen)
    fitted = solved(information, score, widths(linear, chosen))[0]
    kept = replace(linear, prior=np.zeros_like(linear.prior))
    statistic, rank, total, slope = 0.0, 0, np.zeros((len(width), len(width))), np.zeros(len(width))
    for episode in np.unique(linear.episode):
        mine, own = sums(kept.only_episode(int(episode)), chosen)
        # beside the parameters of the model, where they are fitted jointly
        left, matrix = own[count:] - mine[count:, :count] @ fitted[:count], mine[count:, count:]
        total, slope = total + matrix, slope + left
        explained, size = solved(matrix, left, width)[2:]
        statistic, rank = statistic + explained, rank + size
    common, size = solved(total, slope, width)[2:]
    return max(statistic - common, 0.0) / dispersion, max(rank - size, 0)
