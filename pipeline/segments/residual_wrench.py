"""The residual wrench: the constant acceleration that a model lacks in each short window, and what organises it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..estimation.observations import Observations
from ..physics.effects.effect import ActiveEffect
from ..physics.parameters import effect_parameters
from ..physics.residual_wrench import ResidualWrench
from ..physics.rotation import quat_rotate
from ..physics.world import World
from ..tails import chi2_tail
from .cuts import Segment
from .lasting import FORGETFUL, Memory
from .linear import linearised
from .segment_states import fit_states
from .segments import Segments

Array = NDArray[np.float64]

WINDOW_S = 0.14
"""Length of the half-overlapping windows; at 0.06 s the error of an acceleration is 6 m/s2, and nothing is seen."""
BINS = 4
"""Bins of equal counts along a coordinate."""
COORDINATES = ("time", "x", "y", "height", "heading", "speed", "spin", "episode")
WEAK_STD = 1e4
"""Prior of an acceleration [m/s2, rad/s2]: holds those that were not measured (a centroid has no spin)."""


@dataclass(frozen=True, eq=False)
class ResidualWrenches:
    """Residual wrenches of windows (n), each with its own free state.

    wrench (n, 6): acceleration [m/s2] and angular acceleration [rad/s2], world frame; information (n, 6, 6): inverse of
    its covariance; segments: the windows; coordinates: what may organise it, by name, (n,): time in the episode [s],
    x, y and height [m], heading [rad], speed [m/s], spin [rad/s], episode; velocity (n, 3) [m/s] of the frame's origin
    and omega (n, 3) [rad/s], world, in the middle of the window.
    """

    segments: tuple[Segment, ...]
    wrench: Array
    information: Array
    coordinates: dict[str, Array]
    velocity: Array
    omega: Array

    @property
    def covariance(self) -> Array:
        """Covariances (n, 6, 6)."""
        return np.linalg.inv(self.information + np.eye(6) / WEAK_STD**2).astype(np.float64)


@dataclass(frozen=True)
class Omnibus:
    """Whether anything is missing in flight: mean chi2 per number (1 if nothing), its degrees of freedom and p-value.

    The p-value assumes noise that is normal, independent from frame to frame and of the stated size.
    """

    statistic: float
    dof: float
    p_value: float


@dataclass(frozen=True)
class Organiser:
    """How much of the excess of chi2 a wrench that is constant in bins of a coordinate explains; "constant": in all."""

    coordinate: str
    share: float
    gain: float
    p_value: float


def residual_wrenches(segments: Segments) -> ResidualWrenches:
    """Return the residual wrench of each fitted segment of one free body."""
    active = ActiveEffect.of(ResidualWrench(), like=segments.world.gravity[0, :1])
    world = replace(segments.world, effects=(*segments.world.effects, active))
    parameters = [p for p in effect_parameters(world) if p.name.startswith(f"{ResidualWrench.name}.")]
    linear = linearised(
        replace(segments, world=world), parameters, torch.zeros(len(parameters)).to(segments.world.gravity)
    )
    weak = torch.eye(6).to(linear.information) / WEAK_STD**2
    wrench = torch.linalg.solve(linear.information + weak, linear.score)
    coordinates, velocity, omega = coordinates_of(segments)
    return ResidualWrenches(segments.items, wrench.numpy(), linear.information.numpy(), coordinates, velocity, omega)


def wrench_windows(
    world: World,
    whole: Observations,
    flight: Sequence[Segment],
    noise: tuple[float, float],
    memory: Memory = FORGETFUL,
) -> ResidualWrenches | None:
    """Return the residual wrenches of half-overlapping windows of the flights, their states fitted; None for none."""
    windows: list[Segment] = []
    for segment in flight:
        times = whole.times_s[segment.episode, segment.first : segment.last + 1]
        length = max(6, round(WINDOW_S / float(times.diff().median())))
        for first in range(segment.first, segment.last + 2 - length, length // 2):
            windows.append(Segment(segment.episode, first, first + length - 1))
    if not windows:
        return None
    return residual_wrenches(fit_states(Segments.of("flight", world, whole, windows, noise, memory)))


def omnibus(found: ResidualWrenches, scatter: float = 1.0) -> Omnibus:
    """Return the test that all residual wrenches vanish; of windows that do not overlap, see `dispersion`."""
    score = np.einsum("nij,nj->ni", found.information, found.wrench)
    chi2 = float(np.einsum("ni,ni->", score, found.wrench)) / scatter
    dof = float(np.einsum("nij,nji->", found.information, found.covariance))
    return Omnibus(chi2 / max(dof, 1e-9), dof, chi2_tail(chi2, max(dof, 1e-9)))


def dispersion(segments: Segments, found: ResidualWrenches) -> float:
    """Return by what factor short pieces scatter more than the stated noise, whatever wrench acts on each; at least 1.

    Noise that is correlated from frame to frame, as of filtered tracks, shows here.
    """
    chi2 = float(segments.residuals([], segments.world.gravity.new_zeros(0), jacobian=False)[0].square().sum())
    gained = float(np.einsum("ni,nij,nj->", found.wrench, found.information, found.wrench))
    taken = float(np.einsum("nij,nji->", found.information, found.covariance))
    return max(1.0, (chi2 - gained) / max(float(segments.dof.sum()) - taken, 1.0))


def organisers(found: ResidualWrenches) -> list[Organiser]:
    """Return which coordinates organise the residual wrench, the largest share first.

    The gain in chi2 of a wrench that is constant within bins, over one that is constant everywhere, less its numbers,
    over the whole excess of chi2; of "constant", the gain over none.
    """
    score = np.einsum("nij,nj->ni", found.information, found.wrench)
    chi2 = float(np.einsum("ni,ni->", score, found.wrench))
    # of an excess that chance alone makes there is nothing to share
    excess = max(chi2 - 6 * len(score), 3 * np.sqrt(12 * len(score)))

    def gain(groups: Array) -> float:
        total = 0.0
        for value in np.unique(groups):
            mine = groups == value
            g, m = score[mine].sum(0), found.information[mine].sum(0)
            total += float(g @ np.linalg.solve(m + np.eye(6) / WEAK_STD**2, g))
        return total

    everywhere = gain(np.zeros(len(score)))
    results = [Organiser("constant", _share(everywhere - 6, excess), everywhere, chi2_tail(everywhere, 6))]
    for name, values in found.coordinates.items():
        groups = values if name == "episode" else _bins(values)
        numbers = 6 * (len(np.unique(groups)) - 1)
        if numbers:
            more = gain(groups) - everywhere
            results.append(Organiser(name, _share(more - numbers, excess), more, chi2_tail(more, numbers)))
    return sorted(results, key=lambda one: -one.share)


def _share(gain: float, excess: float) -> float:
    return float(np.clip(gain / excess, 0.0, 1.0))


def _bins(values: Array) -> Array:
    edges = np.quantile(values, np.arange(1, BINS) / BINS)
    return np.searchsorted(edges, values).astype(np.float64)


def coordinates_of(segments: Segments) -> tuple[dict[str, Array], Array, Array]:
    """Return coordinates by name (n,), velocities (n, 3) and angular velocities (n, 3), world, half-way."""
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
