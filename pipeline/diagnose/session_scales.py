"""Scales of lengths that differ between sessions, fitted beside the candidates: each calibration has its own.

A system that is calibrated anew measures lengths by some tenths of a per cent differently, which looks like a change of
gravity that comes and goes with the session. How sessions differ is fitted beside the candidates, or it would count as
scatter of every effect between episodes; it may be as large as flights show that it is. What sessions have in common is
left to the candidates.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..physics.effects.effect import ActiveEffect
from ..physics.effects.registry import load_effect
from ..physics.world import World
from ..segments.candidates import Variant
from ..segments.linearization import Linearization, linearize, sums
from ..segments.segments import Segments

NAME = "session_scale"
"""Name of the scales among the parameters."""

LEAST_SPREAD = 1e-4
"""Smallest standard deviation between sessions, in that of the prior of a scale: no information is infinite."""

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
    sessions = np.unique(np.asarray(groups)[[item.episode for item in flight.items]])
    counted = [len({item.episode for item in flight.items if groups[item.episode] == one}) for one in sessions]
    if len(sessions) < 2 or min(counted) < 2:  # of one episode, a scale is one more number for its path
        return linearize(flight, world, variants, groups, robust=False)
    effect = copy.copy(load_effect("length_scale"))
    effect.name = NAME  # pyright: ignore[reportAttributeAccessIssue]
    scale = Variant(-1, ActiveEffect.of(effect, {}, world.gravity[0, :1]), {})
    linear = linearize(flight, world, [*variants, scale], groups, robust=False)
    member = (linear.group[:, None] == sessions[None]).astype(np.float64)
    spread = _spread(_with_scales(linear, member, linear.parameters[-1].prior[1]), len(sessions))
    return _with_scales(linear, member[:, 1:] - 1 / len(sessions), spread)


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

    All candidates are fitted beside them: a drag that the model lacks slows the flights of one session more.
    """
    own = [k for k, p in enumerate(linear.parameters) if p.name.partition(".")[0] == NAME]
    width = linear.parameters[own[0]].prior[1]
    prior = np.array([p.prior[1] ** -2.0 for p in linear.parameters])
    information, score = sums(linear, range(len(prior)), prior)
    covariance = np.linalg.inv(information)
    centred = np.eye(count) - 1 / count
    scales = centred @ (covariance @ score)[own]
    errors = centred @ covariance[np.ix_(own, own)] @ centred
    variance = (float(np.square(scales).sum()) - float(np.trace(errors))) / (count - 1)
    return float(np.clip(np.sqrt(max(variance, 0.0)), LEAST_SPREAD * width, width))
