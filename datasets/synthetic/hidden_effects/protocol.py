"""Initial states of throws, drawn by kind of motion."""

from __future__ import annotations

from typing import Literal

import numpy as np

from .mechanics import Start
from .registry import direction, horizontal, sign
from .rotation import rotation_of
from .things import Array, Thing

Motion = Literal["throw", "slide", "drop", "roll"]
Protocol = Literal["mixed", "throws", "slides", "drops", "rolls"]

_TRAIN: tuple[Motion, ...] = ("throw", "slide", "drop", "throw", "roll", "throw")
_TEST: tuple[Motion, ...] = ("throw", "slide", "drop", "roll")
_ALONE: dict[Protocol, Motion] = {"throws": "throw", "slides": "slide", "drops": "drop", "rolls": "roll"}
_GAP_M = 2e-4
"""Initial height of the lowest point above the ground, for motions that begin on the ground [m]."""


def motions(protocol: Protocol, train: int, test: int) -> list[Motion]:
    """Return the kinds of motion of the training and then the test episodes; the cycle restarts with each split."""
    alone = _ALONE.get(protocol)
    if alone is not None:
        return [alone for _ in range(train + test)]
    return [*(_TRAIN[k % len(_TRAIN)] for k in range(train)), *(_TEST[k % len(_TEST)] for k in range(test))]


def draw_start(thing: Thing, motion: Motion, rng: np.random.Generator) -> Start:
    """Draw an initial state; paths pass within a few centimetres of the world's origin, in a random direction.

    throw: from 0.25 to 0.6 m at 1 to 2.5 m/s, up to 2 m/s upwards, spin of up to 15 rad/s about any axis.
    slide: flat on the ground at 0.8 to 2 m/s, a box turning at 1 to 5 rad/s about the vertical; a ball with spin
        of 5 to 20 rad/s about the vertical, and as much forwards or backwards.
    drop: from 0.2 to 0.8 m, in a random orientation, almost at rest.
    roll: a ball that rolls at 0.4 to 1.3 m/s while it turns at 3 to 10 rad/s about the vertical, or a box that tumbles
        over its edges.
    """
    heading, up = horizontal(rng), np.array([0.0, 0.0, 1.0])
    spin = rng.uniform(3, 15) * direction(rng)
    quat = _any_turn(rng)
    if motion == "throw":
        velocity = rng.uniform(1.0, 2.5) * heading + rng.uniform(0.0, 2.0) * up
        height, ahead = rng.uniform(0.25, 0.6), 0.35
    elif motion == "drop":
        velocity, spin = rng.uniform(-0.1, 0.1, 3), 0.1 * spin
        height, ahead = rng.uniform(0.2, 0.8), 0.0
    elif motion == "slide":
        velocity, height, ahead = rng.uniform(0.8, 2.0) * heading, _GAP_M, 0.3
        if thing.kind == "cube":
            quat, spin = _yaw(rng), sign(rng) * rng.uniform(1, 5) * up
        else:
            spin = sign(rng) * rng.uniform(5, 20) * np.cross(up, heading) + sign(rng) * rng.uniform(5, 20) * up
    else:
        speed = rng.uniform(0.4, 1.3) if thing.kind == "ball" else rng.uniform(0.8, 1.4)
        velocity, ahead = speed * heading, 0.4
        spin = speed / thing.size_m * np.cross(up, heading)
        spin = spin + sign(rng) * rng.uniform(3, 10) * up * (thing.kind == "ball")
        height = _GAP_M if thing.kind == "ball" else rng.uniform(0.02, 0.06)
    place = rng.uniform(-0.05, 0.05, 3) * (1.0, 1.0, 0.0) - ahead * velocity * (1.0, 1.0, 0.0)
    rotation = rotation_of(quat)
    place[2] = height + _depth(thing, rotation)
    return Start(place, quat, velocity, rotation.T @ spin)


def _depth(thing: Thing, rotation: Array) -> float:
    """Return the depth of the lowest point of the body below its centre [m]."""
    middles, radius = thing.spheres
    return float(radius - (middles @ rotation.T)[:, 2].min())


def _any_turn(rng: np.random.Generator) -> Array:
    quat = rng.standard_normal(4)
    return quat / np.linalg.norm(quat)


def _yaw(rng: np.random.Generator) -> Array:
    half = 0.5 * rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
