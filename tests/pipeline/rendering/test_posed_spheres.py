"""Spheres of a model in the poses, colours and cameras of a motion, and the parts of pictures that they reach."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.synthetic.rig import look_at
from cgwm.pipeline.geometry.rotation import quat_exp, quat_to_matrix
from cgwm.pipeline.geometry.spherical_harmonics import harmonics
from cgwm.pipeline.rendering.contact_glyphs import SLIDING_RGB, STICKING_RGB, arrow_scale, contact_marks
from cgwm.pipeline.rendering.label_renderer import LabelRenderer, _exposed
from cgwm.pipeline.rendering.posed_scene import Gloss, Labelled, LabelledModel, _Moving
from cgwm.pipeline.rendering.rasterize import TILE as KERNEL_TILE
from cgwm.pipeline.rendering.rasterize import Raster
from cgwm.pipeline.rendering.relighting import DARKEST, Relighting
from cgwm.pipeline.rendering.render import MIN_ALPHA
from cgwm.pipeline.rendering.screen_bounds import TILE, Box, inside, reach, spans
from cgwm.schemas import Exposure, Light, Pose
from helpers.small_model import small_model

K = torch.tensor([[60.0, 0.0, 40.0], [0.0, 50.0, 30.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 80, 60


def spheres(count: int, seed: int = 0, views: int = 0) -> Labelled:
    """Return spheres about 1 m before a camera at the origin, some out of its view."""
    rng = torch.Generator().manual_seed(seed)
    shape = (views, count, 3) if views else (count, 3)
    means = torch.randn(shape, generator=rng) * torch.tensor([0.6, 0.5, 0.2]) + torch.tensor([0.0, 0.0, 1.0])
    return Labelled(
        means=means,
        scales=0.01 + 0.05 * torch.rand(count, generator=rng),
        opacities=torch.rand(count, generator=rng).clamp_min(0.05),
        colors=torch.rand(shape, generator=rng),
        labels=torch.arange(count),
    )


def alphas(one: Labelled) -> torch.Tensor:
    """Return the peak alpha (N, H, W) of each sphere along the ray of each pixel."""
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1)
    rays = torch.nn.functional.normalize(rays, dim=-1)
    along = torch.einsum("hwk,nk->nhw", rays, one.means)
    away2 = one.means.square().sum(-1)[:, None, None] - along.square()
    return one.opacities[:, None, None] * torch.exp(-0.5 * away2 / one.scales[:, None, None].square())


def test_bounds_hold_all_pixels_of_a_sphere_and_little_more() -> None:
    one = spheres(60)
    found, drawn = spans(one, torch.eye(4), K), alphas(one) >= MIN_ALPHA
    tight = 0
    for k in range(60):
        rows, columns = np.nonzero(drawn[k].numpy())
        if len(rows) == 0:
            continue
        left, top, right, bottom = found[k].tolist()
        assert left <= columns.min() and columns.max() < right and top <= rows.min() and rows.max() < bottom
        if 0 < columns.min() and columns.max() < WIDTH - 1 and 0 < rows.min() and rows.max() < HEIGHT - 1:
            tight += 1
            assert columns.min() - left < 3 and right - columns.max() < 4
            assert rows.min() - top < 3 and bottom - rows.max() < 4
    assert tight > 10


def test_spheres_about_the_camera_reach_all_and_faint_or_hidden_ones_nothing() -> None:
    one = spheres(4)
    means = torch.tensor([[0.0, 0.0, 0.05], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    opacities = torch.tensor([0.9, 0.9, 0.9 * MIN_ALPHA, 0.9])
    found = spans(replace(one, means=means, scales=torch.full((4,), 0.05), opacities=opacities), torch.eye(4), K)
    assert found[0].tolist() == [-np.inf, -np.inf, np.inf, np.inf]
    assert found[1].tolist() == found[2].tolist() == [np.inf, np.inf, -np.inf, -np.inf]
    assert found[3].isfinite().all()
    moved = torch.eye(4)
    moved[2, 3] = -2.0  # the camera stands two metres behind
    back = replace(one, means=means + torch.tensor([0.0, 0.0, 2.0]), opacities=opacities)
    same = replace(one, means=means, opacities=opacities)
    torch.testing.assert_close(spans(back, moved, K), spans(same, torch.eye(4), K))


def test_a_crop_is_made_of_whole_tiles_and_holds_what_is_seen() -> None:
    one = spheres(3, 1)
    means = torch.tensor([[0.05, 0.02, 1.0], [-0.1, 0.1, 1.0], [0.0, -0.05, 1.0]])
    near = replace(one, means=means, scales=torch.full((3,), 0.01), opacities=torch.full((3,), 0.9))
    box = reach(spans(near, torch.eye(4), K), WIDTH, HEIGHT)
    assert box is not None
    each = spans(near, torch.eye(4), K)
    low, high = each[:, :2].amin(0), each[:, 2:].amax(0)
    for first, last, least, most, size in zip(box[:2], box[2:], low, high, (WIDTH, HEIGHT), strict=True):
        assert first % TILE == 0 and (last % TILE == 0 or last == size)
        assert first <= least < first + TILE and last - TILE < most <= last
    assert (box.width, box.height) == (box.right - box.left, box.bottom - box.top)
    assert box.place == (slice(box.top, box.bottom), slice(box.left, box.right))
    shifted = box.camera_matrix(K)
    assert (K - shifted)[:2, 2].tolist() == [box.left, box.top] and shifted[0, 0] == K[0, 0]
    for shift in ([5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, -5.0, 0.0]):
        assert reach(spans(replace(near, means=means + torch.tensor(shift)), torch.eye(4), K), WIDTH, HEIGHT) is None
    assert reach(spans(near.rows(slice(0, 0)), torch.eye(4), K), WIDTH, HEIGHT) is None
    around = replace(near, means=means * 0.01)
    assert reach(spans(around, torch.eye(4), K), WIDTH, HEIGHT) == Box(0, 0, WIDTH, HEIGHT)
    edge = Box(8, 16, 24, 32)
    reached = [[0, 0, 8, 16], [24, 32, 40, 40], [0, 0, 7.9, 40], [0, 0, 40, 15.9], [24.1, 0, 40, 40], [0, 32.1, 40, 40]]
    assert inside(torch.tensor(reached), edge).tolist() == [True, True, False, False, False, False]


def test_sets_are_joined_view_by_view() -> None:
    still, moving = spheres(3), spheres(4, 1, views=2)
    both = Labelled.joined([still, moving])
    assert both.means.shape == (2, 7, 3) and len(both) == 7
    for view in range(2):
        one = both.view(view)
        torch.testing.assert_close(one.means, torch.cat([still.means, moving.means[view]]))
        torch.testing.assert_close(one.colors, torch.cat([still.colors, moving.colors[view]]))
    assert both.labels.tolist() == [0, 1, 2, 0, 1, 2, 3]
    torch.testing.assert_close(both.scales, torch.cat([still.scales, moving.scales]))
    torch.testing.assert_close(both.opacities, torch.cat([still.opacities, moving.opacities]))
    plain = Labelled.joined([still, still])
    assert plain.means.shape == (6, 3)
    kept = both.rows(torch.tensor([0, 4]))
    torch.testing.assert_close(kept.means, both.means[:, [0, 4]])
    assert kept.labels.tolist() == [0, 1] and kept.scales.tolist() == both.scales[[0, 4]].tolist()
    twice = moving.repeated(2)
    torch.testing.assert_close(twice.means, torch.cat([moving.means, moving.means]))
    torch.testing.assert_close(twice.colors, torch.cat([moving.colors, moving.colors]))
    assert moving.seen_from(torch.zeros(1, 3)) is moving
    assert moving.seen_from(torch.zeros(3, 3)).means.shape == (6, 4, 3)


def test_gloss_depends_on_the_direction_of_view_in_axes_of_the_body() -> None:
    rng = torch.Generator().manual_seed(2)
    one = spheres(4, 3)
    higher = 0.05 * torch.randn(4, 8, 3, generator=rng)
    rotation = quat_to_matrix(quat_exp(torch.tensor([0.4, -0.2, 0.9])))
    eye, factor = torch.tensor([0.3, -0.2, -0.4]), 0.5 + torch.rand(4, 1, generator=rng)
    found = Gloss(higher, rotation, factor).added(one.colors, one.means, eye)
    for k in range(4):
        way = torch.nn.functional.normalize(one.means[k] - eye, dim=0) @ rotation
        more = harmonics(way[None], 2)[0, 1:] @ higher[k]
        torch.testing.assert_close(found[k], (one.colors[k] + factor[k] * more).clamp(0, 1))
    turns = torch.stack([rotation, torch.eye(3)])
    views = Gloss(higher, turns, torch.stack([factor, 2 * factor]))
    both = replace(one, means=one.means.expand(2, 4, 3))
    both = replace(both, colors=one.colors.expand(2, 4, 3), gloss=views)
    eyes = torch.stack([eye, -eye])
    seen = both.seen_from(eyes)
    assert seen.gloss is None and seen.colors.shape == (4, 4, 3)
    for number, (at, view) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        alone = both.view(view).seen_from(eyes[at][None])
        torch.testing.assert_close(seen.colors[number], alone.colors.view(4, 3))


def test_bodies_move_with_their_poses_and_keep_their_light() -> None:
    model = LabelledModel(small_model(driven=True))
    assert [part.body for part in model.moving] == [0, 1] and model.bodies == 2
    assert model.moving_count == sum(len(part.spheres) for part in model.moving)
    assert set(model.moving[0].spheres.labels.tolist()) == {1} and set(model.moving[1].spheres.labels.tolist()) == {2}
    quat = quat_exp(torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.0, -0.2]])).numpy()
    position = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    (body, placed), _ = model.placed(position[None], quat[None])
    own = model.moving[0].spheres
    wanted = own.means @ quat_to_matrix(torch.as_tensor(quat[0])).float().T + torch.tensor([0.1, 0.2, 0.3])
    assert body == 0
    torch.testing.assert_close(placed.means[0], wanted)
    torch.testing.assert_close(placed.colors[0], own.colors)


def test_light_is_relative_to_that_of_the_photos() -> None:
    light = Light(lamp=(0.3, 0.5, 0.6), sky=0.2)
    normals = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    lamp = torch.tensor(light.lamp)
    wanted = 1 + 0.2 * normals[:, 2] + (normals @ lamp).clamp_min(0)
    photo = quat_exp(torch.tensor([0.7, -0.3, 0.2]))
    pose = Pose(position_m=(0, 0, 0), quat_wxyz=tuple(photo.tolist()))
    body: Any = type("Body", (), {"photo_pose": pose})
    made = Relighting.of(light, body, normals)
    torch.testing.assert_close(made.brightness(normals), wanted)
    dark = Relighting.of(Light(lamp=(0.0, 0.0, 0.0), sky=1.0), body, normals)
    assert float(dark.brightness(-torch.eye(3))[2]) == pytest.approx(DARKEST)
    torch.testing.assert_close(made.factors(photo), torch.ones(20))
    turn = quat_exp(torch.tensor([-0.5, 0.4, 1.0]))
    there, before = normals @ quat_to_matrix(turn).T, normals @ quat_to_matrix(photo).T
    ratio = made.brightness(there) / made.brightness(before)
    torch.testing.assert_close(made.factors(turn), ratio)
    two = made.turned(torch.stack([quat_to_matrix(turn), quat_to_matrix(photo)]))
    torch.testing.assert_close(two, torch.stack([ratio, torch.ones(20)]))
    moving = _Moving(0, spheres(20), normals, made, 0.1 * torch.ones(20, 3, 3))
    placed = moving.placed(torch.zeros(1, 3), turn[None])
    torch.testing.assert_close(placed.colors[0], (moving.spheres.colors * ratio[:, None]).clamp(0, 1))
    assert placed.gloss is not None
    torch.testing.assert_close(placed.gloss.brightness[0, :, 0], ratio)


def test_arrows_of_contacts_are_impulses_and_colours_their_slip() -> None:
    points, impulses = np.arange(6.0).reshape(2, 3), np.array([[1.0, 0.0, 2.0], [0.0, -1.0, 0.0]])
    marks = contact_marks({"pos_world": points, "impulse_world": impulses, "mode": np.array([1, 0])}, 0.5)
    assert len(marks) == 2 and marks.colors.tolist() == [list(SLIDING_RGB), list(STICKING_RGB)]
    np.testing.assert_allclose(marks.segments_m[:, 0], points)
    np.testing.assert_allclose(marks.segments_m[:, 1], points + 0.5 * impulses)
    assert arrow_scale(4.0, 0.2) == 0.05 and arrow_scale(0.0, 0.2) == 0.0


def test_tiles_of_kernels_cover_a_picture() -> None:
    for width, height in ((KERNEL_TILE, KERNEL_TILE + 1), (2 * KERNEL_TILE - 1, 2 * KERNEL_TILE)):
        one = Raster(width=width, height=height, min_alpha=0.1, min_transmittance=0.01)
        assert one.columns * KERNEL_TILE >= width > (one.columns - 1) * KERNEL_TILE
        assert one.rows * KERNEL_TILE >= height > (one.rows - 1) * KERNEL_TILE
        assert one.thresholds == (0.1, 0.01)


def camera(x: float, width: int = 48, height: int = 40) -> Camera:
    """A camera that looks at the table from the side."""
    matrix = np.array([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    T = look_at(np.array([x, -0.5, 0.4]), np.array([0.04, 0.0, 0.06]))
    return Camera(width=width, height=height, K=matrix, distortion=np.zeros(0), T_world_cam=T)


def test_a_redrawn_part_is_the_picture_of_everything() -> None:
    """On a CPU only the tiles that moving bodies reach are drawn again, on a GPU all: colours, depths, masks agree."""
    renderer = LabelRenderer(small_model(driven=True), {"a": camera(0.0), "b": camera(0.1)})
    rng = np.random.default_rng(0)
    position = np.array([[[0.0, 0.0, 0.05], [0.09, 0.02, 0.06]], [[0.05, 0.05, 0.1], [0.0, 0.0, 0.2]]])
    quat = rng.normal(size=(2, 2, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    placed = renderer._scene.placed(position, quat)
    parts, whole = renderer._one_by_one(placed, 2), renderer._all_at_once(placed, 2)
    assert list(parts) == list(whole) == ["a", "b"]
    for name in parts:
        one, other = parts[name], whole[name]
        assert (one.image.int() - other.image.int()).abs().max() <= 1
        assert (one.mask != other.mask).float().mean() < 1e-3 and (one.amodal != other.amodal).float().mean() < 1e-3
        torch.testing.assert_close(one.depth, other.depth, atol=1e-3, rtol=0)
        assert {0, 1, 2} == set(one.mask.unique().tolist())
        for body in (0, 1):
            assert one.visible_px[:, body].tolist() == (one.mask == body + 1).sum((1, 2)).tolist()
            assert one.amodal_px[:, body].tolist() == ((one.amodal >> body) & 1).sum((1, 2)).tolist()
            assert (one.amodal_px[:, body] >= one.visible_px[:, body]).all() and (one.visible_px[:, body] > 0).any()
        cube = one.depth[0][one.mask[0] == 1]  # 0.6 m away, and 17 cm across from corner to corner
        assert 0.5 < float(cube.min()) and float(cube.max()) < 0.75
    blocks = list(renderer.blocks(position, quat, exposures={"b": Exposure(gain_rgb=(0.5, 0.5, 0.5))}))
    assert [(block.camera, block.start) for block in blocks] == [("a", 0), ("b", 0)]
    np.testing.assert_array_equal(blocks[0].image, parts["a"].image.numpy())
    assert np.abs(blocks[1].image.astype(float) - 0.5 * parts["b"].image.numpy()).max() <= 0.5


def test_exposures_scale_and_shift_and_clip() -> None:
    image = torch.tensor([[[0, 100, 250]]], dtype=torch.uint8)
    assert _exposed(image, Exposure()) is image
    found = _exposed(image, Exposure(gain_rgb=(1.0, 0.5, 1.2), offset_rgb=(-0.1, 0.1, 0.0)))
    assert found.tolist() == [[[0, round(50 + 25.5), 255]]]
