"""Colours of bodies that depend on the direction of view: found where photos show it, and turning with the body."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.synthetic.rig import look_at
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.geometry.spherical_harmonics import harmonics, rotated
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.pipeline.sg_gs.appearance.gloss import LEAST_VIEWS, fit_gloss
from cgwm.pipeline.sg_gs.photos.views import View, camera_center, render_view
from helpers.small_model import cube_splats, small_model
from scipy.spatial.transform import Rotation

SIZE, FOCAL, VIEWS = 28, 42.0, 16


def _glossy(degree: int, strength: float = 0.25, count: int = 40) -> Spheres:
    """Return spheres on a ball, whose colours depend on the direction."""
    rng = np.random.default_rng(1)
    ways = rng.normal(size=(count, 3))
    means = torch.tensor(ways / np.linalg.norm(ways, axis=1, keepdims=True), dtype=torch.float32)
    higher = torch.tensor(rng.normal(0, strength, (count, (degree + 1) ** 2 - 1, 3)), dtype=torch.float32)
    full = torch.full((count,), 1.0)
    colors = torch.full((count, 3), 0.5)
    return Spheres(means, 0.3 * full, 0.9 * full, colors, higher if degree else None)


def _views(spheres: Spheres, noise: float) -> list[View]:
    views, rng = [], np.random.default_rng(2)
    for k in range(VIEWS):
        a, b = 2 * np.pi * k / VIEWS, 0.5 * np.sin(2.4 * k)
        pose = look_at(4.0 * np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)]), np.zeros(3))
        K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
        camera = Camera(width=SIZE, height=SIZE, K=K, distortion=np.zeros(0), T_world_cam=pose)
        blank = torch.zeros(SIZE, SIZE, 3)
        view = View(
            name=str(k), image=blank, cover=None, K=torch.tensor(K, dtype=torch.float32),
            viewmat=torch.tensor(camera.T_cam_world, dtype=torch.float32), camera=camera, labels=None,
            grey=blank[..., 0],
        )  # fmt: skip
        with torch.no_grad():
            drawn = render_view(spheres, view)
        image = drawn.features[0] + torch.tensor(rng.normal(0, noise, (SIZE, SIZE, 3)), dtype=torch.float32)
        views.append(replace(view, image=image, cover=drawn.alpha[:1]))
    return views


def _error(spheres: Spheres, views: list[View]) -> float:
    with torch.no_grad():
        away = [(render_view(spheres, view).features[0] - view.image).square().mean() for view in views]
    return float(torch.stack(away).mean().sqrt())


def test_gloss_is_found_and_repeats_the_photos() -> None:
    true = _glossy(1)
    views = _views(true, 0.01)
    plain = replace(true, harmonics=None)
    found, record = fit_gloss(plain, views, 0, seed=0)
    assert record["degree"] in (1, 2) and record["gain_db"] is not None and record["gain_db"] > 1
    assert found.harmonics is not None and torch.equal(found.colors, plain.colors)
    fresh = _views(true, 0.0)
    assert _error(found, fresh) < 0.5 * _error(plain, fresh)


def test_without_gloss_or_with_few_photos_colours_stay_the_same_from_all_sides() -> None:
    plain = _glossy(0)
    found, record = fit_gloss(plain, _views(plain, 0.02), 0, seed=0)
    assert found.harmonics is None and record == {"degree": 0, "gain_db": None}
    glossy = _views(_glossy(1), 0.0)[: LEAST_VIEWS - 1]
    assert fit_gloss(plain, glossy, 0, seed=0)[1]["degree"] == 0


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_turned_harmonics_have_the_old_values_at_directions_turned_back(degree: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    higher = torch.randn(5, (degree + 1) ** 2 - 1, 3, generator=generator, dtype=torch.float64)
    turn = torch.tensor(Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix())
    ways = torch.nn.functional.normalize(torch.randn(30, 3, generator=generator, dtype=torch.float64), dim=-1)
    now = torch.einsum("dk,nkc->dnc", harmonics(ways, degree)[:, 1:], rotated(higher, turn))
    before = torch.einsum("dk,nkc->dnc", harmonics(ways @ turn, degree)[:, 1:], higher)
    torch.testing.assert_close(now, before)


def test_moved_spheres_look_the_same_to_a_camera_that_moved_with_them() -> None:
    spheres = _glossy(3)
    T = torch.eye(4)
    T[:3, :3] = torch.tensor(Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix())
    T[:3, 3] = torch.tensor([0.3, -0.2, 1.0])
    eye = torch.tensor([3.0, 1.0, -2.0])
    there = spheres.moved(T).seen_from(T[:3, :3] @ eye + T[:3, 3])
    torch.testing.assert_close(there.colors, spheres.seen_from(eye).colors, atol=1e-5, rtol=0)


def test_rollouts_show_the_colours_of_each_pose_and_camera() -> None:
    model = small_model()
    higher = np.random.default_rng(4).normal(0, 0.2, (400, 8, 3))
    model = replace(model, scene=None, body_splats={"cube": replace(cube_splats(), harmonics=higher)})
    K = np.array([[80.0, 0, 24], [0, 80.0, 24], [0, 0, 1]])
    cameras = {
        name: Camera(width=48, height=48, K=K, distortion=np.zeros(0), T_world_cam=look_at(np.array(at), np.zeros(3)))
        for name, at in (("a", [0.3, 0.1, 0.2]), ("b", [-0.2, 0.25, 0.2]))
    }
    turns = Rotation.from_euler("xyz", [[0.0, 0, 0], [0.5, 1.2, -0.8]])
    places = np.array([[[0, 0, 0.0]], [[0.02, 0, 0.01]]])
    renderer = LabelRenderer(model, cameras)
    blocks = list(renderer.blocks(places, turns.as_quat(scalar_first=True)[:, None]))
    assert sorted(block.camera for block in blocks) == ["a", "b"]
    for block in blocks:
        camera = cameras[block.camera]
        for k, turn in enumerate(turns.as_matrix()):
            T = torch.eye(4)
            T[:3, :3], T[:3, 3] = torch.tensor(turn), torch.tensor(places[k, 0])
            body = Spheres.from_numpy(model.body_splats["cube"]).moved(T)
            view = View(
                name="", image=torch.zeros(48, 48, 3), cover=None, K=torch.tensor(K, dtype=torch.float32),
                viewmat=torch.tensor(camera.T_cam_world, dtype=torch.float32), camera=camera, labels=None,
                grey=torch.zeros(48, 48),
            )  # fmt: skip
            seen = body.seen_from(camera_center(view.viewmat))
            expected = render_view(replace(seen, colors=seen.colors.clamp(0, 1)), view).features[0].clamp(0, 1)
            away = np.abs(block.image[k].astype(float) - 255 * expected.numpy())
            assert away.max() < 2.5 and block.image[k].max() > 60
