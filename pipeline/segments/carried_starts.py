"""Detection of episodes that begin while something carries or pushes the body: its acceleration steps at the release.

Backwards in time the same shows flights that end in a hand or a net, which slows the body down.

Until the release at t_r a body has an acceleration that its free motion has not: x(t) = p(t) + A (t_r - t)^2 / 2 for
t < t_r, with a polynomial p of second degree and continuous velocity. What holds a body still carries its weight, and a
hand that throws it does more, so A is of the size of gravity and points up; effects of air, wind or tilt have no step
of that size, and the rounded beginning of an impact is one down. On the ground, no contact makes a body gain speed
faster than by friction: there A has to be along the motion. A filter rounds the step; its width, a property of the
capture, is fitted with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.world import World
from ..trajectories.observations import Observations
from ..trajectories.segmentation import clear_frames
from ..trajectories.track_noise import Noise
from .sliding.support import Support
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.carried
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Beginning:
    """The first frames of a body in an episode: all in flight, or all on the ground."""

    episode: int
    """Index of the episode."""
    frames: NDArray[np.intp]
    """Their indices (n)."""
    times_s: Array
    """Times since the first one (n) [s]."""
    places_m: Array
    """Positions (n, d) [m]: all three coordinates in flight, those along the ground on it."""
    airborne: bool
    """Whether it begins in flight."""
    up: Array
    """Unit vector (3,) against gravity."""

    def without_a_row(self, step: Step) -> Iterator[Beginning]:
        """Yield it without its last frame, its last two, and the frame that a step explains least.

        What holds a body shows in many frames; one wrong row, which no step is needed to explain, does not.
        """
        count, worst = len(self.frames), int((step.residual_m**2).sum(1).argmax())
        for left_out in ([count - 1], [count - 2, count - 1], [worst]):
            kept = np.delete(np.arange(count), left_out)
            yield replace(self, frames=self.frames[kept], times_s=self.times_s[kept], places_m=self.places_m[kept])


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """The step of acceleration that explains a beginning best."""

    release_s: float
    """Time since the first frame [s]."""
    size_m_s2: float
    """Size of the step [m/s2]; 0 where none is admissible."""
    known_m_s2: float
    """Its standard error for independent errors of 1 m [m/s2]."""
    residual_m: Array
    """What is left (n, d) [m]."""


def carried_starts(world: World, whole: Observations, noise: Noise) -> dict[int, int]:
    """Return the first free frame of each episode that begins while the body is carried or pushed, by index.

    Worlds with several bodies, of which one may push another, have none.

    Args:
        world: With the shape, the ground and gravity.
        whole: The episodes.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    return _free_frames(world, list(_beginnings(world, whole, noise)) if len(world.bodies) == 1 else [])


def carried_ends(world: World, whole: Observations, noise: Noise) -> dict[int, int]:
    """Return the last free frame of each episode that ends in the air while something slows the body, by index.

    Arguments as of `carried_starts`.
    """
    return _free_frames(world, list(_ends(world, whole, noise)) if len(world.bodies) == 1 else [])


def _free_frames(world: World, begun: Sequence[Beginning]) -> dict[int, int]:
    """Return the first free frame of each beginning with a step of acceleration, by index of the episode."""
    if not begun:
        return {}
    least = LIMITS.weights * float(world.gravity.norm())
    tried = {width: [_step(one, width) for one in begun] for width in LIMITS.widths_s}
    width, steps = min(tried.items(), key=lambda item: _left(item[1]))
    spread = _spread(steps)
    found = {}

    def large(step: Step) -> bool:
        return step.size_m_s2 >= max(least, LIMITS.sigmas * spread * step.known_m_s2)

    for one, step in zip(begun, steps, strict=True):
        if large(step) and all(large(_step(some, width)) for some in one.without_a_row(step)):
            # the error of the release's time is about one frame
            free = int(np.searchsorted(one.times_s, step.release_s + LIMITS.rounded * width)) + 1
            if free < len(one.frames):
                found[one.episode] = int(one.frames[free])
    return found


def _beginnings(world: World, whole: Observations, noise: Noise) -> Iterator[Beginning]:
    """Yield the first frames of the episodes that have enough of them."""
    clear, normal = clear_frames(world, whole, noise).numpy(force=True), world.ground_normal
    up = -(world.gravity / world.gravity.norm()).flatten().numpy(force=True).astype(np.float64)
    for episode, times in enumerate(whole.times_s.numpy(force=True)):
        seen = np.nonzero(whole.seen[episode, :, 0].numpy(force=True) > 0)[0]
        if not len(seen):
            continue
        airborne = bool(clear[episode, seen[0]])
        other = np.nonzero(clear[episode, seen] != airborne)[0]
        frames = seen[: other[0]] if len(other) else seen
        frames = frames[times[frames] - times[frames[0]] <= LIMITS.window_s]
        if len(frames) < LIMITS.least_frames:
            continue
        places = whole.position_m[episode, frames, 0].numpy(force=True).astype(np.float64)
        if not airborne and normal is not None:
            across = normal.numpy(force=True).astype(np.float64)
            places = places - (places @ across)[:, None] * across
        elif not airborne and _bends(world, whole, episode, frames):
            continue
        since = (times[frames] - times[frames[0]]).astype(np.float64)
        yield Beginning(episode=episode, frames=frames, times_s=since, places_m=places, airborne=airborne, up=up)


def _bends(world: World, whole: Observations, episode: int, frames: NDArray[np.intp]) -> bool:
    """Return whether the surfaces under a body turn between frames (n), where no acceleration is constant."""
    if not world.surfaces or len(world.free) != 1:
        return False
    places, turns = whole.position_m[episode, frames, 0], whole.quat_wxyz[episode, frames, 0]
    reach_m = SEGMENT_THRESHOLDS.sliding_data.near_surface_m
    normals = Support.of(world, whole.free[0], places, turns, 2 * reach_m).mean(reach_m)
    known = normals[normals.norm(dim=-1) > 0]
    return len(known) > 1 and float((known @ known[0]).min()) < np.cos(LIMITS.bend_rad)


def _ends(world: World, whole: Observations, noise: Noise) -> Iterator[Beginning]:
    """Yield the last frames of the episodes that end in the air, backwards in time."""
    clear = clear_frames(world, whole, noise).numpy(force=True)
    for episode, times in enumerate(whole.times_s.numpy(force=True)):
        seen = np.nonzero(whole.seen[episode, :, 0].numpy(force=True) > 0)[0][::-1]
        touched = np.nonzero(~clear[episode, seen])[0]
        frames = seen[: touched[0]] if len(touched) else seen
        frames = frames[times[seen[0]] - times[frames] <= LIMITS.window_s] if len(seen) else frames
        if len(frames) < LIMITS.least_frames:
            continue
        places = whole.position_m[episode, frames, 0].numpy(force=True).astype(np.float64)
        since = (times[frames[0]] - times[frames]).astype(np.float64)
        # what slows it down pulls it back to where it came from
        yield Beginning(episode=episode, frames=frames, times_s=since, places_m=places, airborne=False, up=np.zeros(3))


def _step(one: Beginning, width_s: float) -> Step:
    """Return the step of acceleration that explains a beginning best, rounded by a filter of a width [s]."""
    scale = one.times_s[-1]
    powers = np.vander(one.times_s / scale, 3, increasing=True)
    basis = np.linalg.qr(powers)[0]
    plain = one.places_m - basis @ (basis.T @ one.places_m)
    latest = min(LIMITS.longest_s, scale - LIMITS.free_s)
    releases = one.times_s[one.times_s <= latest]
    best = Step(release_s=0.0, size_m_s2=0.0, known_m_s2=0.0, residual_m=plain)
    if not len(releases):
        return best
    shapes = _shape(releases[:, None] - one.times_s, width_s)
    shapes = shapes - (shapes @ basis) @ basis.T
    square = (shapes**2).sum(1)
    sizes = np.divide(shapes @ plain, square[:, None], out=np.zeros((len(square), 3)), where=square[:, None] > 0)
    gains = square * (sizes**2).sum(1)
    gains[sizes @ (one.up if one.airborne else one.places_m[-1] - one.places_m[0]) <= 0] = 0.0
    place = int(gains.argmax())
    if gains[place] <= 0:
        return best
    return Step(
        release_s=float(releases[place]),
        size_m_s2=float(np.linalg.norm(sizes[place])),
        known_m_s2=float(1 / np.sqrt(square[place])),
        residual_m=plain - shapes[place][:, None] * sizes[place],
    )


def _shape(before_s: Array, width_s: float) -> Array:
    """Return (t_r - t)^2 / 2 until the release and 0 after it, convolved with a normal density of a width [s]."""
    if width_s <= 0:
        return 0.5 * before_s.clip(0.0) ** 2
    x = before_s / width_s
    below = torch.special.ndtr(torch.as_tensor(x)).numpy()
    density = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    return 0.5 * width_s**2 * ((x**2 + 1) * below + x * density)


def _left(steps: Sequence[Step]) -> float:
    return sum(float((step.residual_m**2).sum()) for step in steps)


def _spread(steps: Sequence[Step]) -> float:
    """Return the standard deviation of the residuals [m] that independent errors as uncertain as these would have.

    Errors with correlation r between neighbouring frames carry (1 - r) / (1 + r) as much information.
    """
    usual = float(np.median([(step.residual_m**2).sum() / max(step.residual_m.size - 9, 1) for step in steps]))
    products = sum(float((step.residual_m[1:] * step.residual_m[:-1]).sum()) for step in steps)
    alike = float(np.clip(products / max(_left(steps), 1e-30), 0.0, LIMITS.most_alike))
    return float(np.sqrt(usual * (1 + alike) / (1 - alike)))
