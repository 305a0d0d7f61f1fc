"""The residual wrench: the constant acceleration that a model lacks in each short window, and its covariates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.rotation import quat_rotate
from ...optimization.tails import chi2_tail, f_tail
from ...physics.body import Body
from ...physics.effects.effect import ActiveEffect, BodyMotion, Effect
from ...physics.effects.linear_drag import LinearDrag
from ...physics.effects.magnus_lift import MagnusLift
from ...physics.effects.quadratic_drag import QuadraticDrag
from ...physics.effects.residual_wrench import AXES, ResidualWrench
from ...physics.effects.spin_damping import SpinDamping
from ...physics.parameters import effect_parameters
from ...physics.world import World
from ...trajectories.innovations import WHITE, NoiseModel
from ...trajectories.observations import Observations
from ...trajectories.segmentation import Segment
from ...trajectories.track_noise import Noise
from ..candidates import with_added
from ..segment_fit import linearised
from ..segment_states import fit_states
from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS

Array = NDArray[np.float64]

WINDOW_S = 0.14
"""Length [s] of the half-overlapping windows; at 0.06 s the error of an acceleration is 6 m/s2, too large to show
anything."""
BINS = 4
"""Number of bins, of equal counts, along a coordinate."""
COORDINATES = ("time", "x", "y", "height", "heading", "speed", "spin", "episode")
"""Coordinates that may explain the residual wrench."""
WEAK_STD = 1e4
"""Prior standard deviation of an acceleration [m/s2, rad/s2]: fixes those that were not measured (a centroid has no
spin)."""

TERMS: dict[str, tuple[type[Effect], str]] = {
    "-u": (LinearDrag, "c"),
    "-|u| u": (QuadraticDrag, "k"),
    "omega x u": (MagnusLift, "s"),
    "x": (ResidualWrench, AXES[0]),
    "y": (ResidualWrench, AXES[1]),
    "z": (ResidualWrench, AXES[2]),
    "-omega": (SpinDamping, "d"),
}
"""Effect and parameter of terms of a wrench, each of which is proportional to its parameter; x, y, z: constant along an
axis of the world frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualWrenches:
    """Residual wrenches of windows (n), each with a free state."""

    segments: tuple[Segment, ...]
    """The windows."""
    wrench: Array
    """Acceleration [m/s2] and angular acceleration [rad/s2], world frame, shape (n, 6)."""
    information: Array
    """Inverse covariance of the wrench, shape (n, 6, 6)."""
    coordinates: dict[str, Array]
    """Possible covariates by name, shape (n,): time in the episode [s], x, y and height [m], heading [rad], speed
    [m/s], spin [rad/s], episode."""
    velocity: Array
    """Velocity of the frame's origin in the middle of the window, world, shape (n, 3) [m/s]."""
    omega: Array
    """Angular velocity in the middle of the window, world, shape (n, 3) [rad/s]."""

    @property
    def covariance(self) -> Array:
        """Covariances (n, 6, 6)."""
        return np.linalg.inv(self.information + np.eye(6) / WEAK_STD**2).astype(np.float64)

    def select(self, chosen: Sequence[int]) -> ResidualWrenches:
        """Return the residual wrenches of chosen windows."""
        kept = list(chosen)
        return ResidualWrenches(
            segments=tuple(self.segments[k] for k in kept),
            wrench=self.wrench[kept],
            information=self.information[kept],
            coordinates={name: values[kept] for name, values in self.coordinates.items()},
            velocity=self.velocity[kept],
            omega=self.omega[kept],
        )


@dataclass(frozen=True)
class Omnibus:
    """The test whether anything is missing in flight.

    The p-value assumes normal noise; where it is correlated, its size is known from the flights alone (Fisher's F).
    """

    statistic: float
    """Mean chi2 per degree of freedom; 1 if nothing is missing."""
    dof: float
    """Degrees of freedom."""
    p_value: float
    """Probability of at least this chi2 if nothing is missing."""


@dataclass(frozen=True)
class Covariate:
    """Share of the excess of chi2 explained by a wrench that is constant within bins of a coordinate."""

    coordinate: str
    """One of `COORDINATES`, or "constant": one wrench everywhere."""
    share: float
    """Share of the excess, 0 to 1."""
    gain: float
    """Fall of chi2."""
    p_value: float
    """Probability of at least this gain by chance."""


def residual_wrenches(segments: Segments) -> ResidualWrenches:
    """Return the residual wrench of each fitted segment of one free body."""
    world = with_added(segments.world, ResidualWrench())
    parameters = [p for p in effect_parameters(world) if p.name.startswith(f"{ResidualWrench.name}.")]
    linear = linearised(
        replace(segments, world=world), parameters, torch.zeros(len(parameters)).to(segments.world.gravity)
    )
    weak = torch.eye(6).to(linear.information) / WEAK_STD**2
    wrench = torch.linalg.solve(linear.information + weak, linear.score)
    coordinates, velocity, omega = coordinates_of(segments)
    return ResidualWrenches(
        segments=segments.items,
        wrench=wrench.numpy(),
        information=linear.information.numpy(),
        coordinates=coordinates,
        velocity=velocity,
        omega=omega,
    )


def unit_acceleration(found: ResidualWrenches, term: str) -> Array:
    """Return the linear and angular acceleration (n, 6) of a term of `TERMS` whose parameter is 1.

    The effect itself computes it, as the wrench on a body of unit mass and inertia.
    """
    kind, parameter = TERMS[term]
    velocity, omega = torch.as_tensor(found.velocity).double(), torch.as_tensor(found.omega).double()
    one, zero, unit = velocity.new_ones(1), velocity.new_zeros(1, 3), torch.eye(3).to(velocity)[None]
    body = Body(
        name="unit", motion="free", mass=one, inertia=unit, com=zero, centers=zero[:, None], radii=0 * one[:, None]
    )
    motion = BodyMotion(
        body=body,
        mass=one.expand(len(velocity)),
        inertia=unit.expand(len(velocity), -1, -1),
        com=zero.expand(len(velocity), -1),
        rotation=unit.expand(len(velocity), -1, -1),
        velocity=velocity,
        omega=omega,
        up=unit[:, 2],
        normal=unit[:, 2],
    )
    active = ActiveEffect.of(kind(), {parameter: 1.0}, one)
    wrench = active.effect.wrench(active.values, motion)
    nothing = torch.zeros_like(velocity)
    parts = (nothing if value is None else value.expand_as(nothing) for value in (wrench.force, wrench.torque))
    return torch.cat(tuple(parts), 1).numpy()


def wrench_windows(
    world: World,
    whole: Observations,
    flight: Sequence[Segment],
    noise: Noise,
    memory: NoiseModel = WHITE,
) -> ResidualWrenches | None:
    """Return the residual wrenches of half-overlapping windows of flights, states fitted; None without windows."""
    windows: list[Segment] = []
    for segment in flight:
        times = whole.times_s[segment.episode, segment.first : segment.last + 1]
        length = max(6, round(WINDOW_S / float(times.diff().median())))
        for first in range(segment.first, segment.last + 2 - length, length // 2):
            windows.append(Segment(segment.episode, first, first + length - 1))
    if not windows:
        return None
    return residual_wrenches(fit_states(Segments.of("flight", world, whole, windows, noise, memory)))


def omnibus(found: ResidualWrenches, scatter: float = 1.0, noise_dof: float = math.inf) -> Omnibus:
    """Return the test that all residual wrenches vanish, for windows that do not overlap.

    Args:
        found: The residual wrenches.
        scatter: Factor of the noise variance, see `dispersion`.
        noise_dof: Degrees of freedom from which the size of the noise is known.
    """
    score = np.einsum("nij,nj->ni", found.information, found.wrench)
    chi2 = float(np.einsum("ni,ni->", score, found.wrench)) / scatter
    dof = float(np.einsum("nij,nji->", found.information, found.covariance))
    dof = max(dof, 1e-9)
    known = math.isinf(noise_dof)
    return Omnibus(chi2 / dof, dof, chi2_tail(chi2, dof) if known else f_tail(chi2 / dof, dof, max(noise_dof, 1.0)))


def sound_windows(segments: Segments, found: ResidualWrenches) -> tuple[Segments, ResidualWrenches]:
    """Leave out windows that scatter far more than the quietest quarter does, whatever wrench acts in them.

    They hold a contact, the end of a hand, a burst, or a state that was not found; one of them would pass for noise of
    all. All windows count where fewer than half would be left.

    Args:
        segments: The windows with fitted states.
        found: Their residual wrenches.
    """
    chi2, dof = _left(segments, found)
    told = dof >= 1
    if not told.any():
        return segments, found
    size = chi2 / np.maximum(dof, 1.0)
    most = SEGMENT_THRESHOLDS.slow_errors.unsound * max(1.0, float(np.quantile(size[told], 0.25)))
    kept = np.flatnonzero(~told | (size <= most)).tolist()
    if len(kept) == len(size) or len(kept) < len(size) / 2:
        return segments, found
    return segments.select(kept), found.select(kept)


def dispersion(segments: Segments, found: ResidualWrenches) -> float:
    """Return the factor, at least 1, by which short pieces scatter more than the stated noise under any wrench.

    Noise that is correlated from frame to frame, as of filtered tracks, shows here.
    """
    chi2, dof = _left(segments, found)
    return max(1.0, float(chi2.sum()) / max(float(dof.sum()), 1.0))


def _left(segments: Segments, found: ResidualWrenches) -> tuple[Array, Array]:
    """Return chi2 and degrees of freedom (n) of windows beside their residual wrenches."""
    residuals = segments.residuals([], segments.world.gravity.new_zeros(0), jacobian=False)[0]
    gained = np.einsum("ni,nij,nj->n", found.wrench, found.information, found.wrench)
    taken = np.einsum("nij,nji->n", found.information, found.covariance)
    return residuals.square().sum((1, 2)).numpy() - gained, segments.dof.numpy() - taken


def covariates_of(found: ResidualWrenches) -> list[Covariate]:
    """Return the coordinates that explain the residual wrench, the largest share first.

    The gain in chi2 of a wrench that is constant within bins, over one that is constant everywhere, less its degrees of
    freedom, divided by the whole excess of chi2; for "constant", the gain over none.
    """
    score = np.einsum("nij,nj->ni", found.information, found.wrench)
    chi2 = float(np.einsum("ni,ni->", score, found.wrench))
    # at least the excess that chance may cause: shares of less have no meaning
    excess = max(chi2 - 6 * len(score), 3 * np.sqrt(12 * len(score)))

    def gain(groups: Array) -> float:
        total = 0.0
        for value in np.unique(groups):
            mine = groups == value
            g, m = score[mine].sum(0), found.information[mine].sum(0)
            total += float(g @ np.linalg.solve(m + np.eye(6) / WEAK_STD**2, g))
        return total

    everywhere = gain(np.zeros(len(score)))
    results = [Covariate("constant", _share(everywhere - 6, excess), everywhere, chi2_tail(everywhere, 6))]
    for name, values in found.coordinates.items():
        groups = values if name == "episode" else _bins(values)
        numbers = 6 * (len(np.unique(groups)) - 1)
        if numbers:
            more = gain(groups) - everywhere
            results.append(Covariate(name, _share(more - numbers, excess), more, chi2_tail(more, numbers)))
    return sorted(results, key=lambda one: -one.share)


def motion_axes(velocity: Array) -> Array:
    """Return for each velocity (n, 3) the axes along it, horizontally across it to the left, and across both."""
    along = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-12)
    side = np.cross([0.0, 0.0, 1.0], along)
    size = np.linalg.norm(side, axis=1, keepdims=True)
    side = np.where(size > 1e-6, side / np.maximum(size, 1e-12), [0.0, 1.0, 0.0])
    return np.stack([along, side, np.cross(along, side)], 1)


def _share(gain: float, excess: float) -> float:
    """Return a gain as a share of the excess, 0 to 1."""
    return float(np.clip(gain / excess, 0.0, 1.0))


def _bins(values: Array) -> Array:
    """Return the bin of each value."""
    edges = np.quantile(values, np.arange(1, BINS) / BINS)
    return np.searchsorted(edges, values).astype(np.float64)


def coordinates_of(segments: Segments) -> tuple[dict[str, Array], Array, Array]:
    """Return coordinates by name (n,), velocities (n, 3) and angular velocities (n, 3), world, in mid-window."""
    motion, body = segments.rollout(), segments.observations.free[0]
    item = torch.arange(len(segments.items))
    middle = torch.tensor([n // 2 for n in segments.lengths])

    def at(values: Tensor) -> Tensor:
        return values[item, middle, body]

    place, velocity = at(motion.position_m), at(motion.velocity_m_s)
    omega = quat_rotate(at(motion.quat_wxyz), at(motion.omega_body_rad_s))
    up = segments.world.up[0]
    normal = up if segments.world.ground_normal is None else segments.world.ground_normal
    offset = 0.0 if segments.world.ground_offset is None else float(segments.world.ground_offset[0])
    columns = {
        "time": segments.observations.times_s[item, middle],
        "x": place[:, 0],
        "y": place[:, 1],
        "height": place @ normal - offset,
        "heading": torch.atan2(velocity[:, 1], velocity[:, 0]),
        "speed": velocity.norm(dim=1),
        "spin": omega.norm(dim=1),
        "episode": torch.tensor([float(s.episode) for s in segments.items]),
    }
    return {name: values.numpy() for name, values in columns.items()}, velocity.numpy(), omega.numpy()
