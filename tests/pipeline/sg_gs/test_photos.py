"""Exposure and camera poses that differ from photo to photo, and geometry maps beside the photos."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.check import find_faults
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.sg_gs.appearance.colors import mean_colors
from cgwm.pipeline.sg_gs.appearance.initialization import _neighbour_scales, points_of_depth
from cgwm.pipeline.sg_gs.appearance.losses import geometry_loss, normals_of, scene_loss
from cgwm.pipeline.sg_gs.appearance.optimize import Rates, Trainable, descend
from cgwm.pipeline.sg_gs.held_out import look
from cgwm.pipeline.sg_gs.photos.camera_refinement import Motions, motion_record, moved_for_good
from cgwm.pipeline.sg_gs.photos.photo_exposure import Exposures
from cgwm.pipeline.sg_gs.photos.views import View, _seen, focus_of, load_views, middle_view, render_view, spread_of
from cgwm.pipeline.sg_gs.solid.visual_hull import Silhouette, carve
from pipeline.sg_gs.test_sg_gs import PLACE, make_capture, world

SIZE_M = 0.1


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture") / "tiny")


@pytest.fixture(scope="module")
def views(capture, truth):
    """Return photos of nothing but the spheres, without the sky behind them."""
    found = load_views(capture, capture.photos(), 96, torch.device("cpu"))
    with torch.no_grad():
        return [replace(view, image=render_view(truth, view).features[0]) for view in found]


@pytest.fixture(scope="module")
def truth():
    means, scales, opacities, features = world()
    return Spheres(means, scales, opacities, features[:, :3])


@pytest.fixture(scope="module")
def small(capture, truth):
    """Return the same photos at half the size, for descents of many steps."""
    found = load_views(capture, capture.photos(), 48, torch.device("cpu"))
    with torch.no_grad():
        return [replace(view, image=render_view(truth, view).features[0]) for view in found]


def _turned(view, twist):
    """Return a photo whose camera is said to stand elsewhere; angles [rad] and shift [m]."""
    rotation = torch.tensor(cv2.Rodrigues(np.array(twist[:3]))[0], dtype=torch.float32)
    T = torch.eye(4)
    T[:3, :3], T[:3, 3] = rotation, torch.tensor(twist[3:], dtype=torch.float32)
    viewmat = T @ view.viewmat
    camera = replace(view.camera, T_world_cam=np.linalg.inv(viewmat.double().numpy()))
    return replace(view, viewmat=viewmat, camera=camera)


def with_gains(views):
    """Return gains of channels (V, 3) by chance, and the photos with them."""
    rng = np.random.default_rng(0)
    gains = torch.tensor(np.exp(rng.normal(0, 0.15, (len(views), 3))), dtype=torch.float32)
    return gains, [replace(view, image=view.image * gain) for view, gain in zip(views, gains, strict=True)]


# In the suite: the next test: gains follow renders.
@pytest.mark.evidence
def test_gains_are_found_with_the_colours_up_to_their_mean(small, truth):
    gains, darker = with_gains(small)
    exposures = Exposures(darker, True)
    start = replace(truth, colors=mean_colors(truth, darker))
    descend(Trainable(start, Rates(colors=0.03)), darker, scene_loss(None, exposures), 90, 0, "test")
    wanted = gains / gains.log().mean(0).exp()
    mine = torch.stack([exposures.gain(view) for view in small])
    before, after = wanted.log().abs().mean(), (mine / wanted).log().abs().mean()
    assert float(before) > 0.08
    assert float(after) < 0.01
    np.testing.assert_allclose(exposures.even(darker[0]).image, darker[0].image / mine[0])
    assert exposures.record()["000.png"] == [round(float(value), 4) for value in mine[0]]


def test_gains_follow_renders_up_to_their_mean(small):
    """Of renders that are right but for the gain; with colours that are found meanwhile: `make evidence`."""
    gains, darker = with_gains(small)
    exposures = Exposures(darker, True)
    wanted = gains / gains.log().mean(0).exp()
    for _ in range(60):
        for view, render in zip(darker, small, strict=True):
            exposures.follow(view, render.image, torch.ones_like(view.image[..., 0]))
    mine = torch.stack([exposures.gain(view) for view in small])
    before, after = wanted.log().abs().mean(), (mine / wanted).log().abs().max()
    assert float(before) > 0.08
    assert float(after) < 0.01
    np.testing.assert_allclose(exposures.even(darker[0]).image, darker[0].image / mine[0])
    assert exposures.record()["000.png"] == [round(float(value), 4) for value in mine[0]]


def test_gains_that_are_not_learned_stay_1(views, truth):
    exposures = Exposures(views, False)
    exposures.follow(views[0], 0.5 * views[0].image, torch.ones_like(views[0].image[..., 0]))
    assert torch.equal(exposures.gain(views[0]), torch.ones(3))
    assert exposures.even(views[0]) is views[0]


@pytest.mark.evidence
def test_camera_poses_are_refined_without_moving_the_world(views, truth):
    rng = np.random.default_rng(1)
    bare = [replace(view, cover=None) for view in views]  # all of the picture counts
    twists = [(*rng.normal(0, 0.006, 3), *rng.normal(0, 0.001, 3)) for _ in views]
    off = [_turned(view, twist) for view, twist in zip(bare, twists, strict=True)]
    exposures, motions = Exposures(off, True), Motions(off, spread_of(views))
    trainable = Trainable(truth, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.015))
    descend(trainable, off, scene_loss(None, exposures, motions), 400, 0, "test", 0.001, exposures, motions)
    found = motions.found(off)
    moved = [moved_for_good(view, found[view.name]) for view in off]
    before, after = _disagreement(off, bare), _disagreement(moved, bare)
    assert before > 0.5  # pixels, at the body
    assert after < 0.35 * before
    centers = [np.mean([view.camera.center for view in group], axis=0) for group in (off, moved)]
    np.testing.assert_allclose(*centers, atol=1e-7)
    record = motion_record(found)
    assert set(record["turned_deg"]) == {view.name for view in views}


def _disagreement(views, truth):
    """Return how far points of the body fall apart in the pictures [px], up to a motion of the whole world."""
    points = np.random.default_rng(0).normal(0, 0.03, (60, 3)) + PLACE
    pixels = np.stack(
        [_project(view, points) - _project(true, points) for view, true in zip(views, truth, strict=True)]
    )
    # a common motion of the world would shift points alike in all views; what matters is the scatter between them
    return float(np.sqrt((pixels**2).sum(-1).mean()))


def _project(view, points):
    local = points @ view.viewmat[:3, :3].double().numpy().T + view.viewmat[:3, 3].double().numpy()
    return np.stack([view.K[k, k].item() * local[:, k] / local[:, 2] for k in range(2)], 1)


def test_held_out_photos_are_corrected_by_their_left_half_alone(views, truth):
    darker = replace(views[0], image=views[0].image * 0.8)
    broken = darker.image.clone()
    broken[:, darker.size[0] // 2 :] = 0.123
    figures, other = (
        look([one], [], truth, spread_of(views), poses=False).figures for one in (darker, replace(darker, image=broken))
    )
    assert figures["psnr_right_half_db"] < 25
    assert figures["psnr_right_half_corrected_db"] > 60
    assert other["psnr_right_half_corrected_db"] < 15


def test_the_first_view_is_that_of_the_photo_in_the_middle(views):
    near = views[:5]
    seen = middle_view(near)
    apart = [sum(np.linalg.norm(one.camera.center - other.camera.center) for other in near) for one in near]
    view = near[int(np.argmin(apart))]
    np.testing.assert_allclose(seen.eye_m, view.camera.center)
    pixel, depth = view.camera.project(np.array([seen.target_m]))
    np.testing.assert_allclose(pixel[0], view.camera.K[:2, 2], atol=1e-6)
    nearest = np.linalg.norm(np.array(seen.target_m) - focus_of(near))
    assert depth[0] > 0 and nearest < 0.2 * depth[0]
    level = view.camera.T_world_cam[:3, 0]
    assert abs(np.dot(seen.up, level)) < 1e-9 and np.dot(seen.up, view.camera.T_world_cam[:3, 1]) < 0


def test_a_held_out_photo_finds_its_pose(small, truth):
    twist = (0.004, -0.003, 0.002, 0.001, 0.0, 0.001)
    off = _turned(replace(small[0], cover=None), twist)
    figures = look([off], [], truth, spread_of(small), poses=True).figures
    assert figures["psnr_right_half_corrected_db"] > figures["psnr_right_half_db"] + 5


def _depth_of(view, truth):
    with torch.no_grad():
        image = render_view(truth, view)
    return torch.where(image.alpha[0] > 0.9, image.depth[0], 0.0)


def _write_maps(root, views, truth):
    (root / "depth").mkdir()
    (root / "normals").mkdir()
    (root / "features").mkdir()
    for view in views:
        depth = _depth_of(view, truth)
        stem = view.name.removesuffix(".png")
        cv2.imwrite(str(root / "depth" / view.name), (1000 * depth.numpy()).round().astype(np.uint16))
        normals = normals_of(depth, view.K).numpy()
        cv2.imwrite(str(root / "normals" / view.name), (127.5 * (normals[..., ::-1] + 1)).round().astype(np.uint8))
        np.save(root / "features" / f"{stem}.npy", view.image.numpy()[::2, ::2, :2].astype(np.float16))


def test_maps_are_read_checked_and_scaled(tmp_path, views, truth):
    capture = make_capture(tmp_path / "maps")
    _write_maps(capture.root, views, truth)
    facts, faults = find_faults(Capture.open(capture.root, check=False))
    assert faults == []
    assert facts.geometry_maps == {"depth": 11, "normals": 11, "features": 11}
    view = load_views(capture, capture.photos(), 96, torch.device("cpu"))[3]
    np.testing.assert_allclose(view.depth, _depth_of(views[3], truth), atol=6e-4)
    assert view.features.shape == (72, 96, 2)
    assert float(view.features.min()) >= 0
    assert float(view.features.max()) <= 1
    length = view.normals.norm(dim=-1)
    np.testing.assert_allclose(length[length > 0], 1, atol=1e-5)
    np.save(capture.root / "depth" / "000.npy", np.zeros((3, 4), np.float32))
    np.save(capture.root / "normals" / "other.npy", np.zeros((72, 96, 3), np.float32))
    np.save(capture.root / "features" / "001.npy", np.zeros((72, 96), np.float32))
    messages = [str(fault) for fault in find_faults(Capture.open(capture.root, check=False))[1]]
    assert any("depth/000.npy: the map has 4x3 px" in text for text in messages)
    assert any("normals/other.npy: there is no photo of that name" in text for text in messages)
    assert any("features/001.npy: float32 (72, 96)" in text for text in messages)


def test_points_of_depth_lie_on_the_ground_and_not_on_the_body(views, truth):
    with_depth = [replace(view, depth=_depth_of(view, truth)) for view in views]
    points = points_of_depth(with_depth, 2000, 0)
    assert points is not None
    assert len(points) > 500
    assert np.abs(np.median(points[:, 2])) < 0.02  # the ground is spheres of 12 mm
    away = np.linalg.norm(points - PLACE, axis=1)
    assert away.min() > 0.045  # the ball has a radius of 0.05
    body = [replace(view, depth=view.depth * (view.cover[0] > 0.5)) for view in with_depth]
    assert points_of_depth(body, 2000, 0) is None


def test_normals_of_a_plane_point_to_the_camera(views):
    K = views[0].K
    v, u = torch.meshgrid(torch.arange(72) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    normal = torch.tensor([0.3, -0.2, -0.93])
    normal = normal / normal.norm()
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1)
    depth = (normal * torch.tensor([0.0, 0.0, 0.4])).sum() / (rays @ normal)
    inner = normals_of(depth, K)[6:-6, 6:-6]
    np.testing.assert_allclose(inner, normal.expand_as(inner), atol=2e-3)


def test_depth_maps_carve_what_silhouettes_cannot():
    """A cup: a box with a hole from above. No silhouette sees into it; depth maps do."""
    rng = np.random.default_rng(0)
    K = np.array([[75.0, 0, 32], [0, 75, 32], [0, 0, 1]])
    silhouettes = []
    for _ in range(16):
        direction = rng.normal(size=3)
        direction[2] = abs(direction[2]) + 0.8
        eye = 0.5 * direction / np.linalg.norm(direction)
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation, -rotation @ eye
        mask, depth = _see_cup(T, K)
        silhouettes.append(Silhouette(mask, K, T, depth))
    blind = carve([replace(one, depth_m=None) for one in silhouettes], None)
    seeing = carve(silhouettes, None)
    inside_hole, inside_wall = np.array([[0.0, 0.0, 0.03]]), np.array([[0.042, 0.0, 0.0]])
    assert blind.at(inside_hole) < 0  # filled
    assert seeing.at(inside_hole) > 0.005  # empty
    assert blind.at(inside_wall) < 0
    assert seeing.at(inside_wall) < 0


def _see_cup(T, K):
    """March rays through a box of 0.1 m with a hole of 0.06 m, 0.06 m deep, from above."""
    v, u = np.mgrid[:64, :64] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    depth = np.zeros((64, 64), np.float32)
    for z in np.arange(0.35, 0.65, 0.002):
        points = (z * rays - T[:3, 3]) @ T[:3, :3]
        box = (np.abs(points) < 0.05).all(-1)
        hole = (np.abs(points[..., :2]) < 0.03).all(-1) & (points[..., 2] > -0.01)
        depth[(depth == 0) & box & ~hole] = z
    return depth > 0, depth


def test_depth_pulls_the_colliding_surface_to_where_it_was_measured(views):
    """A disc of spheres before a wall at a known depth: after the descent their front is at that depth."""
    view = views[0]
    height, width = view.image.shape[:2]
    xs, ys = np.meshgrid(np.linspace(-0.05, 0.05, 16), np.linspace(-0.04, 0.04, 13))
    local = np.stack([xs.ravel(), ys.ravel(), np.full(xs.size, 0.314)], 1)
    pose = view.camera.T_world_cam
    means = torch.tensor(local @ pose[:3, :3].T + pose[:3, 3], dtype=torch.float32)
    count = len(means)
    start = Spheres(means, torch.full((count,), 0.004), torch.full((count,), 0.95), torch.zeros(count, 0))
    with torch.no_grad():
        alpha = render_view(start, view).alpha[0]
    cover = (alpha > 0.5).float()[None]
    target = replace(view, cover=cover, depth=torch.full((height, width), 0.3), labels=None)
    trainable = Trainable(start, Rates(means=0.05, log_scales=0.0))
    loss = geometry_loss(0, SIZE_M, 2.0)
    descend(trainable, [target], loss, 100, 0, "test")
    spheres = trainable.spheres()
    local = spheres.means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    front = (local[:, 2] - 2 * spheres.scales).detach()
    assert float((front - 0.3).abs().median()) < 2e-3  # it began 6 mm behind


def test_stray_points_above_the_ground_get_no_large_spheres() -> None:
    rng = np.random.default_rng(0)
    lying = np.concatenate([rng.uniform(-0.5, 0.5, (2000, 2)), np.zeros((2000, 1))], 1)
    stray = np.array([[0.4, 0.1, 0.01], [-0.3, 0.2, 0.02], [0.0, -0.4, 0.03], [0.3, -0.3, 0.1], [-0.4, -0.4, 0.12]])
    together = _neighbour_scales(stray, np.concatenate([stray, lying]))
    assert (together < 0.6 * _neighbour_scales(stray, stray)).all()
    assert together[:3] == pytest.approx(0.5 * np.hypot(stray[:3, 2], 0.02), rel=0.6)  # as of the ground below
    wall = np.stack([rng.uniform(-0.5, 0.5, 500), np.full(500, 0.5), rng.uniform(0.05, 1, 500)], 1)
    both = _neighbour_scales(wall, np.concatenate([wall, lying]))
    assert np.median(both) == pytest.approx(np.median(_neighbour_scales(wall, wall)), rel=0.05)


def _with_black_margin(view: View, pixels: int) -> View:
    seen = torch.ones(view.size[1], view.size[0], dtype=torch.bool)
    seen[:, :pixels] = False
    return replace(view, image=view.image * seen[..., None], seen=seen)


def test_what_an_undistorted_photo_does_not_show_counts_nowhere() -> None:
    camera = Camera(
        width=80, height=60, K=np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]), T_world_cam=np.eye(4),
        distortion=np.array([0.3, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    seen = _seen(camera, 80, 60, torch.device("cpu"))
    assert seen is not None and 0.05 < 1 - float(seen.float().mean()) < 0.5
    white = camera.undistorted(np.full((60, 80, 3), 255, np.uint8))[0]
    assert (white[seen.numpy()] == 255).all() and (white[~seen.numpy()] < 255).any(-1).all()
    assert _seen(replace(camera, distortion=np.zeros(0)), 80, 60, torch.device("cpu")) is None

    size = (60, 80)
    K = torch.tensor([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
    x, y = np.meshgrid(np.linspace(-1.4, 1.4, 29), np.linspace(-1, 1, 21))
    means = torch.as_tensor(np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], 1)).float()
    spheres = Spheres(means, torch.full((len(means),), 0.1), torch.full((len(means),), 0.95), torch.rand(len(means), 3))
    view = View(
        name="a", image=torch.zeros(*size, 3), cover=None, K=K, viewmat=torch.eye(4), camera=camera, labels=None,
        grey=torch.zeros(size),
    )  # fmt: skip
    view = _with_black_margin(replace(view, image=render_view(spheres, view).features[0]), 12)
    exact = look([view], [], spheres, 1.0, poses=False).figures
    assert exact["psnr_db"] > 90 and exact["ssim"] == pytest.approx(1) and exact["psnr_right_half_corrected_db"] > 90
    free = replace(spheres, colors=spheres.colors.clone().requires_grad_())
    value, wrong = scene_loss(None, Exposures([view], learned=True))(free, view, torch.Generator())
    (pull,) = torch.autograd.grad(value, free.colors)
    assert value.item() == pytest.approx(0, abs=1e-5) and float(wrong) == pytest.approx(0, abs=1e-9)
    assert float(pull.abs().max()) < 1e-4  # of L1 at rest, rounding decides the signs
    colors = mean_colors(spheres, [view])
    blind = mean_colors(spheres, [replace(view, seen=None)])
    edge = means[:, 0] < -1.1
    assert float(blind[edge].mean()) < 0.5 * float(colors[edge].mean())
    assert float(pull[edge].abs().max()) < 1e-6


def test_the_exposure_of_a_held_out_photo_is_that_between_its_neighbours(views):
    names = [f"{k:03d}.jpg" for k in range(0, 24, 2)]
    exposures = Exposures([replace(views[0], name=name) for name in names], learned=True)
    smooth = torch.sin(torch.linspace(0, 3, 12))[:, None] * torch.tensor([0.1, 0.2, 0.3])
    exposures.restore({"log_gains": smooth})
    assert torch.allclose(exposures.expected("009.jpg"), (0.5 * (smooth[4] + smooth[5])).exp())
    assert torch.allclose(exposures.expected("007x.jpg"), (0.5 * (smooth[3] + smooth[4])).exp())
    assert torch.allclose(exposures.expected("999.jpg"), smooth[-1].exp())
    exposures.restore({"log_gains": torch.tensor([0.3, -0.3] * 6)[:, None].expand(12, 3)})  # no photo is like the next
    assert torch.equal(exposures.expected("009.jpg"), torch.ones(3))
