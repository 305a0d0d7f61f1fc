"""The path of a pusher: a line or an arc at constant speed, of some length or without end."""

from __future__ import annotations

import math

import numpy as np

from ..datasets.tracks import Track

STEP_RAD = 0.02
"""Turn of an arc from one sample to the next: the chord misses the arc by 5e-5 of its radius."""


def push_track(
    aim_m: np.ndarray,
    quat_wxyz: np.ndarray,
    heading: np.ndarray,
    left: np.ndarray,
    run_up_m: float,
    speed_m_s: float,
    curvature_1_m: float,
    length_m: float | None,
    duration_s: float,
) -> Track:
    """Return the motion of a pusher that passes `aim_m` with a heading, in a fixed orientation.

    Args:
        aim_m: Where its frame's origin would be when it is at the object [m], world, shape (3,).
        quat_wxyz: Its orientation, shape (4,).
        heading: Level unit vector of its motion there, shape (3,).
        left: Level unit vector to the left of that, shape (3,).
        run_up_m: Length of the path from the start to there [m].
        speed_m_s: Along the path [m/s].
        curvature_1_m: Of the path [1/m], positive to the left.
        length_m: Length of the path, after which the pusher stands still [m]; None: it goes on.
        duration_s: Of the rollout [s].
    """
    moving = duration_s if length_m is None or speed_m_s == 0 else min(duration_s, length_m / speed_m_s)
    count = 1 + max(1, math.ceil(abs(curvature_1_m) * speed_m_s * moving / STEP_RAD))
    times = np.linspace(0.0, moving, count)
    if curvature_1_m == 0:
        path = aim_m - heading * run_up_m + heading * speed_m_s * times[:, None]
        velocity = np.repeat((heading * speed_m_s)[None], count, axis=0)
    else:
        turn = curvature_1_m * (speed_m_s * times - run_up_m)[:, None]
        path = aim_m + (np.sin(turn) * heading + (1 - np.cos(turn)) * left) / curvature_1_m
        velocity = speed_m_s * (np.cos(turn) * heading + np.sin(turn) * left)
    if moving < duration_s:
        velocity[-1] = 0.0
    return Track(times, path, np.repeat(quat_wxyz[None], count, axis=0), velocity, np.zeros((count, 3)))
