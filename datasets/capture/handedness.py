"""Whether positions and turns of a body are of one frame: what the ground does to its path it does to its spin.

A force at the point of contact changes velocity and spin together: the angular momentum about that point stays,
whatever the friction is, and a ball that rolls turns about the axis that its path says. Positions whose level axes are
mirrored or exchanged, while the turns are those of the true frame, contradict this, and nothing else shows it: they
fall and rest as they should. Torques by the path, under each exchange of axes, are compared by direction with those by
the turns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...schemas import CaptureManifest
from ..shapes.meshes import primitive_properties
from ..shapes.turns import matrix_of, turn_between
from .tracked_motion import TrackedMotion
from .unit_mistakes import Correction

Array = NDArray[np.float64]

PIECE_S, PIECE_FRAMES = 0.015, 3
"""Duration of a piece over which velocities are averaged, and its fewest steps."""
MOST_TURN_RAD = 1.5
"""Largest turn within a piece whose mean spin is known."""
SURE = 3.0
"""A change of velocity or spin counts from so many standard errors on."""
REACH = 0.15
"""Height of the lowest point over the ground below which the body may touch it, in sizes of the body."""
ROLLS = 0.07
"""Largest difference of speed and spin times radius of a ball that rolls, as a share."""
ROLLING_SHARE = 0.5
"""Share of the pieces on the ground in which a ball has to roll, for its spin itself to be compared."""
AGREES, FEWEST = 0.7, 6
"""Smallest mean cosine between the torques of the frame that is named, and fewest pieces that show it."""
NATS, SPREAD = 6.0, 0.02
"""Least difference of log-likelihood between that frame and the one as written, and the angles (1 - cosine) by which
torques are uncertain at best."""
TO_EACH = 2
"""Pieces to which one impact belongs."""
EPISODES, OF_EPISODE = 2, 3
"""Fewest episodes that have to show an exchange, and number of pieces of an episode, of changes or of rolls, from which
on they rule it out where they do not: a force that is not the ground's may look like an exchange in one episode."""
EXCHANGES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "as written": ((1.0, 0.0), (0.0, 1.0)),
    "first mirrored": ((-1.0, 0.0), (0.0, 1.0)),
    "second mirrored": ((1.0, 0.0), (0.0, -1.0)),
    "exchanged": ((0.0, 1.0), (1.0, 0.0)),
    "exchanged and mirrored": ((0.0, -1.0), (-1.0, 0.0)),
    "turned": ((0.0, -1.0), (1.0, 0.0)),
    "turned back": ((0.0, 1.0), (-1.0, 0.0)),
}
"""What undoes an exchange of the two level axes of positions. Half a turn is none of them: what a rolling resistance
takes from spin and path looks like it."""


def mirrored_axes(manifest: CaptureManifest, motions: Sequence[TrackedMotion]) -> Correction | None:
    """Return the exchange of axes that positions need to be of the frame of the turns; None if nothing shows one.

    Args:
        manifest: The capture's.
        motions: The measured motions of its free body.
    """
    ground = manifest.world.ground
    if ground is None or len(manifest.bodies) != 1 or manifest.surfaces or manifest.articulations:
        return None
    normal = np.array(ground.normal) / np.linalg.norm(ground.normal)
    turning = [m for m in motions if m.track.turns and m.outline is not None]
    solid = primitive_properties(turning[0].body.shape) if turning else None
    if solid is None:
        return None
    inertia = solid.inertia_per_kg.diagonal()
    each = [list(_cosines(m, normal, ground.offset_m, inertia)) for m in turning]
    cosines = np.concatenate([found for one in each for found in one]) if each else np.empty((0, len(EXCHANGES)))
    if len(cosines) < FEWEST:
        return None
    away = 1 - cosines.mean(0) + SPREAD
    best = int(away.argmin())
    gains = [[found[:, best] - found[:, 0] for found in one] for one in each]
    if any(len(gain) >= OF_EPISODE and gain.mean() <= 0 for one in gains for gain in one):
        return None
    if sum(float(sum(gain.sum() for gain in one)) > 0 for one in gains) < EPISODES:
        return None
    sure = len(cosines) / TO_EACH * float(np.log(away[0] / away[best])) >= NATS and 1 - away[best] >= AGREES - SPREAD
    return _correction(list(EXCHANGES)[best], normal) if sure else None


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces (P) of a track that follow each other, with their mean velocity and spin."""

    duration_s: float
    velocity: Array
    """Mean velocities [m/s], shape (P, 3)."""
    spin: Array
    """Mean angular velocities [rad/s], world axes, shape (P, 3)."""
    turn: Array
    """Orientations in the middle of each, shape (P, 3, 3)."""
    ends: NDArray[np.intp]
    """Frames between which they lie, shape (P + 1,)."""
    known: NDArray[np.bool_]
    """Whether the mean spin is known, shape (P,)."""

    @staticmethod
    def of(motion: TrackedMotion) -> _Pieces | None:
        track = motion.track
        assert track.quat_wxyz is not None
        step = float(np.median(np.diff(track.time_s)))
        count = max(PIECE_FRAMES, round(PIECE_S / max(step, 1e-9)))
        ends = np.arange(0, len(track), count)
        if len(ends) < 3:
            return None
        span = np.diff(track.time_s[ends])
        quat = track.quat_wxyz
        each = turn_between(quat[:-1], quat[1:])
        angle = np.add.reduceat(np.linalg.norm(each, axis=1), ends[:-1])[: len(span)]
        middle = matrix_of(quat[(ends[:-1] + ends[1:]) // 2])
        body = turn_between(quat[ends[:-1]], quat[ends[1:]])
        spin = (matrix_of(quat[ends[:-1]]) @ body[..., None])[..., 0] / span[:, None]
        velocity = np.diff(track.position_m[ends], axis=0) / span[:, None]
        known = (angle < MOST_TURN_RAD) & (span < 1.5 * count * step)
        return _Pieces(float(np.median(span)), velocity, spin, middle, ends, known)


def _cosines(motion: TrackedMotion, normal: Array, offset_m: float, inertia: Array) -> Iterator[Array]:
    """Yield cosines (P, 7) between the torques that a motion has by its turns and by its path, for each exchange."""
    pieces = _Pieces.of(motion)
    if pieces is None or motion.outline is None:
        return
    points, clear = _corners(motion, normal, offset_m)
    yield _changes(motion, pieces, normal, inertia, *_arms(points, clear, pieces.ends, REACH * motion.outline.size_m))
    if len(motion.outline.points) == 1:
        yield _rolls(motion, pieces, normal, clear[:, 0])


def _changes(
    motion: TrackedMotion, pieces: _Pieces, normal: Array, inertia: Array, arm: Array, alone: NDArray[np.bool_]
) -> Array:
    """Return the cosines of changes from piece to piece: of angular momentum, and the torque of what moves the body."""
    spin_body = np.einsum("pji,pj->pi", pieces.turn, pieces.spin)
    momentum = np.einsum("pij,pj->pi", pieces.turn, inertia * spin_body)
    force = np.diff(pieces.velocity, axis=0)
    upward = (force @ normal)[:, None] * normal
    torque = np.diff(momentum, axis=0) - np.cross(arm, upward - _fall(force, normal, alone))
    noise = motion.windows.noise * np.sqrt(6) / pieces.duration_s
    sure = np.linalg.norm(force - upward, axis=1) > SURE * noise
    kept = alone & sure & pieces.known[1:] & pieces.known[:-1]
    exchanged = [np.cross(arm[kept], along) for along in _exchanged(force[kept], normal)]
    return np.stack([_cosine(torque[kept], one) for one in exchanged], 1)


def _exchanged(vectors: Array, normal: Array) -> Iterator[Array]:
    """Yield the parts along the ground of vectors (P, 3) under each exchange of axes."""
    axes = np.stack([axis for axis, _ in _axes(normal)])
    for exchange in EXCHANGES.values():
        yield vectors @ axes.T @ np.array(exchange).T @ axes


def _cosine(a: Array, b: Array) -> Array:
    """Return the cosines (P,) between vectors (P, 3)."""
    return (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-30)


def _fall(force: Array, normal: Array, near: NDArray[np.bool_]) -> Array:
    """Return the change of velocity (P, 3) by gravity from piece to piece: that of pieces far from the ground."""
    free = force[~near] @ normal
    usual = float(np.median(free)) if len(free) >= 3 else 0.0
    return np.broadcast_to(min(usual, 0.0) * normal, force.shape)


def _rolls(motion: TrackedMotion, pieces: _Pieces, normal: Array, clear: Array) -> Array:
    """Return the cosines of the spin that the path of a rolling ball has and the measured one; none of other motion."""
    assert motion.outline is not None
    radius_m = motion.outline.size_m
    near = np.abs(clear[(pieces.ends[:-1] + pieces.ends[1:]) // 2]) < REACH * radius_m
    spin = pieces.spin - (pieces.spin @ normal)[:, None] * normal
    speed = np.linalg.norm(pieces.velocity - (pieces.velocity @ normal)[:, None] * normal, axis=1)
    moves = near & pieces.known & (speed > 10 * SURE * motion.windows.noise * np.sqrt(2) / pieces.duration_s)
    rolls = moves & (np.abs(radius_m * np.linalg.norm(spin, axis=1) - speed) < ROLLS * speed)
    if rolls.sum() < ROLLING_SHARE * moves.sum():
        rolls[:] = False
    path = [np.cross(normal, along) for along in _exchanged(pieces.velocity[rolls], normal)]
    return np.stack([_cosine(spin[rolls], one) for one in path], 1)


def _corners(motion: TrackedMotion, normal: Array, offset_m: float) -> tuple[Array, Array]:
    """Return the outline's lowest points from the body's origin (T, P, 3), and their heights over the ground (T, P)."""
    assert motion.outline is not None and motion.track.quat_wxyz is not None
    points = np.einsum("tij,pj->tpi", matrix_of(motion.track.quat_wxyz), motion.outline.points)
    points = points - motion.outline.radii[:, None] * normal
    return points, points @ normal + (motion.track.position_m @ normal - offset_m)[:, None]


def _arms(points: Array, clear: Array, ends: NDArray[np.intp], reach_m: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the arm (P, 3) of what touches the ground around the end of each piece, and whether one point alone does.

    Args:
        points: Lowest points of an outline, as of `_corners`.
        clear: Their heights.
        ends: Frames between which pieces lie.
        reach_m: Height below which a point may touch the ground.
    """
    # an impact may lie between two frames
    low = clear - 0.5 * np.abs(np.diff(clear, axis=0, append=clear[-1:])) < reach_m
    arms, alone = [], []
    for first, last in zip(ends[:-2], ends[2:] + 1, strict=True):
        frame, corner = np.unravel_index(clear[first:last].argmin(), clear[first:last].shape)
        arms.append(points[first + frame, corner])
        alone.append(low[first:last].any(0).sum() == 1)
    return np.array(arms).reshape(-1, 3), np.array(alone, bool)


def _axes(normal: Array) -> Iterator[tuple[Array, str]]:
    """Yield two axes along the ground with which the normal makes a right-handed frame, with their names."""
    up = int(np.abs(normal).argmax())
    first: Array = np.eye(3)[(up + 1) % 3] - normal[(up + 1) % 3] * normal
    first = first / np.linalg.norm(first)
    yield first, "xyz"[(up + 1) % 3]
    second: Array = np.cross(normal, first)
    yield second, "xyz"[(up + 2) % 3]


def _correction(exchange: str, normal: Array) -> Correction:
    """Return the exchange of axes in words."""
    (_, first), (_, second) = _axes(normal)
    other = "or turn the quaternions into the frame of the positions"
    if exchange in ("first mirrored", "second mirrored"):
        axis = first if exchange.startswith("first") else second
        return Correction(
            mistake=f"the positions' {axis} axis is mirrored against the turns",
            remedy=f"multiply p{axis}_m by -1, {other}.",
        )
    if exchange.startswith("exchanged"):
        sign = " and multiply both by -1" if exchange.endswith("mirrored") else ""
        return Correction(
            mistake=f"the positions' axes {first} and {second} are exchanged against the turns",
            remedy=f"exchange p{first}_m and p{second}_m{sign}, {other}.",
        )
    values = (f"-p{second}_m", f"p{first}_m") if exchange == "turned" else (f"p{second}_m", f"-p{first}_m")
    return Correction(
        mistake="positions and turns are of frames that are turned by 90 degrees against each other",
        remedy=f"write {values[0]} as p{first}_m and {values[1]} as p{second}_m, {other}.",
    )
