"""The stage sg-gs on a tiny capture that the renderer itself makes."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline.fit import fit
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.pipeline.geometry.primitives import shape_volume
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.rendering.render import render
from cgwm.pipeline.sg_gs import bodies
from cgwm.pipeline.sg_gs.appearance import mcmc
from cgwm.pipeline.sg_gs.appearance.initialization import body_seeds
from cgwm.pipeline.sg_gs.photos.views import body_windows
from cgwm.pipeline.sg_gs.solid.depth_refinement import Refinement, refine
from cgwm.pipeline.sg_gs.stage import _open, fit_scene
from cgwm.schemas import InputDataError, Shape, SphereShape, SplatConfig

WIDTH, HEIGHT, FOCAL = 96, 72, 110.0
RADIUS, PLACE = 0.05, np.array([0.01, -0.02, 0.05])
CONFIG = SplatConfig(
    iterations=24,
    max_body_spheres=200,
    max_scene_spheres=250,
    max_collision_spheres=60,
    image_size=96,
    device="cpu",
    exposure=False,
    turntable=False,
)


def looking_at(position, target):
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), position
    return T


def world(beside=None):
    """A ball of spheres with a colour that changes over it, on a ground of squares; or two, so far apart [m]."""
    rng = np.random.default_rng(0)
    directions = fibonacci_directions(600)
    ball = PLACE + 0.92 * RADIUS * directions
    ball_colors = 0.5 + 0.4 * np.sin(np.stack([7 * directions[:, 0], 5 * directions[:, 1], 6 * directions[:, 2]], 1))
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 41), np.linspace(-0.4, 0.4, 41))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    ground_colors = (
        0.3 + 0.4 * rng.random((8, 8, 3))[(ground[:, 0] * 9.9).astype(int) % 8, (ground[:, 1] * 9.9).astype(int) % 8]
    )
    means = torch.tensor(np.concatenate([ball, ground]), dtype=torch.float32)
    scales = torch.cat([torch.full((600,), 0.004), torch.full((len(ground),), 0.012)])
    label = torch.zeros(len(means), 2)
    label[:600, 0] = 1.0
    colors = torch.tensor(np.concatenate([ball_colors, ground_colors]), dtype=torch.float32)
    features = torch.cat([colors, label], 1)
    if beside is not None:
        other = torch.cat([1 - colors[:600], label[:600].flip(1)], 1)
        means = torch.cat([means, means[:600] + torch.tensor(beside, dtype=torch.float32)])
        scales, features = torch.cat([scales, scales[:600]]), torch.cat([features, other])
    return means, scales, torch.full_like(scales, 0.95), features


def make_capture(root, shape="", beside=None):
    views = fibonacci_directions(24)[:11]
    poses = [looking_at(PLACE + 0.3 * view, PLACE) for view in views]
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    viewmats = torch.tensor(np.linalg.inv(np.stack(poses)), dtype=torch.float32)
    Ks = torch.tensor(K, dtype=torch.float32).expand(len(poses), 3, 3)
    background = torch.tensor([0.6, 0.7, 0.8, 0.0, 0.0])
    pictures = render(*world(beside), viewmats, Ks, WIDTH, HEIGHT, background).features.numpy()
    (root / "images").mkdir(parents=True)
    (root / "masks").mkdir()
    cameras = {
        "format": "cgwm-cameras/1",
        "scale": {"kind": "metric"},
        "cameras": {
            "c": {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
        },
        "images": {},
    }
    for number, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        name = f"{number:03d}.png"
        cv2.imwrite(str(root / "images" / name), (255 * picture[..., 2::-1]).round().astype(np.uint8))
        cv2.imwrite(str(root / "masks" / name), ((picture[..., 3:] > 0.5) @ [1, 2]).astype(np.uint8))
        cameras["images"][name] = {"camera": "c", "T_world_cam": pose.tolist()}
    (root / "cameras.json").write_text(json.dumps(cameras))
    write_manifest(root, shape)
    return Capture.open(root, check=False)


def write_manifest(root, shape):
    root.mkdir(exist_ok=True)
    ground = "ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }"
    (root / "capture.toml").write_text(
        f'format = "cgwm-capture/1"\n[world]\n{ground}\n[[bodies]]\nname = "ball"\n{shape}\n'
    )


@pytest.fixture
def quick(monkeypatch):
    """Leave the hull as the silhouettes have it: comparing photos takes long, and is not what is tested."""
    monkeypatch.setattr(bodies, "refine", lambda hull, *_: (hull, Refinement(0.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture") / "tiny")


@pytest.fixture(scope="module")
def refined():
    """The refined hulls of the fit to `capture`."""
    return []


@pytest.fixture(scope="module")
def result(capture, refined):
    def keep(*arguments):
        refined.append(refine(*arguments))
        return refined[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bodies, "refine", keep)
        return fit_scene(capture, CONFIG)


def test_the_fit_shows_photos_that_it_did_not_see(capture, result):
    held_out = result.record["held_out"]
    assert held_out["photos"] == ["000.png", "008.png"]
    assert held_out["psnr_db"] > 20
    assert held_out["psnr_object_db"] > 20
    assert held_out["mask_iou"] > 0.9
    losses = result.record["ball"]["appearance_loss"]
    assert np.mean(losses[-10:]) < np.mean(losses[:10])


def test_the_contact_sheet_shows_photos_renders_and_errors(result):
    sheet = cv2.imdecode(np.frombuffer(result.pictures["held_out.png"], np.uint8), cv2.IMREAD_COLOR)
    count = len(result.record["held_out"]["photos"])
    width, gutter = 264, 4
    assert sheet.shape == (3 * 198 + 2 * gutter, count * (width + gutter) - gutter, 3)
    photos, errors = sheet[:198, :width], sheet[-198:, :width]
    assert photos.mean() > 80
    assert errors.mean() < 60  # a fit that errs by a quarter of full scale would be bright


@pytest.mark.evidence
def test_geometry_comes_first_on_request_or_where_maps_are(capture, result, tmp_path, quick):
    assert result.record["ball"]["joint"] is True
    assert "geometry_loss" not in result.record["ball"]
    frozen, moving = (
        fit_scene(capture, CONFIG.model_copy(update={"joint": False, "geometry_rate": rate})) for rate in (0.0, 0.5)
    )
    for one in (frozen, moving):
        losses = one.record["ball"]["geometry_loss"]
        assert np.mean(losses[-5:]) < np.mean(losses[:5])
    # the same descent on silhouettes; what comes after it moves the spheres in one of them only
    apart = np.linalg.norm(frozen.bodies["ball"].visual.means - moving.bodies["ball"].visual.means, axis=1)
    assert 0 < np.median(apart) < 2e-3
    root = shutil.copytree(capture.root, tmp_path / "maps")
    (root / "depth").mkdir()
    for name in capture.photos():
        np.save(root / "depth" / name.replace(".png", ".npy"), np.zeros((HEIGHT, WIDTH), np.float32))
    with_maps = fit_scene(Capture.open(root, check=False), CONFIG.model_copy(update={"iterations": 4}))
    assert with_maps.record["ball"]["joint"] is False


@pytest.mark.evidence
def test_a_budget_makes_spheres_multiply_beside_the_body(capture, result, refined, monkeypatch):
    monkeypatch.setattr(bodies, "refine", lambda *_: refined[0])  # of the same photos, which `result` has compared
    monkeypatch.setattr(mcmc, "REFINED_EVERY", 20)
    config = CONFIG.model_copy(update={"spheres": 250, "adaptive_iterations": 40, "sh_degree": 1})
    adapted = fit_scene(capture, config)
    scene = adapted.scene
    assert scene is not None
    assert 75 < len(scene) <= 250
    assert scene.harmonics is not None
    assert scene.harmonics.shape == (len(scene), 3, 3)
    assert len(adapted.record["scene"]["history"]) == 3
    np.testing.assert_array_equal(adapted.bodies["ball"].visual.means, result.bodies["ball"].visual.means)


@pytest.mark.evidence
def test_psnr_rises(capture, result, quick):
    few = fit_scene(capture, CONFIG.model_copy(update={"iterations": 2}))
    assert result.record["held_out"]["psnr_db"] > few.record["held_out"]["psnr_db"] + 0.5


def test_the_body_is_where_it_stood(result):
    ball = result.bodies["ball"]
    np.testing.assert_allclose(ball.photo_pose.position_m, PLACE, atol=2e-3)
    np.testing.assert_allclose(np.asarray(ball.visual.means).mean(0), 0, atol=1e-6)
    properties = ball.mass_properties
    np.testing.assert_allclose(properties.com_m, 0, atol=2e-3)
    assert properties.volume_m3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.2)
    np.testing.assert_allclose(properties.inertia_m2, 0.4 * RADIUS**2 * np.eye(3), atol=0.2 * 0.4 * RADIUS**2)
    reach = np.linalg.norm(ball.collision.means, axis=1) + result.radius_factor * ball.collision.scales
    # The hull of 9 silhouettes, each pixel 2.6 mm wide, is a polyhedron around the ball.
    assert RADIUS - 2e-3 < reach.max() < RADIUS + 12e-3
    assert len(ball.collision) <= CONFIG.max_collision_spheres


def test_a_layer_that_is_only_seen_begins_closer_to_the_surface(tmp_path):
    """At depth 0.7 its centres lie 0.3 radii further out; radii and filling are the same."""
    ball = shape_volume(Shape(sphere=SphereShape(radius_m=0.05)), tmp_path)
    deep, scales, layer = body_seeds(ball, 60, 2.0, 0)
    seen, same, _ = body_seeds(ball, 60, 2.0, 0, depth=0.7)
    np.testing.assert_array_equal(same, scales)
    np.testing.assert_array_equal(seen[layer:], deep[layer:])
    out = np.linalg.norm(seen, axis=1) - np.linalg.norm(deep, axis=1)
    np.testing.assert_allclose(out[:layer], 0.3 * 2.0 * scales[:layer], rtol=0.02)


def test_spheres_too_far_inside_are_moved_out(capture, result, tmp_path):
    """Photos move spheres that lie 0.3 of their scales further in further out by about as much."""
    stage = _open(capture, CONFIG, None)
    windows, ball = body_windows(stage.train, 0), shape_volume(Shape(sphere=SphereShape(radius_m=RADIUS)), tmp_path)
    ball = replace(ball, surface=ball.surface + PLACE, origin=ball.origin + PLACE)
    fitted = Spheres.from_numpy(result.bodies["ball"].visual)
    fitted = replace(fitted, means=fitted.means + torch.as_tensor(result.bodies["ball"].photo_pose.position_m))
    away = fitted.means - torch.as_tensor(PLACE)
    inward = fitted.scales[:, None] * (away / away.norm(dim=1, keepdim=True)).float()
    found = [
        bodies._outward(stage, 0, replace(fitted, means=fitted.means - k * inward), ball, windows) for k in (0, 0.3)
    ]
    assert found[1][1] - found[0][1] == pytest.approx(0.3, abs=0.11)


def test_a_body_without_photos_has_the_spheres_of_its_shape(tmp_path):
    write_manifest(tmp_path / "tracks_only", "shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } }")
    result = fit_scene(Capture.open(tmp_path / "tracks_only", check=False), CONFIG)
    ball = result.bodies["ball"]
    assert ball.visual is None
    assert result.scene is None
    assert ball.mass_properties.volume_m3 == pytest.approx(1e-3)
    np.testing.assert_allclose(ball.mass_properties.inertia_m2, 0.01 / 6 * np.eye(3), atol=1e-12)
    assert len(ball.collision) <= CONFIG.max_collision_spheres


def test_a_body_with_neither_photos_nor_shape_is_refused(tmp_path):
    write_manifest(tmp_path / "bare", "")
    with pytest.raises(InputDataError, match="body 'ball' has neither a shape nor masks"):
        fit_scene(Capture.open(tmp_path / "bare", check=False), CONFIG)


def test_photos_without_cameras_are_refused(tmp_path):
    capture = make_capture(tmp_path / "raw")
    (capture.root / "cameras.json").unlink()
    with pytest.raises(InputDataError, match="11 photos and no cameras"):
        fit_scene(Capture.open(capture.root, check=False), CONFIG)


def test_photos_alone_need_no_split(tmp_path):
    capture = make_capture(tmp_path / "photos")
    (capture.root / "cameras.json").unlink()
    with pytest.raises(InputDataError, match="11 photos and no cameras"):  # and not: no split 'train'
        fit(capture.root, tmp_path / "model", splat_config=CONFIG)


def test_bodies_of_unscaled_photos_have_a_warning(tmp_path):
    capture = make_capture(tmp_path / "photos")
    cameras = json.loads((capture.root / "cameras.json").read_text())
    cameras["scale"] = {"kind": "unscaled"}
    (capture.root / "cameras.json").write_text(json.dumps(cameras))
    stage = _open(Capture.open(capture.root, check=False), CONFIG, None)
    assert any("in the units of the reconstruction, not in metres" in warning for warning in stage.warnings)
