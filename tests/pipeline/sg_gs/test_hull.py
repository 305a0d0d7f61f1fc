"""Visual hulls of solids whose shape is known."""

import numpy as np
import pytest
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.pipeline.sg_gs.solid.visual_hull import Silhouette, _farthest, carve
from cgwm.schemas import Ground, InputDataError

HALF = np.array([0.05, 0.035, 0.03])
CENTER = np.array([0.02, -0.01, 0.06])
WIDTH, HEIGHT, FOCAL = 160, 120, 180.0


def camera(position):
    forward = (CENTER - position) / np.linalg.norm(CENTER - position)
    right = np.cross(forward, [0.1, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ position
    return T


def silhouettes(count, center=CENTER):
    """Exact masks of an ellipsoid: rays meet it where a quadratic has roots."""
    K = np.array([[FOCAL, 0, 80.3], [0, FOCAL, 59.6], [0, 0, 1]])
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    views = []
    for direction in fibonacci_directions(count):
        T = camera(CENTER + 0.25 * direction)
        rays = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones_like(u)], -1) @ T[:3, :3]
        start = (-T[:3, :3].T @ T[:3, 3] - center) / HALF
        scaled = rays / HALF
        b, a = scaled @ start, (scaled**2).sum(-1)
        views.append(Silhouette(b**2 - a * (start @ start - 1) > 0, K, T))
    return views


@pytest.fixture(scope="module")
def hull():
    return carve(silhouettes(28), None)


def test_the_surface_is_where_it_should_be(hull):
    on_surface = CENTER + fibonacci_directions(2000) * HALF
    distance = hull.at(on_surface)
    # A pixel is 1.4 mm wide at the body; with exact cameras the hull holds the body, and half a pixel at most.
    assert np.abs(distance).mean() < 0.7e-3
    assert distance.max() < 0.8e-3
    outward = (hull.surface - CENTER) / HALF**2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.median((hull.normals * outward).sum(1)) > 0.98


def test_mass_properties_of_the_hull(hull):
    properties = hull.mass_properties()
    squares = HALF**2
    assert properties.volume_m3 == pytest.approx(4 / 3 * np.pi * HALF.prod(), rel=0.06)
    np.testing.assert_allclose(properties.com_m, CENTER, atol=0.3e-3)
    np.testing.assert_allclose(np.diag(properties.inertia_m2), (squares.sum() - squares) / 5, rtol=0.06)


def test_the_ground_cuts_what_no_view_sees(hull):
    ground = Ground(offset_m=0.05)
    cut = carve(silhouettes(12), ground)
    assert cut.surface[:, 2].min() == pytest.approx(0.05, abs=1e-9)
    assert hull.surface[:, 2].min() < 0.035


def test_points_in_blocks_are_as_far_as_all_at_once():
    rng = np.random.default_rng(0)
    points, directions = rng.integers(-9, 10, (2500, 3)).astype(float), fibonacci_directions(50)
    np.testing.assert_array_equal(_farthest(points, directions), (points @ directions.T).argmax(0))


def test_masks_that_do_not_fit_are_refused():
    empty = [Silhouette(np.zeros((HEIGHT, WIDTH), bool), view.K, view.T_cam_world) for view in silhouettes(6)]
    with pytest.raises(InputDataError, match="body 'cup': its mask is not empty in 2 of 6 photos"):
        carve([*silhouettes(6)[:2], *empty[2:]], None, "cup")
    moved = silhouettes(6, CENTER + np.array([0.0, 0.0, 0.11]))
    with pytest.raises(InputDataError, match=r"no point lies inside the masks of all 1. photos"):
        carve([*silhouettes(6), *moved], None)
