"""The stated uncertainty of optical centres: the scatter of noisy adjustments, in any unit, larger where less ties."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cgwm.pipeline.calibrate import center_uncertainty
from cgwm.pipeline.calibrate.center_uncertainty import center_stds, rotation_stds
from cgwm.pipeline.calibrate.metric_scale import umeyama
from cgwm.pipeline.calibrate.reconstruction import SfmModel, Similarity
from helpers.sfm_scene import make_scene, rotation_about
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

NOISE_PX = 0.5
MODELS = {"photos": "RADIAL"}


def _scene(images: int = 6, points: int = 40) -> SfmModel:
    return make_scene(images=images, points=points, noise_px=0.0, outliers=0.0, seed=0)[0]


def _noisy(model: SfmModel, seed: int) -> SfmModel:
    rng = np.random.default_rng(seed)
    seen = {name: (xy + rng.normal(0, NOISE_PX, xy.shape), index) for name, (xy, index) in model.observations.items()}
    return replace(model, observations=seen)


def _adjusted(model: SfmModel) -> SfmModel:
    """Return the least-squares bundle adjustment of poses, points, one focal length, k1 and k2, by scipy."""
    names, camera = list(model.T_cam_world), model.cameras["photos"]
    poses = np.array([model.T_cam_world[name] for name in names])

    def moved(values: np.ndarray) -> SfmModel:
        turns = Rotation.from_rotvec(values[: 3 * len(names)].reshape(-1, 3)).as_matrix()
        shifts = values[3 * len(names) : 6 * len(names)].reshape(-1, 3)
        new = poses.copy()
        new[:, :3, :3] = turns @ poses[:, :3, :3]
        new[:, :3, 3] += shifts
        focal, k1, k2 = values[-3:]
        lens = replace(camera, fx=focal, fy=focal, distortion=(k1, k2, 0.0, 0.0))
        cloud = values[6 * len(names) : -3].reshape(-1, 3)
        return replace(model, cameras={"photos": lens}, T_cam_world=dict(zip(names, new, strict=True)), points=cloud)

    def residuals(values: np.ndarray) -> np.ndarray:
        now, parts = moved(values), []
        for name in names:
            local = now.points @ now.T_cam_world[name][:3, :3].T + now.T_cam_world[name][:3, 3]
            parts.append(now.cameras["photos"].project(local) - model.observations[name][0])
        return np.concatenate(parts).ravel()

    start = np.r_[np.zeros(6 * len(names)), model.points.ravel(), camera.fx, camera.distortion[:2]]
    return moved(least_squares(residuals, start, method="trf", x_scale="jac", max_nfev=8).x)


@pytest.mark.evidence  # 40 bundle adjustments by finite differences
def test_equals_the_scatter_of_adjustments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(center_uncertainty, "SHARED_ERROR_PX", 0.0)
    monkeypatch.setattr(center_uncertainty, "PRINCIPAL_STD", 0.0)  # the scene's is in the middle
    model = _scene()
    true, extent = model.centers(), np.linalg.norm(np.ptp(model.centers(), axis=0))
    off, stated, turned, stated_turns = [], [], [], []
    for seed in range(40):
        fitted = _adjusted(_noisy(model, seed))
        similarity = umeyama(fitted.centers(), true)
        off.append(similarity.points(fitted.centers()) - true)
        stated.append(list(center_stds(fitted, MODELS).values()))
        turns = [
            similarity.pose(pose)[:3, :3] @ model.T_cam_world[name][:3, :3].T
            for name, pose in fitted.T_cam_world.items()
        ]
        turned.append(Rotation.from_matrix(np.array(turns)).as_rotvec())
        stated_turns.append(list(rotation_stds(fitted, MODELS).values()))
    scatter = np.sqrt((np.array(off) ** 2).sum(2).mean(0)) / extent
    # 40 draws: the standard error of a root mean square of three directions is about 7 %
    assert np.median(stated, 0) == pytest.approx(scatter, rel=0.3)
    assert np.sqrt((np.median(stated, 0) ** 2).mean()) == pytest.approx(np.sqrt((scatter**2).mean()), rel=0.1)
    scatter = np.sqrt((np.array(turned) ** 2).sum(2).mean(0))
    assert np.median(stated_turns, 0) == pytest.approx(scatter, rel=0.3)


def test_a_principal_point_off_the_middle_is_a_rotation(monkeypatch: pytest.MonkeyPatch) -> None:
    model = _scene(points=300)
    stds, known = (np.array(list(rotation_stds(model, models).values())) for models in (MODELS, {}))
    monkeypatch.setattr(center_uncertainty, "PRINCIPAL_STD", 0.0)
    without, same = (np.array(list(rotation_stds(model, models).values())) for models in (MODELS, {}))
    camera = model.cameras["photos"]
    angle = np.sqrt(2) * 0.003 * np.hypot(camera.width, camera.height) / camera.focal_px
    assert stds**2 - without**2 == pytest.approx(angle**2) and list(known) == list(same)


def test_is_proportional_to_the_noise_and_free_of_place_and_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(center_uncertainty, "SHARED_ERROR_PX", 0.0)
    model = _noisy(_scene(points=300), 0)
    stds = np.array(list(center_stds(model, MODELS).values()))
    quarter = rotation_about([1, 0, 0], np.pi / 2)  # the box around the centres stays as large
    turned = model.transformed(Similarity(37.0, quarter, np.array([5.0, -80.0, 2.0])))
    assert list(center_stds(turned, MODELS).values()) == pytest.approx(stds, rel=1e-6)
    exact = _scene(points=300)
    twice = {n: (2 * xy - exact.observations[n][0], index) for n, (xy, index) in model.observations.items()}
    assert list(center_stds(replace(model, observations=twice), MODELS).values()) == pytest.approx(2 * stds, rel=1e-6)


def test_shared_errors_do_not_average_out() -> None:
    few, many = (np.median(list(center_stds(_scene(points=count), MODELS).values())) for count in (200, 2000))
    assert many > 0.5 * few


def test_a_photo_that_few_matches_tie_is_the_least_certain() -> None:
    model = _noisy(_scene(points=300), 1)
    name = "03.jpg"
    pixels, index = model.observations[name]
    stds = center_stds(replace(model, observations={**model.observations, name: (pixels[:8], index[:8])}), MODELS)
    assert max(stds, key=lambda image: stds[image]) == name
    assert stds[name] > 3 * center_stds(model, MODELS)[name]


def test_known_intrinsics_make_centres_more_certain() -> None:
    model = _noisy(_scene(points=300), 2)
    free, known = center_stds(model, MODELS), center_stds(model, {})
    assert all(known[image] < free[image] for image in free)


def test_cameras_that_nothing_determines_are_infinitely_uncertain() -> None:
    model = _scene(points=3)
    assert all(std == np.inf or std > 1.0 for std in center_stds(model, {"photos": "OPENCV"}).values())
