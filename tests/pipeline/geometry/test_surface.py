"""Surfaces of unions of spheres and the distances between them; the photos of known meshes that measure them."""

import importlib
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.pipeline.geometry.mesh import mesh_volume
from cgwm.pipeline.geometry.surface_distance import Union, union_surface
from cgwm.pipeline.sg_gs.collision.collision_spheres import distil

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"


def test_a_balls_surface_and_the_distance_from_it():
    ball = Union.of(np.zeros((1, 3)), np.array([0.05]))
    np.testing.assert_allclose(np.linalg.norm(ball.surface, axis=1), 0.05)
    points = np.array([[0.0, 0, 0.08], [0, 0.02, 0]])
    np.testing.assert_allclose(ball.distance(points), [0.03, 0.03], atol=1e-12)


def test_concentric_balls_are_their_difference_apart():
    small, large = (Union.of(np.zeros((1, 3)), np.array([radius])) for radius in (0.04, 0.05))
    for gap in small.gaps(large):
        np.testing.assert_allclose([gap.mean_m, gap.percentile_95_m, gap.max_m], 0.01, atol=1e-9)


def test_what_lies_inside_another_sphere_is_no_surface():
    centers, radii = np.array([[-0.02, 0, 0], [0.02, 0, 0]]), np.array([0.03, 0.03])
    surface = union_surface(centers, radii, 1e-3)
    assert (np.linalg.norm(surface[:, None] - centers, axis=2) >= radii - 1e-9).all()
    # two caps of height r - d are missing: area 2 (4 pi r^2 - 2 pi r (r - d))
    area = 2 * (4 * np.pi * 0.03**2 - 2 * np.pi * 0.03 * 0.01)
    assert len(surface) == pytest.approx(area / 1e-6, rel=0.02)
    # seen from the middle, the waist is nearest, not the far side of either sphere
    waist = np.sqrt(0.03**2 - 0.02**2)
    assert Union.of(centers, radii).distance(np.zeros((1, 3)))[0] == pytest.approx(waist, rel=0.03)


@pytest.fixture(scope="module")
def photos():
    sys.path.insert(0, str(BENCHMARKS))  # as `python benchmarks/known_mesh.py` has it
    try:
        mesh_photos = importlib.import_module("mesh_photos")
    finally:
        sys.path.remove(str(BENCHMARKS))
    return mesh_photos


@pytest.mark.evidence
@pytest.mark.parametrize("seed", [0, 2])
def test_a_distilled_set_is_near_to_its_solid_on_average(photos, seed):
    mesh: Mesh = photos.built_in(seed).mesh
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    solid = mesh_volume(mesh)
    errors = []
    for count in (64, 200):
        spheres = distil(solid, count)
        assert len(spheres.radii) <= count
        union = Union.of(spheres.centers, spheres.radii)
        there = union.distance(solid.surface).mean()
        back = np.abs(solid.at(union.surface)).mean()
        errors.append(0.5 * (there + back) / size)
    assert errors[0] < 0.02
    assert errors[1] < 0.009
    assert errors[1] < 0.6 * errors[0]


def test_no_more_spheres_than_the_bound_wants():
    # three balls in a row, which a few spheres are
    centers = np.array([[-0.05, 0, 0], [0.0, 0, 0], [0.05, 0, 0]])
    points = np.concatenate([center + 0.03 * fibonacci_directions(3000) for center in centers])
    kept = (np.linalg.norm(points[:, None] - centers, axis=2) > 0.03 - 1e-9).all(1)

    class Balls:
        surface = points[kept]
        normals = np.repeat(fibonacci_directions(3000)[None], 3, 0).reshape(-1, 3)[kept]
        tolerance = 1e-6

        def at(self, where):
            return np.linalg.norm(where[:, None] - centers, axis=2).min(1) - 0.03

        def size(self):
            return float(np.linalg.norm(np.ptp(self.surface, axis=0)))

    spheres = distil(Balls(), 500, first=(centers, np.full(3, 0.03)))
    assert len(spheres.radii) == 3
    assert spheres.distance_m < 1e-6
    assert len(distil(Balls(), 500).radii) < 450


def test_photos_of_a_known_mesh_show_it_where_it_is(photos):
    painted = photos.built_in(0)  # convex: its outline is the convex hull of its corners
    cameras = photos.cameras_around(painted.mesh, 6, 80)
    for camera in cameras.values():
        image, mask, surface = photos.draw(painted, camera)
        pixel, corner_depth = camera.project(painted.mesh.vertices)
        assert pixel.min() > 0
        assert pixel.max() < 80
        hull = cv2.convexHull(pixel.astype(np.float32))
        rows, columns = np.mgrid[:80, :80]
        centres = np.stack([columns, rows], -1).reshape(-1, 2) + 0.5
        depth = np.array([cv2.pointPolygonTest(hull, tuple(map(float, centre)), True) for centre in centres])
        depth = depth.reshape(80, 80)
        assert (mask[depth > 0.6] == 1).all()
        assert (mask[depth < -0.6] == 0).all()
        assert (surface[depth < -1] == 0).all()
        on_it = surface[depth > 1]
        assert corner_depth.min() < on_it.min()
        assert on_it.max() < corner_depth.max()
        backdrop = np.round(255 * np.array(photos.BACKDROP))
        assert np.abs(image[depth < -1] - backdrop).max() <= 1
        assert np.abs(image[depth > 1] - backdrop).max(1).mean() > 20
