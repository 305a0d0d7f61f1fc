"""The stated uncertainty of poses: the scatter of noisy adjustments, in any unit, larger where less ties."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from cgwm.pipeline.calibrate import attempts, pose_posterior
from cgwm.pipeline.calibrate.camera_models import LADDER
from cgwm.pipeline.calibrate.center_uncertainty import center_stds, pose_stds
from cgwm.pipeline.calibrate.colmap.mapping import Mapped, adjusted, without_outliers
from cgwm.pipeline.calibrate.observation_noise import moved_by_dropping, noise_by_image
from cgwm.pipeline.calibrate.pose_posterior import posterior, principal_points
from cgwm.pipeline.calibrate.reconstruction import SfmModel, Similarity
from cgwm.pipeline.calibrate.world_frame.metric_scale import umeyama
from helpers.sfm_scene import look_at, make_scene, rotation_about
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

NOISE_PX = 0.5
MODELS = {"photos": "RADIAL"}


def _scene(images: int = 6, points: int = 40) -> SfmModel:
    return make_scene(images=images, points=points, noise_px=0.0, outliers=0.0, seed=0)[0]


def _noisy(model: SfmModel, seed: int, noise_px: float = NOISE_PX) -> SfmModel:
    rng = np.random.default_rng(seed)
    seen = {name: (xy + rng.normal(0, noise_px, xy.shape), index) for name, (xy, index) in model.observations.items()}
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
    monkeypatch.setattr(pose_posterior, "SHARED_VARIANCE", 1.0)
    monkeypatch.setattr(pose_posterior, "HIDDEN_VARIANCE", 1.0)
    monkeypatch.setattr(pose_posterior, "PRINCIPAL_STD", 1e-6)  # the scene's is in the middle
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
        stated_turns.append(list(pose_stds(fitted, MODELS)[1].values()))
    scatter = np.sqrt((np.array(off) ** 2).sum(2).mean(0)) / extent
    # 40 draws: the standard error of a root mean square of three directions is about 7 %
    assert np.median(stated, 0) == pytest.approx(scatter, rel=0.3)
    assert np.sqrt((np.median(stated, 0) ** 2).mean()) == pytest.approx(np.sqrt((scatter**2).mean()), rel=0.1)
    scatter = np.sqrt((np.array(turned) ** 2).sum(2).mean(0))
    assert np.median(stated_turns, 0) == pytest.approx(scatter, rel=0.3)


def _with_middle(model: SfmModel, column: float, row: float) -> SfmModel:
    """Return a model whose photos are what a camera with another principal point takes, or one that assumes it."""
    return replace(model, cameras={"photos": replace(model.cameras["photos"], cx=column, cy=row)})


def _seen_by(model: SfmModel) -> SfmModel:
    seen = {}
    for name, (_, index) in model.observations.items():
        pose = model.T_cam_world[name]
        seen[name] = (model.camera(name).project(model.points[index] @ pose[:3, :3].T + pose[:3, 3]), index)
    return replace(model, observations=seen)


def test_a_principal_point_off_the_middle_is_found_as_far_as_the_observations_tell_it() -> None:
    true = _noisy(_seen_by(_with_middle(_scene(points=300), 324.0, 240.0)), 0)
    # an adjustment that takes it to be in the middle turns the cameras instead
    turn = np.eye(4)
    turn[:3, :3] = rotation_about([0, 1, 0], 4.0 / 600.0)
    turned = {name: turn @ pose for name, pose in true.T_cam_world.items()}
    found = principal_points(replace(_with_middle(true, 320.0, 240.0), T_cam_world=turned), MODELS)["photos"]
    at = posterior(true, MODELS).principal_columns["photos"]
    stds = np.sqrt(posterior(true, MODELS).variances[at : at + 2])
    assert stds[0] < 1.2 and stds[1] > 2.0  # all cameras look down on one ring: its tilt takes the place of the row
    assert 322.5 < found[0] == pytest.approx(324.0, abs=2 * stds[0]) and found[1] == pytest.approx(240.0, abs=stds[1])
    assert principal_points(_scene(points=300), MODELS) == {}  # in the middle already


def test_a_photo_of_its_own_camera_does_not_tell_its_principal_point() -> None:
    model = _noisy(_scene(points=300), 0, noise_px=0.1)
    own = {**model.image_camera, "03.jpg": "other"}
    two = replace(model, image_camera=own, cameras={**model.cameras, "other": model.cameras["photos"]})
    models = {**MODELS, "other": "SIMPLE_PINHOLE"}
    found = posterior(two, models)
    prior = pose_posterior.PRINCIPAL_STD * 800.0
    stds = {name: np.sqrt(found.variances[at : at + 2]) for name, at in found.principal_columns.items()}
    assert stds["other"][0] > 2 * stds["photos"][0] and (stds["other"] < prior).all()
    turns = pose_stds(two, models)[1]
    assert turns["03.jpg"] == max(turns.values())
    assert np.degrees(turns["03.jpg"]) > np.degrees(stds["other"].min() / 600.0) * 0.5


def test_a_photo_alone_with_its_camera_asks_for_no_finer_places() -> None:
    model = _noisy(_scene(images=12, points=300), 0)
    own = {**model.image_camera, "03.jpg": "other"}
    two = replace(model, image_camera=own, cameras={**model.cameras, "other": model.cameras["photos"]})
    inputs = SimpleNamespace(known={}, richest={"photos": "RADIAL", "other": "SIMPLE_PINHOLE"})
    stds = center_stds(two, {**MODELS, "other": "SIMPLE_PINHOLE"})
    assert stds["03.jpg"] > attempts._ALIGN_ABOVE > max(std for image, std in stds.items() if image != "03.jpg")
    uncertain = [
        attempts._uncertain(SimpleNamespace(model=lambda m=m: m), "RADIAL", inputs)
        for m in (two, _noisy(model, 1, noise_px=2.0))
    ]
    assert uncertain == [False, True]


def test_is_proportional_to_the_noise_and_free_of_place_and_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_posterior, "PRINCIPAL_STD", 1e-6)
    model = _noisy(_scene(points=300), 0)
    stds = np.array(list(center_stds(model, MODELS).values()))
    quarter = rotation_about([1, 0, 0], np.pi / 2)  # the box around the centres stays as large
    turned = model.transformed(Similarity(37.0, quarter, np.array([5.0, -80.0, 2.0])))
    assert list(center_stds(turned, MODELS).values()) == pytest.approx(stds, rel=1e-6)
    exact = _scene(points=300)
    twice = {n: (2 * xy - exact.observations[n][0], index) for n, (xy, index) in model.observations.items()}
    assert list(center_stds(replace(model, observations=twice), MODELS).values()) == pytest.approx(2 * stds, rel=1e-6)


def test_a_photo_that_few_matches_tie_is_the_least_certain() -> None:
    model = _noisy(_scene(points=300), 1)
    name = "03.jpg"
    pixels, index = model.observations[name]
    stds = center_stds(replace(model, observations={**model.observations, name: (pixels[:8], index[:8])}), MODELS)
    assert max(stds, key=lambda image: stds[image]) == name
    assert stds[name] > 3 * center_stds(model, MODELS)[name]


def _two_sides(ties: int) -> SfmModel:
    """Return a model of twelve photos, of which each half sees half of the points, the two middle ones `ties` more."""
    model = _noisy(_scene(images=12, points=300), 3, noise_px=0.1)
    seen = {}
    for k, (name, (pixels, index)) in enumerate(model.observations.items()):
        own = ((index < ties) & (k in (5, 6))) | ((index % 2 == 0) == (k < 6))
        seen[name] = (pixels[own], index[own])
    return replace(model, observations=seen)


def test_two_sides_that_few_points_tie_are_less_certain_than_these_say() -> None:
    ratio = {}
    for ties in (6, 300):
        model = _two_sides(ties)
        ratio[ties] = max(pose_stds(model, MODELS)[0].values()) / max(center_stds(model, MODELS).values())
    assert ratio[6] > 3.0 and 1.0 <= ratio[300] < 1.3, ratio


def _few_in_one_photo() -> tuple[SfmModel, SfmModel]:
    """Return a model, and one of whose photos sees twenty points that the others see from all sides."""
    model = _noisy(_scene(points=300), 1)
    pixels, index = model.observations["03.jpg"]
    return model, replace(model, observations={**model.observations, "03.jpg": (pixels[:20], index[:20])})


def test_a_photo_with_few_matches_keeps_all_whose_points_other_photos_tell() -> None:
    _, few = _few_in_one_photo()
    doubted = pose_posterior.without_most_telling(few, MODELS, (), None)
    assert len(doubted.observations["03.jpg"][1]) == 20
    assert max(pose_stds(few, MODELS)[0].values()) < 1.1 * max(center_stds(few, MODELS).values())


def test_a_photo_with_few_matches_keeps_most_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_posterior, "TOLD_ELSEWHERE_DEG", 180.0)  # no point is
    model, few = _few_in_one_photo()
    doubted = pose_posterior.without_most_telling(few, MODELS, (), None)
    left = {name: len(seen) for name, (_, seen) in doubted.observations.items()}
    assert 15 <= left["03.jpg"] < 20 and len(doubted.points) == len(doubted.colors) < 300
    assert sum(len(seen) for _, seen in few.observations.values()) - sum(left.values()) <= 0.005 * 1520
    for name, (pixels, index) in doubted.observations.items():
        drawn = model.camera(name).project(
            doubted.points[index] @ model.T_cam_world[name][:3, :3].T + model.T_cam_world[name][:3, 3]
        )
        assert np.abs(drawn - pixels).max() < 6 * NOISE_PX  # each observation is still of its own point


def test_what_dropping_moved_is_a_draw_of_the_errors() -> None:
    before = _noisy(_scene(points=300), 0)
    names, after = list(before.T_cam_world), before.transformed(Similarity(2.0, np.eye(3), np.ones(3)))
    assert max(map(max, moved_by_dropping(before, after).values())) < 1e-6
    turn = np.eye(4)
    turn[:3, :3] = rotation_about([0, 1, 0], 0.01)
    turned = replace(before, T_cam_world={**before.T_cam_world, names[3]: turn @ before.T_cam_world[names[3]]})
    moved = moved_by_dropping(before, turned)
    assert moved[names[3]][1] == pytest.approx(0.01, rel=0.1) and moved[names[0]][1] < 0.005
    without, with_moves = (pose_stds(before, MODELS, moved=moves) for moves in (None, {names[3]: (0.3, 0.01)}))
    assert with_moves[0][names[3]] == pytest.approx(np.hypot(without[0][names[3]], 0.3))
    assert with_moves[1][names[3]] == pytest.approx(np.hypot(without[1][names[3]], 0.01))
    assert with_moves[0][names[0]] == without[0][names[0]]


def test_no_distortion_is_as_uncertain_as_a_distortion_of_zero() -> None:
    model = _noisy(_scene(points=300), 2)
    none, some = (np.array(list(center_stds(model, {"photos": name}).values())) for name in LADDER[:2])
    assert none == pytest.approx(some, rel=0.02)


def test_known_intrinsics_make_centres_more_certain() -> None:
    model = _noisy(_scene(points=300), 2)
    free, known = center_stds(model, MODELS), center_stds(model, {})
    assert all(known[image] < free[image] for image in free)


def test_cameras_that_nothing_determines_are_infinitely_uncertain() -> None:
    model = _scene(points=3)
    assert all(std == np.inf or std > 1.0 for std in center_stds(model, {"photos": "OPENCV"}).values())


def test_noise_by_image_is_that_of_each_image_and_doubles_the_stated_errors() -> None:
    model = _scene(images=8, points=200)
    rng, levels = np.random.default_rng(0), [0.2, 0.2, 0.6, 0.2, 0.4, 0.2, 0.2, 0.1]
    noise = dict(zip(model.T_cam_world, levels, strict=True))
    seen = {name: (xy + rng.normal(0, noise[name], xy.shape), at) for name, (xy, at) in model.observations.items()}
    found = noise_by_image(replace(model, observations=seen))  # of a model that no fit has bent to its observations
    free = 1.0 - (6 + 3 * 200 / 8) / 400
    assert np.array(list(found.values())) * np.sqrt(free) == pytest.approx(levels, rel=0.12)
    once = pose_stds(model, {}, noise_px={name: 0.5 for name in model.T_cam_world})
    twice = pose_stds(model, {}, noise_px={name: 1.0 for name in model.T_cam_world})
    for small, large in zip(once, twice, strict=True):
        assert list(large.values()) == pytest.approx(2 * np.array(list(small.values())), rel=1e-6)
    one = next(iter(model.T_cam_world))
    more = pose_stds(model, {}, noise_px={name: 1.5 if name == one else 0.5 for name in model.T_cam_world})[0]
    assert more[one] > 2 * once[0][one] and max(more[name] / once[0][name] for name in more if name != one) < 1.5


@pytest.mark.evidence  # 24 adjustments of ten photos; that the noise is each image's is a law above
def test_a_photo_with_few_observations_is_as_uncertain_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of its fourteen observations half agree with a wrong pose by chance, and the others were dropped as wrong."""
    monkeypatch.setattr(pose_posterior, "SHARED_VARIANCE", 1.0)
    monkeypatch.setattr(pose_posterior, "HIDDEN_VARIANCE", 1.0)
    lens, off = {"photos": "SIMPLE_PINHOLE"}, []
    for seed in range(12):
        start, centers = _long_tails(seed)
        kept = without_outliers(adjusted(start, lens, {}, 0), {}, 0)
        model = kept.model()
        similarity = umeyama(model.centers(), centers)
        error = np.linalg.norm(similarity.points(model.centers())[0] - centers[0]) / np.linalg.norm(np.ptp(centers, 0))
        stated = (pose_stds(model, lens, noise_px=noise)[0]["00.jpg"] for noise in (None, kept.noise_px))
        off.append([error / std for std in stated])
    left, before = np.sqrt(np.square(off).mean(0))
    assert left > 2.0 and 0.6 < before < 1.5  # 12 draws: the standard error of a root mean square is about 15 %


def _long_tails(seed: int) -> tuple[Mapped, np.ndarray]:
    """Return cameras with true poses, of which the first sees few points, and centres; features have two noises."""
    rng, count, points = np.random.default_rng(seed), 8, 150
    model, cloud = pycolmap.Reconstruction(), rng.uniform(-0.6, 0.6, (points, 3))
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[600.0, 320.0, 240.0], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    tracks, centers = [pycolmap.Track() for _ in cloud], []
    for k in range(count):
        angle = 2 * np.pi * k / count
        centers.append(1.6 * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.2, 0.6)]))
        pose = look_at(centers[-1], rng.normal(0, 0.1, 3))
        local = cloud @ pose[:3, :3].T + pose[:3, 3]
        noise = np.where(rng.random(points) < (0.4 if k else 0.6), 0.6, 0.08)
        pixels = 600.0 * local[:, :2] / local[:, 2:] + [320.0, 240.0] + rng.normal(size=(points, 2)) * noise[:, None]
        seen = rng.permutation(points)[: points if k else 14]
        places = pycolmap.Point2DList([pycolmap.Point2D(pixels[index]) for index in seen])
        image = pycolmap.Image(name=f"{k:02d}.jpg", camera_id=1, image_id=k + 1, points2D=places)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        for place, index in enumerate(seen):
            tracks[index].add_element(k + 1, place)
    for position, track in zip(cloud, tracks, strict=True):
        model.add_point3D(position, track, np.zeros(3, np.uint8))
    return Mapped(reconstruction=model, names={1: "photos"}), np.array(centers)
