"""Glides: stretches in which a body stays on the ground without an impact, sliding, rolling or spinning.

There the normal force is the weight whatever the law of contact, so that engines that differ by far at an impact agree,
and the information about a friction grows with the fourth power of the time as it does in flight. So glides are cut
long, where other contacts are cut short.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..estimation.observations import Observations
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply, quat_to_matrix
from ..physics.sweeps import tangent_axes
from ..physics.world import State, World
from .cuts import GAP, Segment, without_rest
from .phases import heights_of, is_round, size_of
from .segments import Segments

Array = NDArray[np.float64]

LONGEST_S, SHORTEST_S = 0.5, 0.15
"""A glide is cut into equal parts of at most this length; a shorter one is left to the other contacts."""
NEAR_M, NEAR_SIGMAS = 0.0015, 3.0
"""On the ground: the lowest point lies below this height, and so many standard deviations of the noise."""
SIDE_S, SIDE_FRAMES = 0.04, 3
"""An impact is a jump of the velocity along the normal, or of tilting, between so much before and after it."""
TILTING_RAD_S = 0.3
"""A body that is not round and tilts faster than this, or so many standard deviations (below), turns over an edge."""
JUMP_M_S, JUMP_SIGMAS = 0.12, 4.0
"""A jump of any point of the body by this speed, or so many standard deviations where those are more, is an impact."""


def glides_of(world: World, whole: Observations, clear: Tensor, noise: tuple[float, float]) -> list[Segment]:
    """Return the glides of whole episodes; none without a ground or with several free bodies.

    Args:
        world: For shape and ground.
        whole: The episodes (E).
        clear: Frames (E, T) that are surely in flight.
        noise: Of the tracks (position [m], rotation [rad]).
    """
    if world.ground_normal is None or len(whole.free) != 1 or len(world.bodies) != 1:
        return []
    body = world.bodies[whole.free[0]]
    margin = NEAR_M + NEAR_SIGMAS * float(np.hypot(noise[0], noise[1] * size_of(body)))
    lowest = heights_of(world, body, whole, 0).amin(-1)
    on = (lowest < margin) & ~clear & (whole.seen[:, :, 0] > 0)
    found = []
    for episode, times in enumerate(whole.times_s):
        seen = (whole.seen[episode].amax(-1) > 0).nonzero()[:, 0]  # the first may be hidden, and any of the others
        if len(seen) < 2:
            continue
        steady = on[episode, seen].numpy() & ~_impacts(world, whole, episode, seen, noise)
        if not is_round(body):
            steady &= ~_tilting(world, whole, episode, seen, noise[1])
        parts = _parts(times[seen].numpy(), steady)
        found += [Segment(episode, int(seen[first]), int(seen[last])) for first, last in parts]
    return without_rest(whole, found, noise)


def settled(segments: Segments, state: State) -> State:
    """Return states with the body on the ground as it lies on average, and no speed along the normal."""
    seen, world = segments.observations, segments.world
    assert world.ground_normal is not None and world.ground_offset is not None
    normal, index = world.ground_normal, seen.free[0]
    fields = [value.clone() for value in vars(state).values()]
    weight = seen.turned[:, :, 0, None]
    up = quat_to_matrix(seen.quat_wxyz[:, :, 0]).transpose(-1, -2) @ normal
    up = torch.nn.functional.normalize((up * weight).sum(1), dim=-1)
    now = quat_to_matrix(fields[1][:, index]).transpose(-1, -2) @ normal
    # the shortest turn, in body axes, that brings the mean direction of the normal to where it is now
    turn = torch.cat((1 + (up * now).sum(-1, keepdim=True), torch.linalg.cross(up, now)), -1)
    fields[1][:, index] = quat_multiply(fields[1][:, index], torch.nn.functional.normalize(turn, dim=-1))
    body = world.bodies[index]
    chosen = slice(None) if body.on_plane is None else body.on_plane
    along = quat_to_matrix(fields[1][:, index]).transpose(-1, -2) @ normal
    low = (fields[0][:, index] @ normal - world.ground_offset[0])[:, None] + along @ body.centers[0, chosen].T
    low = (low - body.radii[0, chosen]).amin(-1)
    fields[0][:, index] -= low[:, None] * normal
    fields[2][:, index] -= (fields[2][:, index] @ normal)[:, None] * normal
    return State(*fields)


def _impacts(
    world: World, whole: Observations, episode: int, seen: Tensor, noise: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return which of the seen frames are within one of a jump of the speed along the normal, or of the tilting."""
    assert world.ground_normal is not None
    body = world.bodies[whole.free[0]]
    height = (whole.position_m[episode, seen, 0] @ world.ground_normal)[:, None].numpy()
    quat, turned = whole.quat_wxyz[episode, seen, 0], whole.turned[episode, seen, 0].numpy() > 0
    level = tangent_axes(world.ground_normal)[1:]
    jumps = np.zeros(len(seen), np.bool_)
    for k, frames, t in _windows(whole.times_s[episode, seen].numpy()):
        if (t < 0).sum() < 2 or (t > 0).sum() < 2:
            continue
        inverse = np.linalg.pinv(np.stack([np.ones_like(t), t, t**2, np.maximum(t, 0.0)], 1))[3]
        spread = float(np.linalg.norm(inverse))
        jumps[k] = np.abs(inverse @ height[frames]).max() > max(JUMP_M_S, JUMP_SIGMAS * noise[0] * spread)
        if is_round(body) or not turned[frames].all():
            continue  # no impact changes only how a ball spins
        turns = quat_log(quat_multiply(quat[frames], quat_conjugate(quat[k : k + 1])))  # world axes
        tilting = np.linalg.norm(inverse @ (turns @ level.T).numpy())
        jumps[k] |= tilting > max(JUMP_M_S / size_of(body), JUMP_SIGMAS * noise[1] * spread)
    wide = jumps.copy()
    wide[1:] |= jumps[:-1]
    wide[:-1] |= jumps[1:]
    return wide


def _tilting(world: World, whole: Observations, episode: int, seen: Tensor, noise_rad: float) -> NDArray[np.bool_]:
    """Return about which of the seen frames the body does not stay on one of its sides."""
    assert world.ground_normal is not None
    turned = whole.turned[episode, seen, 0].numpy() > 0
    up = (quat_to_matrix(whole.quat_wxyz[episode, seen, 0]).transpose(-1, -2) @ world.ground_normal).numpy()
    tilts = np.zeros(len(seen), np.bool_)
    for k, frames, t in _windows(whole.times_s[episode, seen].numpy()):
        known = turned[frames]
        if known.sum() < 3:
            continue
        slope = np.linalg.pinv(np.stack([np.ones(int(known.sum())), t[known]], 1))[1]
        spread = float(np.linalg.norm(slope))
        tilts[k] = np.linalg.norm(slope @ up[frames][known]) > max(TILTING_RAD_S, JUMP_SIGMAS * noise_rad * spread)
    return tilts


def _windows(times: Array) -> Iterator[tuple[int, slice, Array]]:
    """Yield the place of each frame (at least two), the frames no further from it than some steps, and how far [s]."""
    step = float(np.median(np.diff(times)))
    side = max(SIDE_FRAMES, round(SIDE_S / step))
    reach = (side + 0.5) * step
    firsts, ends = np.searchsorted(times, times - reach), np.searchsorted(times, times + reach)
    for k, (first, end) in enumerate(zip(firsts, ends, strict=True)):
        yield k, slice(first, end), times[first:end] - times[k]


def _parts(times: Array, steady: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last frames of the steady stretches that are long enough, cut into equal parts."""
    found: list[tuple[int, int]] = []
    steps = np.diff(times)
    breaks = np.append(False, steps > GAP * np.median(steps))
    edges = np.flatnonzero(np.append(True, (steady[1:] != steady[:-1]) | breaks[1:]))
    for first, end in itertools.pairwise([*edges.tolist(), len(times)]):
        length = times[end - 1] - times[first]
        if not steady[first] or length < SHORTEST_S:
            continue
        number = int(np.ceil(length / LONGEST_S - 1e-9))
        cuts = [first + round(k * (end - 1 - first) / number) for k in range(number + 1)]
        found += itertools.pairwise(cuts)
    return found
