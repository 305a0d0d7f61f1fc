"""From a video of a walk to metric cameras: the frames that `import video` takes are enough for `calibrate`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets import import_video
from cgwm.pipeline.calibrate import calibrate
from cgwm.schemas import CamerasFile, read_json
from helpers.sfm_scene import look_at
from pipeline.calibrate.test_calibrate import (
    CONFIG,
    HEIGHT,
    MANIFEST,
    MARKERS,
    PIXELS_PER_M,
    WIDTH,
    _floor,
    _render,
    _texture,
)

FRAMES = 90


def _walk() -> list[np.ndarray]:
    """Return T_cam_world of a walk on an arc, that goes up and down."""
    angles = np.radians(np.linspace(-145, -35, FRAMES))
    heights = 0.9 + 0.2 * np.sin(4 * angles)
    target = np.array([0.0, 0.0, 0.1])
    return [
        look_at(np.array([1.3 * np.cos(a), 1.3 * np.sin(a), h]), target) for a, h in zip(angles, heights, strict=True)
    ]


@pytest.mark.evidence
def test_a_walk_becomes_metric_cameras(tmp_path: Path) -> None:
    floor, wall = _floor(), _texture(round(0.8 * PIXELS_PER_M), 1)[: round(0.5 * PIXELS_PER_M)]
    poses = _walk()
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (WIDTH, HEIGHT))
    for k, pose in enumerate(poses):
        frame = _render(pose, floor, wall)[:, :, ::-1]
        writer.write(cv2.GaussianBlur(frame, (15, 1), 5) if k % 3 else np.ascontiguousarray(frame))  # shaken
    writer.release()
    result = import_video(path, tmp_path / "capture", photos=14)
    root = tmp_path / "capture"
    (root / "capture.toml").write_text(MANIFEST + MARKERS)
    report = calibrate(root, CONFIG)
    assert result.photos == report.photos == report.photos_registered == 14
    cameras = read_json(root / "cameras.json", CamerasFile)
    assert cameras.scale.kind == "metric"
    truth = {name: np.linalg.inv(poses[int(Path(name).stem)])[:3, 3] for name in cameras.images}
    away = [np.linalg.norm(np.array(one.T_world_cam)[:3, 3] - truth[name]) for name, one in cameras.images.items()]
    assert all(int(Path(name).stem) % 3 == 0 for name in truth), "a shaken frame was taken"
    assert max(away) < 0.01  # [m], at 1.5 m from the scene
