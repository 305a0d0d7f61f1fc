"""Measured throws of a small cube, made and filmed by our own engine, so that the right answer is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from cgwm.datasets.capture.cameras import Camera, to_intrinsics
from cgwm.datasets.capture.images import write_image
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.datasets.models.model import Model
from cgwm.pipeline.evaluate.prediction import Motion
from cgwm.pipeline.physics import State, world_of_model
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.pipeline.rendering.video_view import expose
from cgwm.schemas import CamerasFile, Exposure, PosedVideo, Scale, Solver
from helpers.small_model import HALF, small_model

NOISE_M, NOISE_RAD = 5e-4, 2e-3
RATE_HZ, FRAMES = 50, 26
VIDEO_HZ = 25.0
EXPOSURE = Exposure(gain_rgb=(0.8, 0.9, 0.95))


def quick(model: Model) -> Model:
    """Return the model with a coarse solver: here it is at once the truth and the model."""
    return replace(model, file=model.file.model_copy(update={"solver": Solver(step_s=0.004, sweeps=2)}))


def truth() -> Model:
    model = quick(small_model())
    return replace(model, file=model.file.model_copy(update={"exposures": {"left": EXPOSURE}}))


def thrown(seed: int) -> tuple[np.ndarray, Motion]:
    """Return times and the noiseless motion of a cube that is thrown flat over the table, lands and slides."""
    rng = np.random.default_rng(seed)
    state = State(
        torch.tensor([[[-0.1, 0.0, HALF + 0.07]]]).double() + 0.01 * torch.tensor(rng.standard_normal((1, 1, 3))),
        torch.tensor([[[1.0, 0.0, 0.0, 0.0]]]).double(),
        torch.tensor([[[0.9, 0.2, 0.1]]]).double(),
        torch.tensor(0.2 * rng.standard_normal((1, 1, 3))),
    )
    times = np.arange(FRAMES) / RATE_HZ
    rollout = roll_out(world_of_model(truth()), state, torch.tensor(times))
    return times, Motion(rollout.position_m[0].numpy(), rollout.quat_wxyz[0].numpy())


def measured(times: np.ndarray, motion: Motion, seed: int, turned: bool = True) -> Track:
    rng = np.random.default_rng(100 + seed)
    position = motion.position_m[:, 0] + NOISE_M * rng.standard_normal((len(times), 3))
    half = 0.5 * NOISE_RAD * rng.standard_normal((len(times), 3))
    w, x, y, z = motion.quat_wxyz[:, 0].T
    a, b, c = half.T
    quat = np.stack([w - x * a - y * b - z * c, x + w * a - z * b + y * c, y + z * a + w * b - x * c], 1)
    quat = np.c_[quat, z - y * a + x * b + w * c]
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return Track(times, position, quat if turned else None)


def write_capture(root: Path, episodes: int = 3, turned: bool = True, body: str = "cube") -> Path:
    names = [f"{k:03d}" for k in range(episodes)]
    text = [
        'format = "cgwm-capture/1"',
        "[world]",
        "ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }",
        f'[[bodies]]\nname = "{body}"\nmass_kg = 0.37',
        f"shape = {{ box = {{ half_extents_m = [{HALF}, {HALF}, {HALF}] }} }}",
        f"[measurement]\nposition_std_m = {NOISE_M}\nrotation_std_rad = {NOISE_RAD}",
        f"[splits]\ntest = {json.dumps(names)}\nempty = []",
        f"[video]\nframe_rate_hz = {VIDEO_HZ}",
    ]
    (root / "tracks").mkdir(parents=True)
    (root / "capture.toml").write_text("\n".join(text) + "\n")
    for seed, name in enumerate(names):
        write_tracks(root / "tracks" / f"{name}.csv", {body: measured(*thrown(seed), seed, turned)})
    return root


def camera() -> Camera:
    forward = np.array([0.0, 0.6, -0.3])
    forward /= np.linalg.norm(forward)
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = [0.05, -0.55, 0.33]
    K = np.array([[90.0, 0.0, 48.0], [0.0, 90.0, 36.0], [0.0, 0.0, 1.0]])
    return Camera(width=96, height=72, K=K, distortion=np.zeros(0), T_world_cam=pose)


def add_video(root: Path, masks: bool = True, episode: str = "000", kind: str = "metric") -> None:
    """Film an episode with the model itself: the only errors left are those of the predicted motion."""
    _, motion = thrown(int(episode))
    rows = slice(0, None, round(RATE_HZ / VIDEO_HZ))
    renderer = LabelRenderer(truth(), {"left": camera()})
    blocks = list(renderer.blocks(motion.position_m[rows], motion.quat_wxyz[rows]))
    images, labels = (np.concatenate([getattr(block, key) for block in blocks]) for key in ("image", "mask"))
    for k, image in enumerate(images):
        for folder, array in (("videos", (255 * expose(image, EXPOSURE)).round()), ("video_masks", labels[k])):
            if folder == "videos" or masks:
                path = root / folder / "left" / episode / f"{k:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_image(path, array.astype(np.uint8))
    pose = tuple(tuple(float(x) for x in row) for row in camera().T_world_cam)
    cameras = CamerasFile(
        scale=Scale(kind=kind),  # pyright: ignore[reportArgumentType]
        cameras={"c": to_intrinsics(camera())},
        videos={"left": PosedVideo(camera="c", T_world_cam=pose)},  # pyright: ignore[reportArgumentType]
    )
    (root / "cameras.json").write_text(cameras.model_dump_json())


def with_friction(value: float) -> Model:
    model = truth()
    assert model.file.contact is not None
    contact = model.file.contact.model_copy(update={"friction": value})
    parameters = tuple(
        p.model_copy(update={"estimate": value}) if p.name == "friction" else p for p in model.file.parameters
    )
    return replace(model, file=model.file.model_copy(update={"contact": contact, "parameters": parameters}))
