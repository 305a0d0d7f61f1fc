"""Whether a force that is named as a constant one acts as much late in the flights as early.

A gust, or a force that sets in, pushes as a tilt does where all that is seen is how far a body has come at the end. The
named force is therefore split into one that fades over a usual flight and one that grows (their sum is constant), both
with the states of whole flights free: windows of a tenth of a second would show forces a hundred times worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...optimization.tails import student_tail
from ...physics.world import World
from ...segments.candidates import base_parameters, base_values, without_effects
from ...segments.segment_fit import projected
from ...segments.segments import Segments
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

CONSTANT = ("gravity_tilt", "frame_tilt", "constant_force", "gravity_scale", "buoyancy", "length_scale", "clock_scale")
"""Effects whose acceleration in flight is constant: scales of lengths and clock change what gravity seems to be."""
SCALES = ("length_scale", "clock_scale")
"""Those of them that act on what is measured."""


def without_lasting(flight: Segments, world: World, names: Sequence[str], dispersion: float) -> set[str]:
    """Return the selected constant forces that are none: early and late in the flights they differ beyond chance.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        names: Names of the selected effects.
        dispersion: Factor by which variances exceed those of the noise.
    """
    return {name for name in names if name in CONSTANT and _changes(flight.in_world(world), name, dispersion)}


def _changes(flight: Segments, name: str, dispersion: float) -> bool:
    """Return whether an effect of the flights' world is not as large late as it is early.

    No model of slow errors is exact: the difference is weighed against its scatter between episodes (Huber's sandwich,
    with Student's t), at least against the noise.
    """
    parameters = base_parameters(flight.world, "flight")
    rows, jacobian = flight.residuals(parameters, base_values(flight.world, parameters))
    others = [k for k, p in enumerate(parameters) if p.name.partition(".")[0] != name]
    columns = flight.innovations(_fading_and_growing(flight, name))
    joined = torch.cat((jacobian[..., others], columns, jacobian[..., len(parameters) :]), -1)
    linear = projected(flight, rows, joined, len(others) + 2)
    information, score = linear.information.numpy(), linear.score.numpy()
    weak = np.diag([1 / p.prior[1] ** 2 for k, p in enumerate(parameters) if k in others] + [1e-6] * 2)
    covariance = np.linalg.inv(information.sum(0) + weak)
    step = covariance @ score.sum(0)
    early, late = 1 + step[-2:]
    apart = covariance[-2] - covariance[-1]
    own = (score - information @ step) @ apart
    episode = np.array([item.episode for item in flight.items])
    units = [own[episode == one].sum() for one in np.unique(episode)]
    variance = max(float(apart[-2] - apart[-1]) * dispersion, _between(units))
    unlike = min(early, late) < LIMITS.lasting_ratio * max(early, late)
    return unlike and 2 * student_tail(abs(early - late) / math.sqrt(variance), len(units) - 1) < LIMITS.lasting_p


def _between(units: Sequence[float]) -> float:
    """Return the variance of a sum of what independent episodes contribute; infinite for fewer than two."""
    return float(np.square(units).sum()) * len(units) / (len(units) - 1) if len(units) > 1 else math.inf


def _fading_and_growing(flight: Segments, name: str) -> Tensor:
    """Return residuals (B, T nf, 6, 2) in sigmas by a named force times 1 - s and times s.

    s is the time since the first flight of the episode began, as a share of a usual flight.
    """
    seen = flight.observations
    times = seen.times_s
    lengths = [float(row[n - 1] - row[0]) for row, n in zip(times, flight.lengths, strict=True)]
    begun: dict[int, float] = {}
    for item, first in zip(flight.items, times[:, 0].tolist(), strict=True):
        begun[item.episode] = min(float(first), begun.get(item.episode, float(first)))
    starts = [begun[item.episode] for item in flight.items]
    since = times - torch.tensor(starts).to(times)[:, None]
    share = (since / float(np.quantile(lengths, THRESHOLDS.forms.usual_flight))).clamp(0.0, 1.0)[..., None, None]
    acceleration = _acceleration(flight, name, lengths)
    step = times.diff(dim=1)[..., None, None]
    paths = []
    for weight in (1 - share, share):
        path = weight * acceleration
        for _ in range(2):
            area = (0.5 * step * (path[:, 1:] + path[:, :-1])).cumsum(1)
            path = torch.cat((torch.zeros_like(path[:, :1]), area), 1)
        paths.append(path * (seen.seen[..., None] * seen.measured_axes[:, None]) / flight.noise.position_m)
    positions = torch.stack(paths, -1)
    return torch.cat((positions, torch.zeros_like(positions)), 3).flatten(1, 2)


def _acceleration(flight: Segments, name: str, lengths: Sequence[float]) -> Tensor:
    """Return the acceleration [m/s2] that a named constant effect adds, shape (nb, 3) or (1, 3), from the lengths [s].

    A scale changes where a flight begins, too, and what it adds to its acceleration is that of gravity alone (derived).
    """
    values = next(active.values for active in flight.world.effects if active.effect.name == name)
    if name in SCALES:
        factor = 1 + values["s"][:1, None]
        return flight.world.gravity[:1] * ((factor if name == "length_scale" else factor.pow(-2)) - 1)
    moved = flight.positions() - flight.in_world(without_effects(flight.world, name)).positions()
    longest = int(np.argmax(lengths))
    return 2 * moved[longest, flight.lengths[longest] - 1] / lengths[longest] ** 2
