"""Where a body's mass is: its centre and second moments, from the motion about first contacts.

A published inertia or the assumption of uniform density may be far off, and every impact turns the body by it.
Open-loop errors over many impacts are rough in these numbers; over the short windows about first contacts, whose states
at the start are fitted too, they are smooth, and exact derivatives find them in a few steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..datasets.tracks import Track
from ..schemas import InputDataError
from ..schemas import Parameter as FittedParameter
from .estimation.least_squares import Solution, minimise
from .estimation.observations import Observations
from .estimation.trajectory import STATE_SIZE, TrajectoryResiduals, state_prior
from .estimation.warmup import flight_frames
from .physics.parameters import Parameter, apply_parameters, mass_distribution
from .physics.world import World

Array = np.ndarray[Any, np.dtype[np.float64]]

LEAD_FRAMES = 6
"""Frames of flight before the first contact in a window: they give the velocities with which it begins."""
AFTER_S = 0.1
"""How long a window goes on after the first contact: about one tumble of a thrown body."""
MODEL_ERROR = (0.0005, 0.01)
"""What a rigid body and this contact law miss in such a window (position [m], rotation [rad]) beside the tracks' noise.
Only their ratio matters much; the residuals are weighed robustly, and the intervals come from the episodes' scatter."""
ROBUST_SCALE = 3.0
MAX_WINDOWS = 100
"""So many give the second moments within 2 %."""
ITERATIONS = 16
LEAST_EPISODES = 8
"""Fewer cannot tell where the mass is from how the body happens to bounce."""


@dataclass(frozen=True)
class MassDistribution:
    """What was found: the world with it, the parameters for `model.json`, and how the fit went for `fit.json`."""

    world: World
    parameters: tuple[FittedParameter, ...]
    record: dict[str, Any]


def fit_mass_distribution(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    contact: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
) -> MassDistribution:
    """Fit centre of mass and second moments of every free body, the contact's numbers beside them.

    Args:
        world: The world; its centres and inertias are the start.
        episodes: Name and tracks by body of each training episode.
        contact: The contact's numbers that are fitted along, with their start; found again later, open loop.
        noise: Of the tracks (position [m], rotation [rad]).

    Raises:
        InputDataError: If there are too few episodes, or an orientation was not measured.
        NotConvergedError: If the rollouts diverge at the start.
    """
    turning = [e for e in episodes if all(_turns(e[1].get(world.bodies[i].name)) for i in world.free)]
    if len(turning) < LEAST_EPISODES:
        raise InputDataError(
            f"{len(turning)} of {len(episodes)} episodes have orientations of all free bodies.",
            f"{LEAST_EPISODES} or more, to find where the mass is.",
            "record more, or leave phys-geo.mass_distribution at false.",
        )
    observations = _windows(world, turning)
    names = [parameter for parameter, _ in contact]
    start = [parameter.encode(value) for parameter, value in contact]
    for index in world.free:
        added = mass_distribution(world.bodies[index].name, _size_m(world, index))
        names += added
        start += [float(value) for value in world.bodies[index].com[0]] + [0.0, 0.0, 0.0]
    std = [float(np.hypot(error, sigma)) for error, sigma in zip(MODEL_ERROR, noise, strict=True)]
    solution = minimise(
        TrajectoryResiduals(world, names, observations, *std),
        torch.tensor(start).to(world.gravity),
        torch.zeros(len(observations.names), STATE_SIZE * len(observations.free)).to(world.gravity),
        torch.tensor([parameter.limits for parameter in names]).to(world.gravity),
        robust_scale=ROBUST_SCALE,
        iterations=ITERATIONS,
        prior_information=state_prior(len(observations.free)),
    )
    first = len(contact)
    covariance = _sandwich(solution)[first:, first:]
    record = {"windows": len(observations.names), "costs": solution.costs, "converged": solution.converged}
    return MassDistribution(
        _placed(world, names[first:], solution.shared[first:]),
        tuple(
            _parameter(p, float(z), float(s))
            for p, z, s in zip(names[first:], solution.shared[first:], np.sqrt(np.diag(covariance)), strict=True)
        ),
        record,
    )


def _turns(track: Track | None) -> bool:
    return track is not None and track.quat_wxyz is not None


def _windows(world: World, episodes: Sequence[tuple[str, dict[str, Track]]]) -> Observations:
    """Return a window about the first contact of each episode, of at most `MAX_WINDOWS` evenly spread ones."""
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_WINDOWS)).round().astype(int)
    picked = [episodes[i] for i in chosen]
    whole = Observations.of(world, picked, [(-np.inf, np.inf)] * len(picked))
    flying = flight_frames(world, whole).sum(1)
    windows = []
    for times, count in zip(whole.times_s, flying.tolist(), strict=True):
        first, contact = times[max(0, count - LEAD_FRAMES)], times[min(count, len(times) - 1)]
        windows.append((float(first) - 1e-9, float(contact) + AFTER_S))
    return Observations.of(world, picked, windows)


def _size_m(world: World, index: int) -> float:
    """Return the largest distance of a body's surface from its centre of mass [m]."""
    body = world.bodies[index]
    return float(((body.centers[0] - body.com[0]).square().sum(-1).sqrt() + body.radii[0]).max())


def _sandwich(solution: Solution) -> Array:
    """Return the covariance (P, P) from the scatter of the episodes' gradients (Huber 1967)."""
    information = solution.information.numpy()
    scale = np.sqrt(np.diag(information).clip(1e-300))
    inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    scores = solution.scores.numpy()
    return inverse @ (scores.T @ scores) @ inverse


def _placed(world: World, names: Sequence[Parameter], coordinates: Tensor) -> World:
    values = torch.stack([p.decode(z) for p, z in zip(names, coordinates, strict=True)])[None]
    moved = apply_parameters(world, names, values)
    bodies = [replace(b, com=b.com.clone(), inertia=b.inertia.clone()) for b in moved.bodies]
    return replace(world, bodies=tuple(bodies))


def _parameter(parameter: Parameter, coordinate: float, std: float) -> FittedParameter:
    low, high = parameter.limits
    estimate, *interval = (
        float(parameter.decode(torch.tensor(min(max(z, low), high), dtype=torch.float64)))
        for z in (coordinate, coordinate - 1.96 * std, coordinate + 1.96 * std)
    )
    on_bound = min(coordinate - low, high - coordinate) < 1e-6 * (high - low)
    factor = "factor of the second moment of mass given or derived before; " if parameter.unit == "1" else ""
    return FittedParameter(
        name=parameter.name,
        unit=parameter.unit,
        estimate=estimate,
        std_error=std * (estimate if parameter.logarithmic else 1.0),
        interval_95=(interval[0], interval[1]),
        bounds=parameter.bounds,
        state="on_bound" if on_bound else "fitted",
        note=f"{factor}{parameter.reveals} would reveal it",
    )
