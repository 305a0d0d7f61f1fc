"""The benchmark's learned rival: it learns, repeats itself, and sees no track and no truth where it must not."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.capture.images import write_image
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.synthetic.dynamics import ContactTruth
from cgwm.datasets.synthetic.objects import make_object
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from helpers.small_model import cube_splats, small_model, table_splats

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))  # as `python benchmarks/fall_push.py` has it
try:
    from contenders import latent, trajectories
    from contenders.base import Cell
    from contenders.latent_model import LatentModel, Sequences, predicted, stopwatch, train
finally:
    sys.path.remove(str(BENCHMARKS))

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.evidence]
FRAMES, RATE = 5, 30.0
SIZE = (64, 48)


def camera(azimuth: float) -> Camera:
    eye = np.array([0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), 0.35])
    forward = np.array([0, 0, 0.08]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    K = np.array([[70.0, 0, 32], [0, 70.0, 24], [0, 0, 1]])
    return Camera(*SIZE, K, np.zeros(0), T)


CAMERAS = {"left": camera(0.3), "right": camera(2.0)}


def visible_model() -> Model:
    model = small_model()
    body = cube_splats(150)
    colors = np.clip(0.5 + body.means / 0.1 * 0.9, 0.05, 0.95)
    return replace(model, body_splats={"cube": replace(body, colors=colors)}, scene=table_splats(12))


def motion() -> tuple[np.ndarray, np.ndarray]:
    """Return positions (T, 1, 3) and orientations (T, 1, 4) of a cube that falls and turns."""
    time = torch.arange(FRAMES, dtype=torch.float64)[:, None] / RATE
    position = torch.cat((0.2 * time, 0.1 * time, 0.25 - 0.5 * 9.81 * time**2 / 4), 1)
    start = quat_exp(torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)).expand(FRAMES, 4)
    quat = quat_multiply(quat_exp(time * torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)), start)
    return position.numpy()[:, None], quat.numpy()[:, None]


def make_cell(folder: Path) -> Cell:
    """Write a capture of the motion, whose tracks lie, without masks and without a truth; and its splats."""
    model = visible_model()
    position, quat = motion()
    for block in LabelRenderer(model, CAMERAS).blocks(position, quat):
        target = folder / "capture" / "videos" / block.camera / "000"
        target.mkdir(parents=True, exist_ok=True)
        for k, image in enumerate(block.image):
            write_image(target / f"{block.start + k:06d}.png", image)
    entries = {name: {"width": 64, "height": 48, "fx": 70.0, "fy": 70.0, "cx": 32.0, "cy": 24.0} for name in CAMERAS}
    videos = {name: {"camera": name, "T_world_cam": view.T_world_cam.tolist()} for name, view in CAMERAS.items()}
    cameras = {"format": "cgwm-cameras/1", "scale": {"kind": "metric"}, "cameras": entries, "videos": videos}
    (folder / "capture" / "cameras.json").write_text(json.dumps(cameras))
    (folder / "capture" / "capture.toml").write_text(
        'format = "cgwm-capture/1"\n[world]\ngravity_m_s2 = [0.0, 0.0, -9.81]\n'
        "ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }\n"
        '[[bodies]]\nname = "cube"\nmass_kg = 0.37\n[splits]\ntrain = ["000"]\n'
    )
    (folder / "capture" / "tracks").mkdir()
    times = np.arange(FRAMES) / RATE
    lie = Track(times, position[:, 0] + [3.0, 0, 0], np.tile([1.0, 0, 0, 0], (FRAMES, 1)))
    write_tracks(folder / "capture" / "tracks" / "000.csv", {"cube": lie})
    write_model(folder / "splats", model)
    return Cell(folder / "capture", folder / "splats", "cpu", 0)


def rolling(driven: int = 0, count: int = 6, frames: int = 8) -> Sequences:
    """Return sequences of a bright spot that moves as the pose does, at random constant velocities."""
    generator = torch.Generator().manual_seed(0)
    velocity = 0.3 * torch.randn(count, 1, 3, generator=generator)
    position = velocity * torch.arange(frames)[:, None] / RATE
    grid = torch.stack(torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij"), -1) / 16 - 0.5
    image = torch.exp(-((grid - 3 * position[..., None, None, :2]) ** 2).sum(-1) / 0.02)
    return Sequences(
        image[:, :, None].repeat(1, 1, 3, 1, 1),
        position,
        torch.eye(3).expand(count, frames, 3, 3).contiguous(),
        velocity.expand(count, frames, 3).contiguous(),
        torch.zeros(count, frames, 3),
        position[:, :, None].repeat(1, 1, driven, 1),
        torch.ones(count, frames, dtype=torch.bool),
    )


def trained(data: Sequences, seed: int, steps: int) -> tuple[LatentModel, list[float]]:
    torch.manual_seed(seed)
    model = LatentModel(data.images.mean((0, 1)), data.driven_m.shape[2], hidden=32, stochastic=4)
    return model, train(model, data, seed, steps, stopwatch(None), data.images.shape[1])


def test_the_loss_falls_and_open_loop_prediction_beats_a_frozen_object() -> None:
    data = rolling(driven=1)
    model, losses = trained(data, 0, 100)
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    position, rotation, images = predicted(model, data)
    frozen = (data.position_m - data.position_m[:, :1]).norm(dim=-1).mean()
    assert float((position - data.position_m).norm(dim=-1).mean()) < 0.6 * float(frozen)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand_as(rotation), atol=1e-5, rtol=0)
    assert images.shape == data.images.shape
    still = (data.images[:, :1] - data.images).square().mean()
    assert float((images - data.images).square().mean()) < float(still)


def test_equal_seeds_predict_the_same_and_only_the_first_frame_is_read() -> None:
    data = rolling()
    one, other, third = (predicted(trained(data, seed, 4)[0], data) for seed in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    assert not torch.equal(one[0], third[0])
    model, _ = trained(data, 1, 4)
    torch.manual_seed(5)
    later = {name: value.clone() for name, value in vars(data).items()}
    for name in ("images", "position_m", "rotation", "velocity_m_s", "omega_world_rad_s"):
        later[name][:, 1:] = torch.rand(later[name][:, 1:].shape)
    blind = predicted(model, Sequences(**later))
    assert all(torch.equal(a, b) for a, b in zip(one, blind, strict=True))


def test_a_chunk_past_the_end_is_not_known() -> None:
    data = rolling(frames=4)
    chunk = data.chunk(torch.tensor([2, 0]), torch.tensor([1, 0]), 6)
    assert chunk.known.tolist() == [[True] * 3 + [False] * 3, [True] * 4 + [False] * 2]
    assert torch.equal(chunk.position_m[0, 2:], data.position_m[2, 3:].expand(4, 3))


def test_learning_from_frames_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latent, "FREE_STEPS", 3)
    seen = []
    monkeypatch.setattr(latent, "train", lambda model, data, *rest: (seen.append(data), train(model, data, *rest))[1])
    cell = make_cell(tmp_path)
    fitted = latent.Latent("latent").fit(cell, None)
    position, quat = motion()
    (data,) = seen  # poses are those in the pictures, not those of the tracks, and nobody has a truth
    assert not (cell.capture / "truth.json").exists()
    known = data.known[0]
    assert int(known.sum()) >= FRAMES - 1
    off = (data.position_m[0] - torch.as_tensor(position[:, 0])).norm(dim=-1)[known]
    assert float(off.max()) < 0.03
    assert fitted.record["sequences"] == [1, FRAMES]
    start = State(*(torch.zeros(1, 1, n, dtype=torch.float64) for n in (3, 4, 3, 3)))
    start.position_m[0], start.quat_wxyz[0] = torch.as_tensor(position[0]), torch.as_tensor(quat[0])
    times = np.arange(12) / RATE + 0.004 * (np.arange(12) % 2)  # one camera a little later than the other
    first, again = (fitted.predict(start, {}, times) for _ in range(2))
    assert first.position_m.shape == (12, 1, 3)
    np.testing.assert_array_equal(first.position_m, again.position_m)
    np.testing.assert_allclose(first.position_m[0], position[0])
    np.testing.assert_allclose(np.linalg.norm(first.quat_wxyz, axis=-1), 1.0, atol=1e-6)
    assert {name: image.shape for name, image in first.images.items()} == dict.fromkeys(CAMERAS, (12, 48, 64, 3))
    # what it begins with is what the splats show at the start
    shown = next(LabelRenderer(visible_model(), {"left": CAMERAS["left"]}).blocks(position[:1], quat[:1])).image[0]
    unexposed = replace(fitted.cameras, exposures={})
    film = unexposed.film(position[:1], quat[:1])[0, :3].permute(1, 2, 0).numpy()
    assert np.abs(255 * film - shown).mean() < 0.5


@pytest.mark.parametrize("pushed", [False, True])
def test_true_trajectories_move_and_settle(pushed: bool) -> None:
    contact = ContactTruth(
        friction=0.35, friction_fingertip=0.3, natural_time=0.0032, damping_ratio=0.4, impedance=0.97
    )
    times = np.arange(31) / RATE
    solid, down = make_object(0), np.array([0.0, 0.0, -1.0])
    ways = trajectories.draw_trajectories(solid, contact, down, pushed, 2, times, 0)
    again = trajectories.draw_trajectories(solid, contact, down, pushed, 2, times, 0)
    for way, same in zip(ways, again, strict=True):
        np.testing.assert_array_equal(way.position_m, same.position_m)
        assert np.linalg.norm(way.position_m[-1, :2] - way.position_m[0, :2]) > 0.01
        assert way.position_m[:, 2].min() > 0.02
        assert (way.fingertip_m is None) != pushed
        if not pushed:
            speed = np.diff(way.position_m[:, 2]) * RATE
            assert speed[:3].max() < way.velocity_m_s[0, 2] + 1e-3, "it does not fall freely at first"
