"""Paths of pushers: a line or an arc at constant speed, of finite or unlimited length."""

from __future__ import annotations

import math

import numpy as np

from ...datasets.capture.tracks import Track

STEP_RAD = 0.02
"""Turn of an arc between two samples [rad]: the chord deviates from the arc by 5e-5 of its radius."""


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
    """Return the motion of a pusher that passes through a point with a heading, at a fixed orientation.

    Args:
        aim_m: Position of the origin of its body frame at the object [m], world frame, shape (3,).
        quat_wxyz: Orientation (body to world), shape (4,).
        heading: Horizontal unit vector along its motion there, world frame, shape (3,).
        left: Horizontal unit vector to the left of the heading, world frame, shape (3,).
        run_up_m: Length of the path from the start to the object [m].
        speed_m_s: Speed along the path [m/s].
        curvature_1_m: Curvature of the path [1/m], positive to the left.
        length_m: Length of the path, after which the pusher stops [m]; None for an unlimited path.
        duration_s: Duration of the rollout [s].
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
    return Track(
        time_s=times,
        position_m=path,
        quat_wxyz=np.repeat(quat_wxyz[None], count, axis=0),
        velocity_m_s=velocity,
        omega_body_rad_s=np.zeros((count, 3)),
    )


def commanded_velocity(track: Track) -> np.ndarray:
    """Return the velocities of a pusher [m/s], world frame, shape (T, 3).

    Raises:
        ValueError: If the track has none.
    """
    if track.velocity_m_s is None:
        raise ValueError("the motion of a driven body has no velocities.")
    return track.velocity_m_s
