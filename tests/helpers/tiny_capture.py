"""A tiny capture on disk, made by our own engine and renderer: two cameras of 64x48 pixels, a cube that is thrown."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from cgwm.datasets.capture.cameras import Camera, to_intrinsics
from cgwm.datasets.capture.images import read_label, write_image
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.datasets.models.model import Model, write_model
from cgwm.pipeline.geometry.rotation import quat_exp
from cgwm.pipeline.physics import State, engine, world_of_model
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.schemas import CamerasFile, PosedVideo, Scale, Solver
from helpers.small_model import HALF, MASS, collision_splats, cube_splats, small_model, table_splats

WIDTH, HEIGHT, RATE_HZ, FRAMES = 64, 48, 30.0, 10
EPISODE = "000"
FAST = (
    *("--set", "phys-geo.step_s=0.003", "--set", "phys-geo.population=8"),
    *("--set", "phys-geo.generations=2", "--set", "phys-geo.iterations=1"),
)
"""Settings of `cgwm fit` that run all steps, and none of them well."""


def tiny_model() -> Model:
    """The cube with few spheres, whose colours vary slowly enough for pixels of a centimetre."""
    model = small_model()
    body = cube_splats(150)
    colors = np.clip(0.5 + body.means / 0.1 * np.array([0.9, 0.9, 0.9]), 0.05, 0.95)
    file = model.file.model_copy(update={"solver": Solver(step_s=0.004, sweeps=2)})
    corners = {"cube": collision_splats(2)}
    return replace(
        model, file=file, collision=corners, body_splats={"cube": replace(body, colors=colors)}, scene=table_splats(12)
    )


def start_state() -> State:
    """A tilted cube above the table, moving sideways: it hits within five frames."""

    def row(*values: float) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float64).view(1, 1, -1)

    quat = quat_exp(torch.tensor([0.3, 0.5, 0.2], dtype=torch.float64)).view(1, 1, 4)
    return State(row(-0.05, -0.03, 0.125), quat, row(0.4, 0.2, -0.6), row(1.5, -2.0, 1.0))


@cache
def thrown() -> Track:
    """The cube from `start_state` on."""
    times = torch.arange(FRAMES, dtype=torch.float64) / RATE_HZ
    rollout = engine.rollout(world_of_model(tiny_model()), start_state(), times)
    return Track(times.numpy(), rollout.position_m[0, :, 0].numpy(), rollout.quat_wxyz[0, :, 0].numpy())


def camera(azimuth_deg: float) -> Camera:
    azimuth = math.radians(azimuth_deg)
    eye = np.array([0.55 * math.cos(azimuth), 0.55 * math.sin(azimuth), 0.35])
    forward = np.array([0, 0, 0.08]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    K = np.array([[70.0, 0, WIDTH / 2], [0, 70.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(width=WIDTH, height=HEIGHT, K=K, distortion=np.zeros(0), T_world_cam=pose)


CAMERAS = {"left": camera(20.0), "right": camera(115.0)}


def write_tiny_capture(root: Path, track: Track | None = None, masks: bool = True, noise: float = 0.01) -> Path:
    """Write a capture and, beside it, `<root>-model`, the model to fit from; return the capture."""
    track = thrown() if track is None else track
    root.mkdir(parents=True)
    text = [
        'format = "cgwm-capture/1"',
        "[world]",
        "ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }",
        f'[[bodies]]\nname = "cube"\nmass_kg = {MASS}',
        f"shape = {{ box = {{ half_extents_m = [{HALF}, {HALF}, {HALF}] }} }}",
        f"[splits]\ntrain = {json.dumps([EPISODE])}",
        f"[video]\nframe_rate_hz = {RATE_HZ}",
    ]
    (root / "capture.toml").write_text("\n".join(text) + "\n")
    rng = np.random.default_rng(0)
    assert track.quat_wxyz is not None
    for name, view in CAMERAS.items():
        renderer = LabelRenderer(tiny_model(), {name: view})
        blocks = list(renderer.blocks(track.position_m[:, None], track.quat_wxyz[:, None]))
        images, labels = (np.concatenate([getattr(block, key) for block in blocks]) for key in ("image", "mask"))
        for k, image in enumerate(images):
            noisy = (image + 255 * noise * rng.standard_normal(image.shape)).round().clip(0, 255)
            write_frame(root / "videos" / name / EPISODE, k, noisy)
            if masks:
                write_frame(root / "video_masks" / name / EPISODE, k, labels[k])
    write_cameras(root, CAMERAS)
    write_model(model_of(root), tiny_model())
    return root


def model_of(root: Path) -> Path:
    return root.with_name(root.name + "-model")


def write_frame(folder: Path, number: int, array: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{number:06d}.png", array.astype(np.uint8))


def write_cameras(root: Path, cameras: dict[str, Camera]) -> None:
    poses = {name: tuple(tuple(float(x) for x in row) for row in view.T_world_cam) for name, view in cameras.items()}
    file = CamerasFile(
        scale=Scale(kind="metric"),
        cameras={name: to_intrinsics(view) for name, view in cameras.items()},
        videos={name: PosedVideo(camera=name, T_world_cam=pose) for name, pose in poses.items()},  # pyright: ignore[reportArgumentType]
    )
    (root / "cameras.json").write_text(file.model_dump_json())


def change_masks(root: Path, camera_name: str, change: Callable[[int, np.ndarray], np.ndarray]) -> None:
    """Replace each mask (H, W) of a camera by what `change` makes of its number and itself."""
    folder = root / "video_masks" / camera_name / EPISODE
    for k, path in enumerate(sorted(folder.iterdir())):
        write_frame(folder, k, change(k, read_label(path)))


def with_manifest(root: Path, before: str, after: str) -> None:
    """Replace a text in the manifest, which must be there."""
    text = (root / "capture.toml").read_text()
    assert before in text
    (root / "capture.toml").write_text(text.replace(before, after))


def with_tracks(root: Path, track: Track) -> None:
    (root / "tracks").mkdir(exist_ok=True)
    write_tracks(root / "tracks" / f"{EPISODE}.csv", {"cube": track})
