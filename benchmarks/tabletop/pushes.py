"""Push: a driven fingertip strikes an object at rest and stops; the object slides on, turns and comes to rest."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from cgwm.datasets.synthetic.dynamics import (
    BODY_GROUP,
    FINGERTIP_RADIUS,
    STEPS_PER_S,
    ContactTruth,
    MjModel,
    Motion,
    build_model,
    matrix_from_quat,
    mujoco,
    rest_pose,
    simulate,
    smooth_path,
)
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import EpisodePlan, stays_in_view, tilted_deg
from cgwm.datasets.synthetic.rig import video_cameras
from cgwm.schemas import NotConvergedError
from numpy.typing import NDArray

from .plan import CANDIDATES, FRAME_RATE, RESTING_M_S, TEST_FRAMES, TRAIN_FRAMES, episode_names, speed_at_end

Array = NDArray[np.float64]

_TRIES = 400
_SETTLING_S = 0.2  # the object sinks into its resting contact before time zero
_RAMP_S = 0.04
_STOPS_S = 0.27
"""When the fingertip has stopped at the latest."""
_SLIDES_M = 0.012
"""How far the object of the training push slides at least once the fingertip has stopped."""
_TILT_DEG = 6.0


def plan_pushes(
    rng: np.random.Generator, camera_seed: int, solid: SolidObject, down: Array, contact: ContactTruth, tests: int
) -> tuple[tuple[EpisodePlan, ...], dict[str, int]]:
    """Draw one push to train on and others to test on, each straight, of its own heading, offset and speed.

    Args and returns are those of `plan_tosses`.

    Raises:
        NotConvergedError: If no push moves the object as wanted.
    """
    model, cameras = build_model(solid, contact, fingertip=True), video_cameras(camera_seed).values()
    rejected: Counter[str] = Counter()
    episodes: list[EpisodePlan] = []
    for index, name in enumerate(episode_names(tests)):
        split, frames = ("train", TRAIN_FRAMES) if index == 0 else ("test", TEST_FRAMES)
        duration = frames / FRAME_RATE
        times = np.arange(round((_SETTLING_S + duration) * STEPS_PER_S) + 1) / STEPS_PER_S - _SETTLING_S
        best: tuple[float, Motion] | None = None
        candidates = 0
        for _ in range(_TRIES):
            qpos, points, speed = _push(rng, model, solid, down, split)
            stops = float(np.linalg.norm(points[1] - points[0])) / speed + _RAMP_S
            if stops > _STOPS_S:
                rejected["stops late"] += 1
                continue
            motion = simulate(
                model, qpos, np.zeros(6), -_SETTLING_S, duration, smooth_path(points, speed, _RAMP_S, times)
            )
            fault = _fault(motion, stops if split == "train" else None)
            if fault is None and not stays_in_view(solid, motion, cameras):
                fault = "out of view"
            if fault is None:
                candidates += 1
                unrest = speed_at_end(solid, motion)
                if best is None or unrest < best[0]:
                    best = unrest, motion
                if unrest < RESTING_M_S or candidates == CANDIDATES:
                    break
                fault = "no rest"
            rejected[fault] += 1
        if best is None:
            raise NotConvergedError(f"push: none of {_TRIES} pushes of the {solid.family} serves as episode {name}.")
        episodes.append(EpisodePlan(name, split, frames, best[1]))
    return tuple(episodes), dict(rejected)


def _push(
    rng: np.random.Generator, model: MjModel, solid: SolidObject, down: Array, split: str
) -> tuple[Array, Array, float]:
    """Draw a push: the object's pose at rest (7,), the fingertip's path [m] of shape (2, 3), and its speed [m/s]."""
    heading = rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(heading), np.sin(heading)])
    aside = np.array([-direction[1], direction[0]])
    start = -direction * rng.uniform(0.03, 0.08)
    qpos = rest_pose(solid, down, rng.uniform(-np.pi, np.pi), *start)
    speed = rng.uniform(0.4, 0.8) if split == "train" else rng.uniform(0.3, 0.9)
    turn = matrix_from_quat(qpos[3:7])
    world = solid.vertices @ turn.T + qpos[:3]
    com = solid.com @ turn.T + qpos[:3]
    breadth = np.abs((world[:, :2] - com[:2]) @ aside).max()
    offset = rng.uniform(-0.4, 0.4) * breadth
    height = max(min(0.35 * world[:, 2].max(), 0.7 * com[2]), FINGERTIP_RADIUS + 0.004)
    beside = np.array([*(com[:2] + offset * aside), height])
    touches = _reach(model, qpos, beside, direction)
    # Far enough away that it has its full speed when it touches.
    gap = speed * _RAMP_S / 2 + rng.uniform(0.004, 0.012)
    points = beside + np.outer([touches - gap, touches + rng.uniform(0.025, 0.06)], [*direction, 0])
    return qpos, np.asarray(points, np.float64), speed


def _reach(model: MjModel, qpos: Array, point: Array, direction: Array) -> float:
    """Return where the fingertip, moving along `direction` through `point`, first touches the object [m].

    By rays through its middle and its two sides: a little late where an edge stands out between them.
    """
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:] = qpos, (0, 0, -100)
    mujoco.mj_kinematics(model, data)
    groups = np.zeros(6, np.uint8)
    groups[BODY_GROUP] = 1
    along, away, hit = np.array([*direction, 0]), 0.5, np.zeros(1, np.int32)
    first = math.inf
    for share in (-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9):
        side = share * FINGERTIP_RADIUS * np.array([-direction[1], direction[0], 0])
        distance = mujoco.mj_ray(model, data, point + side - away * along, along, groups, 1, -1, hit)
        if distance >= 0:
            first = min(first, distance - FINGERTIP_RADIUS * math.sqrt(1 - share**2))
    return (first if math.isfinite(first) else away) - away


def _fault(motion: Motion, stops: float | None) -> str | None:
    """Return why a push is of no use; `stops` [s] is when the fingertip stops, where sliding after it is wanted."""
    first, last = motion.qpos[motion.row(0.0)], motion.qpos[-1]
    if motion.first_contact is None or np.linalg.norm(last[:2] - first[:2]) < 0.03:
        return "hardly moved"
    if max(tilted_deg(first[3:7], row[3:7]) for row in motion.qpos[::36]) > _TILT_DEG:
        return "tipped"
    if stops is not None and np.linalg.norm(last[:2] - motion.qpos[motion.row(stops), :2]) < _SLIDES_M:
        return "no slide"
    return None
