"""Checks before a diagnosis: units, geometry and masses that belong together, and episodes that contain information.

Each refusal states what was found, what would be usable, and what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ...schemas import InputDataError
from ..physics.body import Body
from ..physics.world import World
from ..trajectories.initial_state import clearance
from ..trajectories.observations import Observations, refuse_slow_times
from ..trajectories.segmentation import size_of, whole_episodes
from ..trajectories.track_noise import estimate_noise
from .prepare import Prepared
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.input

ENVELOPE_ITERATIONS = 20
"""Iterations of the lower envelope of all places: an expectile (Newey & Powell 1987)."""
_BELONG_TOGETHER = (
    "a shape, a ground and tracks that belong together.",
    "check [[bodies]] shape, [world] ground, whether the tracks' frame is level, that quaternions have w first and "
    "turn the body into the world, and which body was tracked.",
)
"""What would be usable and what to do, where tracks and geometry do not agree."""


def check_units_and_geometry(world: World, episodes: Sequence[Episode], where: str) -> None:
    """Refuse times in another unit, bodies deep under the ground, and masses that no body of that shape has.

    Raises:
        InputDataError: What is wrong, and what to check.
    """
    free = [world.bodies[k].name for k in world.free]
    refuse_slow_times(episodes, free, where)
    for index in world.free:
        _check_mass(world.bodies[index], where)
    _check_depth(world, episodes, where)


def _check_mass(body: Body, where: str) -> None:
    """Refuse a mass or moments of inertia that no body of that shape has."""
    mass, size = float(body.mass[0]), size_of(body)
    most = LIMITS.densest_kg_m3 * 4 / 3 * math.pi * size**3
    if mass > most:
        raise InputDataError(
            f"{where}: '{body.name}' has {mass:.3g} kg within {1e3 * size:.0f} mm of its origin; a ball of osmium "
            f"of that size has {most:.3g} kg.",
            "a mass in kilograms, and a shape in metres.",
            "check [[bodies]] mass_kg and shape.",
        )
    least, greatest = (float(v) for v in torch.linalg.eigvalsh(body.inertia[0])[[0, -1]])
    reach = float(((body.centers[0] - body.com[0]).square().sum(-1).sqrt() + body.radii[0]).max())
    if least <= 0 or greatest > mass * reach**2:
        raise InputDataError(
            f"{where}: '{body.name}' has moments of inertia of {least:.3g} to {greatest:.3g} kg m2; with all its "
            f"{mass:.3g} kg on its surface it would have {mass * reach**2:.3g} kg m2 at most.",
            "inertia_kg_m2 of that mass and shape.",
            "check [[bodies]] inertia_kg_m2, mass_kg and shape, or leave the inertia out. If it was fitted, the turns "
            "are not those of such a body: check that quaternions have w first and turn the body into the world.",
        )


def _check_depth(world: World, episodes: Sequence[Episode], where: str) -> None:
    """Refuse bodies that lie deep under the ground, unless the ground is only tilted."""
    whole = whole_episodes(world, episodes)
    if world.ground_normal is None or not bool(whole.has_orientation.any()):
        return
    size = min(size_of(world.bodies[k]) for k in world.free)
    seen = whole.seen.amax(-1) > 0
    gap, place = clearance(world, whole)[seen], whole.position_m[:, :, 0][seen]
    deep = float(torch.quantile(gap, 0.05))
    if deep >= -LIMITS.most_off * size:
        return
    free = [world.bodies[k].name for k in world.free]
    position, rotation = estimate_noise([t[name] for _, t in episodes for name in free if name in t])
    most = LIMITS.most_off * size + LIMITS.noise_sigmas * math.hypot(position, rotation * size)
    if deep < -most and not _on_a_tilted_plane(gap, place, world.ground_normal, most):
        raise InputDataError(
            f"{where}: in 5 % of the frames the body lies {-1e3 * deep:.0f} mm or more under the ground; its "
            f"size is {1e3 * size:.0f} mm.",
            *_BELONG_TOGETHER,
        )


def _on_a_tilted_plane(gap: Tensor, place: Tensor, normal: Tensor, most: float) -> bool:
    """Return whether gaps to the ground are explained by a tilt about the origin, which is a named effect.

    Args:
        gap: Gap to the ground (n,) [m], negative under it.
        place: Position of the body (n, 3) [m], world.
        normal: Normal of the ground (3,).
        most: Maximum residual depth [m], and maximum offset at the origin, which means a ground at another height.
    """
    under = gap < 0
    along = place - (place @ normal)[:, None] * normal  # rank 2 of 3: the solution of least norm
    columns = torch.cat((along, torch.ones_like(gap)[:, None]), 1)
    plane = columns.new_zeros(4)
    for _ in range(ENVELOPE_ITERATIONS):  # frames of low flight lie above the tilted ground
        weight = torch.where(gap[under] < columns[under] @ plane, 1.0, LIMITS.envelope_weight).sqrt()
        plane = torch.linalg.lstsq(weight[:, None] * columns[under], weight * gap[under], driver="gelsd").solution
    left = gap - columns @ plane
    level = float(plane[:3].norm()) <= LIMITS.most_tilt and abs(float(plane[3])) <= most
    return level and float(torch.quantile(left, LIMITS.deep_share)) >= -most


def check_observability(world: World, prepared: Prepared, where: str) -> None:
    """Refuse episodes that are one motion, that float or do not move, or whose noise hides everything.

    Raises:
        InputDataError: What is wrong, and what to record or check.
    """
    whole, sigma = prepared.observations, prepared.noise.position_m
    size = min(size_of(world.bodies[k]) for k in world.free)
    gravity, seen = float(world.gravity.norm()) or 9.81, prepared.least_force_m_s2
    if seen > LIMITS.least_seen * gravity and sigma > LIMITS.share_of_size * size:
        what = f"no force below {100 * seen / gravity:.0f} % of the weight" if math.isfinite(seen) else "no force"
        raise InputDataError(
            f"{where}: with a noise of {1e3 * sigma:.3g} mm on a body of {1e3 * size:.3g} mm {what} could be detected "
            "in these flights, and no contact.",
            f"noise and episodes in which a force of {100 * LIMITS.least_seen:.0f} % of the weight can be detected.",
            "record longer flights, more of them, or with less noise; check the unit of the positions.",
        )
    spread, alike = _travel(whole), _apart(whole)
    if spread < LIMITS.alike_sigmas * sigma and not _turns(whole, prepared.noise.rotation_rad):
        raise InputDataError(
            f"{where}: nothing moves by more than {1e3 * spread:.2g} mm, with a noise of {1e3 * sigma:.2g} mm.",
            "motions: throws, drops, pushes, slides.",
            "record some, or check which body was tracked.",
        )
    if alike < LIMITS.alike_sigmas * sigma:
        raise InputDataError(
            f"{where}: the {len(whole.names)} episodes are one motion: they differ by {1e3 * alike:.2g} mm, with a "
            f"noise of {1e3 * sigma:.2g} mm. An effect that fits one of them fits all, which is no evidence.",
            "episodes that differ: in speed, direction and spin.",
            "record others, and check that none is a copy.",
        )
    _refuse_floating(world, prepared, where)


def _refuse_floating(world: World, prepared: Prepared, where: str) -> None:
    """Refuse episodes in which the body is above the ground and not in free fall in many frames."""
    whole = prepared.observations
    if world.ground_normal is None or not prepared.has_orientation or not bool(prepared.supported.any()):
        return
    gap = clearance(world, whole)
    size = min(size_of(world.bodies[k]) for k in world.free)
    high = _resting(whole, prepared.supported & (gap > LIMITS.most_off * size), world)
    if bool(high.any()) and _rests_on_a_tilted_plane(gap[high], whole.position_m[:, :, 0][high], world, size):
        return
    share = float(high.sum()) / max(float((whole.seen.amax(-1) > 0).sum()), 1.0)
    if share > LIMITS.most_carried:
        raise InputDataError(
            f"{where}: in {100 * share:.0f} % of the frames the body is {1e3 * float(gap[high].median()):.0f} mm above "
            f"the ground and does not fall; its size is {1e3 * size:.0f} mm.",
            *_BELONG_TOGETHER,
        )


def _resting(whole: Observations, supported: Tensor, world: World) -> Tensor:
    """Return which supported frames (E, T) belong to stretches in which the body is carried and not thrown back.

    A filter smears a bounce over its window: frames around it are neither flight nor near the ground, but over the
    whole stretch the velocity along gravity changes far more than that of a body at rest.
    """
    up = -world.gravity[0] / world.gravity[0].norm().clamp_min(1e-9)
    height, resting = whole.position_m[:, :, 0] @ up, torch.zeros_like(supported)
    for episode, marks in enumerate(supported):
        frames = torch.nonzero(marks)[:, 0]
        for run in torch.tensor_split(frames, (torch.nonzero(frames.diff() > 1)[:, 0] + 1).tolist()):
            if len(run) < LIMITS.least_stretch:
                continue
            ends = torch.stack((run[:2], run[-2:]))
            times, places = whole.times_s[episode, ends], height[episode, ends]
            speed = places.diff(dim=1)[:, 0] / times.diff(dim=1)[:, 0]
            lasted = float(times[1].mean() - times[0].mean())
            resting[episode, run] = abs(float(speed[1] - speed[0])) < 0.5 * float(world.gravity.norm()) * lasted
    return resting


def _rests_on_a_tilted_plane(gap: Tensor, place: Tensor, world: World, size: float) -> bool:
    """Return whether a body is carried by a ground that is tilted about the origin, which is a named effect.

    Args:
        gap: Gap to the ground (n,) [m].
        place: Position of the body (n, 3) [m], world.
        world: The model's world.
        size: Size of the body [m].
    """
    normal = world.ground_normal
    assert normal is not None  # without a ground nothing is above it
    along = place - (place @ normal)[:, None] * normal
    plane = torch.linalg.lstsq(along, gap, driver="gelsd").solution
    left = (gap - along @ plane).abs()
    near = float(torch.quantile(left, 1 - LIMITS.deep_share)) <= LIMITS.most_off * size
    return float(plane.norm()) <= LIMITS.most_tilt and near


def _travel(whole: Observations) -> float:
    """Return the largest standard deviation [m] of a coordinate within an episode."""
    known = whole.seen[..., None]
    mean = (known * whole.position_m).sum(1, keepdim=True) / known.sum(1, keepdim=True).clamp_min(1.0)
    square = (known * (whole.position_m - mean).square()).sum(1) / known.sum(1).clamp_min(1.0)
    return float(square.max().sqrt())


def _turns(whole: Observations, sigma: float) -> bool:
    """Return whether any orientation changes by more than the noise [rad]."""
    known = (whole.has_orientation[..., None] * whole.quat_wxyz).abs()
    spread = known.amax(1) - torch.where(whole.has_orientation[..., None] > 0, known, torch.inf).amin(1)
    return bool((torch.nan_to_num(spread, neginf=0.0) > 2 * LIMITS.alike_sigmas * sigma).any())


def _apart(whole: Observations) -> float:
    """Return the largest root mean square distance [m], by axis, of an episode's positions from those of the first."""
    both = (whole.seen * whole.seen[:1])[1:]
    if len(both) == 0 or not bool((both.sum((1, 2)) > 0).all()):
        return math.inf
    away = (whole.position_m[1:] - whole.position_m[:1]).square().mean(-1)
    return float(((both * away).sum((1, 2)) / both.sum((1, 2))).max().sqrt())
