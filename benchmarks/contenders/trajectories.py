"""Trajectories with ground truth, for the rival that needs many: the true object on the true ground, by MuJoCo.

Starts are drawn as those of the benchmark's tests are: tosses that land after 0.11 to 0.2 s, flat or spinning, and
straight pushes by the fingertip through the object at rest. None is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from cgwm.datasets.synthetic.dynamics import (
    FINGERTIP_RADIUS,
    GRAVITY,
    STEPS_PER_S,
    ContactTruth,
    Motion,
    build_model,
    lowest,
    matrix_from_quat,
    quat_from_matrix,
    rest_pose,
    simulate,
    smooth_path,
)
from cgwm.datasets.synthetic.objects import SolidObject

from .base import Array

_SETTLING_S, _RAMP_S = 0.2, 0.04


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The object's true motion at T frames, and the fingertip's.

    position_m, velocity_m_s, omega_body_rad_s (T, 3); quat_wxyz (T, 4); fingertip_m (T, 3) or None.
    """

    position_m: Array
    quat_wxyz: Array
    velocity_m_s: Array
    omega_body_rad_s: Array
    fingertip_m: Array | None


def draw_trajectories(
    solid: SolidObject, contact: ContactTruth, down: Array, pushed: bool, count: int, times_s: Array, seed: int
) -> list[Trajectory]:
    """Simulate trajectories.

    Args:
        solid: The true object.
        contact: The true contact.
        down: The body direction that points down at rest, shape (3,).
        pushed: Whether a fingertip pushes; else the object is tossed.
        count: How many.
        times_s: Times of the frames from 0 on [s], multiples of a step of 1 / STEPS_PER_S.
        seed: Draws the starts.
    """
    rng = np.random.default_rng([seed, 40])
    model, end = build_model(solid, contact, fingertip=pushed), float(times_s[-1])
    trajectories = []
    for index in range(count):
        if pushed:
            qpos, path, speed = _push(rng, solid, down)
            steps = np.arange(round((_SETTLING_S + end) * STEPS_PER_S) + 1) / STEPS_PER_S - _SETTLING_S
            command = smooth_path(path, speed, _RAMP_S, steps)
            motion = simulate(model, qpos, np.zeros(6), -_SETTLING_S, end, command)
        else:
            motion = simulate(model, *_release(rng, solid, down, contact.friction, index % 2 == 0), 0.0, end)
        trajectories.append(_at(motion, times_s, pushed))
    return trajectories


def _at(motion: Motion, times_s: Array, pushed: bool) -> Trajectory:
    rows = motion.rows(times_s)
    qpos, qvel = motion.qpos[rows], motion.qvel[rows]
    return Trajectory(qpos[:, :3], qpos[:, 3:7], qvel[:, :3], qvel[:, 3:6], qpos[:, 7:10] if pushed else None)


def _release(
    rng: np.random.Generator, solid: SolidObject, down: Array, friction: float, spinning: bool
) -> tuple[Array, Array]:
    """Draw a toss by when it lands and how fast: pose and velocity of the body frame."""
    if spinning:
        quat_wxyz = rng.standard_normal(4)
        quat_wxyz /= np.linalg.norm(quat_wxyz)
        spin = rng.standard_normal(3)
        omega_body = spin / np.linalg.norm(spin) * rng.uniform(2.0, 6.0)
    else:
        flat = matrix_from_quat(rest_pose(solid, down, rng.uniform(-np.pi, np.pi), 0, 0)[3:7])
        azimuth, half = rng.uniform(-np.pi, np.pi), rng.uniform(*np.radians((5, 40))) / 2
        tilt = np.array([np.cos(half), np.cos(azimuth) * np.sin(half), np.sin(azimuth) * np.sin(half), 0])
        quat_wxyz = quat_from_matrix(matrix_from_quat(tilt) @ flat)
        omega_body = -down * rng.uniform(-4, 4) + 0.5 * rng.standard_normal(3)
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.2, 0.8)
    landing, rise = rng.uniform(0.11, 0.2), rng.uniform(0.1, 0.45)
    direction = np.array([np.cos(heading), np.sin(heading), 0])
    travel = speed * landing + 0.5 * speed**2 / (2 * friction * GRAVITY)
    position = -direction * travel * rng.uniform(0.4, 0.7) + [*rng.uniform(-0.03, 0.03, 2), 0]
    position[2] = lowest(solid, quat_wxyz) + GRAVITY / 2 * landing**2 - rise * landing
    return np.concatenate([position, quat_wxyz]), np.concatenate([speed * direction + (0, 0, rise), omega_body])


def _push(rng: np.random.Generator, solid: SolidObject, down: Array) -> tuple[Array, Array, float]:
    """Draw a push: the object's pose at rest (7,), the fingertip's path [m] of shape (2, 3), and its speed [m/s]."""
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.9)
    direction = np.array([np.cos(heading), np.sin(heading), 0])
    aside = np.array([-direction[1], direction[0], 0])
    qpos = rest_pose(solid, down, rng.uniform(-np.pi, np.pi), *(-direction[:2] * rng.uniform(0.03, 0.08)))
    turn = matrix_from_quat(qpos[3:7])
    corners = solid.vertices[solid.faces]
    shares = rng.dirichlet(np.ones(3), (len(corners), 200))
    surface = (shares @ corners).reshape(-1, 3) @ turn.T + qpos[:3]
    com = turn @ solid.com + qpos[:3]
    across = (surface - com) @ aside
    offset = rng.uniform(-0.4, 0.4) * np.abs(across).max()
    height = max(min(0.35 * surface[:, 2].max(), 0.7 * com[2]), FINGERTIP_RADIUS + 0.004)
    near = np.abs(across - offset) < FINGERTIP_RADIUS
    along = (surface - com) @ direction
    touches = float((along[near] if near.any() else along).min()) - FINGERTIP_RADIUS
    beside = np.array([*(com + offset * aside)[:2], height])
    gap = speed * _RAMP_S / 2 + rng.uniform(0.004, 0.012)
    path = beside + np.outer([touches - gap, touches + rng.uniform(0.025, 0.06)], direction)
    return qpos, np.asarray(path, np.float64), speed
