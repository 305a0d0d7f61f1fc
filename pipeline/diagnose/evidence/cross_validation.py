"""Cross-validation over episodes: prediction errors with effect parameters estimated from the other episodes.

The state of a segment is fitted to its first frames only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ...physics.parameters import Parameter, effect_parameters
from ...physics.world import World
from ...segments.candidates import base_parameters, base_values, without_effects
from ...segments.segment_fit import linearised
from ...segments.segment_states import fit_states
from ...segments.segments import Segments

KNOWN_SHARE = 0.5
"""Share of a segment's frames that the state is fitted to; the error is measured on the rest."""
ITERATIONS = 3
"""Iterations of that fit, which starts at the state fitted to all frames."""


def held_out_errors(segments: Segments, world: World, effect: str) -> tuple[float, float]:
    """Return the mean prediction error [m] without an effect and with it.

    The parameters of the effect that predict an episode are estimated from the other episodes, by one Gauss-Newton step
    from the estimate of all.

    Args:
        segments: Segments with states fitted by the world.
        world: The world with the effect at its estimate.
        effect: Name of the effect.
    """
    without = without_effects(world, effect)
    parameters = [p for p in effect_parameters(world) if p.name.startswith(f"{effect}.")]
    with_it = segments.in_world(world)
    values = _by_others(with_it, parameters, base_values(world, parameters))
    before = segments.in_world(without)
    return _error(before, [], values.new_zeros(0)), _error(with_it, parameters, values)


def held_out_fall(segments: Segments, world: World, effect: str) -> float:
    """Return the mean fall of an episode's prediction error by an effect, in its standard errors; see above.

    Args:
        segments: Segments with states fitted by the world.
        world: The world with the effect at its estimate.
        effect: Name of the effect.
    """
    parameters = [p for p in effect_parameters(world) if p.name.startswith(f"{effect}.")]
    with_it, before = segments.in_world(world), segments.in_world(without_effects(world, effect))
    values = _by_others(with_it, parameters, base_values(world, parameters))
    fall = _away(before, [], values.new_zeros(0)) - _away(with_it, parameters, values)
    episode = torch.tensor([item.episode for item in segments.items])
    own = torch.stack([fall[episode == one].sum() for one in episode.unique()])
    return float(own.mean() / (own.std() / len(own) ** 0.5).clamp_min(1e-12)) if len(own) > 1 else 0.0


def held_out_loss(segments: Segments, world: World) -> float:
    """Return the mean prediction error of a world, positions plus rotations, in standard deviations of the noise.

    The parameters of all effects that predict an episode are estimated from the other episodes, as in
    `held_out_errors`.

    Args:
        segments: Segments with states fitted by the world.
        world: The world with its effects at their estimates.
    """
    parameters = base_parameters(world, segments.kind)
    at = segments.in_world(world)
    values = _by_others(at, parameters, base_values(world, parameters))
    fitted, late = continued(at, parameters, values)
    away = fitted.residuals(parameters, values, jacobian=False)[0].unflatten(1, (late.shape[1], -1))
    loss = 0.0
    for measured, columns in (
        (segments.observations.seen, slice(0, 3)),
        (segments.observations.has_orientation, slice(3, 6)),
    ):
        weight = measured * late
        loss += float((away[..., columns].norm(dim=-1) * weight).sum() / weight.sum().clamp_min(1.0))
    return loss


def _by_others(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Tensor:
    """Estimate the parameters (B, P) of each segment from the other episodes."""
    linear = linearised(segments, parameters, values)
    prior = torch.diag(torch.tensor([1 / p.prior[1] ** 2 for p in parameters]).to(values))
    episode = torch.tensor([item.episode for item in segments.items])
    bounds = torch.tensor([p.limits for p in parameters]).reshape(-1, 2).to(values)
    found = torch.empty(len(episode), len(parameters)).to(values)
    for number in episode.unique().tolist():
        others = episode != number
        step = torch.linalg.solve(linear.information[others].sum(0) + prior, linear.score[others].sum(0))
        found[~others] = (values + step).clamp(bounds[:, 0], bounds[:, 1])
    return found


def _error(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> float:
    """Return the mean position error [m] of the frames that the states are not fitted to."""
    known = torch.tensor([max(3, round(KNOWN_SHARE * n)) for n in segments.lengths])
    seen = segments.observations.seen
    late = seen * (torch.arange(seen.shape[1]) >= known[:, None])[..., None]
    return float(_away(segments, parameters, values).sum() / late.sum().clamp_min(1.0))


def _away(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Tensor:
    """Return the sum of these errors of each segment (B,) [m]."""
    fitted, late = continued(segments, parameters, values)
    away = (fitted.positions(parameters, values) - segments.observations.position_m).norm(dim=-1)
    return (away * segments.observations.seen * late).sum((1, 2))


def continued(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> tuple[Segments, Tensor]:
    """Fit the states to the first frames, and return the segments and the mask (B, T, 1) of the other frames."""
    observed = segments.observations
    known = torch.tensor([max(3, round(KNOWN_SHARE * n)) for n in segments.lengths])
    early = (torch.arange(observed.times_s.shape[1]) < known[:, None])[..., None].to(observed.seen)
    start = replace(
        segments,
        observations=replace(observed, seen=observed.seen * early, has_orientation=observed.has_orientation * early),
    )
    fitted = fit_states(start, parameters, values, ITERATIONS, search=False)
    return replace(fitted, observations=replace(observed, state=fitted.observations.state)), 1 - early
