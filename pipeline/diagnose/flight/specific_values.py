"""Effects of which each group, or each episode, has values of its own: in a world, and as evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.tails import chi2_tail
from ...physics.effects.effect import Effect
from ...physics.effects.registry import load_effect
from ...physics.parameters import Parameter, effect_parameters
from ...physics.world import World
from ...segments.candidates import Candidate, with_added
from ...segments.segment_fit import refit
from ...segments.segments import Segments
from ..evidence.evidence import Evidence
from ..evidence.score_test import ScoreTest

Array = NDArray[np.float64]


def parameters_of(world: World, name: str) -> list[Parameter]:
    """Return the parameters of an effect in a world, by the name of the effect."""
    return [p for p in effect_parameters(world) if p.name.partition(".")[0] == name]


def with_specific(
    world: World, flight: Segments, spec: str, mean: Array, values: Mapping[str, Array]
) -> tuple[World, Segments]:
    """Return a world with an effect that has specific values, and flights in it.

    Args:
        world: The world without the effect.
        flight: The flights.
        spec: The effect, with `@group` or `@episode`.
        mean: Its parameters (k,), for episodes without values of their own.
        values: Parameters (k,) by name of the episode.
    """
    effect = load_effect(spec)
    names = [parameter.name for parameter in effect.parameters]
    own = dict(world.own_values)
    for episode, mine in values.items():
        numbers = {f"{effect.name}.{name}": float(value) for name, value in zip(names, mine, strict=True)}
        own[episode] = {**own.get(episode, {}), **numbers}
    world = with_added(replace(world, own_values=own), effect, dict(zip(names, mean.tolist(), strict=True)))
    return world, replace(flight, observations=flight.observations.with_own(world)).in_world(world)


def values_of_each(
    effect: Effect, world: World, flight: Segments, units: NDArray[np.int64], start: Mapping[int, Array]
) -> tuple[dict[int, Array], Array]:
    """Return the parameters (k,) of an effect that each unit of flights has, and the chi2 of each flight (B,).

    Args:
        effect: The effect.
        world: The world without it.
        flight: Segments (B) with states fitted by that world.
        units: Group or episode of each flight (B,).
        start: Parameters (k,) of each unit to start from.
    """
    added = with_added(world, effect)
    own = parameters_of(added, effect.name)
    values, cost = {}, np.zeros(len(units))
    for unit, value in start.items():
        mine = np.flatnonzero(units == unit)
        fitted = refit([flight.select(mine.tolist())], added, own, encoded(own, value, flight))
        values[unit] = np.array([fitted.number(parameter.name)[0] for parameter in own])
        cost[mine] = fitted.by_segment[0].numpy()
    return values, cost


def encoded(parameters: Sequence[Parameter], values: Array, flight: Segments) -> Tensor:
    """Return values within the bounds of their parameters."""
    kept = [float(np.clip(value, *p.bounds)) for p, value in zip(parameters, values, strict=True)]
    return flight.dof.new_tensor(kept).double()


def specific_evidence(spec: str, values: Array, statistic: float, delta_bic: float) -> Evidence:
    """Return the evidence of an effect with specific values.

    Args:
        spec: The effect, with `@group` or `@episode`.
        values: Parameters of each group or episode (n, k).
        statistic: Fall of chi2 by all values.
        delta_bic: Change of BIC.
    """
    effect, mean, spread = load_effect(spec), values.mean(0), values.std(0, ddof=1)
    names, error = [p.name for p in effect.parameters], spread / math.sqrt(len(values))
    test = ScoreTest(
        statistic=statistic,
        dof=values.size,
        p_value=chi2_tail(statistic, values.size),
        estimate=mean,
        covariance=np.diag(error**2),
        admissible=True,
    )
    return Evidence(
        candidate=Candidate(spec, effect),
        constants={},
        test=test,
        p_value=test.p_value,
        delta_bic=delta_bic,
        numbers={name: (float(v), float(e)) for name, v, e in zip(names, mean, error, strict=True)},
        spread=dict(zip(names, spread.tolist(), strict=True)),
    )
