"""Film of a run in splats: the plant beside what the model had predicted for the same time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.capture.cameras import Camera
from ...datasets.capture.video import encoded_webm
from ...datasets.models.model import Model
from ...datasets.rollouts.control_file import RunTables
from ...datasets.shapes.interpolation import by_column
from ...datasets.shapes.ply import Splats
from ..geometry.viewpoint import look_at
from ..rendering.contact_sheets import contact_sheet, evenly, jpeg_uri
from .frame_renderer import FrameRenderer
from .horizon import Array
from .task_world import TaskWorld

Image = NDArray[np.uint8]

SIZE = (320, 240)
"""Width and height of a picture [px]."""
MOST_FRAMES = 40
"""Largest number of frames of a film: a picture on the CPU takes as long as ten plans."""
FILM_HZ = 8.0
"""Frames per second, at which a short run is filmed; of a long one, every so many are taken."""
AHEAD_S = 0.5
"""Age of the plans whose prediction is shown [s]."""
ELEVATION_DEG, ANGLE_DEG = 50.0, 40.0
"""Direction of the camera above the ground, and its vertical angle of view."""
_SHEET = 6
_RED, _GREY = (0.85, 0.2, 0.15), (0.55, 0.55, 0.55)


def film_of(found: TaskWorld, tables: RunTables, device: str) -> tuple[bytes | None, str]:
    """Return a film (WebM) of a run, and some of its frames as the URI of a picture; None and "" without splats.

    Args:
        found: The task.
        tables: The run.
        device: cpu or cuda.
    """
    name = found.world.body_names[found.object]
    if name not in found.model.body_splats or not len(tables.arrays["actions"]):
        return None, ""
    return filmed(tables, _picture(found, tables, device))


def filmed(tables: RunTables, draw: Callable[[int], tuple[Image, Image]]) -> tuple[bytes, str]:
    """Return a film (WebM) of a run, and some of its frames as the URI of a picture.

    Args:
        tables: The run.
        draw: Draws plant and prediction, each (H, W, 3), at the number of a command.
    """
    frames = _frames(tables)
    pictures = [draw(frame) for frame in frames]
    pairs = [np.concatenate(pair, axis=1) for pair in pictures]
    shown = evenly(len(frames), _SHEET)
    rows = [np.stack([pictures[k][side] for k in shown]) for side in (0, 1)]
    return encoded_webm(pairs, FILM_HZ), jpeg_uri(contact_sheet(rows))


def _frames(tables: RunTables) -> list[int]:
    """Return the commands that are filmed."""
    time = tables.arrays["control/time"]
    wanted = max(2, math.ceil((time[-1] - time[0]) * FILM_HZ))
    return evenly(len(time), min(wanted, MOST_FRAMES))


def _picture(found: TaskWorld, tables: RunTables, device: str) -> Callable[[int], tuple[Image, Image]]:
    """Return a function that draws plant and prediction, each (H, W, 3), at the number of a command."""
    renderer = FrameRenderer(visible_model(found), _camera(found, tables), device)
    time = tables.arrays["control/time"]

    def drawn(pose: Array, finger: Array) -> Image:
        state = found.state(pose[:3], pose[3:], finger)
        moved = type(state)(*(part.to(device, torch.float32) for part in state.tensors))
        return renderer.of(moved)[0].cpu().numpy()

    def pair(frame: int) -> tuple[Image, Image]:
        real = drawn(tables.arrays["obs/object"][frame], tables.arrays["obs/finger"][frame])
        found = predicted_at(tables, float(time[frame]))
        return real, real if found is None else drawn(*found)

    return pair


def predicted_at(tables: RunTables, now_s: float, ahead_s: float = AHEAD_S) -> tuple[Array, Array] | None:
    """Return pose (7,) of the object and targets of the joints that a plan of a while before had; None before.

    Args:
        tables: The run.
        now_s: The time that was predicted [s].
        ahead_s: Least age of the plan [s].
    """
    made = tables.arrays["plans/state_time"]
    index = int((made <= now_s - ahead_s + 1e-9).sum()) - 1
    if index < 0:
        return None
    times = tables.arrays["plans/times"][index]
    pose, finger = (by_column(now_s, times, tables.arrays[f"plans/{name}"][index]) for name in ("object", "targets"))
    pose[3:] /= np.linalg.norm(pose[3:])
    return pose, finger


def visible_model(found: TaskWorld) -> Model:
    """Return the model with a picture of the finger, and of the goal as a mark on the ground."""
    model, robot = found.model, found.task.robot
    splats = dict(model.body_splats)
    if robot.name not in splats:
        splats[robot.name] = Splats(
            np.zeros((1, 3)), np.array([robot.radius_m / 2]), np.array([0.99]), np.array([_RED])
        )
    kept = {body.name for body in model.file.bodies}
    return replace(
        model, body_splats={name: value for name, value in splats.items() if name in kept}, scene=_ground(found)
    )


def _ground(found: TaskWorld) -> Splats:
    """Return the model's background, or where it has none, a ground; with a cross at the goal."""
    x, y = found.task.goal.position_m
    z = found.finger_z - found.task.robot.height_m
    arm = np.linspace(-0.03, 0.03, 13)
    cross = np.concatenate((np.c_[x + arm, np.full(13, y)], np.c_[np.full(13, x), y + arm]))
    parts = [Splats(np.c_[cross, np.full(26, z)], np.full(26, 0.0025), np.full(26, 0.99), np.tile(_RED, (26, 1)))]
    scene = found.model.scene
    if scene is None:
        line = np.linspace(-0.5, 0.5, 41)
        grid = np.stack(np.meshgrid(line + x, line + y), -1).reshape(-1, 2)
        count = len(grid)
        scene = Splats(
            np.c_[grid, np.full(count, z - 0.02)],
            np.full(count, 0.02),
            np.full(count, 0.95),
            np.tile(_GREY, (count, 1)),
        )
    names = ("means", "scales", "opacities", "colors")
    joined = [np.concatenate([np.asarray(getattr(part, name)) for part in (scene, *parts)]) for name in names]
    return Splats(*joined)


def _camera(found: TaskWorld, tables: RunTables) -> Camera:
    """Return a camera that sees the goal and all places of the object and of the finger."""
    width, height = SIZE
    places = np.concatenate(
        (tables.arrays["obs/object"][:, :2], tables.arrays["obs/finger"], [found.task.goal.position_m])
    )
    middle = 0.5 * (places.min(0) + places.max(0))
    reach = max(0.15, float(np.linalg.norm(places - middle, axis=1).max()) + 0.05)
    target = np.array([*middle, found.finger_z])
    angle, half = math.radians(ELEVATION_DEG), math.radians(ANGLE_DEG) / 2
    eye = target + reach / math.sin(half) * np.array([0.0, -math.cos(angle), math.sin(angle)])
    focal = 0.5 * height / math.tan(half)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pose = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
    return Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=pose)
