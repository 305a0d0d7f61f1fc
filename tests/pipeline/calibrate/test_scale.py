"""Metric scale and world frame: right on synthetic scenes, with intervals that cover the truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from cgwm.pipeline.calibrate.reconstruction import SfmModel, Similarity
from cgwm.pipeline.calibrate.triangulation import triangulate
from cgwm.pipeline.calibrate.world_frame.axes import dominant_plane, ground_frame, upright_frame
from cgwm.pipeline.calibrate.world_frame.markers import detect_markers, dictionary, marker_corners
from cgwm.pipeline.calibrate.world_frame.metric_scale import (
    from_camera_distance,
    from_known_distance,
    from_markers,
    umeyama,
)
from cgwm.schemas import InputDataError, KnownCameraDistance, KnownDistance, Marker, NotConvergedError, Pose
from helpers.sfm_scene import make_scene, rotation_about

TRUE = Similarity(0.37, rotation_about([1, -2, 0.5], 0.8), np.array([0.3, -0.2, 0.1]))
"""From the arbitrary frame of structure from motion to the world, in metres."""


@pytest.fixture(scope="module")
def world() -> SfmModel:
    """A scene in its true world, metres."""
    return make_scene(images=16, points=400, noise_px=0.5, outliers=0.0, seed=1)[0]


@pytest.fixture(scope="module")
def model(world) -> SfmModel:
    """The same scene in an arbitrary frame and unit."""
    inverse = Similarity(1.0 / TRUE.scale, TRUE.rotation.T, -(TRUE.rotation.T @ TRUE.translation) / TRUE.scale)
    return world.transformed(inverse)


def _project(world: SfmModel, points: np.ndarray, noise_px: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {
        name: world.camera(name).project(points @ pose[:3, :3].T + pose[:3, 3])
        + rng.normal(0.0, noise_px, (len(points), 2))
        for name, pose in world.T_cam_world.items()
    }


def _marker(identifier: int, x: float, y: float, angle: float, side: float = 0.07) -> Marker:
    quat = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
    return Marker(id=identifier, side_m=side, pose=Pose(position_m=(x, y, 0.0), quat_wxyz=quat))


def _corners(marker: Marker) -> np.ndarray:
    pose = marker.pose
    assert pose is not None
    angle = 2 * np.arctan2(pose.quat_wxyz[3], pose.quat_wxyz[0])
    return marker_corners(marker.side_m) @ rotation_about([0, 0, 1], angle).T + np.array(pose.position_m)


MARKERS = (_marker(0, 0.3, 0.3, 0.4), _marker(1, -0.3, 0.25, 2.0), _marker(2, 0.1, -0.3, -1.0))


def _sightings(world, markers, noise_px, seed=0):
    rng = np.random.default_rng(seed)
    return {marker.id: _project(world, _corners(marker), noise_px, rng) for marker in markers}


def test_similarity_maps_poses_with_points(world, model):
    back = model.transformed(TRUE)
    np.testing.assert_allclose(back.points, world.points, atol=1e-12)
    for name in world.T_cam_world:
        np.testing.assert_allclose(back.T_cam_world[name], world.T_cam_world[name], atol=1e-12)


def test_umeyama_recovers_a_similarity():
    points = np.random.default_rng(0).normal(size=(30, 3))
    found = umeyama(points, TRUE.points(points))
    assert found.scale == pytest.approx(TRUE.scale, rel=1e-12)
    np.testing.assert_allclose(found.rotation, TRUE.rotation, atol=1e-12)


def test_umeyama_never_mirrors():
    points = np.random.default_rng(0).normal(size=(30, 3))
    assert np.linalg.det(umeyama(points, points * [-1.0, 1.0, 1.0]).rotation) == pytest.approx(1.0)


def test_posed_markers_fix_scale_and_frame(world, model):
    frame = from_markers(model, MARKERS, _sightings(world, MARKERS, noise_px=0.0))
    assert frame.fixes_frame
    assert frame.similarity.scale == pytest.approx(TRUE.scale, rel=1e-9)
    np.testing.assert_allclose(frame.similarity.points(model.points), world.points, atol=1e-9)


def test_posed_markers_ignore_false_sightings(world, model):
    sightings = _sightings(world, MARKERS, noise_px=0.05)
    for name in list(sightings[0])[:4]:
        sightings[0][name] = sightings[0][name] + 60.0
    frame = from_markers(model, MARKERS, sightings)
    assert frame.similarity.scale == pytest.approx(TRUE.scale, rel=1e-3)
    assert frame.residual_m is not None
    assert frame.residual_m < 5e-4


@pytest.mark.parametrize("posed", [True, False])
def test_interval_of_the_marker_scale_covers_the_truth(world, model, posed):
    """Over 25 noise draws with the shared edge bias the figure allows for; 2 sigma in at least 85 %."""
    markers = MARKERS if posed else tuple(m.model_copy(update={"pose": None}) for m in MARKERS[:1])
    hits = []
    for seed in range(25):
        rng = np.random.default_rng(100 + seed)
        sightings = _sightings(world, MARKERS[: len(markers)], 0.1, seed)
        bias = rng.normal(0.0, 0.1)
        for marker in sightings.values():
            for name, xy in marker.items():
                outward = xy - xy.mean(axis=0)
                marker[name] = xy + bias * outward / np.linalg.norm(outward, axis=1, keepdims=True)
        frame = from_markers(model, markers, sightings)
        hits.append(abs(frame.similarity.scale / TRUE.scale - 1.0) < 2.0 * frame.relative_std)
        assert frame.relative_std < 0.01
    assert np.mean(hits) >= 0.85


def test_marker_without_pose_is_the_world(world, model):
    free = MARKERS[0].model_copy(update={"pose": None})
    frame = from_markers(model, [free], _sightings(world, MARKERS[:1], noise_px=0.0))
    T_marker_world = np.eye(4)
    angle = 0.4
    T_marker_world[:3, :3] = rotation_about([0, 0, 1], angle).T
    T_marker_world[:3, 3] = -T_marker_world[:3, :3] @ [0.3, 0.3, 0.0]
    expected = world.points @ T_marker_world[:3, :3].T + T_marker_world[:3, 3]
    np.testing.assert_allclose(frame.similarity.points(model.points), expected, atol=1e-8)
    assert "the world frame is that of marker 0" in frame.source


def test_markers_that_contradict_each_other_are_refused(world, model):
    wrong = (*MARKERS[:2], MARKERS[2].model_copy(update={"pose": Pose(position_m=(0.1, -0.1, 0.0))}))
    with pytest.raises(InputDataError, match=r"markers do not lie where their poses say: marker 0: \d+\.\d mm"):
        from_markers(model, wrong, _sightings(world, MARKERS, noise_px=0.0))


def test_missing_marker_tells_what_was_seen(world, model):
    absent = (_marker(7, 0.0, 0.0, 0.0),)
    with pytest.raises(NotConvergedError, match=r"Marker\(s\) 7 not found .* Seen \(id in photos\): 0 in 16"):
        from_markers(model, absent, _sightings(world, MARKERS[:1], noise_px=0.0))


def test_known_distance(world, model):
    rng = np.random.default_rng(5)
    ends = np.array([[0.2, 0.1, 0.0], [-0.2, 0.0, 0.3]])
    length = float(np.linalg.norm(ends[1] - ends[0]))
    pixels = _project(world, ends, 0.3, rng)
    names = sorted(pixels)[:5]
    known = KnownDistance(
        distance_m=length,
        a_px={name: tuple(pixels[name][0]) for name in names},
        b_px={name: tuple(pixels[name][1]) for name in names},
    )
    frame = from_known_distance(model, known)
    assert not frame.fixes_frame
    assert abs(frame.similarity.scale / TRUE.scale - 1.0) < 3.0 * frame.relative_std < 0.02


def test_marks_of_different_points_are_refused(world, model):
    names = sorted(world.T_cam_world)[:3]
    marks = {name: (100.0 * index, 50.0 + 90.0 * index) for index, name in enumerate(names)}
    with pytest.raises(InputDataError, match=r"known_distance.a_px: the marks do not meet in one point \(3 of 3"):
        from_known_distance(model, KnownDistance(distance_m=1.0, a_px=marks, b_px=marks))


def test_known_camera_distance(world, model):
    names = ("00.jpg", "05.jpg")
    length = float(np.linalg.norm(world.center(names[0]) - world.center(names[1])))
    frame = from_camera_distance(model, KnownCameraDistance(distance_m=length, images=names))
    assert frame.similarity.scale == pytest.approx(TRUE.scale, rel=1e-9)
    assert 0.0 < frame.relative_std < 0.01
    with pytest.raises(InputDataError, match=r"the photo '99\.jpg' is not registered"):
        from_camera_distance(model, KnownCameraDistance(distance_m=1.0, images=("00.jpg", "99.jpg")))


def test_triangulation_error_agrees_with_its_covariance(world):
    """Mahalanobis distance squared averages 3 over noise draws (3 coordinates)."""
    rng = np.random.default_rng(9)
    point = np.array([[0.1, -0.1, 0.2]])
    distances = []
    for _ in range(60):
        pixels = _project(world, point, 0.5, rng)
        found = triangulate(world, {name: tuple(xy[0]) for name, xy in pixels.items()}, noise_px=0.5)
        assert found is not None
        error = found.position - point[0]
        distances.append(error @ np.linalg.solve(found.covariance, error))
    assert 2.0 < np.mean(distances) < 4.0


def test_triangulation_needs_two_views(world):
    assert triangulate(world, {"00.jpg": (320.0, 240.0), "absent.jpg": (1.0, 1.0)}, 0.5) is None


def test_detected_corners_use_our_pixel_centres():
    """A marker drawn over whole pixels: its corners lie on pixel borders, which are whole numbers in our convention."""
    aruco = dictionary("4X4_50")
    side = 120
    image = np.full((300, 400), 255, np.uint8)
    image[90 : 90 + side, 150 : 150 + side] = cv2.aruco.generateImageMarker(aruco, 3, side)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    found = detect_markers(np.repeat(image[:, :, None], 3, axis=2), aruco)
    assert list(found) == [3]
    expected = [[150, 90], [150 + side, 90], [150 + side, 90 + side], [150, 90 + side]]
    np.testing.assert_allclose(found[3], expected, atol=0.15)


def test_unknown_dictionary_names_the_nearest():
    with pytest.raises(InputDataError, match="Did you mean '4X4_50'"):
        dictionary("4x4_50")


def test_ground_is_found_under_the_cameras(world):
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform(-1, 1, (300, 2)), rng.normal(0, 0.001, 300)])
    above = rng.uniform([-0.3, -0.3, 0.02], [0.3, 0.3, 0.5], (500, 3))
    plane = dominant_plane(np.concatenate([above, floor]), world.centers(), 1.5)
    assert plane is not None
    normal, offset = plane
    np.testing.assert_allclose(normal, [0, 0, 1], atol=0.005)
    assert offset == pytest.approx(0.0, abs=0.002)


def test_ground_frame_puts_the_plane_at_zero_and_the_cameras_above(world, model):
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.zeros(500)])
    points = np.concatenate([world.points, floor])
    seen = {name: (np.zeros((len(points), 2)), np.arange(len(points))) for name in world.T_cam_world}
    inverse = Similarity(1.0, TRUE.rotation.T, -TRUE.rotation.T @ TRUE.translation)
    hidden = replace(world, points=points, observations=seen).transformed(inverse)
    motion = ground_frame(hidden, np.array([0.0, 0.0, 1.0]))
    assert motion is not None
    assert motion.scale == 1.0
    # Points just above the floor belong to the slab and lift the plane by a fraction of its thickness.
    np.testing.assert_allclose(motion.points(hidden.points)[-500:, 2], 0.0, atol=1e-3)
    assert (hidden.transformed(motion).centers()[:, 2] > 0.4).all()


def test_no_ground_where_no_plane_is_below_everything(world):
    points = np.random.default_rng(0).normal(size=(1000, 3))
    assert dominant_plane(points, world.centers() * 10, 1.5) is None


@pytest.mark.parametrize("count", [4, 16])
def test_photos_are_upright_where_nothing_tells_the_world(world, model, count):
    """An arc of cameras that look down at the scene: the mean of their up directions leans, their rows do not."""
    up = np.array([0.0, 0.0, 1.0])
    arc = replace(model, T_cam_world=dict([*model.T_cam_world.items()][:count]))
    motion = upright_frame(arc, up, {})
    assert motion is not None and motion.scale == 1.0
    turned = arc.transformed(motion)
    rows = np.array([pose[0, :3] for pose in turned.T_cam_world.values()])
    np.testing.assert_allclose(rows @ up, 0.0, atol=1e-6)
    whole = TRUE.rotation @ motion.rotation.T  # from the new world to the true one: a turn about the vertical
    np.testing.assert_allclose(whole @ up, up, atol=1e-6)


def test_photos_at_all_angles_are_not_made_upright(world):
    rolled = {
        name: np.block(
            [[rotation_about([0, 0, 1], np.pi * (k % 2)) @ pose[:3, :3], pose[:3, 3:]], [np.zeros((1, 3)), 1]]
        )
        for k, (name, pose) in enumerate(world.T_cam_world.items())
    }
    assert upright_frame(replace(world, T_cam_world=rolled), np.array([0.0, 0.0, 1.0]), {}) is None


def test_portrait_photos_are_upright_as_viewers_show_them(model):
    """The files of a phone that is held upright lie on their side, which their EXIF data say."""
    up, on_side = np.array([0.0, 0.0, 1.0]), np.eye(4)
    on_side[:3, :3] = rotation_about([0, 0, 1], -np.pi / 2)  # the file's columns run down
    lying = replace(model, T_cam_world={name: on_side @ pose for name, pose in model.T_cam_world.items()})
    as_shown = upright_frame(lying, up, dict.fromkeys(lying.T_cam_world, ((0.0, -1.0), (1.0, 0.0))))
    expected = upright_frame(model, up, {})
    assert as_shown is not None and expected is not None
    np.testing.assert_allclose(as_shown.rotation, expected.rotation, atol=1e-9)
