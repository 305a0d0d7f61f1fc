"""Sliding segments: a body stays on the ground or on fixed surfaces without an impact, sliding, rolling or spinning.

There the normal force is the weight whatever the contact law, so that engines that differ widely in an impact agree,
and the information about a friction grows with the fourth power of the time as in flight. So sliding segments are cut
long, while other contacts are cut short. On fixed surfaces the normal force follows from their normals and the
curvature of the path.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.rotation import quat_conjugate, quat_log, quat_multiply, quat_to_matrix
from ...physics.body import Body
from ...physics.impulse_solver import tangent_axes
from ...physics.state import State
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.segmentation import GroundPlane, Segment, heights_of, size_of, without_rest
from ...trajectories.thresholds import TRACK_THRESHOLDS
from ...trajectories.track_noise import Noise
from ..contact_phases import is_round
from ..impact_law import contact_law
from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS
from .support import Carrying, Support, on_surfaces, within_of

LIMITS = SEGMENT_THRESHOLDS.sliding_data

Array = NDArray[np.float64]

LIFTS = 3
"""Number of steps by which a body is put onto curved surfaces."""
SINKS = 0.47
"""How deep a body sinks into a soft contact in steps of half its time tau, in units of tau^2 and the acceleration by
which it is pressed on (derived)."""
SIDE_S, SIDE_FRAMES = 0.04, 3
"""Time [s] and minimum number of frames on both sides over which a jump of a velocity is measured."""


def find_sliding_segments(world: World, whole: Observations, clear: Tensor, noise: Noise) -> list[Segment]:
    """Return the sliding segments of whole episodes; none without a ground or with several bodies.

    Args:
        world: For shape and ground.
        whole: The episodes (E).
        clear: Airborne frames (E, T).
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    if world.ground_normal is None or len(whole.free) != 1 or len(world.bodies) != 1:
        return []
    body = world.bodies[whole.free[0]]
    margin = LIMITS.near_m + LIMITS.near_sigmas * float(np.hypot(noise.position_m, noise.rotation_rad * size_of(body)))
    lowest = heights_of(world, body, whole, 0).amin(-1)
    on = (lowest < margin) & ~clear & (whole.seen[:, :, 0] > 0)
    track = _SeenFrames.of(whole, on)
    near = on.flatten()[track.rows].numpy()
    normal = GroundPlane.of(world).normal
    steady = near & ~_impacts(body, normal, whole, track, noise, near)
    if not is_round(body):
        steady &= ~_tilting(normal, whole, track, noise.rotation_rad, near)
    return without_rest(whole, _segments(whole, track, steady, LIMITS.longest_s), noise)


def segments_on_surfaces(
    world: World, whole: Observations, clear: Tensor, noise: Noise
) -> tuple[list[Segment], Carrying]:
    """Return the pieces of rolling and sliding on fixed surfaces, as long as they are, and what carries the body.

    A body with edges slides where it lies on one plane.

    Args:
        world: With fixed surfaces and no ground, and one body.
        whole: The episodes (E).
        clear: Airborne frames (E, T).
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    body, error = world.bodies[whole.free[0]], noise.position_m
    if not is_round(body):
        error = float(np.hypot(error, noise.rotation_rad * size_of(body)))
    carrying = Carrying.of(world, whole, within_of(error))
    on = (carrying.gap_m < LIMITS.near_surface_m + LIMITS.near_sigmas * error) & ~clear & (whole.seen[:, :, 0] > 0)
    normal = None
    if not is_round(body):
        on &= whole.has_orientation[:, :, 0] > 0
        normal = torch.nn.functional.normalize(carrying.normal[on].median(0).values, dim=-1)
        on &= carrying.normal @ normal > LIMITS.flat
    track = _SeenFrames.of(whole, on)
    near = on.flatten()[track.rows].numpy()
    steady = near & ~_impacts(body, normal, whole, track, noise, near)
    if normal is not None:
        steady &= ~_tilting(normal, whole, track, noise.rotation_rad, near)
    return without_rest(whole, _segments(whole, track, steady, LIMITS.longest_on_surface_s), noise), carrying


def _segments(whole: Observations, track: _SeenFrames, steady: NDArray[np.bool_], longest_s: float) -> list[Segment]:
    """Return the steady stretches of the seen frames (N), cut into parts of at most a length [s]."""
    found, length = [], whole.times_s.shape[1]
    for own in track.episodes:
        parts = _parts(track.times[own], steady[own], longest_s)
        rows = track.rows[own].tolist()
        found += [Segment(rows[0] // length, rows[first] % length, rows[last] % length) for first, last in parts]
    return found


@dataclass(frozen=True)
class _SeenFrames:
    """Seen frames (N) of the episodes of which a frame is asked for, one episode after another."""

    rows: Tensor
    """Their places among all frames of all episodes, shape (N,)."""
    times: Array
    """Their times, shape (N,) [s]."""
    episodes: list[slice]
    """Where each episode's frames are, two or more."""

    @staticmethod
    def of(whole: Observations, asked: Tensor) -> _SeenFrames:
        """Return them, of frames (E, T) that are asked for."""
        seen = whole.seen.amax(-1) > 0  # any frame may be hidden, the first included
        seen &= ((asked & seen).any(1) & (seen.sum(1) > 1))[:, None]
        rows = seen.flatten().nonzero()[:, 0]
        ends = [0, *itertools.accumulate(count for count in seen.sum(1).tolist() if count)]
        return _SeenFrames(rows, whole.times_s.flatten()[rows].numpy(), [slice(*ab) for ab in itertools.pairwise(ends)])

    def beside(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the chosen frames (N,) and those next to one in an episode."""
        wide = chosen.copy()
        for own in self.episodes:
            wide[own][1:] |= chosen[own][:-1]
            wide[own][:-1] |= chosen[own][1:]
        return wide

    def windows(self, asked: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], Array]]:
        """Yield asked frames (n,), those within some steps of each (n, w), and their distance (n, w) [s].

        Frames with as many others near them come together.
        """
        firsts, ends = np.zeros((2, len(self.times)), np.int64)
        for own in self.episodes:
            times = self.times[own]
            step = float(np.median(np.diff(times)))
            reach = (max(SIDE_FRAMES, round(SIDE_S / step)) + 0.5) * step
            firsts[own] = own.start + np.searchsorted(times, times - reach)
            ends[own] = own.start + np.searchsorted(times, times + reach)
        for width in np.unique((ends - firsts)[asked]).tolist():
            places = np.flatnonzero((ends - firsts == width) & asked)
            frames = firsts[places, None] + np.arange(width)
            yield places, frames, self.times[frames] - self.times[places, None]


def grounded_states(segments: Segments, state: State) -> State:
    """Return states with the body on the ground in its mean orientation, without speed along the normal."""
    if on_surfaces(segments.world):
        return carried_states(segments, state)
    seen, world = segments.observations, segments.world
    (normal, offset), index = GroundPlane.of(world), seen.free[0]
    fields = [value.clone() for value in state.tensors]
    weight = seen.has_orientation[:, :, 0, None]
    up = quat_to_matrix(seen.quat_wxyz[:, :, 0]).transpose(-1, -2) @ normal
    up = torch.nn.functional.normalize((up * weight).sum(1), dim=-1)
    now = quat_to_matrix(fields[1][:, index]).transpose(-1, -2) @ normal
    # the shortest turn, in body axes, that brings the mean direction of the normal to where it is now
    turn = torch.cat((1 + (up * now).sum(-1, keepdim=True), torch.linalg.cross(up, now)), -1)
    fields[1][:, index] = quat_multiply(fields[1][:, index], torch.nn.functional.normalize(turn, dim=-1))
    body = world.bodies[index]
    chosen = slice(None) if body.on_plane is None else body.on_plane
    along = quat_to_matrix(fields[1][:, index]).transpose(-1, -2) @ normal
    low = (fields[0][:, index] @ normal - offset[0])[:, None] + along @ body.centers[0, chosen].T
    low = (low - body.radii[0, chosen]).amin(-1)
    fields[0][:, index] -= low[:, None] * normal
    fields[2][:, index] -= (fields[2][:, index] @ normal)[:, None] * normal
    return State(*fields)


def carried_states(segments: Segments, state: State) -> State:
    """Return states with the body on its surfaces, as deep as the law of `segments` carries it, moving along them.

    A ball whose orientation was not measured rolls, as it does some tenths of a second after it was let go.
    """
    seen, world = segments.observations, segments.world
    index = seen.free[0]
    body, fields = world.bodies[index], [value.clone() for value in state.tensors]
    turned, within = seen.has_orientation[:, :, 0], within_of(segments.noise.position_m)
    if not is_round(body) and seen.carried is not None:
        normals = seen.carried[:, :, 2]  # the largest moment comes last
        up = (quat_to_matrix(seen.quat_wxyz[:, :, 0]).mT @ normals[..., None]).squeeze(-1)
        up = torch.nn.functional.normalize((up * turned[..., None]).sum(1), dim=-1)
        now = (quat_to_matrix(fields[1][:, index]).mT @ normals[:, 0, :, None]).squeeze(-1)
        # the shortest turn, in body axes, that brings the mean direction of the normal to where it is now
        turn = torch.cat((1 + (up * now).sum(-1, keepdim=True), torch.linalg.cross(up, now)), -1)
        fields[1][:, index] = quat_multiply(fields[1][:, index], torch.nn.functional.normalize(turn, dim=-1))
    reach = LIMITS.near_surface_m + LIMITS.near_sigmas * segments.noise.position_m + within
    for _ in range(LIFTS):
        support = Support.of(world, index, fields[0][:, index], fields[1][:, index], reach)
        depth = SINKS * contact_law(world).contact_time_s[0].square() * (support.normal @ -world.gravity[0])
        fields[0][:, index] += support.lifted(within, depth)
    support = Support.of(world, index, fields[0][:, index], fields[1][:, index], reach)
    carried, velocity = support.carried(within), fields[2][:, index]
    velocity = velocity - (carried.mT @ (carried @ velocity[..., None])).squeeze(-1)
    fields[2][:, index] = velocity
    if is_round(body):
        known = (turned.sum(1) >= 2)[:, None]
        spin = support.rolling(within, velocity, float(body.radii[0].max()))
        spin = (quat_to_matrix(fields[1][:, index]).mT @ spin[..., None]).squeeze(-1)
        fields[3][:, index] = torch.where(known, fields[3][:, index], spin)
    return State(*fields)


def _impacts(
    body: Body,
    normal: Tensor | None,
    whole: Observations,
    track: _SeenFrames,
    noise: Noise,
    asked: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return which of the asked frames are within one frame of a jump of the speed along the normal, or of the tilting.

    Args:
        body: The body.
        normal: Normal of the ground (3,); None for jumps of the velocity in any direction.
        whole: The episodes.
        track: Their seen frames (N).
        noise: Standard deviations of the tracks.
        asked: Which of these are asked for, shape (N,); the answer for others means nothing.
    """
    place = whole.position_m[:, :, 0].flatten(0, 1)[track.rows]
    heights = (place if normal is None else (place @ normal)[:, None]).numpy()
    sigmas = LIMITS.kink_sigmas if normal is None else LIMITS.jump_sigmas
    quat, turned = whole.quat_wxyz[:, :, 0].flatten(0, 1)[track.rows], _turned(whole, track)
    level = torch.eye(3).to(place) if normal is None else tangent_axes(normal)[1:]
    jumps = np.zeros(len(track.times), np.bool_)
    for places, frames, t in track.windows(track.beside(asked)):
        inverse = np.linalg.pinv(np.stack([np.ones_like(t), t, t**2, np.maximum(t, 0.0)], -1))[:, 3]
        spread = np.linalg.norm(inverse, axis=1)
        least = np.maximum(LIMITS.jump_m_s, sigmas * noise.position_m * spread)
        found = np.linalg.norm((inverse[..., None] * heights[frames]).sum(1), axis=1) > least
        known = turned[frames].all(1)
        if not is_round(body) and known.any():  # an impact of a ball never changes its spin alone
            now = quat_conjugate(quat[torch.from_numpy(places)])[:, None]
            turns = quat_log(quat_multiply(quat[torch.from_numpy(frames)], now))  # world axes
            tilting = np.linalg.norm(np.einsum("nw,nwa->na", inverse, (turns @ level.T).numpy()), axis=1)
            least = np.maximum(LIMITS.jump_m_s / size_of(body), LIMITS.jump_sigmas * noise.rotation_rad * spread)
            found |= known & (tilting > least)
        jumps[places] = found & ((t < 0).sum(1) >= 2) & ((t > 0).sum(1) >= 2)
    return track.beside(jumps)


def _turned(whole: Observations, track: _SeenFrames) -> NDArray[np.bool_]:
    """Return at which of the seen frames (N,) the orientation was measured."""
    return (whole.has_orientation[:, :, 0].flatten()[track.rows] > 0).numpy()


def _tilting(
    normal: Tensor, whole: Observations, track: _SeenFrames, noise_rad: float, asked: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return at which of the asked frames the body does not stay on one of its sides; arguments as of `_impacts`."""
    turned = _turned(whole, track)
    quat = whole.quat_wxyz[:, :, 0].flatten(0, 1)[track.rows]
    up = (quat_to_matrix(quat).transpose(-1, -2) @ normal).numpy()
    tilts = np.zeros(len(track.times), np.bool_)
    for places, frames, t in track.windows(asked):
        known = turned[frames]
        # a frame that does not count is a row of zeros
        slope = np.linalg.pinv(np.stack([np.ones_like(t), t], -1) * known[..., None])[:, 1]
        least = np.maximum(LIMITS.tilting_rad_s, LIMITS.jump_sigmas * noise_rad * np.linalg.norm(slope, axis=1))
        tilting = np.linalg.norm(np.einsum("nw,nwa->na", slope, up[frames]), axis=1)
        tilts[places] = (known.sum(1) >= 3) & (tilting > least)
    return tilts


def _parts(times: Array, steady: NDArray[np.bool_], longest_s: float) -> list[tuple[int, int]]:
    """Return first and last frames of the steady stretches that are long enough, cut into equal parts of a length."""
    found: list[tuple[int, int]] = []
    steps = np.diff(times)
    breaks = np.append(False, steps > TRACK_THRESHOLDS.segmentation.gap * np.median(steps))
    edges = np.flatnonzero(np.append(True, (steady[1:] != steady[:-1]) | breaks[1:]))
    for first, end in itertools.pairwise([*edges.tolist(), len(times)]):
        length = times[end - 1] - times[first]
        if not steady[first] or length < LIMITS.shortest_s:
            continue
        number = int(np.ceil(length / longest_s - 1e-9))
        cuts = [first + round(k * (end - 1 - first) / number) for k in range(number + 1)]
        found += itertools.pairwise(cuts)
    return found
