"""Cameras that lie upon each other, as an object makes them that looks alike from several sides, are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cgwm.pipeline.calibrate.folded_cameras import folded_sides
from helpers.sfm_scene import look_at, make_scene


def _sides(angles_deg: np.ndarray) -> int:
    rng = np.random.default_rng(0)
    model = make_scene(images=4, points=20, noise_px=0.0, outliers=0.0, seed=0)[0]
    places = [np.array([np.cos(a), np.sin(a), 0.4]) for a in np.radians(angles_deg)]
    poses = {f"{k:02d}.jpg": look_at(place + rng.normal(0, 0.01, 3), np.zeros(3)) for k, place in enumerate(places)}
    return folded_sides(replace(model, T_cam_world=poses), list(poses))


@pytest.mark.parametrize("sides", [1, 2, 3, 4])
def test_photos_of_an_object_with_equal_sides_lie_upon_each_other(sides: int) -> None:
    ring = np.arange(24) * 15.0
    assert _sides(ring % (360.0 / sides)) == sides


def test_bursts_rings_and_photos_at_random_are_not_folded() -> None:
    assert _sides(np.repeat(np.arange(12) * 30.0, 2)) == 1
    assert _sides(np.random.default_rng(1).uniform(0, 360, 30)) == 1
    assert _sides(np.arange(3) * 120.0) == 1
