"""The metric scale from depth maps of photos."""

from __future__ import annotations

import numpy as np
import pytest
from cgwm.pipeline.calibrate.reconstruction import SfmModel, Similarity
from cgwm.pipeline.calibrate.world_frame.depth_scale import SENSOR_STD, from_depth
from helpers.sfm_scene import make_scene

UNIT_M = 0.37


@pytest.fixture(scope="module")
def model() -> SfmModel:
    """A scene in an arbitrary unit."""
    scene = make_scene(images=8, points=200, noise_px=0.3, outliers=0.0, seed=1)[0]
    return scene.transformed(Similarity(1 / UNIT_M, np.eye(3), np.zeros(3)))


def maps(model: SfmModel, noise: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a depth map [m] of each photo with holes, a noise of one factor a map, and a tenth of wrong pixels."""
    rng, found = np.random.default_rng(seed), {}
    for name, pose in model.T_cam_world.items():
        depth = np.zeros((480, 640), np.float32)
        pixels, seen = model.observations[name]
        z = UNIT_M * (model.points[seen] @ pose[2, :3] + pose[2, 3]) * (1 + noise * rng.normal())
        z[rng.random(len(z)) < 0.1] *= 2
        columns, rows = np.floor(pixels).astype(int).T
        inside = (columns >= 0) & (columns < 640) & (rows >= 0) & (rows < 480) & (rng.random(len(z)) < 0.7)
        depth[rows[inside], columns[inside]] = z[inside]
        found[name] = depth
    return found


def test_the_scale_is_that_of_the_maps_despite_holes_and_wrong_pixels(model: SfmModel) -> None:
    found = maps(model, noise=0.0)
    frame = from_depth(model, model.T_cam_world, found.get)
    assert frame is not None and frame.similarity.scale == pytest.approx(UNIT_M, rel=2e-3)
    assert frame.source == "depth maps of 8 photos" and not frame.fixes_frame
    assert frame.relative_std == pytest.approx(SENSOR_STD, rel=0.05)


def test_maps_that_disagree_make_it_less_certain(model: SfmModel) -> None:
    away = []
    for seed in range(8):
        found = maps(model, noise=0.05, seed=seed)
        frame = from_depth(model, model.T_cam_world, found.get)
        assert frame is not None and frame.relative_std is not None and SENSOR_STD < frame.relative_std < 0.05
        away.append((frame.similarity.scale / UNIT_M - 1) / frame.relative_std)
    assert 0.2 < np.sqrt(np.mean(np.square(away))) < 2.0


def test_without_maps_of_the_photos_size_there_is_no_scale(model: SfmModel) -> None:
    found = maps(model, noise=0.0)
    few = dict(list(found.items())[:2])
    assert from_depth(model, model.T_cam_world, few.get) is None
    assert from_depth(model, model.T_cam_world, lambda name: found[name][::2, ::2]) is None
    assert from_depth(model, model.T_cam_world, lambda name: np.zeros((480, 640), np.float32)) is None
