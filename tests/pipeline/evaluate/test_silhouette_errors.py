"""Silhouettes against masks: figures of shifted squares are known, and points of two cameras are found exactly."""

import math

import numpy as np
import pytest
from cgwm.datasets.capture.cameras import Camera
from cgwm.pipeline.evaluate.mask_centroids import LEAST_STD, Sighting, centroid_distance, triangulated
from cgwm.pipeline.evaluate.silhouette_errors import SilhouetteErrors, silhouette_errors

SIDE = 10


def square(column: int, row: int = 8, label: int = 1) -> np.ndarray:
    image = np.zeros((40, 60), np.uint8)
    image[max(row, 0) : row + SIDE, max(column, 0) : column + SIDE] = label
    return image


def errors(real: np.ndarray, predicted: np.ndarray, bodies: int = 1) -> SilhouetteErrors:
    return silhouette_errors(real[None], predicted[None], np.ones(real.shape, bool), bodies)


@pytest.mark.parametrize("shift", [0, 3, 25])
def test_a_shifted_square(shift: int) -> None:
    found = errors(square(20), square(20 + shift))
    common = max(SIDE - shift, 0)
    assert found.iou[0, 0] == pytest.approx(common / (2 * SIDE - common))
    assert found.centroid_px[0, 0] == pytest.approx(shift)
    assert found.real_centroids[0, 0] == pytest.approx([20 + SIDE / 2, 8 + SIDE / 2])
    assert 0 <= found.outline_px[0, 0] <= shift and (found.outline_px[0, 0] > 0) == (shift > 0)


def test_outlines_of_a_grown_square_are_apart_by_what_it_grew() -> None:
    grown = np.zeros((40, 60), np.uint8)
    grown[6 : 10 + SIDE, 18 : 22 + SIDE] = 1
    found = errors(square(20), grown)
    assert found.centroid_px[0, 0] == pytest.approx(0)
    assert 2.0 <= found.outline_px[0, 0] < 2.3  # corners are further away than sides


def test_what_is_not_in_sight_is_said() -> None:
    nothing = np.zeros((40, 60), np.uint8)
    neither, lost = errors(nothing, nothing), errors(square(20), nothing)
    assert np.isnan([neither.iou[0, 0], neither.centroid_px[0, 0], lost.centroid_px[0, 0]]).all()
    assert lost.iou[0, 0] == 0  # the prediction has left the picture
    cut = errors(square(-4), square(20))
    assert np.isnan(cut.real_centroids).all() and np.isfinite(cut.predicted_centroids).all()
    assert math.isfinite(cut.centroid_px[0, 0])


def test_bodies_are_told_apart() -> None:
    both = np.maximum(square(5), square(30, label=2))
    swapped = np.maximum(square(30), square(5, label=2))
    assert errors(both, both, 2).iou.tolist() == [[1.0, 1.0]]
    assert errors(both, swapped, 2).iou.tolist() == [[0.0, 0.0]]


def camera(angle: float) -> Camera:
    """Return a camera 1 m away that looks at the origin from a direction."""
    forward = -np.array([math.cos(angle), math.sin(angle), 0.5])
    forward /= np.linalg.norm(forward)
    right = np.array([-math.sin(angle), math.cos(angle), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = -forward
    K = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
    return Camera(width=320, height=240, K=K, distortion=np.zeros(0), T_world_cam=pose)


CAMERAS = camera(0.3), camera(1.7)


def seen(points: np.ndarray, view: Camera, noise: np.ndarray | float = 0.0) -> np.ndarray:
    return (view.project(points)[0] + noise)[:, None]


def sightings(real: np.ndarray, predicted: np.ndarray, noise: np.ndarray, views: int = 2) -> list[Sighting]:
    times = np.arange(len(real)) / 30.0
    return [
        Sighting(time_s=times, cameras=[v] * len(real), real=seen(real, v, noise[k]), predicted=seen(predicted, v))
        for k, v in enumerate(CAMERAS[:views])
    ]


def test_triangulated_points_are_exact() -> None:
    point = np.array([0.05, -0.02, 0.03])
    pixels = np.array([view.project(point[None])[0][0] for view in CAMERAS])
    assert triangulated(CAMERAS, pixels) == pytest.approx(point, abs=1e-12)


def test_the_distance_and_its_interval() -> None:
    rng = np.random.default_rng(1)
    real = 0.05 * rng.standard_normal((30, 3))
    shift = np.array([0.04, -0.02, 0.03])
    length = float(np.linalg.norm(shift))
    quiet = centroid_distance(sightings(real, real + shift, np.zeros((2, 30, 2))))
    assert quiet is not None and quiet.instants == 30
    assert quiet.mean_m == pytest.approx(length, abs=1e-12) == quiet.final_m
    width = quiet.interval_95_m[1] - quiet.interval_95_m[0]
    loud = centroid_distance(sightings(real, real + shift, 2.0 * rng.standard_normal((2, 30, 2))))
    assert loud is not None
    assert (loud.interval_95_m[1] - loud.mean_m) / (width / 2) == pytest.approx(2.0 / (LEAST_STD * 320), rel=0.4)
    assert loud.interval_95_m[0] <= length <= loud.interval_95_m[1]


def test_one_camera_tells_no_distance() -> None:
    real = np.zeros((3, 3))
    assert centroid_distance(sightings(real, real, np.zeros((2, 3, 2)), views=1)) is None
    gone = np.full((2, 3, 2), np.nan)
    assert centroid_distance(sightings(real, real, gone)) is None
