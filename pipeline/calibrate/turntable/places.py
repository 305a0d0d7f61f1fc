"""Where on a turntable photos were taken that COLMAP did not register: one angle each, from their verified matches."""

from __future__ import annotations

from collections.abc import Mapping as Map
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..reconstruction import Array, SfmCamera, SfmModel, VerifiedPair
from .motion import TurntableMotion, about_z
from .points import with_points

MOVED_PX = 2.0
"""Least displacement of a match that tells an angle [px]: what stands with the camera, and outlines, do not move."""
_ANGLES = 720
_FINE, _FINE_STEPS = 0.5, 21
_AGREE_PX = 2.0
"""Distance to the epipolar line below which a match agrees [px]."""
_LEAST_AGREE, _LEAST_SHARE = 12, 0.5
"""Least number of matches that agree with the angle of a photo, and least share of its matches."""
_CLEAR = 1.3
"""By how much more matches must agree with an angle than with any that is further than 10 degrees from it."""
_APART_DEG = 10.0


@dataclass(frozen=True)
class _Place:
    """An angle of a photo on a ring, and the number of matches that agree with it."""

    ring: int
    angle: float
    agree: int


def with_places(
    model: SfmModel, motion: TurntableMotion, pairs: Sequence[VerifiedPair], cameras: Map[str, str]
) -> tuple[SfmModel, TurntableMotion]:
    """Place further photos on the rings of a turntable, one after the other, those with most evidence first.

    Args:
        model: The model, with the axis of the turntable along z.
        motion: Its motion.
        pairs: Verified pairs of all photos.
        cameras: Name of the camera of each photo that may be placed.

    Returns:
        The model and the motion with these photos; where there are any, the points are made anew from all matches that
        agree with the poses, and have no colour yet.
    """
    moving = [_moving(pair) for pair in pairs]
    touching: dict[str, list[VerifiedPair]] = {}
    for pair in moving:
        touching.setdefault(pair.image_a, []).append(pair)
        touching.setdefault(pair.image_b, []).append(pair)
    left = [name for name, camera in cameras.items() if name not in model.T_cam_world and camera in model.cameras]
    placed = motion
    while left:
        poses = placed.poses()
        places = {}
        for name in left:
            lens = model.cameras[cameras[name]]
            known = [pair for pair in touching.get(name, []) if _other(pair, name) in poses]
            place = _place(name, lens, known, placed, {image: model.cameras[cameras[image]] for image in poses})
            if place is not None:
                places[name] = place
        if not places:
            break
        best = max(places, key=lambda name: places[name].agree)
        placed = _added(placed, best, places[best])
        left.remove(best)
    if placed is motion:
        return model, motion
    whole = replace(
        model,
        T_cam_world=placed.poses(),
        image_camera={image: cameras[image] for image in placed.poses()},
    )
    return with_points(whole, moving), placed


def _moving(pair: VerifiedPair) -> VerifiedPair:
    moved = np.linalg.norm(pair.xy_a - pair.xy_b, axis=1) > MOVED_PX
    return replace(pair, xy_a=pair.xy_a[moved], xy_b=pair.xy_b[moved])


def _other(pair: VerifiedPair, name: str) -> str:
    return pair.image_b if pair.image_a == name else pair.image_a


def _place(
    name: str,
    lens: SfmCamera,
    pairs: Sequence[VerifiedPair],
    motion: TurntableMotion,
    lenses: Map[str, SfmCamera],
) -> _Place | None:
    """Return where a photo was taken, or None if its matches with placed photos do not tell."""
    if sum(len(pair.xy_a) for pair in pairs) < _LEAST_AGREE:
        return None
    poses = motion.poses()
    sides = [_sides(pair, name, lens, lenses[_other(pair, name)]) for pair in pairs]
    others = [poses[_other(pair, name)] for pair in pairs]
    found: list[tuple[int, Array, Array]] = []
    coarse = np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False)
    for ring, standing in enumerate(motion.T_cam_axis):
        if len(motion.rings[ring]) > 1:
            found.append((ring, coarse, _agreeing(standing, coarse, sides, others, lens.focal_px)))
    if not found:
        return None
    ring, _, counts = max(found, key=lambda item: item[2].max())
    peak = float(coarse[counts.argmax()])
    fine = peak + np.radians(np.linspace(-_FINE, _FINE, _FINE_STEPS))
    agree = _agreeing(motion.T_cam_axis[ring], fine, sides, others, lens.focal_px)
    best = int(agree.max())
    angle = float(np.mean(fine[agree == best]))
    total = sum(len(pair.xy_a) for pair in pairs)
    away = np.abs(np.angle(np.exp(1j * (coarse - angle)))) > np.radians(_APART_DEG)
    rival = max(int(item[2][away].max()) for item in found)
    if best < max(_LEAST_AGREE, _LEAST_SHARE * total) or best < _CLEAR * rival:
        return None
    return _Place(ring, angle, best)


def _sides(pair: VerifiedPair, name: str, lens: SfmCamera, other: SfmCamera) -> tuple[Array, Array]:
    """Return the rays of a pair's matches in the photo `name` and in the other one."""
    mine, theirs = (pair.xy_a, pair.xy_b) if pair.image_a == name else (pair.xy_b, pair.xy_a)
    return lens.rays(mine), other.rays(theirs)


def _agreeing(
    standing: Array, angles: Array, sides: Sequence[tuple[Array, Array]], others: Sequence[Array], focal_px: float
) -> Array:
    """Return with how many matches each angle (angle,) of a photo agrees, shape (angle,)."""
    poses = np.array([standing @ about_z(angle) for angle in angles])
    total = np.zeros(len(angles))
    for (mine, theirs), other in zip(sides, others, strict=True):
        rotation = poses[:, :3, :3] @ other[:3, :3].T
        shift = poses[:, :3, 3] - rotation @ other[:3, 3]
        x, y, z = shift.T
        zero = np.zeros_like(x)
        cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
        essential = cross @ rotation  # mine^T E theirs = 0
        a, b = np.column_stack([mine, np.ones(len(mine))]), np.column_stack([theirs, np.ones(len(theirs))])
        line = np.einsum("kij,nj->kni", essential, b)
        back = np.einsum("kji,nj->kni", essential, a)
        algebraic = np.abs(np.einsum("kni,ni->kn", line, a))
        slope = np.sqrt((line[..., :2] ** 2).sum(-1) + (back[..., :2] ** 2).sum(-1))
        total += (algebraic * focal_px < _AGREE_PX * np.maximum(slope, np.finfo(float).tiny)).sum(1)
    return total


def _added(motion: TurntableMotion, name: str, place: _Place) -> TurntableMotion:
    rings = list(motion.rings)
    rings[place.ring] = (*rings[place.ring], name)
    return TurntableMotion(tuple(rings), motion.T_cam_axis, {**motion.angles, name: place.angle})
