"""Film of a run of a hand: the plant beside the object as a plan had predicted it, on hulls of links in dots."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ....datasets.capture.cameras import Camera
from ....datasets.models.model import Model
from ....datasets.rollouts.control_file import RunTables
from ....datasets.shapes.ply import Splats
from ...geometry.rotation import quat_to_matrix
from ...geometry.viewpoint import look_at
from ...physics.body import Body
from ..film import AHEAD_S, ANGLE_DEG, SIZE, Image, filmed, predicted_at
from ..frame_renderer import FrameRenderer
from ..horizon import Array
from .world import HandWorld

DOT_M = 0.003
"""Distance of the dots on a hull [m]."""
LINK_COLOR, LIGHT, DARKEST = (0.62, 0.66, 0.72), (0.3, -0.5, 0.81), 0.35
"""Colour of links; direction of the light, and the share of it that comes from everywhere."""
AWAY = (0.35, -0.7, 0.62)
"""Direction from the object to the camera."""
REACH_M = 0.11
"""Radius of what is seen around the middle of the object's places [m]."""


def hand_film_of(hand: HandWorld, tables: RunTables, device: str) -> tuple[bytes | None, str]:
    """Return a film (WebM) of a run, and some of its frames as the URI of a picture; None and "" without commands.

    Args:
        hand: The task.
        tables: The run.
        device: cpu or cuda.
    """
    if not len(tables.arrays["actions"]):
        return None, ""
    return filmed(tables, _picture(hand, tables, device))


def _picture(hand: HandWorld, tables: RunTables, device: str) -> Callable[[int], tuple[Image, Image]]:
    """Return a function that draws plant and prediction, each (H, W, 3), at the number of a command."""
    middle = np.median(tables.arrays["obs/object"][:, :3], axis=0)
    renderer = FrameRenderer(dotted_model(hand), _camera(middle), device)
    time, ahead = tables.arrays["control/time"], min(AHEAD_S, hand.task.planner.horizon_s)

    def drawn(pose: Array, joints: Array) -> Image:
        state = hand.state(pose[:3], pose[3:], dict(zip(hand.joints, joints.tolist(), strict=True)))
        moved = type(state)(*(part.to(device, torch.float32) for part in state.tensors))
        return renderer.of(moved)[0].cpu().numpy()

    def pair(frame: int) -> tuple[Image, Image]:
        joints = tables.arrays["obs/joints"][frame]
        real = drawn(tables.arrays["obs/object"][frame], joints)
        found = predicted_at(tables, float(time[frame]), ahead)
        return real, real if found is None else drawn(found[0], joints)

    return pair


def dotted_model(hand: HandWorld) -> Model:
    """Return the model with all bodies of the world of a task, in its order; links have dots on their hulls."""
    world, name = hand.world, hand.world.body_names[hand.object]
    body = next(body for body in hand.model.file.bodies if body.name == name)
    start = hand.state(hand.task.start.position_m, hand.task.start.quat_wxyz,
                       dict(zip(hand.joints, hand.home.tolist(), strict=True)))  # fmt: skip
    turns = quat_to_matrix(start.quat_wxyz[0]).numpy()
    splats = {
        link.name: _dots(link, lambda normals, turn=turn: _lit(normals @ turn.T))
        for link, turn in zip(world.bodies[:-1], turns[:-1], strict=True)
        if link.name not in hand.chain.within and link.hull is not None
    }
    # without photos an object has a colour for each direction, so that its turns are seen
    seen = hand.model.body_splats.get(name)
    splats[name] = seen or _dots(world.bodies[-1], lambda normals: 0.5 + 0.45 * normals)
    bodies = tuple(body.model_copy(update={"name": each}) for each in world.body_names[:-1])
    file = hand.model.file.model_copy(update={"bodies": (*bodies, body)})
    return replace(hand.model, file=file, body_splats=splats, scene=None)


def _lit(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours (n, 3) of a link where its surface has normals (n, 3) in the world."""
    share = DARKEST + (1 - DARKEST) * np.clip(normals @ np.array(LIGHT), 0, 1)
    return share[:, None] * np.array(LINK_COLOR)


def _dots(body: Body, colors: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Splats:
    """Return dots on the hull of a body's balls, coloured by its normals."""
    points = body.centers[0].numpy()
    hull = ConvexHull(points)
    places, normals = [], []
    for corners, plane in zip(points[hull.simplices], hull.equations, strict=True):
        longest = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).max())
        count = max(1, math.ceil(longest / DOT_M))
        first, second = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T / count
        places.append(np.stack((first, second, 1 - first - second), -1) @ corners)
        normals.append(np.tile(plane[:3], (len(first), 1)))
    means = np.concatenate(places)
    size, solid = np.full(len(means), 0.5 * DOT_M), np.full(len(means), 0.99)
    return Splats(means, size, solid, colors(np.concatenate(normals)))


def _camera(target: Array) -> Camera:
    """Return a camera that looks at a place (3,) [m]."""
    width, height = SIZE
    half = math.radians(ANGLE_DEG) / 2
    eye = target + REACH_M / math.sin(half) * np.array(AWAY) / np.linalg.norm(AWAY)
    focal = 0.5 * height / math.tan(half)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pose = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
    return Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=pose)
