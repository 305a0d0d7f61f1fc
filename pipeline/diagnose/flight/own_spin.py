"""A lift of each episode's own: every throw has another spin, and nobody has measured it.

A spin that lasts for a flight lifts the body by q x u, so that the first half of a flight tells q, and q tells the
second half. A tilt or a gust of each episode's own would be a constant force there, and an effect in no library follows
neither: the lift is named where it predicts second halves better than no force and than a constant one in nearly all
episodes. Halves are predicted from their own start, under the noise of neighbouring frames alone: slow errors,
estimated before the lift is known, would hold it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.tails import student_tail
from ...physics.effects.effect import ActiveEffect
from ...physics.effects.registry import load_effect
from ...physics.parameters import Parameter
from ...physics.world import World
from ...segments.candidates import Candidate, base_parameters, with_added, without_effects
from ...segments.prepare import Prepared, whole_flights
from ...segments.segment_fit import linearised, refit
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ...trajectories.innovations import WHITE
from ..evidence.cross_validation import ITERATIONS, KNOWN_SHARE, continued
from ..evidence.effect_selection import SelectionStep
from ..thresholds import THRESHOLDS
from .specific_values import parameters_of, specific_evidence, with_specific

LIMITS = THRESHOLDS.verdict

SPIN_LIFT, RIVAL = "spin_lift", "constant_force"
"""The lift, and what a tilt, a gust or a slow error of each episode would be instead."""

Array = NDArray[np.float64]


def with_own_spins(
    prepared: Prepared, steps: list[SelectionStep], world: World, flight: Segments, candidates: Sequence[Candidate]
) -> tuple[list[SelectionStep], World, Segments]:
    """Select a lift of each episode's own, in place of a common one and of tilts, where flights ask for it.

    Args:
        prepared: The episodes.
        steps: The selection steps.
        world: The world with the selected effects.
        flight: Segments with states fitted by it.
        candidates: All candidates.
    """
    if not _untold(prepared, world, flight, candidates):
        return steps, world, flight
    mistaken = [step.best.name for step in steps if step.flagged and not _acts_along(step.best.candidate)]
    bare = without_effects(world, *mistaken)
    whole = prepared.segments("flight", bare, whole_flights(flight.items))
    whole = fit_states(replace(whole, noise_model=WHITE, observations=replace(whole.observations, time_shift=None)))
    if not predicts(whole, bare):
        return steps, world, flight
    lifts, gain = _by_flights(whole, SPIN_LIFT)
    if follows_heading(whole, lifts):
        return steps, world, flight
    spec, every = f"{SPIN_LIFT}@episode", np.array(list(lifts.values()))
    evidence = specific_evidence(spec, every, gain, -gain)
    step = SelectionStep((evidence,), (evidence,), True, own_std=float(np.sqrt(np.mean(every.var(0, ddof=1)))))
    named = {prepared.names[episode]: lift for episode, lift in lifts.items()}
    lifted, moved = with_specific(bare, flight, spec, every.mean(0), named)
    fitted = refit([fit_states(moved)], lifted, base_parameters(lifted, "flight"))
    kept = [step for step in steps if step.flagged and step.best.name not in mistaken]
    return [*kept, step], fitted.world, fitted.segments[0]


def _untold(prepared: Prepared, world: World, flight: Segments, candidates: Sequence[Candidate]) -> bool:
    """Return whether a spin can be what episodes have of their own: it was not measured, and one body flies."""
    measured = prepared.has_orientation or flight.observations.spin_rad_s is not None
    there = any(active.effect.name == SPIN_LIFT and _has_own(active) for active in world.effects)
    return not measured and not there and len(world.free) == 1 and any(one.spec == SPIN_LIFT for one in candidates)


def _has_own(active: ActiveEffect) -> bool:
    """Return whether an effect has a value for each episode or group."""
    return any(parameter.shared != "all" for parameter in active.effect.parameters)


def _acts_along(candidate: Candidate) -> bool:
    """Return whether an effect is a drag, which no lift can be taken for."""
    return "drag" in candidate.effect.provides


def predicts(whole: Segments, world: World) -> bool:
    """Return whether a lift of each flight's own predicts second halves better than no force and a constant one.

    Args:
        whole: Whole flights with states fitted by the world, under white noise.
        world: The world without a lift.
    """
    episode = np.array([item.episode for item in whole.items])
    if len(np.unique(episode)) < LIMITS.own_spins:
        return False
    away = {
        name: _by_episode(_second_halves(whole.in_world(_with(world, name)), name), episode)
        for name in ("", RIVAL, SPIN_LIFT)
    }
    lift = away.pop(SPIN_LIFT)
    gains = [np.log(other / lift) for other in away.values()]
    return all(_beyond_chance(gain, math.log(LIMITS.own_spin_gain)) for gain in gains)


def follows_heading(whole: Segments, values: Mapping[int, Array]) -> bool:
    """Return whether lifts have one part along the heading in all episodes, as a force by place or time makes them.

    Along a throw, q_z lifts sideways with a constant force, and q along the heading with one that grows as the body
    falls: a force that grows on the way, as in a vortex, needs the latter in every throw.

    Args:
        whole: Whole flights.
        values: Lifts (3,) by episode.
    """
    up = -whole.world.gravity[0].numpy()
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    parts = []
    for episode, lift in values.items():
        way = np.sum([_way(whole, k) for k, item in enumerate(whole.items) if item.episode == episode], axis=0)
        level = way - (way @ up) * up
        parts.append(float(lift @ level) / max(float(np.linalg.norm(level)), 1e-12))
    mean, error = float(np.mean(parts)), float(np.std(parts, ddof=1)) / math.sqrt(len(parts))
    return student_tail(abs(mean) / max(error, 1e-12), len(parts) - 1) < LIMITS.repeated_p


def _way(whole: Segments, k: int) -> Array:
    """Return the displacement (3,) [m] between the first and the last measured frame of a flight."""
    seen = torch.nonzero(whole.observations.seen[k, :, 0])[:, 0]
    place = whole.observations.position_m[k, :, 0]
    return (place[seen[-1]] - place[seen[0]]).numpy()


def _beyond_chance(gain: Array, least: float) -> bool:
    """Return whether episodes gain at least so much on average, and something beyond chance (Student's t)."""
    error = float(gain.std(ddof=1)) / math.sqrt(len(gain))
    mean = float(gain.mean())
    return mean > least and student_tail(mean / max(error, 1e-12), len(gain) - 1) < LIMITS.repeated_p


def _by_episode(away: Tensor, episode: NDArray[np.int64]) -> Array:
    """Return the mean over the flights of each episode."""
    return np.array([float(away[torch.as_tensor(episode == one)].mean()) for one in np.unique(episode)])


def _second_halves(whole: Segments, name: str) -> Tensor:
    """Return the root mean square error [m] of each second half (B,), from a state and a force fitted to the first."""
    seen = whole.observations
    known = torch.tensor([max(3, round(KNOWN_SHARE * n)) for n in whole.lengths])
    early = (torch.arange(seen.times_s.shape[1]) < known[:, None])[..., None].to(seen.seen)
    first = replace(whole, observations=replace(seen, seen=seen.seen * early))
    parameters = parameters_of(whole.world, name)
    values = _estimated(first, parameters)[0] if parameters else seen.times_s.new_zeros(len(known), 0)
    fitted, late = continued(whole, parameters, values)
    away = (fitted.positions(parameters, values) - seen.position_m).square().sum(-1)
    weight = seen.seen * late
    return ((away * weight).sum((1, 2)) / weight.sum((1, 2)).clamp_min(1.0)).sqrt()


def _estimated(segments: Segments, parameters: Sequence[Parameter]) -> tuple[Tensor, Tensor, Segments]:
    """Return the parameters (B, P) of each flight, their information (B, P, P), and the flights with their states."""
    prior = torch.diag(torch.tensor([1 / p.prior[1] ** 2 for p in parameters]).to(segments.dof))
    values = segments.dof.new_zeros(len(segments.items), len(parameters))
    information = values[..., None].expand(-1, -1, len(parameters))
    bounds = torch.tensor([p.limits for p in parameters]).to(values)
    for _ in range(ITERATIONS):
        linear = linearised(segments, parameters, values)
        information = linear.information + prior
        step = torch.linalg.solve(information, linear.score - values @ prior)
        values = (values + step).clamp(bounds[:, 0], bounds[:, 1])
        segments = fit_states(segments, parameters, values, search=False)
    return values, information, segments


def _by_flights(whole: Segments, name: str) -> tuple[dict[int, Array], float]:
    """Return the likeliest parameters (k,) of an effect in each episode, by its flights, and the fall of chi2."""
    inside = whole.in_world(_with(whole.world, name))
    parameters = parameters_of(inside.world, name)
    before = inside.residuals([], inside.world.gravity.new_zeros(0), jacobian=False)[0].square().sum((1, 2))
    values, information, fitted = _estimated(inside, parameters)
    after = fitted.residuals(parameters, values, jacobian=False)[0].square().sum((1, 2))
    episode = np.array([item.episode for item in whole.items])
    decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(parameters)], 1)
    found = {}
    for one in np.unique(episode).tolist():
        mine = torch.as_tensor(episode == one)
        weighted = (information[mine] @ decoded[mine, :, None]).sum(0)
        found[one] = torch.linalg.solve(information[mine].sum(0), weighted)[:, 0].numpy()
    return found, float((before - after).sum())


def _with(world: World, name: str) -> World:
    """Return a world with an effect at neutral; itself for an empty name."""
    return with_added(world, load_effect(name)) if name else world
