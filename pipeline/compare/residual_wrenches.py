"""Residual wrench of a model in each segment of the motion, and the coordinates that explain it in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...schemas import CovariateShare, Phase
from ..physics.world import World
from ..segments.flights.residual_wrench import (
    ResidualWrenches,
    coordinates_of,
    covariates_of,
    motion_axes,
    wrench_windows,
)
from ..segments.prepare import Prepared
from ..trajectories.segmentation import Segment
from .short_horizon_errors import ShortErrors, ShortFit

Array = NDArray[np.float64]

LEAST_SHARE = 0.05
"""Minimum share of the excess that a coordinate has to explain to be reported."""
LEAST_WINDOWS = 8
"""Minimum number of windows of flight for a comparison of four bins."""
SIGNIFICANT = 0.01
"""Largest p-value at which a coordinate is reported."""
LEAST_SPIN = 1.0
"""Smallest spin whose axis counts as known [rad/s]."""
KNOWN_STD = 1e3
"""Standard error above which a component counts as not measured [m/s2, rad/s2]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WrenchPoint:
    """Misfit, residual wrench and coordinates of one segment of the motion."""

    episode: str
    """Name of the episode."""
    span_s: tuple[float, float]
    """Start and end of the segment, from the episode's first measured frame [s]."""
    phase: Phase
    """Phase to which its residuals are attributed."""
    misfit: float
    """Root of the reduced chi-square of its short prediction, in units of the noise."""
    acceleration: Array
    """Residual acceleration [m/s2] (3,) and angular acceleration [rad/s2] (3,), world frame, shape (6,); NaN in
    contact, where the ground balances every force.
    """
    std: Array
    """Standard errors of `acceleration`, same shape; NaN where nothing was measured."""
    in_motion: Array
    """Its components along the velocity, horizontally to the left of it, across both (lift), and along omega x velocity
    [m/s2], and of the torque along the spin [rad/s2], shape (5,); NaN where unknown."""
    in_motion_std: Array
    """Their standard errors, same shape."""
    coordinates: Mapping[str, float]
    """Coordinates at its middle: time [s], x, y, height [m], heading [deg], speed [m/s], spin [rad/s]."""


def wrench_points(world: World, fit: ShortFit, prepared: Prepared) -> tuple[list[WrenchPoint], list[CovariateShare]]:
    """Return the segments of the motion as points, and the coordinates that explain the residual wrench in flight.

    Flight is divided into half-overlapping windows; in contact the fitted segments are used. Both lists are empty for
    several free bodies and for jointed ones.

    Args:
        world: The world of the model.
        fit: The short predictions of the model.
        prepared: The episodes, cut into segments.
    """
    if len(world.free) != 1 or world.chains:
        return [], []
    points: list[WrenchPoint] = []
    episodes = prepared.names
    flown = () if prepared.flight is None else prepared.flight.items
    flight = wrench_windows(world, fit.observations, flown, prepared.noise, prepared.noise_model)
    if flight is not None:
        std = np.sqrt(np.diagonal(flight.covariance, axis1=1, axis2=2))
        std = np.where(std < KNOWN_STD, std, np.nan)
        moving = _in_motion(flight)
        points += _points(flight.segments, flight.coordinates, (flight.wrench, std), moving, fit.errors, episodes)
    if fit.contact is not None:
        nothing = np.full((len(fit.contact.items), 6), np.nan)
        unknown = nothing[:, :5], nothing[:, :5]
        places = coordinates_of(fit.contact)[0]
        points += _points(fit.contact.items, places, (nothing, nothing), unknown, fit.errors, episodes)
    if flight is None or len(flight.segments) < LEAST_WINDOWS:
        return points, []
    ordered = [one for one in covariates_of(flight) if one.share >= LEAST_SHARE and one.p_value < SIGNIFICANT]
    return points, [CovariateShare(coordinate=one.coordinate, share=one.share) for one in ordered]


def _in_motion(found: ResidualWrenches) -> tuple[Array, Array]:
    """Return the components of `WrenchPoint.in_motion` (n, 5) and their standard errors."""
    lift = np.cross(found.omega, found.velocity)
    spin = np.where(np.linalg.norm(found.omega, axis=1, keepdims=True) > LEAST_SPIN, found.omega, np.nan)
    axes = np.concatenate((motion_axes(found.velocity), _unit(np.where(np.isfinite(spin), lift, np.nan))[:, None]), 1)
    rows, covariance = slice(0, 3), found.covariance
    force = np.einsum("nij,nj->ni", axes, found.wrench[:, rows])
    force_var = np.einsum("nij,njk,nik->ni", axes, covariance[:, rows, rows], axes)
    turning = _unit(spin)
    torque = np.einsum("nj,nj->n", turning, found.wrench[:, 3:])
    torque_var = np.einsum("nj,njk,nk->n", turning, covariance[:, 3:, 3:], turning)
    values, std = np.c_[force, torque], np.sqrt(np.c_[force_var, torque_var])
    known = std < KNOWN_STD
    return np.where(known, values, np.nan), np.where(known, std, np.nan)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _points(
    segments: Sequence[Segment],
    coordinates: Mapping[str, Array],
    wrench: tuple[Array, Array],
    in_motion: tuple[Array, Array],
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
                episode=one.episode,
                span_s=(float(times[segment.first]), float(times[segment.last])),
                phase=one.phase_name(int(one.cause[middle])),
                misfit=float(np.sqrt(np.nansum(np.square(one.sigmas[rows])) / left)),
                acceleration=wrench[0][k],
                std=wrench[1][k],
                in_motion=in_motion[0][k],
                in_motion_std=in_motion[1][k],
                coordinates=place,
            )
        )
    return points
