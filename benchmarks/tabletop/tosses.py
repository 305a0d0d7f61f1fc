"""Fall: an object is tossed low and fast, bounces, slides over the ground and comes to rest."""

from __future__ import annotations

import math

import numpy as np
from cgwm.datasets.synthetic.dynamics import (
    GRAVITY,
    STEPS_PER_S,
    ContactTruth,
    Motion,
    lowest,
    matrix_from_quat,
    quat_from_matrix,
    rest_pose,
)
from cgwm.datasets.synthetic.fall import unpredictability
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import EXPOSURE_LEAD_S, EpisodePlan, stays_in_view, turned_deg
from cgwm.datasets.synthetic.rig import video_cameras
from cgwm.schemas import NotConvergedError
from numpy.typing import NDArray

from .draft import NO_DRAFT, Draft
from .engines import Maker
from .engines.mujoco_engine import Coulomb
from .plan import CANDIDATES, FRAME_RATE, RESTING_M_S, TEST_FRAMES, TRAIN_FRAMES, episode_names, speed_at_end

Array = NDArray[np.float64]

_TRIES = 400
_CHAOTIC = 3.0
"""Mean error of the true engine itself, in units of 10 mm and 10 degrees, from which on a toss is no test."""
_SLID_M = 0.03
"""How far the training toss slips over the ground at least."""
_TOUCHES_M = 0.0005


def plan_tosses(
    rng: np.random.Generator,
    camera_seed: int,
    solid: SolidObject,
    down: Array,
    contact: ContactTruth,
    tests: int,
    make: Maker = Coulomb,
    draft: Draft = NO_DRAFT,
) -> tuple[tuple[EpisodePlan, ...], dict[str, int]]:
    """Draw one toss to train on and others to test on; every second test is thrown spinning, the others flat.

    Args:
        rng: Source of randomness.
        camera_seed: What the video cameras were placed with; tosses stay in their view.
        solid: The object.
        down: The body direction that points down at rest, shape (3,).
        contact: The true contact.
        tests: Number of test episodes.
        make: Makes the engine whose motions are the truth.
        draft: Keeps the episodes that are drawn, and has those that were.

    Returns:
        The episodes, and how many draws were left out for which reason.

    Raises:
        NotConvergedError: If no toss stays in view.
    """
    engine, cameras = make(solid, contact, False), video_cameras(camera_seed).values()
    rejected = {"like another": 0, "contact time": 0, "no slip": 0, "out of view": 0, "chaotic": 0, "no rest": 0}
    episodes: list[EpisodePlan] = []
    begun = draft.read(rng, rejected)
    for index, name in enumerate(episode_names(tests)):
        split, frames = ("train", TRAIN_FRAMES) if index == 0 else ("test", TEST_FRAMES)
        duration = frames / FRAME_RATE
        if index < len(begun):
            motion = engine.simulate(begun[index][:7], begun[index][7:], -EXPOSURE_LEAD_S, duration)
            episodes.append(EpisodePlan(name, split, frames, motion))
            continue
        best: tuple[float, Motion, Array] | None = None
        candidates = 0

        def again(other: ContactTruth, qpos: Array, qvel: Array, duration: float = duration) -> Motion:
            return make(solid, other, False).simulate(qpos, qvel, -EXPOSURE_LEAD_S, duration)

        for _ in range(_TRIES):
            qpos, qvel = _release(rng, solid, down, contact.friction, split, spinning=index % 2 == 0)
            if any(turned_deg(qpos[3:7], other.motion.qpos[0, 3:7]) < 15 for other in episodes):
                rejected["like another"] += 1
                continue
            motion = engine.simulate(qpos, qvel, -EXPOSURE_LEAD_S, duration)
            first, last = (0.10, 0.17) if split == "train" else (0.12, 0.3)
            if motion.first_contact is None or not first < motion.first_contact < last:
                rejected["contact time"] += 1
            elif split == "train" and slip(solid, motion) < _SLID_M:
                rejected["no slip"] += 1
            elif not stays_in_view(solid, motion, cameras):
                rejected["out of view"] += 1
            elif unpredictability(rng, contact, motion, _CHAOTIC, again) > _CHAOTIC:
                rejected["chaotic"] += 1
            else:
                candidates += 1
                unrest = 0.0 if split == "train" else speed_at_end(solid, motion)
                if best is None or unrest < best[0]:
                    best = unrest, motion, np.concatenate((qpos, qvel))
                if unrest < RESTING_M_S or candidates == CANDIDATES:
                    break
                rejected["no rest"] += 1
        if best is None:
            raise NotConvergedError(f"fall: none of {_TRIES} tosses of the {solid.family} serves as episode {name}.")
        episodes.append(EpisodePlan(name, split, frames, best[1]))
        begun.append(best[2])
        draft.write(rng, rejected, begun)
    return tuple(episodes), rejected


def slip(solid: SolidObject, motion: Motion) -> float:
    """Return the way that the object's lowest point slips over the ground while it touches it [m]."""
    every = STEPS_PER_S // 240
    total = 0.0
    for qpos, qvel in zip(motion.qpos[::every], motion.qvel[::every], strict=True):
        turn = matrix_from_quat(qpos[3:7])
        arms = solid.vertices @ turn.T
        low = arms[arms[:, 2].argmin()]
        if qpos[2] + low[2] < _TOUCHES_M:
            velocity = qvel[:3] + np.cross(turn @ qvel[3:6], low)
            total += math.hypot(velocity[0], velocity[1]) * every / STEPS_PER_S
    return total


def _release(
    rng: np.random.Generator, solid: SolidObject, down: Array, friction: float, split: str, spinning: bool
) -> tuple[Array, Array]:
    """Draw a release by when it lands and how fast: pose and velocity of the body frame."""
    if split == "test" and spinning:
        quat_wxyz = rng.standard_normal(4)
        quat_wxyz /= np.linalg.norm(quat_wxyz)
        spin = rng.standard_normal(3)
        omega_body = spin / np.linalg.norm(spin) * rng.uniform(2.0, 6.0)
    else:
        flat = rest_pose(solid, down, rng.uniform(-np.pi, np.pi), 0, 0)[3:7]
        tilt = rng.uniform(*np.radians((8, 25) if split == "train" else (5, 40)))
        quat_wxyz = quat_from_matrix(_about_horizontal(rng.uniform(-np.pi, np.pi), tilt) @ matrix_from_quat(flat))
        omega_body = -down * rng.uniform(-4, 4) + 0.5 * rng.standard_normal(3)
    heading = rng.uniform(-np.pi, np.pi)
    speed = rng.uniform(0.4, 0.8) if split == "train" else rng.uniform(0.2, 0.8)
    landing = rng.uniform(0.11, 0.15) if split == "train" else rng.uniform(0.135, 0.18)
    rise = rng.uniform(0.1, 0.3) if split == "train" else rng.uniform(0.1, 0.45)
    direction = np.array([np.cos(heading), np.sin(heading), 0])
    travel = speed * landing + 0.5 * speed**2 / (2 * friction * GRAVITY)
    position = -direction * travel * rng.uniform(0.4, 0.7) + [*rng.uniform(-0.03, 0.03, 2), 0]
    position[2] = lowest(solid, quat_wxyz) + GRAVITY / 2 * landing**2 - rise * landing
    return np.concatenate([position, quat_wxyz]), np.concatenate([speed * direction + (0, 0, rise), omega_body])


def _about_horizontal(azimuth: float, angle: float) -> Array:
    """Return the rotation matrix (3, 3) by an angle [rad] about the horizontal axis at an azimuth [rad]."""
    half = angle / 2
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    return matrix_from_quat(np.array([np.cos(half), *(np.sin(half) * axis)]))
