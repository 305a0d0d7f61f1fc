"""The phase of every measured frame: flight, impact, sliding, rolling, sticking, rest.

Flight is told from the tracks, the shape and the ground alone; what happens in contact from the forces that the
fitted model has in its short rollouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..estimation.observations import Observations
from ..estimation.warmup import FLIGHT_MARGIN_M, clearance
from ..physics.rotation import quat_to_matrix
from ..physics.world import Body, World

if TYPE_CHECKING:
    from .segments import Segments

PhaseName = Literal["flight", "impact", "sliding", "rolling", "sticking", "rest"]
PHASES: tuple[PhaseName, ...] = ("flight", "impact", "sliding", "rolling", "sticking", "rest")

MOVE_SHARE = 0.75
"""A point this share of its last or next move away from contact may have bounced between the two frames: whatever the
bounce, one of its sides lies within half of a move (study of diagnosis, pitfall P1)."""
NOISE_SIGMAS = 3.0
"""Heights are measured; the margin of flight grows by so many of their standard deviations."""
IMPACT_WEIGHTS = 3.0
"""A normal impulse of more than so many times that of the weight over a frame is an impact; rolling over an edge
reaches twice."""
IMPACT_M_S = 0.05
"""Or, at frames so short that the weight gives nearly nothing, one that changes the speed by this."""
REST_M_S = 0.02
"""A surface slower than this, noise apart, rests."""
ROUND_SHARE = 0.5
"""A body rolls where the touching sphere's radius is more than this share of its size: a cube's corner sticks."""


@dataclass(frozen=True, eq=False)
class EpisodePhases:
    """The phases of an episode: time_s (T,); phase (T,) of `PHASES`; clear (T,): surely out of contact."""

    episode: str
    time_s: NDArray[np.float64]
    phase: NDArray[np.str_]
    clear: NDArray[np.bool_]


def size_of(body: Body) -> float:
    """Return the largest distance [m] of a body's surface from its frame's origin."""
    return float((body.centers[0].square().sum(-1).sqrt() + body.radii[0]).max())


def is_round(body: Body) -> bool:
    """Whether a body is a ball about its frame's origin, so that its contacts do not depend on its orientation."""
    return bool((body.centers[0].square().sum(-1).sqrt() < 1e-3 * body.radii[0].max()).all())


def clear_frames(world: World, observations: Observations, noise: tuple[float, float]) -> Tensor:
    """Return which frames (B, T) are surely free of contact, bounces between two frames included.

    Args:
        world: The world; without a ground, driven or further free bodies all is flight.
        observations: Whole episodes, or windows of them.
        noise: Of the tracks (position [m], rotation [rad]).
    """
    clear = observations.seen.amax(-1) > 0
    if world.ground_normal is not None and world.ground_offset is not None:
        for column, index in enumerate(observations.free):
            heights = heights_of(world, world.bodies[index], observations, column)
            margin = FLIGHT_MARGIN_M + NOISE_SIGMAS * float(np.hypot(noise[0], noise[1] * size_of(world.bodies[index])))
            clear &= _apart(heights, margin)
    others = clearance(replace(world, ground_normal=None), observations)
    if bool(torch.isfinite(others).any()):
        clear &= _apart(others[..., None], FLIGHT_MARGIN_M + NOISE_SIGMAS * noise[0])
    for a in range(len(observations.free)):
        for b in range(a):
            reach = size_of(world.bodies[observations.free[a]]) + size_of(world.bodies[observations.free[b]])
            gap = (observations.position_m[:, :, a] - observations.position_m[:, :, b]).norm(dim=-1) - reach
            clear &= _apart(gap[..., None], FLIGHT_MARGIN_M + NOISE_SIGMAS * noise[0])
    return clear


def heights_of(world: World, body: Body, observations: Observations, column: int) -> Tensor:
    """Return the heights (B, T, N) [m] of a body's spheres; of a ball around it where no orientation was measured."""
    normal, offset = world.ground_normal, world.ground_offset
    assert normal is not None and offset is not None
    origin = observations.position_m[:, :, column] @ normal - offset[0]
    chosen = slice(None) if body.on_plane is None else body.on_plane
    along = quat_to_matrix(observations.quat_wxyz[:, :, column]).transpose(-1, -2) @ normal
    own = origin[..., None] + along @ body.centers[0, chosen].T - body.radii[0, chosen]
    ball = (origin - size_of(body))[..., None]
    return torch.where(observations.turned[:, :, column, None] > 0, own, torch.minimum(own, ball))


def _apart(gaps: Tensor, margin: float) -> Tensor:
    """Return the frames (B, T) whose gaps (B, T, N) all exceed the margin and a share of their last and next move."""
    moves = gaps.diff(dim=1).abs()
    edge = torch.zeros_like(gaps[:, :1])
    move = torch.maximum(torch.cat((edge, moves), 1), torch.cat((moves, edge), 1))
    return (gaps > margin + MOVE_SHARE * move).all(-1)


def contact_phases(contact: Segments) -> list[list[PhaseName]]:
    """Return the phase of each measured frame of fitted contact segments, from a rollout of their model.

    The phase of a frame is what happened between the frame before and itself; the first takes that of the second.
    """
    rollout = contact.rollout(record_contacts=True)
    record = rollout.contacts
    assert record is not None
    world, seen = contact.world, contact.observations
    steps = seen.times_s.diff(dim=1)
    normal = (record.impulse_n_s * record.normal).sum(-1)  # (B, T, C)
    speeds = _surface_speeds(world, rollout.velocity_m_s, rollout.omega_body_rad_s)
    limit = REST_M_S + contact.noise[0] / steps.median() * 0.5
    weight = world.gravity[0].norm() * torch.cat((steps[:, :1], steps), 1)
    mass = min(float(world.bodies[k].mass[0]) for k in world.free)
    total, slides = normal.sum(-1), (normal * record.sliding).sum(-1)
    round_share = _round_share(world, record.body_a, normal)
    turning = torch.stack([rollout.omega_body_rad_s[:, :, k].norm(dim=-1) for k in world.free]).amax(0)
    found: list[list[PhaseName]] = []
    for item, count in enumerate(contact.lengths):
        names: list[PhaseName] = []
        for frame in range(count):
            k = max(frame, min(1, count - 1))
            impulse = float(total[item, k])
            if impulse <= 0:
                names.append("flight")
            elif impulse > mass * max(IMPACT_WEIGHTS * float(weight[item, k]), IMPACT_M_S):
                names.append("impact")
            elif float(speeds[item, k]) < float(limit):
                names.append("rest")
            elif float(slides[item, k]) > 0.5 * impulse:
                names.append("sliding")
            elif float(round_share[item, k]) > 0.5 and float(turning[item, k]) > 0:
                names.append("rolling")
            else:
                names.append("sticking")
        found.append(names)
    return found


def _surface_speeds(world: World, velocity: Tensor, omega: Tensor) -> Tensor:
    """Return the largest speed (B, T) [m/s] of any free body's surface, to a factor of two."""
    parts = [
        velocity[:, :, k].norm(dim=-1) + size_of(world.bodies[k]) * omega[:, :, k].norm(dim=-1) for k in world.free
    ]
    return torch.stack(parts).amax(0)


def _round_share(world: World, body_a: Tensor, normal: Tensor) -> Tensor:
    """Return the share (B, T) of the normal impulse that large spheres carry."""
    large = []
    for index, body in enumerate(world.bodies):
        chosen = slice(None) if body.on_plane is None else body.on_plane
        big = (body.radii[0] > ROUND_SHARE * size_of(body))[chosen]
        slots = int((body_a == index).sum())
        large.append(big if len(big) == slots else torch.zeros(slots, dtype=torch.bool))
    mask = torch.cat(large).to(normal) if large else normal.new_zeros(normal.shape[-1])
    if len(mask) != normal.shape[-1]:
        return normal.new_zeros(normal.shape[:-1])
    return (normal * mask).sum(-1) / normal.sum(-1).clamp_min(1e-30)


def phases_of(
    episodes: Sequence[str], whole: Observations, clear: Tensor, contact: Segments | None
) -> list[EpisodePhases]:
    """Return the phases of whole episodes.

    Args:
        episodes: Their names.
        whole: The episodes (E).
        clear: Frames that are surely in flight (E, T).
        contact: The fitted contact segments; None where there are none.
    """
    places = torch.arange(1, whole.times_s.shape[1] + 1)
    lengths = ((whole.seen.amax(-1) > 0) * places).amax(1).tolist()
    names = [np.full(n, "flight", dtype="<U8") for n in lengths]
    if contact is not None:
        for segment, phases in zip(contact.items, contact_phases(contact), strict=True):
            for frame, phase in zip(range(segment.first, segment.last + 1), phases, strict=True):
                if not bool(clear[segment.episode, frame]):
                    names[segment.episode][frame] = phase
    return [
        EpisodePhases(name, whole.times_s[k, :n].numpy(), names[k], clear[k, :n].numpy())
        for k, (name, n) in enumerate(zip(episodes, lengths, strict=True))
    ]
