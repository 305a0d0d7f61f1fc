"""The self-check accepts right models and rejects models that are broken on purpose.

The thresholds are those of the conventions; nothing here was used to choose them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cgwm.pipeline.calibrate.consistency_check import check_model, consistent_inliers, sampson_error
from cgwm.pipeline.calibrate.reconstruction import SfmCamera, SfmModel, Similarity, VerifiedPair
from helpers.sfm_scene import look_at, make_scene, rotation_about
from numpy.typing import NDArray


@pytest.fixture(scope="module")
def scene() -> tuple[SfmModel, list[VerifiedPair]]:
    return make_scene(images=20, points=3000, noise_px=0.5, outliers=0.1, seed=0)


def _moved(model: SfmModel, change, names) -> SfmModel:
    """Return the model with some cameras changed: `change` maps (R_cam_world, centre) to a new such pair."""
    poses = dict(model.T_cam_world)
    for name in names:
        rotation, center = change(poses[name][:3, :3], model.center(name))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
        poses[name] = pose
    return replace(model, T_cam_world=poses)


def _half(model: SfmModel) -> list[str]:
    names = sorted(model.T_cam_world)
    return names[: len(names) // 2]


def test_right_model_passes(scene):
    model, pairs = scene
    check = check_model(model, pairs)
    assert check.passed
    assert len(check.strong) > 50
    assert check.images_without_strong_pair == ()
    assert check.worst is not None
    # A tenth of the matches is false on purpose; chance lets some of those agree.
    assert 0.85 < check.worst.consistent < 0.97


def test_verdict_does_not_depend_on_frame_and_unit(scene):
    model, pairs = scene
    turned = model.transformed(Similarity(37.0, rotation_about([1, 2, 3], 1.0), np.array([5.0, -80.0, 2.0])))
    for a, b in zip(check_model(model, pairs).pairs, check_model(turned, pairs).pairs, strict=True):
        assert (a.image_a, a.image_b, a.inliers) == (b.image_a, b.image_b, b.inliers)
        assert a.consistent == pytest.approx(b.consistent, abs=0.01)


def test_half_turned_by_ten_degrees_is_rejected(scene):
    model, pairs = scene
    turn = rotation_about([0, 0, 1], np.radians(10.0))
    broken = _moved(model, lambda R, c: (R @ turn.T, turn @ c), _half(model))
    assert not check_model(broken, pairs).passed


def test_half_shifted_is_rejected(scene):
    model, pairs = scene
    broken = _moved(model, lambda R, c: (R, c + np.array([0.0, 0.0, 0.3])), _half(model))
    assert not check_model(broken, pairs).passed


def test_half_scaled_is_rejected(scene):
    model, pairs = scene
    pivot = model.center(_half(model)[-1])
    broken = _moved(model, lambda R, c: (R, pivot + 1.6 * (c - pivot)), _half(model))
    assert not check_model(broken, pairs).passed


def test_folded_path_is_rejected(scene):
    """Half of the circle is laid over the other half, as where opposite sides look alike."""
    model, pairs = scene
    turn = rotation_about([0, 0, 1], np.pi)
    broken = _moved(model, lambda R, c: (R @ turn.T, turn @ c), _half(model))
    check = check_model(broken, pairs)
    assert not check.passed
    assert check.failed[0].consistent < 0.2


def test_mirrored_model_is_rejected(scene):
    """Mirrored centres with the rotations that go with them (R M R keeps it a rotation)."""
    model, pairs = scene
    mirror = np.diag([-1.0, 1.0, 1.0])
    broken = _moved(model, lambda R, c: (np.diag([-1.0, 1.0, 1.0]) @ R @ mirror, mirror @ c), list(model.T_cam_world))
    assert not check_model(broken, pairs).passed


def test_centres_turned_inside_out_are_rejected(scene):
    """The Sampson error cannot tell t from -t; the points behind the cameras can."""
    model, pairs = scene
    broken = _moved(model, lambda R, c: (R, -c), list(model.T_cam_world))
    check = check_model(broken, pairs)
    assert not check.passed


def test_path_bent_by_a_seventh_is_rejected(scene):
    """A low-frequency bend of 14 % of the path, all rotations right: the fault seen on real photos."""
    model, pairs = scene
    names = sorted(model.T_cam_world)
    span = np.ptp(model.centers(), axis=0).max()
    poses = model
    for index, name in enumerate(names[10:]):
        shift = np.array([0.0, 0.0, 0.14 * span * (1 + index % 2)])
        poses = _moved(poses, lambda R, c, shift=shift: (R, c + shift), [name])
    assert not check_model(poses, pairs).passed


def test_one_wrong_camera_is_found_and_named(scene):
    model, pairs = scene
    name = sorted(model.T_cam_world)[7]
    turn = rotation_about([0, 1, 0], np.radians(5.0))
    check = check_model(_moved(model, lambda R, c: (turn @ R, c), [name]), pairs)
    assert not check.passed
    assert all(name in (pair.image_a, pair.image_b) for pair in check.failed)


def test_weak_pairs_reject_nothing(scene):
    """False matches between look-alike sides stay below the 200 inliers that count."""
    model, pairs = scene
    rng = np.random.default_rng(3)
    false = VerifiedPair(
        pairs[0].image_a, pairs[0].image_b, rng.uniform(0, 480, (199, 2)), rng.uniform(0, 480, (199, 2))
    )
    check = check_model(model, [*pairs, false])
    assert check.passed
    strong = replace(false, xy_a=rng.uniform(0, 480, (200, 2)), xy_b=rng.uniform(0, 480, (200, 2)))
    assert not check_model(model, [*pairs, strong]).passed


def test_unregistered_images_are_passed_over(scene):
    model, pairs = scene
    poses = {name: pose for name, pose in model.T_cam_world.items() if not name.endswith("03.jpg")}
    check = check_model(replace(model, T_cam_world=poses), pairs)
    assert check.passed
    assert all("03.jpg" not in pair.image_a + pair.image_b for pair in check.pairs)


def test_sampson_error_is_the_distance_to_the_epipolar_line_for_sideways_motion():
    """Moving along x, epipolar lines are rows, and the first-order error is the row difference over sqrt 2."""
    rays_a, rays_b = np.array([[0.1, 0.20]]), np.array([[-0.1, 0.21]])
    error = sampson_error(rays_a, rays_b, np.eye(3), np.array([-1.0, 0.0, 0.0]))
    assert error == pytest.approx(0.01 / np.sqrt(2.0), rel=1e-12)


def test_no_baseline_compares_the_rotated_rays():
    rng = np.random.default_rng(0)
    a = rng.uniform(-0.3, 0.3, (100, 2))
    turn = rotation_about([0, 1, 0], 0.1)
    turned = np.column_stack([a, np.ones(100)]) @ turn.T
    b = turned[:, :2] / turned[:, 2:]
    assert consistent_inliers(a, b, turn, np.zeros(3), 500.0).all()
    assert not consistent_inliers(a, b + 0.02, turn, np.zeros(3), 500.0).any()


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), (0.08, -0.12, 0.002, -0.001), (-0.2, 0.2, 0.0, 0.0)])
def test_rays_undo_projection(distortion):
    camera = SfmCamera(width=640, height=480, fx=600.0, fy=610.0, cx=322.0, cy=238.0, distortion=distortion)
    rng = np.random.default_rng(1)
    points: NDArray[np.float64] = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.2], (200, 3))
    np.testing.assert_allclose(camera.rays(camera.project(points)), points[:, :2] / points[:, 2:], atol=1e-12)


def test_look_at_is_a_rotation():
    pose = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
