"""Colliding spheres against the solids that they stand for, by support functions and distances."""

from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.datasets.synthetic.objects import make_object, write_obj
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.pipeline.geometry.mesh import mesh_mass_properties, mesh_volume, read_mesh
from cgwm.pipeline.geometry.primitives import spheres_volume
from cgwm.pipeline.sg_gs.collision.collision_spheres import (
    distil,
    fills_hull,
    shape_to_spheres,
    support_of_spheres,
    union_distance,
)
from cgwm.schemas import InputDataError, Shape
from scipy.spatial import ConvexHull

HALF = np.array([0.05, 0.03, 0.02])
DIRECTIONS = fibonacci_directions(400)


def ball_mesh(count=24):
    theta, phi = np.linspace(0, np.pi, count + 1)[1:-1], np.arange(2 * count) * np.pi / count
    rings = [[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t in theta for p in phi]
    vertices = np.array([[0, 0, 1], *rings, [0, 0, -1]])
    around, last = 2 * count, len(vertices) - 1
    faces = []
    for j in range(around):
        k = (j + 1) % around
        faces += [[0, 1 + j, 1 + k], [last, last - around + k, last - around + j]]
        for i in range(count - 2):
            a, b = 1 + i * around + j, 1 + i * around + k
            faces += [[a, a + around, b], [b, a + around, b + around]]
    return Mesh(vertices, np.array(faces))


@pytest.fixture(scope="module")
def ellipsoid():
    ball = ball_mesh()
    return Mesh(ball.vertices * HALF, ball.faces)


@pytest.fixture(scope="module")
def ellipsoid_volume(ellipsoid):
    return mesh_volume(ellipsoid)


@pytest.mark.parametrize("count", [8, 64, 256])
def test_a_box_has_its_corners(count):
    splats, distance = shape_to_spheres(Shape.model_validate({"box": {"half_extents_m": HALF}}), Path(), count)
    assert len(splats) <= count
    support = support_of_spheres(splats.means, 2 * splats.scales, np.concatenate([np.eye(3), -np.eye(3), DIRECTIONS]))
    true = np.abs(np.concatenate([np.eye(3), -np.eye(3), DIRECTIONS])) @ HALF
    np.testing.assert_allclose(support[:6], true[:6], atol=1e-12)
    # A sphere of 1 mm rounds a corner off by (sqrt(3) - 1) mm in its direction, and nothing sticks out.
    assert (support - true).min() > -0.74e-3
    assert (support - true).max() < 1e-9
    assert distance < {8: 0.06, 64: 0.01, 256: 0.004}[count]


def test_a_ball_is_one_sphere():
    splats, distance = shape_to_spheres(Shape.model_validate({"sphere": {"radius_m": 0.035}}), Path(), 100, 3.0)
    assert distance == 0
    np.testing.assert_allclose(splats.scales, [0.035 / 3.0])


def test_an_ellipsoid_is_supported_and_covered_within_a_millimetre(ellipsoid_volume):
    spheres = distil(ellipsoid_volume, 200)
    true = np.linalg.norm(DIRECTIONS * HALF, axis=1)
    assert np.abs(support_of_spheres(spheres.centers, spheres.radii, DIRECTIONS) - true).max() < 0.5e-3
    on_surface = fibonacci_directions(3000) * HALF
    assert np.abs(union_distance(spheres.centers, spheres.radii, on_surface)).max() < 1.2e-3
    assert spheres.distance_m < 1.2e-3
    inside = 0.9 * fibonacci_directions(300) * HALF * np.random.default_rng(0).random((300, 1)) ** (1 / 3)
    assert union_distance(spheres.centers, spheres.radii, inside).max() < 0


def test_volume_and_inertia_of_an_ellipsoid(ellipsoid, ellipsoid_volume):
    squares = HALF**2
    inertia = np.diag((squares.sum() - squares) / 5)
    for properties, tolerance in ((mesh_mass_properties(ellipsoid), 0.01), (ellipsoid_volume.mass_properties(), 0.012)):
        assert properties.volume_m3 == pytest.approx(4 / 3 * np.pi * HALF.prod(), rel=tolerance)
        np.testing.assert_allclose(properties.com_m, 0, atol=2e-5)
        np.testing.assert_allclose(properties.inertia_m2, inertia, atol=tolerance * inertia.max())


def test_inertia_of_a_mesh_does_not_depend_on_the_origin(ellipsoid):
    offset = np.array([0.3, -0.2, 0.1])
    here, there = (
        mesh_mass_properties(ellipsoid),
        mesh_mass_properties(Mesh(ellipsoid.vertices + offset, ellipsoid.faces)),
    )
    np.testing.assert_allclose(there.com_m, here.com_m + offset, atol=1e-12)
    np.testing.assert_allclose(there.inertia_m2, here.inertia_m2, atol=1e-10)


def test_a_non_convex_solid_keeps_its_waist():
    centers, radii = np.array([[-0.03, 0, 0], [0.03, 0, 0]]), np.array([0.035, 0.035])
    spheres = distil(spheres_volume(centers, radii), 120)
    waist = np.array([[0, 0.03, 0], [0, 0, -0.03]])
    assert union_distance(spheres.centers, spheres.radii, waist).min() > 0.005
    true = support_of_spheres(centers, radii, DIRECTIONS)
    assert np.abs(support_of_spheres(spheres.centers, spheres.radii, DIRECTIONS) - true).max() < 0.4e-3


def test_meshes_from_files(tmp_path, ellipsoid):
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in ellipsoid.vertices)
    faces = [f"f {a + 1}/1 {b + 1}/1 {c + 1}/1\n" for a, b, c in ellipsoid.faces]
    (tmp_path / "ball.obj").write_text(vertices + "".join(faces))
    mesh = read_mesh(tmp_path / "ball.obj")
    np.testing.assert_array_equal(mesh.faces, ellipsoid.faces)
    record = np.zeros(len(faces), [("n", "<f4", 3), ("corners", "<f4", (3, 3)), ("a", "<u2")])
    record["corners"] = ellipsoid.corners()[:, ::-1]
    header = b"binary".ljust(80) + len(faces).to_bytes(4, "little")
    (tmp_path / "ball.stl").write_bytes(header + record.tobytes())
    flipped = read_mesh(tmp_path / "ball.stl")
    assert mesh_mass_properties(flipped).volume_m3 == pytest.approx(mesh_mass_properties(mesh).volume_m3, rel=1e-5)
    splats, _ = shape_to_spheres(Shape.model_validate({"mesh": {"path": "ball.obj"}}), tmp_path, 60)
    assert len(splats) <= 60


def test_a_flat_face_of_a_mesh_stands_on_its_corners_and_edges(tmp_path):
    """What protrudes in the middle of a face makes a dome of it, on which the body rolls."""
    prism = make_object(6)
    write_obj(tmp_path / "prism.obj", prism)
    splats, _ = shape_to_spheres(Shape.model_validate({"mesh": {"path": "prism.obj"}}), tmp_path, 100)
    faces = np.unique(ConvexHull(prism.parts[0]).equations.round(9), axis=0)
    above = splats.means @ faces[:, :3].T + 2 * splats.scales[:, None] + faces[:, 3]
    large = 2 * splats.scales > 0.001
    assert large.sum() > 50 and above[large].max() < 1e-6
    assert 0 <= above.max() < 1e-3


def test_a_mesh_in_which_spheres_fit_at_the_corners_alone_is_refused(tmp_path):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.05, 0.05, 0.0005]
    faces = ["1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
    (tmp_path / "plate.obj").write_text("\n".join(lines))
    words = r"plate.obj: spheres fit inside the mesh in single places alone, 0.07 m .* it is thinner than 1.5 mm"
    with pytest.raises(InputDataError, match=words):
        shape_to_spheres(Shape.model_validate({"mesh": {"path": "plate.obj"}}), tmp_path, 60)


def test_bad_meshes(tmp_path, ellipsoid):
    with pytest.raises(InputDataError, match=r"none.obj: no such file."):
        read_mesh(tmp_path / "none.obj")
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in ellipsoid.vertices)
    (tmp_path / "open.obj").write_text(
        vertices + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in ellipsoid.faces[1:])
    )
    with pytest.raises(InputDataError, match="not closed: 3 of"):
        read_mesh(tmp_path / "open.obj")
    (tmp_path / "bad.obj").write_text("v 0 0 0\nf 1 2 9\n")
    with pytest.raises(InputDataError, match="a face names vertex 9 of 1"):
        read_mesh(tmp_path / "bad.obj")


@pytest.mark.parametrize("seed", [1, 4, *(pytest.param(seed, marks=pytest.mark.evidence) for seed in (0, 2, 3))])
def test_boxes_wedges_and_prisms_fill_their_hull_and_blocks_with_a_notch_do_not(seed):
    one = make_object(seed)
    solid = mesh_volume(Mesh(one.vertices, np.asarray(one.faces, np.int64)))
    spheres = distil(solid, 32)
    convex = one.family not in ("l_block", "t_block")
    assert fills_hull(spheres.centers, spheres.radii, solid.mass_properties().volume_m3) == convex
