"""Flat faces of solids from photos: of a box whose surface bulges, and of a ball that must stay one."""

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.pipeline.geometry.flat_solid import flattened
from cgwm.pipeline.geometry.solid_grid import Volume, crossings, grid_points
from cgwm.pipeline.sg_gs.collision.collision_spheres import distil
from cgwm.pipeline.sg_gs.photos.views import View
from cgwm.pipeline.sg_gs.solid import facets
from cgwm.pipeline.sg_gs.solid.facets import flatten_faces

HALF, RADIUS = np.array([0.05, 0.04, 0.03]), 0.045
WIDTH, HEIGHT, FOCAL = 120, 120, 190.0
PITCH = 2e-3
AXES = np.concatenate([np.eye(3), -np.eye(3)])
CORNERS = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3) * HALF


def box_height(points):
    over = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(1), 0)


def pillow_height(points):
    """A box whose faces are caps of large spheres: they stand out by 1.5 mm in the middle, by less at their corners."""
    radius = 0.6
    middles = AXES * (np.tile(HALF, 2) + 1.5e-3 - radius)[:, None]
    return (np.linalg.norm(points[:, None] - middles, axis=2) - radius).max(1)


def ball_height(points):
    return np.linalg.norm(points, axis=1) - RADIUS


def tube_height(points):
    """A cylinder along z."""
    over = np.stack([np.linalg.norm(points[:, :2], axis=1) - RADIUS, np.abs(points[:, 2]) - HALF[2]], 1)
    return np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(1), 0)


def notch_height(points):
    """A box without the quarter where x > 0 and z > 0."""
    return np.maximum(box_height(points), np.minimum(points[:, 0], points[:, 2]))


def solid_of(height, pitch=PITCH):
    origin = -0.06 * np.ones(3) + 0.37 * pitch
    shape = (int(0.12 / pitch),) * 3
    field = height(grid_points(shape, origin, pitch)).reshape(shape)
    return Volume.from_inside(field < 0, origin, pitch, crossings(field, origin, pitch))


def check_flat(flat, planes, tolerance_m):
    """Check that the faces of a box are planes near the true ones, that spheres touch them and none stands out."""
    spheres = distil(flat, 40)
    for axis in AXES:
        plane = planes[np.argmax(planes[:, :3] @ axis)]
        corners = CORNERS[CORNERS @ axis > 0]
        assert np.abs(corners @ plane[:3] - plane[3]).max() < max(tolerance_m, 1e-9)
        over = spheres.centers @ plane[:3] + spheres.radii - plane[3]
        assert over.max() < 0.1e-3
        assert (over > -0.01e-3).sum() >= 4
        face = flat.surface[(np.abs(flat.surface @ plane[:3] - plane[3]) < 2e-3) & inner(flat.surface, axis)]
        assert len(face) > 10
        off = np.abs(face @ plane[:3] - plane[3])
        assert np.percentile(off, 99) < 1e-6
        assert off.max() < 0.3e-3  # some points near a corner of a coarse grid
    sharp = np.linalg.norm(flat.surface - CORNERS[:, None], axis=2).min(1) < max(tolerance_m, 1e-5)
    assert sharp.sum() >= (8 if tolerance_m < 1e-5 else 7)  # photos of a coarse hull leave one corner round
    assert flat.mass_properties().volume_m3 == pytest.approx(8 * HALF.prod(), rel=0.01)


def inner(points, axis):
    """Return which points lie above the inner part of the face along an axis."""
    return ((np.abs(points) < HALF - 8e-3) | (np.abs(axis) > 0.5)).all(1)


def paint(points):
    """A pattern in space with detail of all sizes [m] that a pixel of 1.3 mm shows."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(40, 3)) * rng.uniform(150, 900, (40, 1))
    return 0.5 + 0.09 * np.sin(points @ waves.T + rng.uniform(0, 6, 40)).sum(-1)


def photos(height):
    """Photos by sphere tracing, without a lamp, with masks."""
    found = []
    for place in 0.25 * fibonacci_directions(36):
        forward = -place / np.linalg.norm(place)
        right = np.cross(forward, [0.1, 0.0, 1.0])
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), place
        v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1) @ T[:3, :3].T
        rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
        far = np.full(len(rays), 0.15)
        for _ in range(30):
            far += height(place + far[:, None] * rays)
        points = place + far[:, None] * rays
        hit = (far < 0.4).reshape(HEIGHT, WIDTH)
        grey = np.where(hit, paint(points).reshape(HEIGHT, WIDTH), 0.3)
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        camera = Camera(WIDTH, HEIGHT, K, np.zeros(0), T)
        picture = torch.tensor(grey, dtype=torch.float32)
        found.append(
            View(
                name="photo",
                image=picture[..., None].expand(-1, -1, 3),
                cover=torch.tensor(hit[None], dtype=torch.float32),
                K=torch.tensor(camera.K, dtype=torch.float32),
                viewmat=torch.tensor(camera.T_cam_world, dtype=torch.float32),
                camera=camera,
                labels=hit.astype(np.uint8),
                grey=picture,
            )
        )
    return found


@pytest.mark.evidence
def test_bulging_faces_of_a_box_become_planes_that_its_spheres_touch():
    flat, record = flatten_faces(solid_of(pillow_height), photos(box_height), 0, 0)
    assert (record.regions, record.flat) == (6, 6)
    assert 1e-3 < record.moved_most_m < 2.5e-3
    check_flat(flat, flat.faces.planes, 0.2e-3)


@pytest.mark.evidence
@pytest.mark.parametrize("height", [ball_height, tube_height])
def test_round_bodies_stay_round(height):
    solid = solid_of(height)
    flat, record = flatten_faces(solid, photos(height), 0, 0)
    ends = 2 if height is tube_height else 0
    assert record.flat == ends
    sides = np.linalg.norm(flat.surface[:, :2], axis=1) > RADIUS - 1e-3
    assert (flat.faces.of_point[sides] < 0).mean() > 0.9 if ends else flat is solid


def test_a_pillow_on_planes_is_a_box():
    pillow = solid_of(pillow_height, 3 * PITCH)
    planes = np.c_[AXES, np.tile(HALF, 2)]
    face = (pillow.surface @ AXES.T - np.tile(HALF, 2)).argmax(1)
    before = distil(pillow, 40)
    assert (before.centers @ AXES.T + before.radii[:, None] - np.tile(HALF, 2)).max() > 1e-3
    check_flat(flattened(pillow, face, planes), planes, 1e-6)


def test_a_concave_edge_stays_concave():
    notched = solid_of(notch_height, 2 * PITCH)
    planes = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])
    apart = np.abs(notched.surface @ planes[:, :3].T)
    face = np.where((notched.surface[:, 0] > -1e-3) & (notched.surface[:, 2] > -1e-3), apart.argmin(1), -1)
    face[(apart.min(1) > 1e-3) | (np.abs(notched.surface[:, 1]) > HALF[1] - 6e-3)] = -1
    flat = flattened(notched, face, planes)
    inside = np.array([[0.02, 0, -0.01], [-0.02, 0, 0.01], [-0.01, 0, -0.01]])
    assert (flat.at(inside) < -5e-3).all()
    assert flat.at(np.array([[0.02, 0.0, 0.01]]))[0] > 5e-3
    assert flat.mass_properties().volume_m3 == pytest.approx(notched.mass_properties().volume_m3, rel=0.02)


def test_the_best_plane_is_found_between_the_displacements_that_were_compared():
    rng = np.random.default_rng(0)
    columns = np.c_[np.ones(50), rng.uniform(-1, 1, (50, 2))]
    true, offsets = np.array([3.1e-4, -2.7e-4, 1.2e-4]), np.linspace(-2e-3, 2e-3, 45)
    scores = np.exp(-0.5 * ((offsets - (columns @ true)[:, None]) / 3e-4) ** 2)
    found = facets.Curves(offsets, scores, np.ones(50)).fitted(columns)
    np.testing.assert_allclose(found, true, atol=1e-5)


def test_an_edge_ends_at_a_face_that_is_not_flat():
    # Beyond a bulging end, no surface is near but that of the two planes: the edge would grow into a horn.
    pillow = solid_of(pillow_height, 2 * PITCH)
    height = pillow.surface @ AXES.T - np.tile(HALF, 2)
    face = np.array([0, -1, 1, 2, -1, 3])[height.argmax(1)]
    planes = np.c_[AXES, np.tile(HALF, 2)][[0, 2, 3, 5]]
    spheres = distil(flattened(pillow, face, planes), 60)
    over = (spheres.centers @ AXES.T + spheres.radii[:, None]).max(0) - np.tile(HALF, 2)
    assert over[[1, 4]].max() < height.max() + 0.5 * pillow.pitch
    assert over[[0, 2, 3, 5]].max() < 0.25 * pillow.pitch
