"""What a kind of motion shows of effects: the numbers that it tells, with intervals, and no others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from .first_contacts import UNOBSERVABLE_SHARE, FirstContacts, correlation_of, described, few_covariance, placed
from .physics.effects import ActiveEffect
from .physics.parameters import Parameter
from .physics.world import World


def at_nothing(world: World, names: Sequence[str]) -> World:
    """Return the world with some of its effects at nothing, at their own constants."""
    return replace(world, effects=tuple(_neutral(a) if a.effect.name in names else a for a in world.effects))


def shown_effects(
    world: World,
    names: Sequence[str],
    parameters: Sequence[Parameter],
    values: Tensor,
    information: Tensor,
    prior: Tensor,
    score: Tensor,
    excess: float,
    record: dict[str, Any],
) -> FirstContacts:
    """Return what was found of the effects of which the data show at least a number.

    Another number of such an effect stands near nothing, and its interval is wide.

    Args:
        world: With the effects.
        names: Of the effects.
        parameters: What was fitted (P), theirs and others.
        values: In fitted coordinates (P,).
        information: On the values (P, P), without priors.
        prior: Information of these (P,).
        score: Of each piece of motion (B, P), with a start of its own: what a formula misses is missed all through it.
        excess: By what factor the variance of residuals exceeds that of the noise.
        record: For `fit.json`.
    """
    whose = [p.name.partition(".")[0] for p in parameters]
    held = np.diag(prior.numpy())
    covariance = few_covariance(information.numpy() / excess + held, score.numpy() / excess, held)
    std = np.sqrt(np.diag(covariance))
    known = std < UNOBSERVABLE_SHARE * np.array([p.prior[1] for p in parameters])
    shown = {name for name, yes in zip(whose, known, strict=True) if yes and name in names}
    own = [k for k, name in enumerate(whose) if name in shown]
    if not own:
        return FirstContacts(world, (), record)
    mine = [parameters[k] for k in own]
    return FirstContacts(
        placed(world, mine, values[own]),
        tuple(described(p, float(values[k]), float(std[k])) for p, k in zip(mine, own, strict=True)),
        record,
        (correlation_of([p.name for p in mine], covariance[np.ix_(own, own)]),),
    )


def _neutral(active: ActiveEffect) -> ActiveEffect:
    constants = {c.name: active.values[c.name] for c in active.effect.constants}
    return ActiveEffect.of(active.effect, constants, next(iter(active.values.values())))
