"""Impacts of a body that falls flat on a face, from the flights on both sides, without any contact law.

Where a face meets the ground nearly flat, its corners touch one after the other, within milliseconds. What each takes
off the body turns it, but how much energy the whole impact leaves hardly depends on that: in MuJoCo the square root of
the ratio of the energies after and before varies by 3 to 6 % up to a tilt of 2 deg at 1 m/s, 4 deg at 2 m/s and 8 deg
at 5 m/s, while the share of it that turns the body rises from nothing to a tenth. So an impact is that of a ball with
the energy of the motion along the normal and of the turning that tips the face: it tells the rebound, not friction. A
body that comes down more tilted loses more, the slower it is: what flat impacts show of a rebound that falls with the
speed, tilts do not imitate.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.hull_faces import hull_faces
from ...geometry.rotation import quat_exp, quat_to_matrix
from ...physics.body import Body
from ...physics.world import World
from ...trajectories.segmentation import GroundPlane, Segment, heights_of
from ..contact_phases import is_round
from ..prepare import Prepared
from ..segment_states import fit_states
from ..thresholds import SEGMENT_THRESHOLDS
from .velocities import Ends, Impacts, between_flights, ends_of, falling_body, impacts_between

LIMITS = SEGMENT_THRESHOLDS.flat_impacts

Array = NDArray[np.float64]

KNOWN_M_S = 1e-3
"""Standard deviation of what flat impacts do not use: the velocities along the ground, and the spin [rad/s]."""


def flat_impacts(prepared: Prepared, world: World) -> Impacts | None:
    """Return the impacts of a body that falls flat on one of its faces and rebounds as flat; None where there are none.

    Args:
        prepared: The episodes.
        world: In which flights are followed, with the effects that act in flight.
    """
    body = falling_body(prepared, world)
    if prepared.flight is None or body is None or is_round(body):
        return None
    normals, reaches = faces_of(body)
    if not len(normals):
        return None
    chains, reach = _chains(prepared, world, body, normals, reaches)
    items = [item for chain in chains for item in chain]
    if not items:
        return None
    flights = fit_states(prepared.segments("flight", world, items))
    reach_m = torch.tensor(reach).to(world.gravity)
    starts, ends, good = ends_of(flights, reach_m)
    normal = GroundPlane.of(world).normal
    times, last = flights.observations.times_s, torch.tensor(flights.lengths) - 1
    frames = times[torch.arange(len(items)), last], times[:, 0]
    speeds = [_speeds(world, body, end, at, normals) for end, at in zip((ends, starts), frames, strict=True)]
    kept = [
        (before, after)
        for before, after in impacts_between(chains, starts, ends, good)
        if bool(speeds[0][1][before]) and bool(speeds[1][1][after])
    ]
    found = between_flights(items, kept, starts, ends)
    if found is None:
        return None
    a, b = (torch.tensor(side) for side in zip(*kept, strict=True))
    return replace(
        found,
        before=_along(-speeds[0][0][a], normal),
        after=_along(speeds[1][0][b], normal),
        covariance_before=_covariance(found.covariance_before, normal),
        covariance_after=_covariance(found.covariance_after, normal),
        reach_m=reach_m[a],
    )


def faces_of(body: Body) -> tuple[Array, Array]:
    """Return the outward normals (F, 3) of the flat faces of a body's hull, body axes, and their distances (F,).

    The distances [m] are those of the ground from the centre of mass where the body lies on them.
    """
    points = body.centers[0].numpy()
    chosen = slice(None) if body.on_plane is None else body.on_plane
    points, radius = points[chosen], float(body.radii[0, chosen].max())
    found = hull_faces(points)
    if not found:
        return np.zeros((0, 3)), np.zeros(0)
    normals = np.array([face.normal for face in found])
    return normals, ((points - body.com[0].numpy()) @ normals.T).max(0) + radius


def _chains(
    prepared: Prepared, world: World, body: Body, normals: Array, reaches: Array
) -> tuple[list[list[Segment]], list[float]]:
    """Return pairs of neighbouring flights, the first of which ends flat, and the distance of the face below in each.

    The second is as long as no corner is near the ground: a body that turns after a flat impact lands on an edge,
    before its centre of mass says so.
    """
    whole, (normal, offset) = prepared.observations, GroundPlane.of(world)
    turn = quat_to_matrix(whole.quat_wxyz[:, :, whole.free[0]])
    down = -(turn.transpose(-1, -2) @ normal).numpy()  # (E, T, 3)
    com = whole.position_m[:, :, whole.free[0]] + (turn @ body.com[0]).to(whole.position_m)
    height = (com @ normal - offset[0]).numpy()
    clear = heights_of(world, body, whole, 0).amin(-1).numpy() > LIMITS.clear_sigmas * prepared.noise.position_m
    clear &= whole.seen[:, :, 0].numpy() > 0
    times = whole.times_s.numpy()
    flights = () if prepared.flight is None else prepared.flight.items
    chains: list[list[Segment]] = []
    reach: list[float] = []
    for before in sorted(flights, key=lambda one: (one.episode, one.first)):
        episode, last = before.episode, before.last
        towards = normals @ down[episode, last]
        face = int(towards.argmax())
        near = np.flatnonzero(
            (times[episode] > times[episode, last]) & (times[episode] < times[episode, last] + LIMITS.apart_s)
        )
        if towards[face] < math.cos(LIMITS.tilt_rad) or not len(near):
            continue
        lowest = int(near[height[episode, near].argmin()])
        after = _clear_frames(clear[episode], lowest + 1)
        if len(after) >= SEGMENT_THRESHOLDS.impact_data.min_frames and after[0] <= near[-1]:
            chains.append([before, Segment(episode, after[0], after[-1])])
            reach += [float(reaches[face])] * 2
    return chains, reach


def _clear_frames(clear: NDArray[np.bool_], first: int) -> list[int]:
    """Return the first frames in a row, from one on, that are clear of the ground (T,), without the last of them."""
    begun = itertools.dropwhile(lambda k: not clear[k], range(first, len(clear)))
    return list(itertools.takewhile(lambda k: clear[k], begun))[:-1]


def _speeds(world: World, body: Body, ends: Ends, frame_s: Tensor, normals: Array) -> tuple[Tensor, Tensor]:
    """Return the speeds (n,) with the energy along the normal and of tipping, and whether ends of flights are flat.

    Args:
        world: The world.
        body: The body.
        ends: Starts or ends of flights (n) on the ground, with the rotations of the frames next to it.
        frame_s: Times of these frames [s], shape (n,).
        normals: Outward normals (F, 3) of the body's faces.
    """
    normal = GroundPlane.of(world).normal
    velocity, omega = ends.twist[:, :3], ends.twist[:, 3:]
    tipping = omega - (omega @ normal)[:, None] * normal
    rotation = quat_to_matrix(quat_exp(omega * (ends.time_s - frame_s)[:, None])) @ ends.rotation
    inertia = rotation @ body.inertia[0] @ rotation.mT
    turning = torch.einsum("ni,nij,nj->n", tipping, inertia, tipping) / body.mass[0]
    along = velocity @ normal
    square = along.square() + turning
    level = velocity - along[:, None] * normal
    towards = -(rotation.mT @ normal) @ torch.as_tensor(normals).to(normal).T
    flat = towards.amax(-1) > math.cos(LIMITS.tilt_rad)
    upright = (turning < LIMITS.turning_share * square) & (level.norm(dim=-1) < LIMITS.slip_share * along.abs())
    return square.sqrt(), flat & upright


def _along(speed: Tensor, normal: Tensor) -> Tensor:
    """Return twists (n, 6) of motion along the normal alone."""
    return torch.cat([speed[:, None] * normal, torch.zeros_like(speed)[:, None].expand(-1, 3)], 1)


def _covariance(covariance: Tensor, normal: Tensor) -> Tensor:
    """Return covariances (n, 6, 6) of motion along the normal alone."""
    found = KNOWN_M_S**2 * torch.eye(6).to(covariance).repeat(len(covariance), 1, 1)
    own = torch.einsum("i,nij,j->n", normal, covariance[:, :3, :3], normal)
    found[:, :3, :3] += own[:, None, None] * torch.outer(normal, normal)
    return found
