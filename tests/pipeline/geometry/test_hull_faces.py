"""Faces of convex hulls: those of few points against scipy's."""

import numpy as np
import pytest
from cgwm.pipeline.geometry.hull_faces import FEW, hull_faces
from scipy.spatial import ConvexHull

CUBE = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


@pytest.mark.parametrize("count", [4, 5, 9, 24, 40])
def test_the_planes_and_the_area_are_those_of_scipy(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3))
    found, hull = hull_faces(points), ConvexHull(points)
    planes = np.array([(*face.normal, face.offset) for face in found])
    key = np.lexsort(planes.round(6).T), np.lexsort(hull.equations.round(6).T)
    assert np.allclose(planes[key[0]], hull.equations[key[1]], atol=1e-12)
    assert sum(face.area for face in found) == pytest.approx(hull.area, rel=1e-12)
    assert (count <= FEW) == (count != 40)


def test_a_face_has_its_corners_alone_and_each_plane_stands_once() -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    within = np.array([(0.0, 0.0, 1.0), (0.3, 0.2, 1.0), (1.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
    found = hull_faces(np.concatenate((CUBE, within)) @ turn.T)
    assert len(found) == 6
    assert all(face.area == pytest.approx(4) and face.offset == pytest.approx(-1) for face in found)
    top = next(face for face in found if face.normal @ turn[:, 2] > 0.999)
    assert set(top.corners) == {1, 3, 5, 7}


@pytest.mark.parametrize("points", [CUBE[:4, [0, 1, 1]], CUBE[:2], np.zeros((5, 3)), np.zeros((0, 3))])
def test_points_in_a_plane_have_no_faces(points: np.ndarray) -> None:
    assert hull_faces(points) == []
