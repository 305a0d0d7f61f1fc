"""Phase of every measured frame: flight, impact, sliding, rolling, sticking or rest.

Flight follows from the tracks, the shape and the ground alone; phases of contact follow from the forces of the fitted
model in its short rollouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..physics.body import Body
from ..physics.world import World
from ..trajectories.observations import Observations
from ..trajectories.segmentation import size_of
from .thresholds import SEGMENT_THRESHOLDS

if TYPE_CHECKING:
    from .segments import Segments

PhaseName = Literal["flight", "impact", "sliding", "rolling", "sticking", "rest"]
PHASES: tuple[PhaseName, ...] = ("flight", "impact", "sliding", "rolling", "sticking", "rest")
"""All phases."""

LIMITS = SEGMENT_THRESHOLDS.phases


@dataclass(frozen=True, eq=False)
class EpisodePhases:
    """The phases of an episode of T frames."""

    episode: str
    """Its name."""
    time_s: NDArray[np.float64]
    """Frame times, shape (T,) [s]."""
    phase: NDArray[np.str_]
    """One of `PHASES` for each frame, shape (T,)."""
    airborne: NDArray[np.bool_]
    """Airborne frames: surely without contact, shape (T,)."""


def is_round(body: Body) -> bool:
    """Return whether a body is a ball about its frame's origin: its contacts do not depend on its orientation."""
    return body.once(_is_round)


def _is_round(body: Body) -> bool:
    return bool((body.centers[0].square().sum(-1).sqrt() < 1e-3 * body.radii[0].max()).all())


def contact_phases(contact: Segments) -> list[list[PhaseName]]:
    """Return the phase of each measured frame of fitted contact segments, from a rollout of their model.

    The phase of a frame is what happened between the frame before and itself; the first takes that of the second.
    """
    rollout = contact.rollout(record_contacts=True)
    record = rollout.contacts
    if record is None:
        raise ValueError("the rollout did not record its contacts")
    world, seen = contact.world, contact.observations
    steps = seen.times_s.diff(dim=1)
    normal = (record.impulse_n_s * record.normal).sum(-1)  # (B, T, C)
    speeds = _surface_speeds(world, rollout.velocity_m_s, rollout.omega_body_rad_s)
    limit = LIMITS.rest_m_s + contact.noise.position_m / steps.median() * 0.5
    weight = world.gravity[0].norm() * torch.cat((steps[:, :1], steps), 1)
    mass = min(float(world.bodies[k].mass[0]) for k in world.tracked)
    total, slides = normal.sum(-1), (normal * record.sliding).sum(-1)
    round_share = _round_share(world, record.body_a, normal)
    turning = torch.stack([rollout.omega_body_rad_s[:, :, k].norm(dim=-1) for k in world.tracked]).amax(0)
    found: list[list[PhaseName]] = []
    for item, count in enumerate(contact.lengths):
        names: list[PhaseName] = []
        for frame in range(count):
            k = max(frame, min(1, count - 1))
            impulse = float(total[item, k])
            if impulse <= 0:
                names.append("flight")
            elif impulse > mass * max(LIMITS.impact_weights * float(weight[item, k]), LIMITS.impact_m_s):
                names.append("impact")
            elif float(speeds[item, k]) < float(limit):
                names.append("rest")
            elif float(slides[item, k]) > LIMITS.sliding_impulse * impulse:
                names.append("sliding")
            elif float(round_share[item, k]) > LIMITS.rolling_impulse and float(turning[item, k]) > 0:
                names.append("rolling")
            else:
                names.append("sticking")
        found.append(names)
    return found


def _surface_speeds(world: World, velocity: Tensor, omega: Tensor) -> Tensor:
    """Return the largest speed (B, T) [m/s] of any free body's surface, to a factor of two."""
    parts = [
        velocity[:, :, k].norm(dim=-1) + size_of(world.bodies[k]) * omega[:, :, k].norm(dim=-1) for k in world.tracked
    ]
    return torch.stack(parts).amax(0)


def _round_share(world: World, body_a: Tensor, normal: Tensor) -> Tensor:
    """Return the share (B, T) of the normal impulse that acts on large spheres."""
    large = []
    for index, body in enumerate(world.bodies):
        chosen = slice(None) if body.on_plane is None else body.on_plane
        big = (body.radii[0] > LIMITS.round_share * size_of(body))[chosen]
        points = int((body_a == index).sum())
        large.append(big if len(big) == points else torch.zeros(points, dtype=torch.bool))
    mask = torch.cat(large).to(normal) if large else normal.new_zeros(normal.shape[-1])
    if len(mask) != normal.shape[-1]:
        return normal.new_zeros(normal.shape[:-1])
    return (normal * mask).sum(-1) / normal.sum(-1).clamp_min(1e-30)


def phases_of(
    episodes: Sequence[str], whole: Observations, airborne: Tensor, contact: Segments | None
) -> list[EpisodePhases]:
    """Return the phases of whole episodes.

    Args:
        episodes: Their names.
        whole: The episodes (E).
        airborne: Airborne frames (E, T).
        contact: The fitted contact segments; None where there are none.
    """
    places = torch.arange(1, whole.times_s.shape[1] + 1)
    lengths = ((whole.seen.amax(-1) > 0) * places).amax(1).tolist()
    names = [np.full(n, "flight", dtype="<U8") for n in lengths]
    if contact is not None:
        for segment, phases in zip(contact.items, contact_phases(contact), strict=True):
            for frame, phase in zip(range(segment.first, segment.last + 1), phases, strict=True):
                if not bool(airborne[segment.episode, frame]):
                    names[segment.episode][frame] = phase
    return [
        EpisodePhases(name, whole.times_s[k, :n].numpy(), names[k], airborne[k, :n].numpy())
        for k, (name, n) in enumerate(zip(episodes, lengths, strict=True))
    ]
