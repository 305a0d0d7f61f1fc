"""Effects in flight that each group of episodes (a session, a ball) has with a value of its own.

Groups share no parameter of such an effect, so that each is fitted to the flights of one group, beside the effects that
are common to all. It is named where it explains the flights better than the same effect with one value, by the odds of
BIC, and, where each group has several episodes, predicts each from the others of its group.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import student_tail
from ...physics.effects.registry import FLIGHT_ALIASES
from ...physics.parameters import effect_parameters
from ...physics.world import World
from ...segments.candidates import (
    Candidate,
    Variant,
    admissible,
    base_parameters,
    variants_of,
    with_added,
    without_effects,
)
from ...segments.linearization import Linearization, linearize
from ...segments.prepare import Prepared
from ...segments.segment_fit import refit
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ..evidence.effect_selection import SelectionStep
from ..evidence.evidence import Evidence, prior_odds
from ..evidence.score_test import canonical_correlation, solved
from ..thresholds import THRESHOLDS
from .specific_values import encoded, parameters_of, specific_evidence, values_of_each, with_specific

LIMITS = THRESHOLDS.flight

Array = NDArray[np.float64]

ZERO = 1e-6
"""Usual sizes below which a value is at its limit of zero."""


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
    """Chi2 of all flights, in units of the scatter, with BIC's penalty for its parameters and for implausible ones."""
    alone: float
    """The same with one value for all groups."""
    by_flight: Array
    """Chi2 of each flight (B,)."""
    twins: tuple[tuple[Candidate, dict[int, Array]], ...] = ()
    """Effects that do the same in flight, with parameters (k,) by group."""
    beside: int = 0
    """Number of parameters of the other selected effects."""

    @property
    def place(self) -> _Place:
        """The place in which it is."""
        return _Place(replaces=self.replaces, world=self.world, flight=self.flight, beside=self.beside)

    @property
    def mean(self) -> Array:
        """Mean of the parameters over groups."""
        return np.mean(list(self.values.values()), axis=0)

    @property
    def spread(self) -> Array:
        """Standard deviation of the parameters between groups."""
        return np.std(list(self.values.values()), axis=0, ddof=1)


@dataclass(frozen=True, kw_only=True)
class _Search:
    """What all fits of effects with a value in each group share."""

    prepared: Prepared
    """The episodes."""
    candidates: Sequence[Candidate]
    """All candidates."""
    groups: NDArray[np.int64]
    """Group (B,) of each flight."""
    scatter: float
    """Factor by which variances exceed those of the noise."""
    penalty: float
    """BIC's penalty of one parameter."""


@dataclass(frozen=True, kw_only=True)
class _Place:
    """A place for an effect with a value in each group."""

    replaces: str | None
    """The selected effect whose place it is; None for one beside all of them."""
    world: World
    """The world with the other selected effects."""
    flight: Segments
    """Flights with states fitted by that world."""
    beside: int
    """Number of parameters of the other selected effects."""


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
    penalty = math.log(max(float(flight.dof.sum()), 2.0))
    search = _Search(prepared=prepared, candidates=candidates, groups=groups, scatter=scatter, penalty=penalty)
    sizes = {
        step.best.name: len(step.best.candidate.effect.parameters)
        for step in steps
        if step.flagged and step.own_std is None
    }
    before = refit([flight], world, []).cost / scatter + penalty * sum(sizes.values())
    fits = [one for place in _places(world, flight, sizes) for one in _fits(search, place)]
    equals = _likeliest([one for one in fits if in_several(one.candidate, one.values)], before)
    equals = [*_with_twins(search, equals[0]), *equals[1:]] if equals else []
    if not 0 < len(equals) <= LIMITS.most_equals:
        return steps, world, flight
    best = min(equals, key=lambda one: one.cost)
    equals = [best, *(one for one in equals if one is not best)]
    evidence = tuple(_evidence(one, before - best.cost - (one.cost - best.cost), penalty) for one in equals)
    step = SelectionStep(evidence, evidence, True, own_std=float(best.spread[0]))
    kept = [one for one in steps if one.flagged and one.best.name != best.replaces]
    return [*kept, step], *_placed(prepared, best, groups)


def _likeliest(found: Sequence[_Fitted], before: float) -> list[_Fitted]:
    """Return the likeliest effect and those that flights do not tell from it; none where it explains too little.

    Args:
        found: The effects.
        before: The cost with the selected effects alone.
    """
    best = min(found, key=lambda one: one.cost, default=None)
    if best is None or best.cost - min(before, best.alone) > LIMITS.slight_bic:
        return []
    helping = sorted((one for one in found if one is not best and one.cost < before), key=lambda one: one.cost)
    return [best, *(one for one in helping if _unproven(best, one))]


def in_several(candidate: Candidate, values: Mapping[int, Array]) -> bool:
    """Return whether more than one group has an effect.

    What cannot be negative and is zero in all groups but one, as a drag, is no law: one group shows what looks like it.

    Args:
        candidate: The effect.
        values: Its parameters (k,) by group.
    """
    least = np.array([ZERO * parameter.scale for parameter in candidate.effect.parameters])
    return sum(bool((np.abs(one) > least).any()) for one in values.values()) > 1


def _with_twins(search: _Search, one: _Fitted) -> list[_Fitted]:
    """Return an effect and those that do the same in flight, refitted."""
    return [one, *(_fitted(search, one.place, candidate, values) for candidate, values in one.twins)]


def _places(world: World, flight: Segments, sizes: Mapping[str, int]) -> Iterator[_Place]:
    """Yield the place beside all selected effects, and that of each through which no other one acts.

    Args:
        world: The world with the selected effects.
        flight: Flights with states fitted by it.
        sizes: Number of parameters of each selected effect, by name.
    """
    yield _Place(replaces=None, world=world, flight=flight, beside=sum(sizes.values()))
    for name in sizes:
        bare = without_effects(world, name)
        if len(bare.effects) == len(world.effects) - 1:
            beside = sum(sizes.values()) - sizes[name]
            yield _Place(replaces=name, world=bare, flight=fit_states(flight.in_world(bare)), beside=beside)


def _unproven(best: _Fitted, other: _Fitted) -> bool:
    """Return whether another effect in the same place is not worse in most episodes: a paired t-test, as for one value.

    Args:
        best: The likeliest effect.
        other: The other one.
    """
    if other.replaces != best.replaces:
        return False
    if other.cost - best.cost < LIMITS.alias_chi2:
        return True
    episode = np.array([item.episode for item in best.flight.items])
    worse = np.array([(other.by_flight - best.by_flight)[episode == one].sum() for one in np.unique(episode)])
    return float(worse.mean()) <= LIMITS.paired_t * float(worse.std(ddof=1)) / math.sqrt(len(worse))


def _groups(prepared: Prepared, flight: Segments) -> NDArray[np.int64]:
    """Return the group (B,) of each flight."""
    return np.array([prepared.groups[item.episode] for item in flight.items])


def _fits(search: _Search, place: _Place) -> list[_Fitted]:
    """Return the likeliest effects with a value in each group in a place, refitted."""
    world, flight = place.world, place.flight
    spun = flight.observations.spin_rad_s is not None
    kept, _ = admissible(world, search.candidates, search.prepared.has_orientation, spun)
    present = {active.effect.name for active in world.effects}
    kept = [candidate for candidate in kept if _suits(candidate) and not _alike(candidate, present)]
    variants = variants_of(kept, world.gravity[0, :1])
    if not variants:
        return []
    linear = linearize(flight, world, variants, search.prepared.groups, robust=False)
    scored = [one for variant in variants if (one := _scored(search, linear, variant)) is not None]
    scored.sort(key=lambda one: (-one.gain, one.variant.place))
    found = []
    for one, twins in _unlike(linear, scored)[: LIMITS.own_shortlist]:
        fitted = _fitted(search, place, kept[one.variant.place], one.values)
        found.append(replace(fitted, twins=tuple((kept[twin.variant.place], twin.values) for twin in twins)))
    return found


@dataclass(frozen=True, kw_only=True)
class _Scored:
    """An effect with a value in each group, estimated by one step from neutral."""

    gain: float
    """Fall of chi2 in units of the scatter, less BIC's penalty for the parameters."""
    variant: Variant
    """The effect with its constants."""
    values: dict[int, Array]
    """Parameters (k,) by group."""


def _scored(search: _Search, linear: Linearization, variant: Variant) -> _Scored | None:
    """Return an effect with a value in each group; None where that explains or predicts too little."""
    columns = linear.columns(variant.parameters)
    by_group = {one: _solved(linear, columns, search.groups == one) for one in np.unique(search.groups).tolist()}
    gain = sum(fall for _, fall in by_group.values()) / search.scatter - search.penalty * len(columns) * len(by_group)
    if gain <= 0 or not _predicts(linear, columns, search.groups):
        return None
    return _Scored(gain=gain, variant=variant, values={one: value for one, (value, _) in by_group.items()})


def _fitted(search: _Search, place: _Place, candidate: Candidate, start: dict[int, Array]) -> _Fitted:
    """Return an effect refitted to the flights of each group, and to all of them."""
    values, by_flight, alone = _refitted(candidate, place.world, place.flight, search.groups, start)
    beside, own = search.penalty * place.beside, search.penalty * len(candidate.effect.parameters)
    names = [p.name for p in candidate.effect.parameters]
    odds = sum(prior_odds(candidate.effect, dict(zip(names, v.tolist(), strict=True))) for v in values.values())
    return _Fitted(
        candidate=candidate,
        replaces=place.replaces,
        world=place.world,
        flight=place.flight,
        values=values,
        cost=float(by_flight.sum()) / search.scatter + beside + own * len(values) + odds,
        by_flight=by_flight,
        alone=alone / search.scatter + beside + own,
        beside=place.beside,
    )


def _unlike(linear: Linearization, scored: Sequence[_Scored]) -> list[tuple[_Scored, list[_Scored]]]:
    """Return the effects, each with those after it that do the same with as many parameters."""
    found: list[tuple[_Scored, list[_Scored]]] = []
    for one in scored:
        mine = linear.columns(one.variant.parameters)
        for other, twins in found:
            columns = linear.columns(other.variant.parameters)
            if canonical_correlation(linear, mine, columns) >= LIMITS.contained:
                if len(columns) == len(mine):
                    twins.append(one)
                break
        else:
            found.append((one, []))
    return found


def _suits(candidate: Candidate) -> bool:
    """Return whether an effect can have a value in each group."""
    effect = candidate.effect
    few = 0 < len(effect.parameters) <= LIMITS.own_parameters
    return few and not effect.constants and "drag" not in effect.needs and effect.phase != "contact"


def _alike(candidate: Candidate, present: set[str]) -> bool:
    """Return whether flights do not tell an effect from one that has one value for all: groups say the same again."""
    return any(candidate.effect.name in group and present & set(group) for group in FLIGHT_ALIASES)


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
    added = with_added(world, candidate.effect)
    own = parameters_of(added, candidate.effect.name)
    alone = refit([flight], added, own, encoded(own, np.mean(list(start.values()), axis=0), flight))
    return *values_of_each(candidate.effect, world, flight, groups, start), alone.cost


def _placed(prepared: Prepared, best: _Fitted, groups: NDArray[np.int64]) -> tuple[World, Segments]:
    """Return the world with the values of the groups, its other effects fitted again, and the flights in it."""
    own = {
        episode: best.values[group]
        for episode, group in zip(prepared.names, prepared.groups, strict=True)
        if group in best.values
    }
    world, flight = with_specific(best.world, best.flight, f"{best.candidate.spec}@group", best.mean, own)
    found = refit([flight], world, base_parameters(world, "flight"))
    return found.world, found.segments[0]


def _evidence(one: _Fitted, gain: float, count: float) -> Evidence:
    """Return the evidence of an effect with a value in each group."""
    values = np.array(list(one.values.values()))
    return specific_evidence(f"{one.candidate.spec}@group", values, gain + count * values.size, -gain)
