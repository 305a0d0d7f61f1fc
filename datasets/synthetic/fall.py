"""Scene `fall`: an object is tossed, tumbles, bounces, slides and comes to rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...schemas import NotConvergedError
from .dynamics import GRAVITY, ContactTruth, MjModel, Motion, build_model, draw_contact, lowest, rest_pose, simulate
from .objects import SolidObject, make_object, resting_down
from .plan import EXPOSURE_LEAD_S, EpisodePlan, ScenePlan, stays_in_view, turned_deg
from .rig import video_cameras

Array = NDArray[np.float64]

FRAME_RATE = 30.0
TRAIN_FRAMES, TEST_FRAMES = 15, 36
_LOWEST_RELEASE_M = 0.01
_TRIES = 600
_CANDIDATES = 8
_PREDICTABLE = 0.5
"""A toss with a repeatability error below this is accepted at once, in units of 10 mm and 10 degrees; if there is none,
the best candidate is used."""
_MATERIALS = ((1.2, 1.1), (0.8, 0.9), (1.2, 0.9))
"""Typical errors of fitted friction and damping ratio, as factors; one pair for each restart."""


def plan_fall(seed: int) -> ScenePlan:
    """Draw the object, its contact parameters and four tosses: one to train on, three longer ones to test on."""
    solid = make_object(seed)
    rng = np.random.default_rng([seed, 2])
    contact = draw_contact(rng)
    photo_qpos = rest_pose(solid, resting_down(solid), rng.uniform(-np.pi, np.pi), *rng.uniform(-0.01, 0.01, 2))
    model = build_model(solid, contact, fingertip=False)
    episodes: list[EpisodePlan] = []
    for name in ("000", "001", "002", "003"):
        split, frames = ("train", TRAIN_FRAMES) if name == "000" else ("test", TEST_FRAMES)
        others = [episode.motion.qpos[0, 3:7] for episode in episodes]
        episodes.append(EpisodePlan(name, split, frames, _toss(rng, seed, model, solid, contact, split, others)))
    return ScenePlan(
        name="fall",
        seed=seed,
        solid=solid,
        contact=contact,
        photo_qpos=photo_qpos,
        frame_rate=FRAME_RATE,
        episodes=tuple(episodes),
        fingertip=False,
    )


def _toss(
    rng: np.random.Generator,
    seed: int,
    model: MjModel,
    solid: SolidObject,
    contact: ContactTruth,
    split: str,
    others: list[Array],
) -> Motion:
    """Draw tosses until one stays in view, differs from the others, and meets the requirements of its split."""
    duration = (TRAIN_FRAMES if split == "train" else TEST_FRAMES) / FRAME_RATE
    cameras = video_cameras(seed).values()
    useful: list[tuple[float, Motion]] = []

    def again(other: ContactTruth, qpos: Array, qvel: Array) -> Motion:
        return simulate(build_model(solid, other, fingertip=False), qpos, qvel, -EXPOSURE_LEAD_S, duration)

    for _ in range(_TRIES):
        qpos, qvel = _release(rng, solid)
        if not _is_new_and_high(qpos, solid, others):
            continue
        motion = simulate(model, qpos, qvel, -EXPOSURE_LEAD_S, duration)
        if _suits(motion, split) and stays_in_view(solid, motion, cameras):
            best = min((value for value, _ in useful), default=np.inf)
            useful.append((unpredictability(rng, contact, motion, best, again), motion))
            if useful[-1][0] < _PREDICTABLE or len(useful) == _CANDIDATES:
                break
    if not useful:
        raise NotConvergedError(
            f"scene fall: none of {_TRIES} tosses of the {solid.family} stays in view.", todo="choose another seed."
        )
    return min(useful, key=lambda one: one[0])[1]


def _suits(motion: Motion, split: str) -> bool:
    """Return whether a toss stays near the middle and meets what its split asks for."""
    near = np.linalg.norm(motion.qpos[:, :2], axis=1).max() < 0.22
    return bool(near) and (_instructive(motion) if split == "train" else _settles(motion))


def _is_new_and_high(qpos: Array, solid: SolidObject, others: Sequence[Array]) -> bool:
    """Return whether a release is turned otherwise than those before, and high enough over the ground."""
    alike = any(turned_deg(qpos[3:7], other) < 35 for other in others)
    return not alike and qpos[2] >= lowest(solid, qpos[3:7]) + _LOWEST_RELEASE_M


def _release(rng: np.random.Generator, solid: SolidObject) -> tuple[Array, Array]:
    """Draw the release of a toss (pose and velocity of the body frame) from its landing time and speed."""
    quat_wxyz = rng.standard_normal(4)
    quat_wxyz /= np.linalg.norm(quat_wxyz)
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.1, 0.3)
    direction = np.array([np.cos(heading), np.sin(heading), 0])
    position = -direction * rng.uniform(0.06, 0.14)
    rise, landing = rng.uniform(0.2, 0.45), rng.uniform(0.145, 0.18)
    position[2] = lowest(solid, quat_wxyz) + GRAVITY / 2 * landing**2 - rise * landing
    spin = rng.standard_normal(3)
    omega_body = spin / np.linalg.norm(spin) * rng.uniform(0.5, 1.5)
    velocity = speed * direction + (0, 0, rise)
    return np.concatenate([position, quat_wxyz]), np.concatenate([velocity, omega_body])


def _instructive(motion: Motion) -> bool:
    """Return whether the first impact is early and the object turns and travels after it."""
    if motion.first_contact is None or not 0.12 < motion.first_contact < 0.2:
        return False
    hit, end = motion.qpos[motion.row(motion.first_contact)], motion.qpos[-1]
    return turned_deg(hit[3:7], end[3:7]) > 25 and float(np.linalg.norm(end[:2] - hit[:2])) > 0.04


def unpredictability(
    rng: np.random.Generator,
    contact: ContactTruth,
    motion: Motion,
    enough: float,
    again: Callable[[ContactTruth, Array, Array], Motion],
) -> float:
    """Return the error of the true engine itself when it starts from indistinguishable states and parameters.

    A die that lands on an edge does not test a model: two starts that no measurement distinguishes end on different
    faces. Each restart differs by the accuracy of a state measured over 0.1 s and by one of `_MATERIALS`; the result is
    the mean error over time and restarts, in units of 10 mm and 10 degrees. Restarts end as soon as the result is
    certain to exceed `enough`.

    Args:
        rng: Source of randomness.
        contact: The true contact.
        motion: The true motion.
        enough: Value above which the exact result does not matter.
        again: Simulates a motion of the same length from another contact, qpos and qvel.
    """
    total = 0.0
    for friction, damping in _MATERIALS:
        qpos, qvel = motion.qpos[0].copy(), motion.qvel[0].copy()
        qpos[:3] += 0.0003 * rng.standard_normal(3)
        qpos[3:7] += 0.5 * 0.003 * rng.standard_normal(4)
        qpos[3:7] /= np.linalg.norm(qpos[3:7])
        qvel[:3] += 0.006 * rng.standard_normal(3)
        qvel[3:6] += 0.06 * rng.standard_normal(3)
        other = replace(contact, friction=friction * contact.friction, damping_ratio=damping * contact.damping_ratio)
        restart = again(other, qpos, qvel)
        shift = np.linalg.norm(restart.qpos[:, :3] - motion.qpos[:, :3], axis=1).mean()
        turns = [turned_deg(a, b) for a, b in zip(restart.qpos[::200, 3:7], motion.qpos[::200, 3:7], strict=True)]
        total += (float(shift) / 0.01 + float(np.mean(turns)) / 10) / len(_MATERIALS)
        if total > enough:
            break
    return total


def _settles(motion: Motion) -> bool:
    """Return whether the object is near rest at the end, and its first impact is not before the end of the warm-up."""
    speed, rate = np.linalg.norm(motion.qvel[-1, :3]), np.linalg.norm(motion.qvel[-1, 3:6])
    return bool(motion.first_contact is not None and motion.first_contact > 0.14 and speed < 0.02 and rate < 0.3)
