"""Where a body's mass is: its centre and second moments, from the motion about first contacts.

A published inertia or the assumption of uniform density may be far off, and every impact turns the body by it.
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
from .first_contacts import fit_first_contacts, sandwich
from .physics.parameters import Parameter, apply_parameters, mass_distribution
from .physics.world import World

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
    start = list(contact)
    for index in world.free:
        added = mass_distribution(world.bodies[index].name, _size_m(world, index))
        values = [float(value) for value in world.bodies[index].com[0]] + [1.0, 1.0, 1.0]
        start += zip(added, values, strict=True)
    solution, windows = fit_first_contacts(world, turning, start, noise)
    first, names = len(contact), [parameter for parameter, _ in start]
    covariance = sandwich(solution)[first:, first:]
    record = {"windows": windows, "costs": solution.costs, "converged": solution.converged}
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


def _size_m(world: World, index: int) -> float:
    """Return the largest distance of a body's surface from its centre of mass [m]."""
    body = world.bodies[index]
    return float(((body.centers[0] - body.com[0]).square().sum(-1).sqrt() + body.radii[0]).max())


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
