"""What no verdict can rest on: tracks, shapes and masses that do not belong together, and episodes that show nothing.

Each refusal says what was found, what would be usable, and what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...datasets.tracks import Track
from ...schemas import InputDataError
from ..estimation.noise import estimate_noise
from ..estimation.observations import Observations
from ..estimation.warmup import clearance
from ..physics.world import World
from .cuts import whole_episodes
from .phases import size_of
from .prepared import Prepared

LONGEST_STEP_S = 0.2
"""Slower tracks show no flight; those in milliseconds look so."""
MOST_OFF = 0.2
"""A body whose lowest point lies deeper than this share of its size under the ground, or rests higher above it, has
another shape or ground."""
NOISE_SIGMAS = 2.0
"""Beyond it: 2 % of the frames of a body at rest are measured so much deeper, of a box, whose corners all may, 5 %."""
MOST_TILT = 0.1
"""Of the measured frame [rad], for a ground that is level in the manifest: an error of measurement that has a name."""
ENVELOPE_ITERATIONS, ENVELOPE_WEIGHT = 20, 0.02
"""Of the plane under all places: an expectile (Newey & Powell 1987), in which what lies above weighs so little."""
MOST_CARRIED = 0.2
"""Of the frames, above the ground and yet not falling."""
DENSEST_KG_M3 = 23000.0
"""Osmium. No body is heavier than a ball of it about the whole shape."""
ALIKE_SIGMAS = 3.0
"""Motions that differ by less, root mean square, are one motion measured several times."""
LEAST_SEEN = 0.25
"""Share of gravity: where no force below it could be told from the noise, nothing that is worth a name could."""
SHARE_OF_SIZE = 0.25
_BELONG_TOGETHER = (
    "a shape, a ground and tracks that belong together.",
    "check [[bodies]] shape, [world] ground, whether the tracks' frame is level, and which body was tracked.",
)


def refuse_strange(world: World, episodes: Sequence[tuple[str, dict[str, Track]]], where: str) -> None:
    """Refuse times in another unit, bodies that sink into the ground, and masses that no body of that shape has.

    Raises:
        InputDataError: What is wrong, and what to look at.
    """
    free = [world.bodies[k].name for k in world.free]
    refuse_slow_times([t[b] for _, t in episodes for b in free if b in t], where)
    for index in world.free:
        body = world.bodies[index]
        mass, size = float(body.mass[0]), size_of(body)
        most = DENSEST_KG_M3 * 4 / 3 * math.pi * size**3
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
                "check [[bodies]] inertia_kg_m2, mass_kg and shape, or leave the inertia out.",
            )
    whole = whole_episodes(world, episodes)
    if world.ground_normal is None or not bool(whole.turned.any()):
        return
    size = min(size_of(world.bodies[k]) for k in world.free)
    seen = whole.seen.amax(-1) > 0
    gap, place = clearance(world, whole)[seen], whole.position_m[:, :, 0][seen]
    deep = float(torch.quantile(gap, 0.05))
    if deep >= -MOST_OFF * size:
        return
    position, rotation = estimate_noise([t[name] for _, t in episodes for name in free if name in t])
    most = MOST_OFF * size + NOISE_SIGMAS * math.hypot(position, rotation * size)
    if deep < -most and not _on_a_tilted_plane(gap, place, world.ground_normal, most):
        raise InputDataError(
            f"{where}: in 5 % of the frames the body lies {-1e3 * deep:.0f} mm or more under the ground; its "
            f"size is {1e3 * size:.0f} mm.",
            *_BELONG_TOGETHER,
        )


def _on_a_tilted_plane(gap: Tensor, place: Tensor, normal: Tensor, most: float) -> bool:
    """Return whether gaps to the ground are those to one that is tilted about the origin: that has a name.

    Args:
        gap: Where the body is under the ground they are negative (n,) [m].
        place: Where the body is (n, 3) [m], world.
        normal: Of the ground (3,).
        most: Depth [m] that may be left, and that may stay at the origin, where a ground at another height differs.
    """
    under = gap < 0
    along = place - (place @ normal)[:, None] * normal  # two numbers in three: the solution of least norm
    columns = torch.cat((along, torch.ones_like(gap)[:, None]), 1)
    plane = columns.new_zeros(4)
    for _ in range(ENVELOPE_ITERATIONS):  # what flies low over the tilted ground lies above it
        weight = torch.where(gap[under] < columns[under] @ plane, 1.0, ENVELOPE_WEIGHT).sqrt()
        plane = torch.linalg.lstsq(weight[:, None] * columns[under], weight * gap[under], driver="gelsd").solution
    left = gap - columns @ plane
    level = float(plane[:3].norm()) <= MOST_TILT and abs(float(plane[3])) <= most
    return level and float(torch.quantile(left, 0.05)) >= -most


def refuse_slow_times(tracks: Sequence[Track], where: str) -> None:
    """Refuse tracks whose frames are too far apart to show a flight.

    Raises:
        InputDataError: They are probably in milliseconds.
    """
    step = float(np.median(np.concatenate([np.diff(track.time_s) for track in tracks]))) if tracks else 0.0
    if step > LONGEST_STEP_S:
        raise InputDataError(
            f"{where}: the tracks have a frame every {step:.3g} s; if these are milliseconds, they are not "
            "what the column time_s says.",
            f"at most {LONGEST_STEP_S:g} s.",
            "write time_s in seconds.",
        )


def refuse_blind(world: World, prepared: Prepared, where: str) -> None:
    """Refuse episodes that are one motion, that float or stand still, or that show nothing through their noise.

    Raises:
        InputDataError: What is wrong, and what to record or check.
    """
    whole, sigma = prepared.whole, prepared.noise[0]
    size = min(size_of(world.bodies[k]) for k in world.free)
    gravity, seen = float(world.gravity.norm()) or 9.81, prepared.least_force_m_s2
    if seen > LEAST_SEEN * gravity and sigma > SHARE_OF_SIZE * size:
        what = f"no force below {100 * seen / gravity:.0f} % of the weight" if math.isfinite(seen) else "no force"
        raise InputDataError(
            f"{where}: with a noise of {1e3 * sigma:.3g} mm on a body of {1e3 * size:.3g} mm {what} could be seen in "
            "these flights, and no contact.",
            f"noise or episodes that show {100 * LEAST_SEEN:.0f} % of the weight.",
            "record longer flights, more of them, or with less noise; check the unit of the positions.",
        )
    spread, alike = _travel(whole), _apart(whole)
    if spread < ALIKE_SIGMAS * sigma and not _turns(whole, prepared.noise[1]):
        raise InputDataError(
            f"{where}: nothing moves by more than {1e3 * spread:.2g} mm, with a noise of {1e3 * sigma:.2g} mm.",
            "motions: throws, drops, pushes, slides.",
            "record some, or check which body was tracked.",
        )
    if alike < ALIKE_SIGMAS * sigma:
        raise InputDataError(
            f"{where}: the {len(whole.names)} episodes are one motion: they differ by {1e3 * alike:.2g} mm, with a "
            f"noise of {1e3 * sigma:.2g} mm. What helps one of them helps all, which proves nothing.",
            "episodes that differ: in speed, direction and spin.",
            "record others, and check that none is a copy.",
        )
    _refuse_floating(world, prepared, where)


def _refuse_floating(world: World, prepared: Prepared, where: str) -> None:
    whole = prepared.whole
    if world.ground_normal is None or not prepared.turned or not bool(prepared.carried.any()):
        return
    gap = clearance(world, whole)
    size = min(size_of(world.bodies[k]) for k in world.free)
    high = prepared.carried & (gap > MOST_OFF * size)
    share = float(high.sum()) / max(float((whole.seen.amax(-1) > 0).sum()), 1.0)
    if share > MOST_CARRIED:
        raise InputDataError(
            f"{where}: in {100 * share:.0f} % of the frames the body is {1e3 * float(gap[high].median()):.0f} mm above "
            f"the ground and does not fall; its size is {1e3 * size:.0f} mm.",
            *_BELONG_TOGETHER,
        )


def _travel(whole: Observations) -> float:
    """Return the largest standard deviation [m] of a coordinate within an episode."""
    known = whole.seen[..., None]
    mean = (known * whole.position_m).sum(1, keepdim=True) / known.sum(1, keepdim=True).clamp_min(1.0)
    square = (known * (whole.position_m - mean).square()).sum(1) / known.sum(1).clamp_min(1.0)
    return float(square.max().sqrt())


def _turns(whole: Observations, sigma: float) -> bool:
    known = (whole.turned[..., None] * whole.quat_wxyz).abs()
    spread = known.amax(1) - torch.where(whole.turned[..., None] > 0, known, torch.inf).amin(1)
    return bool((torch.nan_to_num(spread, neginf=0.0) > 2 * ALIKE_SIGMAS * sigma).any())


def _apart(whole: Observations) -> float:
    """Return the largest root mean square distance [m], by axis, of an episode's positions from those of the first."""
    both = (whole.seen * whole.seen[:1])[1:]
    if len(both) == 0 or not bool((both.sum((1, 2)) > 0).all()):
        return math.inf
    away = (whole.position_m[1:] - whole.position_m[:1]).square().mean(-1)
    return float(((both * away).sum((1, 2)) / both.sum((1, 2))).max().sqrt())
