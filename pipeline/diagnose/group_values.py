"""Effects in flight that each group of episodes (a session, a ball) has with a value of its own.

Groups share no parameter of such an effect, so that each is fitted to the flights of one group, beside the effects that
are common to all. It is named where it explains the flights better than the same effect with one value, by the odds of
BIC, and, where each group has several episodes, predicts each from the others of its group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..optimization.uncertainty import chi2_tail, student_tail
from ..physics.effects.effect import ActiveEffect
from ..physics.effects.registry import load_effect
from ..physics.parameters import Parameter, effect_parameters
from ..physics.world import World
from ..segments.candidates import Candidate, Variant, admissible, base_parameters, variants_of, without_effect
from ..segments.linearization import Linearization, linearize
from ..segments.prepare import Prepared
from ..segments.segment_fit import Refit, refit
from ..segments.segment_states import fit_states
from ..segments.segments import Segments
from .effect_selection import SelectionStep
from .evidence import Evidence
from .score_test import ScoreTest, canonical_correlation, solved
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.flight

Array = NDArray[np.float64]

MOST_PARAMETERS = 3
"""Most parameters of an effect: more are a body's, which is the same in all groups."""
REFITTED = 5
"""How many effects, no two of which do the same, are refitted in each place: a step from neutral ranks them badly."""


@dataclass(frozen=True, kw_only=True)
class _Fitted:
    """An effect with a value in each group."""

    candidate: Candidate
    """The effect."""
    replaces: str | None
    """The selected effect in whose place it is; None for a further one."""
    world: World
    """The world without it."""
    flight: Segments
    """Flights with states fitted by that world."""
    values: dict[int, Array]
    """Parameters (k,) by group."""
    cost: float
    """Chi2 of all flights, in units of the scatter, with BIC's penalty for its parameters."""
    alone: float
    """The same with one value for all groups."""
    by_flight: Array
    """Chi2 of each flight (B,)."""

    @property
    def mean(self) -> Array:
        """Mean of the parameters over groups."""
        return np.mean(list(self.values.values()), axis=0)

    @property
    def spread(self) -> Array:
        """Standard deviation of the parameters between groups."""
        return np.std(list(self.values.values()), axis=0, ddof=1)


def with_group_values(
    prepared: Prepared,
    steps: list[SelectionStep],
    world: World,
    flight: Segments,
    candidates: Sequence[Candidate],
    scatter: float,
) -> tuple[list[SelectionStep], World, Segments]:
    """Select an effect with a value in each group, in place of a selected effect or beside them, if there is one.

    Args:
        prepared: The episodes.
        steps: The selection steps.
        world: The world with the selected effects.
        flight: Segments with states fitted by it.
        candidates: All candidates.
        scatter: Factor by which variances exceed those of the noise.
    """
    groups = _groups(prepared, flight)
    if len(np.unique(groups)) < 2 or any(parameter.shared == "group" for parameter in effect_parameters(world)):
        return steps, world, flight
    count = math.log(max(float(flight.dof.sum()), 2.0))
    named = [step.best.name for step in steps if step.flagged and step.own_std is None]
    before = _cost(refit([flight], world, []), scatter) + count * sum(
        len(step.best.candidate.effect.parameters) for step in steps if step.best.name in named
    )
    found: list[_Fitted] = []
    for name in (None, *named):
        bare = world if name is None else without_effect(world, name)
        if len(bare.effects) < len(world.effects) - 1:
            continue  # another effect acts through this one
        states = flight if name is None else fit_states(flight.in_world(bare))
        others = [step for step in steps if step.best.name in named and step.best.name != name]
        penalty = count * sum(len(step.best.candidate.effect.parameters) for step in others)
        found += _fits(prepared, groups, bare, states, candidates, (scatter, count, penalty), name)
    best = min(found, key=lambda one: one.cost, default=None)
    if best is None or best.cost - min(before, best.alone) > LIMITS.slight_bic:
        return steps, world, flight
    episode = np.array([item.episode for item in flight.items])
    helping = [one for one in found if one is not best and one.cost < before]
    equals = [best, *(one for one in helping if _unproven(best, one, episode))]
    gain = before - best.cost
    evidence = tuple(_evidence(one, gain - (one.cost - best.cost), count) for one in equals)
    step = SelectionStep(evidence, evidence, True, own_std=float(best.spread[0]))
    kept = [one for one in steps if one.flagged and one.best.name != best.replaces]
    return [*kept, step], *_placed(prepared, best, groups)


def _unproven(best: _Fitted, other: _Fitted, episode: NDArray[np.int64]) -> bool:
    """Return whether another effect in the same place is not worse in most episodes: a paired t-test, as for one value.

    Args:
        best: The likeliest effect.
        other: The other one.
        episode: Episode of each flight (B,).
    """
    if other.replaces != best.replaces:
        return False
    if other.cost - best.cost < LIMITS.alias_chi2:
        return True
    worse = np.array([(other.by_flight - best.by_flight)[episode == one].sum() for one in np.unique(episode)])
    return float(worse.mean()) <= LIMITS.paired_t * float(worse.std(ddof=1)) / math.sqrt(len(worse))


def _groups(prepared: Prepared, flight: Segments) -> NDArray[np.int64]:
    """Return the group (B,) of each flight."""
    return np.array([prepared.groups[item.episode] for item in flight.items])


def _cost(found: Refit, scatter: float) -> float:
    """Return chi2 in units of the scatter."""
    return found.cost / scatter


def _fits(
    prepared: Prepared,
    groups: NDArray[np.int64],
    world: World,
    flight: Segments,
    candidates: Sequence[Candidate],
    scale: tuple[float, float, float],
    replaces: str | None,
) -> list[_Fitted]:
    """Return the likeliest effects with a value in each group, refitted.

    Args:
        prepared: The episodes.
        groups: Group of each flight.
        world: The world without them.
        flight: Flights with states fitted by it.
        candidates: All candidates.
        scale: The scatter, BIC's penalty of one parameter, and of the effects that the world was given.
        replaces: The selected effect in whose place they are.
    """
    scatter, count, penalty = scale
    spun = flight.observations.spin_rad_s is not None
    kept = [one for one in admissible(world, candidates, prepared.has_orientation, spun)[0] if _suits(one)]
    variants = variants_of(kept, world.gravity[0, :1])
    if not variants:
        return []
    linear = linearize(flight, world, variants, prepared.groups, robust=False)
    scored = []
    for variant in variants:
        columns = linear.columns(variant.parameters)
        start = {group: _solved(linear, columns, groups == group) for group in np.unique(groups).tolist()}
        gain = sum(one[1] for one in start.values()) / scatter - count * len(columns) * len(start)
        if gain > 0 and _predicts(linear, columns, groups):
            scored.append((gain, variant, {group: one[0] for group, one in start.items()}))
    scored.sort(key=lambda one: (-one[0], one[1].place))
    found = []
    for _, variant, start in _unlike(linear, scored)[:REFITTED]:
        values, by_flight, alone = _refitted(kept[variant.place], world, flight, groups, start)
        size = len(variant.parameters)
        found.append(
            _Fitted(
                candidate=kept[variant.place],
                replaces=replaces,
                world=world,
                flight=flight,
                values=values,
                cost=float(by_flight.sum()) / scatter + penalty + count * size * len(values),
                by_flight=by_flight,
                alone=alone / scatter + penalty + count * size,
            )
        )
    return found


def _unlike(
    linear: Linearization, scored: Sequence[tuple[float, Variant, dict[int, Array]]]
) -> list[tuple[float, Variant, dict[int, Array]]]:
    """Return the variants without those that do the same as one before them."""
    found: list[tuple[float, Variant, dict[int, Array]]] = []
    for one in scored:
        columns = [linear.columns(other[1].parameters) for other in found]
        mine = linear.columns(one[1].parameters)
        if all(canonical_correlation(linear, mine, other) < LIMITS.contained for other in columns):
            found.append(one)
    return found


def _suits(candidate: Candidate) -> bool:
    """Return whether an effect can have a value in each group."""
    effect = candidate.effect
    few = 0 < len(effect.parameters) <= MOST_PARAMETERS
    return few and not effect.constants and "drag" not in effect.needs and effect.phase != "contact"


def _solved(linear: Linearization, columns: list[int], mine: NDArray[np.bool_]) -> tuple[Array, float]:
    """Return the parameters of some flights by one step from neutral, and the fall of chi2."""
    information = linear.information[mine][:, columns][:, :, columns].sum(0)
    width = np.array([linear.parameters[k].prior[1] for k in columns])
    value, _, gain, _ = solved(information, linear.score[mine][:, columns].sum(0), width)
    return value, gain


def _predicts(linear: Linearization, columns: list[int], groups: NDArray[np.int64]) -> bool:
    """Return whether episodes are predicted better by the others of their group than by all; True where none has any.

    Student's t of the gains of chi2 over episodes.
    """
    gains = []
    for episode in np.unique(linear.episode):
        mine = linear.episode == episode
        own = (groups == groups[mine][0]) & ~mine
        if not own.any():
            return True
        information = linear.information[mine][:, columns][:, :, columns].sum(0)
        score = linear.score[mine][:, columns].sum(0)
        chi2 = []
        for others in (own, ~mine):
            value = _solved(linear, columns, others)[0]
            chi2.append(value @ information @ value - 2 * score @ value)
        gains.append(chi2[1] - chi2[0])
    if len(gains) < 2 or np.mean(gains) <= 0:
        return False
    error = float(np.std(gains, ddof=1)) / math.sqrt(len(gains))
    return student_tail(float(np.mean(gains)) / max(error, 1e-12), len(gains) - 1) < THRESHOLDS.verdict.repeated_p


def _refitted(
    candidate: Candidate, world: World, flight: Segments, groups: NDArray[np.int64], start: dict[int, Array]
) -> tuple[dict[int, Array], Array, float]:
    """Return an effect's parameters by group, the chi2 of each flight (B,), and that of all with one value for all."""
    added = _added(candidate, world)
    own = _own_parameters(candidate, added)
    values, cost = {}, np.zeros(len(groups))
    mean = np.mean(list(start.values()), axis=0)
    alone = refit([flight], added, own, _encoded(own, mean, flight))
    for group, value in start.items():
        mine = np.flatnonzero(groups == group)
        part = flight.select(mine.tolist())
        fitted = refit([part], added, own, _encoded(own, value, flight))
        values[group] = np.array([fitted.number(parameter.name)[0] for parameter in own])
        cost[mine] = fitted.by_segment[0].numpy()
    return values, cost, alone.cost


def _added(candidate: Candidate, world: World) -> World:
    """Return a world with an effect at neutral."""
    active = ActiveEffect.of(candidate.effect, {}, world.gravity[0, :1])
    return replace(world, effects=(*world.effects, active))


def _own_parameters(candidate: Candidate, world: World) -> list[Parameter]:
    """Return the parameters of an effect in a world."""
    return [p for p in effect_parameters(world) if p.name.partition(".")[0] == candidate.effect.name]


def _encoded(parameters: Sequence[Parameter], values: Array, flight: Segments) -> Tensor:
    """Return values within the bounds of their parameters."""
    kept = [float(np.clip(value, *p.bounds)) for p, value in zip(parameters, values, strict=True)]
    return flight.dof.new_tensor(kept).double()


def _placed(prepared: Prepared, best: _Fitted, groups: NDArray[np.int64]) -> tuple[World, Segments]:
    """Return the world with the values of the groups, its other effects fitted again, and the flights in it."""
    effect = load_effect(f"{best.candidate.spec}@group")
    names = [p.name for p in best.candidate.effect.parameters]
    mean = dict(zip(names, best.mean.tolist(), strict=True))
    active = ActiveEffect.of(effect, mean, best.world.gravity[0, :1])
    own = {
        episode: {f"{effect.name}.{name}": float(v) for name, v in zip(names, best.values[group], strict=True)}
        for episode, group in zip(prepared.names, prepared.groups, strict=True)
        if group in best.values
    }
    known = {name: {**best.world.own_values.get(name, {}), **values} for name, values in own.items()}
    world = replace(best.world, effects=(*best.world.effects, active), own_values=known)
    flight = replace(best.flight, observations=best.flight.observations.with_own(world)).in_world(world)
    found = refit([flight], world, base_parameters(world, "flight"))
    return found.world, found.segments[0]


def _evidence(one: _Fitted, gain: float, count: float) -> Evidence:
    """Return the evidence of an effect with a value in each group."""
    size, groups = len(one.mean), len(one.values)
    names = [p.name for p in one.candidate.effect.parameters]
    error = one.spread / math.sqrt(groups)
    statistic = gain + count * size * groups
    test = ScoreTest(
        statistic=statistic,
        dof=size * groups,
        p_value=chi2_tail(statistic, size * groups),
        estimate=one.mean,
        covariance=np.diag(error**2),
        admissible=True,
    )
    spec = f"{one.candidate.spec}@group"
    return Evidence(
        candidate=Candidate(spec, load_effect(spec)),
        constants={},
        test=test,
        p_value=test.p_value,
        delta_bic=-gain,
        numbers={name: (float(v), float(e)) for name, v, e in zip(names, one.mean, error, strict=True)},
        spread=dict(zip(names, one.spread.tolist(), strict=True)),
    )
