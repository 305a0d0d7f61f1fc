"""Photos of a camera that only turned are told from those of one that moved, whatever the reconstruction says."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from cgwm.pipeline.calibrate.reconstruction import SfmCamera, SfmModel, VerifiedPair
from cgwm.pipeline.calibrate.turned_on_the_spot import turned_on_the_spot
from helpers.sfm_scene import make_scene
from scipy.spatial.transform import Rotation

TRUE = SfmCamera(width=640, height=480, fx=600.0, fy=600.0, cx=323.0, cy=238.0, distortion=(-0.1, 0.0, 0.0, 0.0))


def _turns(arm_m: float, count: int = 12) -> tuple[SfmModel, list[VerifiedPair]]:
    """Return what a camera at the end of an arm sees of things two to four metres away, and a wrong model of it."""
    rng, seen = np.random.default_rng(0), []
    points = Rotation.random(6000, rng=rng).apply([0.0, 0.0, 1.0]) * rng.uniform(2.0, 4.0, (6000, 1))
    for k in range(count):
        turn = Rotation.from_euler("yx", [20.0 * k, 8.0 * np.sin(k)], degrees=True)
        local = turn.inv().apply(points) - [0.0, 0.0, arm_m]
        pixels = TRUE.project(local) + rng.normal(0, 0.1, (len(points), 2))
        inside = (local[:, 2] > 0.7 * np.linalg.norm(local, axis=1)) & (pixels > 0).all(1)
        seen.append((pixels, inside & (pixels[:, 0] < 640) & (pixels[:, 1] < 480)))
    model = make_scene(images=count, points=40, noise_px=0.0, outliers=0.0, seed=0)[0]
    names = list(model.T_cam_world)
    pairs = [
        VerifiedPair(names[a], names[b], seen[a][0][both], seen[b][0][both])
        for a, b in combinations(range(count), 2)
        if (both := seen[a][1] & seen[b][1]).sum() >= 50
    ]
    wrong = replace(TRUE, fx=876.0, fy=876.0, distortion=(0.12, -0.19, 0.0, 0.0))
    return replace(model, cameras={"photos": wrong}), pairs


def test_turns_on_the_spot_are_found_through_any_lens() -> None:
    model, pairs = _turns(0.0)
    assert turned_on_the_spot(replace(model, observations=_exact(model)), pairs)


def test_a_camera_at_the_end_of_an_arm_and_one_that_is_carried_have_moved() -> None:
    model, pairs = _turns(0.3)
    assert not turned_on_the_spot(replace(model, observations=_exact(model)), pairs)
    model, carried = make_scene(images=8, points=300, noise_px=0.3, outliers=0.0, seed=0)[:2]
    assert not turned_on_the_spot(model, carried)


def test_few_pairs_tell_nothing() -> None:
    model, pairs = _turns(0.0)
    assert not turned_on_the_spot(replace(model, observations=_exact(model)), pairs[:5])


def _exact(model: SfmModel) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return observations at which the model agrees with them to rounding, as a wrong one may."""
    found = {}
    for name, (_, seen) in model.observations.items():
        pose = model.T_cam_world[name]
        found[name] = (model.camera(name).project(model.points[seen] @ pose[:3, :3].T + pose[:3, 3]), seen)
    return found
