"""Push and Tip: a driven fingertip strikes an object at rest and stops.

Push: it strikes low; the object slides on, turns and comes to rest. Tip: it strikes high an object that stands on its
tallest rest; the object topples and comes to rest on another face.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

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
    smooth_path,
)
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import EpisodePlan, stays_in_view, tilted_deg
from cgwm.datasets.synthetic.rig import video_cameras
from cgwm.schemas import NotConvergedError
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from .draft import NO_DRAFT, Draft
from .engines import Maker
from .engines.mujoco_engine import Coulomb
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
_FOOTHOLD_M = 0.008
_TOPPLES_DEG, _TIPS_DEG = 45.0, 12.0
"""How far a test object has fallen over at the end, and the training one within its 15 frames."""


@dataclass(frozen=True)
class Strike:
    """How an object is struck, and what it is to do.

    Args:
        height: Heights of the fingertip as shares of that of the object's top and of its centre of mass; the lower one
            counts.
        offset: Largest distance of the fingertip's line from the centre of mass, in half breadths of the object.
        fault: Returns why a motion is of no use, given when the fingertip stops, where that matters.
        rest: Returns the body direction that points down, given the object and that of its most stable rest.
    """

    height: tuple[float, float]
    offset: float
    fault: Callable[[Motion, float | None], str | None]
    rest: Callable[[SolidObject, Array], Array]


def tall_rest(solid: SolidObject) -> Array:
    """Return the body direction that points down where the object stands tallest, shape (3,).

    Of all facets of the convex hull on which it stands by more than `_FOOTHOLD_M` from every edge, that over which the
    centre of mass is highest.

    Raises:
        NotConvergedError: If it stands on none so well.
    """
    hull = ConvexHull(solid.vertices - solid.com)
    best: tuple[float, Array] | None = None
    for equation in np.unique(hull.equations.round(6), axis=0):
        normal, height = equation[:3], -equation[3]
        corners = hull.points[hull.points @ normal > height - 1e-4]
        side = np.linalg.svd(normal[None])[2][1:]
        foot = corners @ side.T
        if len(foot) < 3 or np.linalg.matrix_rank(foot - foot[0], tol=1e-3) < 2:
            continue
        room = -ConvexHull(foot).equations[:, 2].max()  # the centre of mass is the origin
        if room > _FOOTHOLD_M and (best is None or height > best[0]):
            best = height, normal
    if best is None:
        raise NotConvergedError(f"tip: the {solid.family} stands on no facet.")
    return best[1]


def plan_strikes(
    strike: Strike,
    rng: np.random.Generator,
    camera_seed: int,
    solid: SolidObject,
    down: Array,
    contact: ContactTruth,
    tests: int,
    make: Maker = Coulomb,
    draft: Draft = NO_DRAFT,
) -> tuple[tuple[EpisodePlan, ...], dict[str, int]]:
    """Draw one strike to train on and others to test on, each straight, of its own heading, offset and speed.

    Args and returns are those of `plan_tosses`, after `strike`, which is `PUSH` or `TIP`.

    Raises:
        NotConvergedError: If none moves the object as wanted.
    """
    down = strike.rest(solid, down)
    model, cameras = build_model(solid, contact, fingertip=True), video_cameras(camera_seed).values()
    engine = make(solid, contact, True)
    rejected: Counter[str] = Counter()
    episodes: list[EpisodePlan] = []
    begun = draft.read(rng, rejected)
    for index, name in enumerate(episode_names(tests)):
        split, frames = ("train", TRAIN_FRAMES) if index == 0 else ("test", TEST_FRAMES)
        duration = frames / FRAME_RATE
        times = np.arange(round((_SETTLING_S + duration) * STEPS_PER_S) + 1) / STEPS_PER_S - _SETTLING_S

        def struck(
            qpos: Array, points: Array, speed: float, duration: float = duration, times: Array = times
        ) -> Motion:
            path = smooth_path(points, speed, _RAMP_S, times)
            return engine.simulate(qpos, np.zeros(6), -_SETTLING_S, duration, path)

        if index < len(begun):
            motion = struck(begun[index][:7], begun[index][7:13].reshape(2, 3), float(begun[index][13]))
            episodes.append(EpisodePlan(name, split, frames, motion))
            continue
        best: tuple[float, Motion, Array] | None = None
        candidates = 0
        for _ in range(_TRIES):
            qpos, points, speed = _push(strike, rng, model, solid, down, split)
            stops = float(np.linalg.norm(points[1] - points[0])) / speed + _RAMP_S
            if stops > _STOPS_S:
                rejected["stops late"] += 1
                continue
            motion = struck(qpos, points, speed)
            fault = strike.fault(motion, stops if split == "train" else None)
            if fault is None and not stays_in_view(solid, motion, cameras):
                fault = "out of view"
            if fault is None:
                candidates += 1
                unrest = speed_at_end(solid, motion)
                if best is None or unrest < best[0]:
                    best = unrest, motion, np.concatenate((qpos, points.ravel(), [speed]))
                if unrest < RESTING_M_S or candidates == CANDIDATES:
                    break
                fault = "no rest"
            rejected[fault] += 1
        if best is None:
            reasons = ", ".join(f"{reason} {count}" for reason, count in rejected.items())
            raise NotConvergedError(f"none of {_TRIES} pushes of the {solid.family} serves ({reasons}).")
        episodes.append(EpisodePlan(name, split, frames, best[1]))
        begun.append(best[2])
        draft.write(rng, rejected, begun)
    return tuple(episodes), dict(rejected)


def _push(
    strike: Strike, rng: np.random.Generator, model: MjModel, solid: SolidObject, down: Array, split: str
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
    offset = rng.uniform(-strike.offset, strike.offset) * breadth
    height = max(min(strike.height[0] * world[:, 2].max(), strike.height[1] * com[2]), FINGERTIP_RADIUS + 0.004)
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


def _stands(motion: Motion, stops: float | None) -> str | None:
    """Return why a toppling is of no use; `stops` is given for the short training motion."""
    first, last = motion.qpos[motion.row(0.0)], motion.qpos[-1]
    if motion.first_contact is None:
        return "not struck"
    tilt = tilted_deg(first[3:7], last[3:7])
    return None if tilt > (_TOPPLES_DEG if stops is None else _TIPS_DEG) else "stands"


PUSH = Strike((0.35, 0.7), 0.4, _fault, lambda _, down: down)
"""The fingertip strikes low, and the object slides."""
TIP = Strike((0.9, 2.0), 0.15, _stands, lambda solid, _: tall_rest(solid))
"""The fingertip strikes high an object that stands tall, and topples it."""
