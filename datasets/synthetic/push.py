"""Scene `push`: a driven fingertip pushes an object over the ground; it slides, turns and comes to rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...schemas import NotConvergedError
from .dynamics import (
    FINGERTIP_RADIUS,
    STEPS_PER_S,
    MjModel,
    Motion,
    build_model,
    draw_contact,
    matrix_from_quat,
    rest_pose,
    simulate,
    smooth_path,
)
from .objects import SolidObject, make_object, resting_down
from .plan import EpisodePlan, ScenePlan, stays_in_view, tilted_deg, turned_deg
from .rig import video_cameras

Array = NDArray[np.float64]

FRAME_RATE = 15.0
TRAIN_FRAMES, TEST_FRAMES = 15, 30
_TRIES = 400
_SETTLING_S = 0.2  # the object sinks into its resting contact before time zero
_RAMP_S = 0.08


def plan_push(seed: int) -> ScenePlan:
    """Draw the object, its contact parameters and four pushes: one to train on, three longer ones to test on."""
    solid = make_object(seed)
    rng = np.random.default_rng([seed, 3])
    contact = draw_contact(rng)
    down = resting_down(solid)
    photo_qpos = rest_pose(solid, down, rng.uniform(-np.pi, np.pi), *rng.uniform(-0.01, 0.01, 2))
    model = build_model(solid, contact, fingertip=True)
    episodes = []
    for name in ("000", "001", "002", "003"):
        split, frames = ("train", TRAIN_FRAMES) if name == "000" else ("test", TEST_FRAMES)
        episodes.append(EpisodePlan(name, split, frames, _push(rng, seed, model, solid, down, split)))
    return ScenePlan(
        name="push",
        seed=seed,
        solid=solid,
        contact=contact,
        photo_qpos=photo_qpos,
        frame_rate=FRAME_RATE,
        episodes=tuple(episodes),
        fingertip=True,
    )


def _push(rng: np.random.Generator, seed: int, model: MjModel, solid: SolidObject, down: Array, split: str) -> Motion:
    """Draw pushes until one moves and turns the object visibly, does not tip it, and ends at rest in view."""
    duration = (TRAIN_FRAMES if split == "train" else TEST_FRAMES) / FRAME_RATE
    cameras = video_cameras(seed).values()
    times = np.arange(round((_SETTLING_S + duration) * STEPS_PER_S) + 1) / STEPS_PER_S - _SETTLING_S
    for _ in range(_TRIES):
        heading = rng.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(heading), np.sin(heading)])
        start = -direction * rng.uniform(0.02, 0.06)
        qpos = rest_pose(solid, down, rng.uniform(-np.pi, np.pi), *start)
        speed = rng.uniform(0.15, 0.28) if split == "train" else rng.uniform(0.1, 0.3)
        points = _path(rng, solid, qpos, direction, bends=split != "train")
        command = smooth_path(points, speed, _RAMP_S, times)
        if np.abs(command[1][times > duration - 0.2]).max() > 0:
            continue
        motion = simulate(model, qpos, np.zeros(6), -_SETTLING_S, duration, command)
        if _visible(motion) and _upright(motion) and stays_in_view(solid, motion, cameras):
            return motion
    raise NotConvergedError(
        f"scene push: none of {_TRIES} pushes of the {solid.family} moves it as wanted.", todo="choose another seed."
    )


def _path(rng: np.random.Generator, solid: SolidObject, qpos: Array, direction: Array, bends: bool) -> Array:
    """Draw a path of the fingertip at constant height: towards the object, off its centre of mass, and beyond.

    Args:
        rng: Source of randomness.
        solid: The object.
        qpos: Its position [m] and quat_wxyz, shape (7,).
        direction: Direction of the first leg, horizontal unit vector, shape (2,).
        bends: Whether the path turns by 20 to 50 degrees half-way.

    Returns:
        Corners [m], world frame, shape (2 or 3, 3).
    """
    turn = matrix_from_quat(qpos[3:7])
    world = solid.vertices @ turn.T + qpos[:3]
    com = solid.com @ turn.T + qpos[:3]
    aside = np.array([-direction[1], direction[0]])
    breadth = np.abs((world[:, :2] - com[:2]) @ aside).max()
    depth = -((world[:, :2] - com[:2]) @ direction).min()
    gap = rng.uniform(0.008, 0.02)
    first = com[:2] + rng.uniform(-0.5, 0.5) * breadth * aside - (depth + FINGERTIP_RADIUS + gap) * direction
    corners = [first, first + (gap + rng.uniform(0.06, 0.10)) * direction]
    if bends:
        angle = rng.choice([-1, 1]) * rng.uniform(np.radians(20), np.radians(50))
        turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ direction
        corners.append(corners[-1] + rng.uniform(0.03, 0.06) * turned)
    height = min(0.35 * world[:, 2].max(), 0.7 * com[2])
    return np.array([[*corner, max(height, FINGERTIP_RADIUS + 0.004)] for corner in corners])


def _visible(motion: Motion) -> bool:
    """Return whether the object travels and turns."""
    first, last = motion.qpos[motion.row(0.0)], motion.qpos[-1]
    travel = float(np.linalg.norm(last[:2] - first[:2]))
    return bool(travel > 0.03 and turned_deg(first[3:7], last[3:7]) > 12)


def _upright(motion: Motion) -> bool:
    """Return whether the object stays on its facet and is at rest at the end."""
    first = motion.qpos[0, 3:7]
    tilt = max(tilted_deg(first, row[3:7]) for row in motion.qpos[::36])
    return bool(tilt < 4 and np.linalg.norm(motion.qvel[-1, :3]) < 0.01)
