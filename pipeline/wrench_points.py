"""What a model lacks in each piece of the motion, as points of a chart, and which coordinate orders it in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..schemas import Organiser, Phase
from .diagnosis.wrench import ResidualWrenches, organisers, residual_wrenches, wrench_windows
from .physics.world import World
from .short_errors import Cut, ShortErrors, ShortFit

Array = NDArray[np.float64]

LEAST_SHARE = 0.05
"""A coordinate that takes away less of the excess orders nothing."""
LEAST_WINDOWS = 8
"""Of fewer windows of flight, four bins are not told apart."""
SIGNIFICANT = 0.01
KNOWN_STD = 1e3
"""A component with a larger standard error [m/s2, rad/s2] was not measured."""


@dataclass(frozen=True, eq=False)
class WrenchPoint:
    """What is missing in one segment: force over mass and torque over inertia, and where the body was.

    Attributes:
        episode: Of the segment.
        span_s: Its start and end, from the episode's first measured frame [s].
        phase: What the segment's residuals are due to.
        acceleration: Residual acceleration [m/s2] (3,) and angular acceleration [rad/s2] (3,), world frame, shape (6,).
        std: Standard errors, same shape; NaN where nothing was measured.
        coordinates: Of the segment's middle: time [s], x, y, height [m], heading [deg], speed [m/s], spin [rad/s].
    """

    episode: str
    span_s: tuple[float, float]
    phase: Phase
    acceleration: Array
    std: Array
    coordinates: Mapping[str, float]


def wrench_points(
    world: World, fit: ShortFit, cut: Cut, episodes: Sequence[str]
) -> tuple[list[WrenchPoint], list[Organiser]]:
    """Return the residual wrench of every piece, and what orders that of flight; nothing for several free bodies.

    Flights are looked at in half-overlapping windows, contacts in the segments that were fitted. Only those of flight
    are told apart by a coordinate: there the model has no contact law that could be wrong.

    Args:
        world: The model's.
        fit: Its short predictions.
        cut: How the episodes were cut.
        episodes: Their names.
    """
    if len(world.free) != 1:
        return [], []
    flight = wrench_windows(world, fit.whole, cut.flight, cut.noise)
    contact = None if fit.contact is None else residual_wrenches(fit.contact)
    points = [
        point for found in (flight, contact) if found is not None for point in _points(found, fit.errors, episodes)
    ]
    if flight is None or len(flight.segments) < LEAST_WINDOWS:
        return points, []
    ordered = [one for one in organisers(flight) if one.share >= LEAST_SHARE and one.p_value < SIGNIFICANT]
    return points, [Organiser(coordinate=one.coordinate, share=one.share) for one in ordered]


def _points(found: ResidualWrenches, errors: Mapping[str, ShortErrors], episodes: Sequence[str]) -> list[WrenchPoint]:
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    std = np.where(std < KNOWN_STD, std, np.nan)
    points = []
    for k, segment in enumerate(found.segments):
        one = errors[episodes[segment.episode]]
        times = one.time_s - one.time_s[0]
        middle = (segment.first + segment.last) // 2
        if one.cause[middle] < 0:
            continue
        coordinates = {name: float(values[k]) for name, values in found.coordinates.items() if name != "episode"}
        coordinates["time"] -= float(one.time_s[0])
        coordinates["heading"] = float(np.degrees(coordinates["heading"]))
        points.append(
            WrenchPoint(
                one.episode,
                (float(times[segment.first]), float(times[segment.last])),
                one.phase_name(one.cause[middle]),
                found.wrench[k],
                std[k],
                coordinates,
            )
        )
    return points
