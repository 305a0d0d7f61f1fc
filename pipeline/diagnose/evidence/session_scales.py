"""Scales of lengths that differ between sessions, fitted beside the candidates: each calibration has its own.

A system that is calibrated anew measures lengths by some tenths of a per cent differently, which looks like a change of
gravity that comes and goes with the session. How sessions differ is fitted beside the candidates, or it would count as
scatter of every effect between episodes; it may be as large as flights show that it is, beside what is usual: the two
sessions of a recording tell hardly how far sessions scatter. What sessions have in common is left to the candidates.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...physics.effects.effect import ActiveEffect
from ...physics.effects.registry import load_effect
from ...physics.world import World
from ...segments.candidates import Variant
from ...segments.linearization import Linearization, linearize, sums
from ...segments.segments import Segments
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

NAME = "session_scale"
"""Name of the scales among the parameters."""

Array = NDArray[np.float64]


def linearize_beside_scales(
    flight: Segments, world: World, variants: Sequence[Variant], groups: Sequence[int]
) -> Linearization:
    """Return the linearization of flights, with the differences between the scales of sessions as base parameters.

    Args:
        flight: Flights with fitted states.
        world: The model's world.
        variants: The candidates.
        groups: Session of each episode.
    """
    member = members(flight, groups)
    if member is None:
        return linearize(flight, world, variants, groups, robust=False)
    linear = linearize(flight, world, [*variants, scale_variant(world)], groups, robust=False)
    spread = _spread(_with_scales(linear, member, linear.parameters[-1].prior[1]), member.shape[1])
    return _with_scales(linear, apart(member), spread)


def members(flight: Segments, groups: Sequence[int]) -> Array | None:
    """Return which of n sessions each flight belongs to, (B, n); None where their scales cannot be told apart.

    Of one episode, a scale is one more number for its path.
    """
    own = np.asarray(groups)[[item.episode for item in flight.items]]
    sessions = np.unique(own)
    counted = [len({item.episode for item in flight.items if groups[item.episode] == one}) for one in sessions]
    if len(sessions) < 2 or min(counted) < 2:
        return None
    return (own[:, None] == sessions[None]).astype(np.float64)


def apart(member: Array) -> Array:
    """Return what a flight has of each number by which sessions differ, (B, n - 1), from its session (B, n)."""
    return member[:, 1:] - 1 / member.shape[1]


def scale_variant(world: World) -> Variant:
    """Return the scale of lengths as a candidate under the name of the sessions' scales."""
    effect = copy.copy(load_effect("length_scale"))
    effect.name = NAME  # pyright: ignore[reportAttributeAccessIssue]
    return Variant(-1, ActiveEffect.of(effect, {}, world.gravity[0, :1]), {})


def scale_spread(linear: Linearization) -> float | None:
    """Return the standard deviation between the scales of sessions of a linearization; None without these."""
    return next((p.prior[1] for p in linear.parameters if p.name.partition(".")[0] == NAME), None)


def _with_scales(linear: Linearization, member: Array, width: float) -> Linearization:
    """Return a linearization with scales in place of its last parameter, the scale that all have in common.

    Args:
        linear: Linearization of segments (B).
        member: What a segment has of each scale, (B, n).
        width: Standard deviation of the prior of each.
    """
    count, base, added = len(linear.parameters) - 1, linear.base, member.shape[1]
    change = np.zeros((len(member), added + count, count + 1))
    change[:, [*range(base), *range(base + added, added + count)], range(count)] = 1.0
    change[:, base : base + added, count] = member
    scales = tuple(replace(linear.parameters[-1], name=f"{NAME}.s{k}", prior=(0.0, width)) for k in range(added))
    prior = np.full(added, width**-2.0)
    return replace(
        linear,
        parameters=(*linear.parameters[:base], *scales, *linear.parameters[base:-1]),
        base=base + added,
        information=change @ linear.information @ change.swapaxes(1, 2),
        score=(change @ linear.score[..., None])[..., 0],
        prior=np.concatenate((linear.prior[:base], prior, linear.prior[base:-1])),
    )


def _spread(linear: Linearization, count: int) -> float:
    """Return the standard deviation between the scales of sessions, beyond the errors of their differences.

    The usual one counts for some degrees of freedom beside it, as in `falsification`. All candidates are fitted beside
    them: a drag that the model lacks slows the flights of one session more.
    """
    own = [k for k, p in enumerate(linear.parameters) if p.name.partition(".")[0] == NAME]
    width = linear.parameters[own[0]].prior[1]
    prior = np.array([p.prior[1] ** -2.0 for p in linear.parameters])
    information, score = sums(linear, range(len(prior)), prior)
    covariance = np.linalg.inv(information)
    centred = np.eye(count) - 1 / count
    scales = centred @ (covariance @ score)[own]
    errors = centred @ covariance[np.ix_(own, own)] @ centred
    found = max(float(np.square(scales).sum()) - float(np.trace(errors)), 0.0)
    counts = LIMITS.model_counts
    return min(math.sqrt((counts * LIMITS.usual_scale**2 + found) / (counts + count - 1)), width)
