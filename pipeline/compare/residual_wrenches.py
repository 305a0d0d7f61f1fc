"""What a model lacks in each piece of the motion, as points of a chart, and which coordinate orders it in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..schemas import Organiser, Phase
from .diagnosis.cuts import Segment
from .diagnosis.prepared import Prepared
from .diagnosis.wrench import coordinates_of, organisers, wrench_windows
from .physics.world import World
from .short_errors import ShortErrors, ShortFit

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
    """One piece of the motion: how badly it is fitted, what is missing in it, and where the body was.

    Attributes:
        episode: Of the piece.
        span_s: Its start and end, from the episode's first measured frame [s].
        phase: What its residuals are due to.
        misfit: Root of the reduced chi-square of its short prediction, in units of the noise.
        acceleration: Residual acceleration [m/s2] (3,) and angular acceleration [rad/s2] (3,), world frame, shape (6,);
            NaN in contact, where the ground answers every force.
        std: Standard errors, same shape; NaN where nothing was measured.
        coordinates: Of its middle: time [s], x, y, height [m], heading [deg], speed [m/s], spin [rad/s].
    """

    episode: str
    span_s: tuple[float, float]
    phase: Phase
    misfit: float
    acceleration: Array
    std: Array
    coordinates: Mapping[str, float]


def wrench_points(world: World, fit: ShortFit, prepared: Prepared) -> tuple[list[WrenchPoint], list[Organiser]]:
    """Return the pieces of the motion as points, and what orders the wrench of flight; nothing for several free bodies.

    Flights are looked at in half-overlapping windows, contacts in the segments that were fitted.

    Args:
        world: The model's.
        fit: Its short predictions.
        prepared: How the episodes were cut.
    """
    if len(world.free) != 1:
        return [], []
    points: list[WrenchPoint] = []
    episodes = prepared.names
    flown = () if prepared.flight is None else prepared.flight.items
    flight = wrench_windows(world, fit.whole, flown, prepared.noise, prepared.memory)
    if flight is not None:
        std = np.sqrt(np.diagonal(flight.covariance, axis1=1, axis2=2))
        std = np.where(std < KNOWN_STD, std, np.nan)
        points += _points(flight.segments, flight.coordinates, flight.wrench, std, fit.errors, episodes)
    if fit.contact is not None:
        nothing = np.full((len(fit.contact.items), 6), np.nan)
        points += _points(fit.contact.items, coordinates_of(fit.contact)[0], nothing, nothing, fit.errors, episodes)
    if flight is None or len(flight.segments) < LEAST_WINDOWS:
        return points, []
    ordered = [one for one in organisers(flight) if one.share >= LEAST_SHARE and one.p_value < SIGNIFICANT]
    return points, [Organiser(coordinate=one.coordinate, share=one.share) for one in ordered]


def _points(
    segments: Sequence[Segment],
    coordinates: Mapping[str, Array],
    wrench: Array,
    std: Array,
    errors: Mapping[str, ShortErrors],
    episodes: Sequence[str],
) -> list[WrenchPoint]:
    points = []
    for k, segment in enumerate(segments):
        one = errors[episodes[segment.episode]]
        times = one.time_s - one.time_s[0]
        rows = slice(segment.first, segment.last + 1)
        middle = (segment.first + segment.last) // 2
        left = float(one.freedom[rows].sum())
        if one.cause[middle] < 0 or left <= 0:
            continue
        place = {name: float(values[k]) for name, values in coordinates.items() if name != "episode"}
        place["time"] -= float(one.time_s[0])
        place["heading"] = float(np.degrees(place["heading"]))
        points.append(
            WrenchPoint(
                one.episode,
                (float(times[segment.first]), float(times[segment.last])),
                one.phase_name(int(one.cause[middle])),
                float(np.sqrt(np.nansum(np.square(one.sigmas[rows])) / left)),
                wrench[k],
                std[k],
                place,
            )
        )
    return points
