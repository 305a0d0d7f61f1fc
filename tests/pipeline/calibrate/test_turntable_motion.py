"""Cameras of a turntable: the axis and the rings are found, adjusted, and told from cameras that are free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cgwm.datasets.synthetic.rig import look_at
from cgwm.pipeline.calibrate.bundle import linearized
from cgwm.pipeline.calibrate.center_uncertainty import center_stds
from cgwm.pipeline.calibrate.reconstruction import SfmCamera, SfmModel, Similarity, VerifiedPair
from cgwm.pipeline.calibrate.turntable.adjustment import adjusted
from cgwm.pipeline.calibrate.turntable.cameras import on_turntable
from cgwm.pipeline.calibrate.turntable.motion import TurntableMotion, turntable_motion
from cgwm.pipeline.calibrate.world_frame.metric_scale import umeyama
from scipy.spatial.transform import Rotation

COUNT, NOISE_PX = 8, 0.3
FOCAL = 800.0
LENSES = {name: {"photos": name} for name in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL")}


def truth(jitter: float = 0.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Return T_cam_world of two rings about an axis; with `jitter`, of a camera that is carried."""
    rng, poses = np.random.default_rng(seed), {}
    for k in range(2 * COUNT):
        rise, angle = np.radians(18.0 if k < COUNT else 36.0), 2 * np.pi * (k % COUNT) / COUNT + 0.1 * (k >= COUNT)
        way = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        place = look_at(way * (1 + jitter * rng.normal()) + jitter * rng.normal(size=3), jitter * rng.normal(size=3))
        poses[f"{k:02d}.png"] = np.linalg.inv(place)
    return poses


def observed(poses: dict[str, np.ndarray], seed: int = 0) -> tuple[SfmModel, list[VerifiedPair]]:
    """Return a model whose observations of points on a ball have noise, with true poses, and its matches."""
    rng = np.random.default_rng([seed, 1])
    points = rng.normal(size=(150, 3))
    points *= 0.2 / np.linalg.norm(points, axis=1, keepdims=True)
    camera = SfmCamera(width=640, height=480, fx=FOCAL, fy=FOCAL, cx=320.0, cy=240.0)
    observations, seen = {}, {}
    for name, pose in poses.items():
        center = -pose[:3, :3].T @ pose[:3, 3]
        facing = np.flatnonzero((points * (center - points)).sum(1) > 0.08)
        pixels = camera.project(points[facing] @ pose[:3, :3].T + pose[:3, 3])
        seen[name] = dict(zip(facing.tolist(), pixels + rng.normal(0, NOISE_PX, pixels.shape), strict=True))
        observations[name] = (np.array(list(seen[name].values())), facing)
    names = list(poses)
    pairs = []
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            both = sorted(set(seen[first]) & set(seen[second]))
            if len(both) > 8:
                a, b = (np.array([seen[one][key] for key in both]) for one in (first, second))
                pairs.append(VerifiedPair(first, second, a, b))
    model = SfmModel(
        cameras={"photos": camera},
        image_camera=dict.fromkeys(names, "photos"),
        T_cam_world=dict(poses),
        points=points,
        colors=np.full((len(points), 3), 90, np.uint8),
        observations=observations,
        reprojection_error_px=NOISE_PX,
    )
    return model, pairs


def bent(model: SfmModel, size: float, seed: int = 3) -> SfmModel:
    """Return a model in another frame whose poses are off."""
    rng = np.random.default_rng(seed)
    moved = model.transformed(Similarity(3.0, Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.ones(3)))
    poses = {}
    for name, pose in moved.T_cam_world.items():
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(rng.normal(0, size, 3)).as_matrix()
        off[:3, 3] = rng.normal(0, size, 3)
        poses[name] = off @ pose
    return replace(moved, T_cam_world=poses)


def largest_error(model: SfmModel, poses: dict[str, np.ndarray]) -> float:
    """Return the largest error of a centre after the best similarity, as a share of the extent."""
    true = np.array([-pose[:3, :3].T @ pose[:3, 3] for name, pose in poses.items() if name in model.T_cam_world])
    found = np.array([model.center(name) for name in poses if name in model.T_cam_world])
    away = np.linalg.norm(umeyama(found, true).points(found) - true, axis=1)
    return float(away.max() / np.linalg.norm(np.ptp(true, axis=0)))


def cameras_of(poses: dict[str, np.ndarray]) -> dict[str, str]:
    return dict.fromkeys(poses, "photos")


def test_a_turntable_is_found_in_any_frame_and_adjusted_to_the_truth() -> None:
    poses = truth()
    model, pairs = observed(poses)
    start = bent(model, 0.02)
    found = on_turntable([start], pairs, cameras_of(poses), LENSES, {})
    assert found is not None and found.camera_model == "SIMPLE_PINHOLE"
    assert sorted(map(len, found.motion.rings)) == [COUNT, COUNT]
    assert largest_error(start, poses) > 0.005 and largest_error(found.model, poses) < 0.001
    assert found.model.cameras["photos"].focal_px == pytest.approx(FOCAL, rel=0.02)
    stds = center_stds(found.model, {"photos": "SIMPLE_RADIAL"}, (), found.motion)
    free = center_stds(found.model, {"photos": "SIMPLE_RADIAL"})
    assert all(0 < stds[name] < free[name] for name in poses)


def test_a_carried_camera_is_not_on_a_turntable() -> None:
    poses = truth(jitter=0.002)
    model, pairs = observed(poses)
    assert turntable_motion(model) is not None  # near enough to be tried
    assert on_turntable([model], pairs, cameras_of(poses), LENSES, {}) is None


def test_photos_that_were_not_registered_are_placed_on_the_rings() -> None:
    poses = truth()
    whole, pairs = observed(poses)
    kept = [name for name in poses if int(name[:2]) % COUNT < 6]
    part = replace(
        whole,
        image_camera={name: "photos" for name in kept},
        T_cam_world={name: poses[name] for name in kept},
        observations={name: whole.observations[name] for name in kept},
    )
    found = on_turntable([part], pairs, cameras_of(poses), LENSES, {})
    assert found is not None and len(found.model.T_cam_world) == 2 * COUNT
    assert largest_error(found.model, poses) < 0.001
    # matches of nothing that moves tell no angle
    still = [replace(pair, xy_b=pair.xy_a) if len({pair.image_a, pair.image_b} - set(kept)) else pair for pair in pairs]
    few = on_turntable([part], still, cameras_of(poses), LENSES, {})
    assert few is not None and set(few.model.T_cam_world) == set(kept)


def test_the_design_of_a_motion_is_its_derivative() -> None:
    model, _ = observed(truth())
    found = turntable_motion(model)
    assert found is not None
    turned, motion = found
    names = list(turned.T_cam_world)
    design, step = motion.design(names, 0), 1e-6 * np.random.default_rng(5).normal(size=motion.numbers)
    moved, before = motion.moved(step).poses(), motion.poses()
    for k, name in enumerate(names):
        shift = -moved[name][:3, :3].T @ moved[name][:3, 3] + before[name][:3, :3].T @ before[name][:3, 3]
        turn = Rotation.from_matrix(moved[name][:3, :3] @ before[name][:3, :3].T).as_rotvec()
        assert (design @ step)[6 * k : 6 * k + 6] == pytest.approx(np.concatenate([shift, turn]), abs=1e-10)


def test_an_adjustment_ends_where_no_number_of_the_motion_the_lens_or_a_point_lowers_the_loss() -> None:
    model, _ = observed(truth())
    start = turntable_motion(bent(model, 0.02))
    assert start is not None
    known_px, weight = 790.0, 1e-3
    found, motion = adjusted(*start, {"photos": "SIMPLE_RADIAL"}, 1.0, {"photos": (known_px, weight)})
    assert found.T_cam_world.keys() == model.T_cam_world.keys()
    assert all(np.array_equal(found.T_cam_world[name], pose) for name, pose in motion.poses().items())
    before = linearized(motion.placed(start[0]), {"photos": "SIMPLE_RADIAL"}, 1.0)
    after = linearized(found, {"photos": "SIMPLE_RADIAL"}, 1.0)
    after.right[after.columns["photos"]] += weight * (known_px - found.cameras["photos"].fx)
    design = motion.design(list(found.T_cam_world), 2)
    assert np.abs(design.T @ after.right).max() < 1e-3 * np.abs(design.T @ before.right).max()
    assert np.abs(after.points_right).max() < 1e-2 * np.abs(before.points_right).max()


def test_rings_need_photos_of_one_camera() -> None:
    model, _ = observed(truth())
    names = list(model.T_cam_world)
    other = replace(
        model,
        image_camera={name: "ab"[k % 2] for k, name in enumerate(names)},
        cameras={"a": model.cameras["photos"], "b": model.cameras["photos"]},
    )
    assert turntable_motion(other) is None  # four photos of a camera are no ring
    assert turntable_motion(replace(model, T_cam_world=dict(list(model.T_cam_world.items())[:4]))) is None


def test_the_right_side_of_the_normal_equations_is_half_the_gradient() -> None:
    model, _ = observed(truth())
    exact = linearized(model, {"photos": "OPENCV"}, loss_px=1.0)
    cost = lambda tried: np.log1p(linearized(tried, {}).residuals_px ** 2).sum()  # noqa: E731
    step = 1e-5
    for column, change in (
        (exact.columns["photos"], {"fx": FOCAL + step}),
        (exact.columns["photos"] + 1, {"fy": FOCAL + step}),
    ):
        camera = replace(model.cameras["photos"], **change)
        slope = (cost(replace(model, cameras={"photos": camera})) - cost(model)) / step
        assert slope == pytest.approx(-2 * exact.right[column], rel=1e-3, abs=1e-4)


def test_poses_of_a_motion_are_those_of_its_rings() -> None:
    motion = TurntableMotion((("a", "b"),), (np.eye(4),), {"a": 0.0, "b": np.pi / 2})
    assert motion.poses()["b"][:3, :3] @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0])
    assert motion.numbers == 7
