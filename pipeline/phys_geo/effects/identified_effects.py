"""Estimates of the effects that a kind of motion identifies, with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...optimization.uncertainty import REACH, correlation_of, few_covariance, inverse, student_reach
from ...physics.effects import ActiveEffect
from ...physics.parameters import Parameter
from ...physics.world import World
from ...segments.first_contact_fit import EffectEstimate, placed
from ...segments.fitted_parameters import fitted_parameter
from ...segments.thresholds import SEGMENT_THRESHOLDS


def at_neutral(world: World, names: Sequence[str]) -> World:
    """Return the world with the named effects neutral; their constants stay."""
    return replace(world, effects=tuple(_neutral(a) if a.effect.name in names else a for a in world.effects))


def identified_effects(
    world: World,
    names: Sequence[str],
    parameters: Sequence[Parameter],
    values: Tensor,
    information: Tensor,
    prior: Tensor,
    units: Tensor,
    score: Tensor,
    excess: float,
    record: dict[str, Any],
    apart: np.ndarray | None = None,
) -> EffectEstimate:
    """Keep the effects of which the data identify at least one parameter.

    Another parameter of such an effect stays near its neutral value, with a wide interval.

    Args:
        world: World with the effects.
        names: Names of the effects.
        parameters: Fitted parameters (P), those of the effects and others.
        values: Estimates in fitted coordinates, shape (P,).
        information: Information on the values without priors, shape (P, P).
        prior: Information of the priors, shape (P,).
        units: Information of each unit, shape (U, P, P): an episode, or an impact. The error of an effect's formula, or
            of the contact law, is common to all frames of one.
        score: Gradient of the log-likelihood of each unit, shape (U, P).
        excess: Ratio of the variance of the residuals to that of the noise.
        record: Course of the fit, for `fit.json`.
        apart: How far each value (P,) is from those of other minima that the data do not tell from this one.
    """
    effect_of = [p.name.partition(".")[0] for p in parameters]
    prior_information = np.diag(prior.numpy())
    covariance = few_covariance(
        information.numpy() / excess + prior_information, score.numpy() / excess, prior_information
    )
    std = np.sqrt(np.diag(covariance))
    known = std < SEGMENT_THRESHOLDS.preparation.unobservable_share * np.array([p.prior[1] for p in parameters])
    few = student_reach(units.numpy() / excess, inverse(information.numpy() / excess + prior_information))
    covariance = covariance * np.outer(few, few)
    if apart is not None:  # an interval holds the other minima, too
        wider = 1 + apart / (REACH * np.sqrt(np.diag(covariance)))
        covariance = covariance * np.outer(wider, wider)
    std = np.sqrt(np.diag(covariance))
    identified = {name for name, yes in zip(effect_of, known, strict=True) if yes and name in names}
    kept = [k for k, name in enumerate(effect_of) if name in identified]
    if not kept:
        return EffectEstimate(world=world, parameters=(), record=record)
    theirs = [parameters[k] for k in kept]
    return EffectEstimate(
        world=placed(world, theirs, values[kept]),
        parameters=tuple(
            fitted_parameter(p, float(values[k]), float(std[k])) for p, k in zip(theirs, kept, strict=True)
        ),
        record=record,
        correlations=(correlation_of([p.name for p in theirs], covariance[np.ix_(kept, kept)]),),
    )


def _neutral(active: ActiveEffect) -> ActiveEffect:
    """Return an effect with neutral parameters and its constants."""
    constants = {c.name: active.values[c.name] for c in active.effect.constants}
    return ActiveEffect.of(active.effect, constants, next(iter(active.values.values())))


def with_constants(world: World, constants: Mapping[str, float]) -> World:
    """Return the world with constants of its effects, `effect.constant` by name."""
    effects = []
    for active in world.effects:
        given = {c.name: constants.get(f"{active.effect.name}.{c.name}") for c in active.effect.constants}
        chosen = {name: value for name, value in given.items() if value is not None}
        like = next(iter(active.values.values()), torch.zeros(1))
        effects.append(ActiveEffect.of(active.effect, active.values | chosen, like))
    return replace(world, effects=tuple(effects))
