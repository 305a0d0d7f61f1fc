"""The ground without the bodies: a cast shadow is found where there is one, and lifted; hidden ground is filled in."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.pipeline.geometry.ground_spheres import on_plane
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.geometry.viewpoint import look_at
from cgwm.pipeline.sg_gs.ground import bare_ground as ground_module
from cgwm.pipeline.sg_gs.ground.cast_shadow import Caster, _cover, find_shadow
from cgwm.pipeline.sg_gs.ground.ground_photo import CELLS, GroundPhoto

CELL, HALF = 0.004, np.array([0.06, 0.04, 0.05])
BOX = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3) * HALF + [0, 0, HALF[2]]
TO_LAMP = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])
FACTORS = np.array([0.62, 0.64, 0.66])


def _caster(corners: np.ndarray) -> Caster:
    """Return a box of given corners as spheres of 1 mm on its surface, 4 mm apart."""
    low, high = corners.min(0), corners.max(0)
    axes = [np.linspace(a, b, round((b - a) / 0.004) + 1) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    points = points[(np.isclose(points, low) | np.isclose(points, high)).any(1)]
    return Caster(points, np.full(len(points), 0.001))


def _polygon(points: np.ndarray) -> np.ndarray:
    cells = (points[:, :2] + 0.5 * CELLS * CELL) / CELL
    image = np.zeros((CELLS, CELLS), np.uint8)
    hull = cv2.convexHull(cells.astype(np.float32))
    cv2.fillConvexPoly(image, np.round((hull - 0.5) * 16).astype(np.int32), 1, shift=4)
    return image > 0


def _photo(seed: int, shaded: bool) -> GroundPhoto:
    """A speckled ground, with a box on it that hides the ground below."""
    rng = np.random.default_rng(seed)
    layer = cv2.GaussianBlur(rng.normal(size=(CELLS, CELLS, 3)), (0, 0), 3)
    colors = np.array([0.55, 0.5, 0.45]) * (1 + 0.2 * layer / layer.std())
    if shaded:
        shadow = _polygon(BOX - (BOX[:, 2] / TO_LAMP[2])[:, None] * TO_LAMP)
        colors = np.where(shadow[..., None], colors * FACTORS, colors)
    pixels = np.where(_polygon(BOX[BOX[:, 2] < 1e-9]), 0, 10)
    colors = np.where(pixels[..., None] > 0, colors, 0).clip(0, 1)
    return GroundPhoto(
        axes=np.eye(3), corner=np.full(2, -0.5 * CELLS * CELL), height=0.0, cell=CELL,
        colors=colors.astype(np.float32), pixels=pixels.astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("seed", [1, 2])
def test_the_lamp_is_found_by_the_shadow_of_the_body(seed: int) -> None:
    shadow = find_shadow(_photo(seed, shaded=True), [_caster(BOX)])
    assert shadow is not None
    assert np.degrees(np.arccos(shadow.to_lamp @ TO_LAMP)) < 3
    assert shadow.factors == pytest.approx(FACTORS, abs=0.06)  # a median of some 100 independent speckles of 20 %
    outline = _polygon(BOX - BOX[:, 2:] / TO_LAMP[2] * TO_LAMP)
    assert shadow.cover.sum() == pytest.approx(outline.sum(), rel=0.1)


@pytest.mark.parametrize("seed", [0, 4])
def test_no_shadow_is_seen_in_a_texture(seed: int) -> None:
    assert find_shadow(_photo(seed, shaded=False), [_caster(BOX)]) is None


def test_the_ground_in_a_notch_is_not_in_the_shadow() -> None:
    arms = [np.array([[-0.06, -0.06, 0.0], [0.06, -0.02, 0.06]]), np.array([[-0.06, -0.02, 0.0], [-0.02, 0.06, 0.06]])]
    parts = [_caster(arm) for arm in arms]
    body = Caster(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("means", "scales")))
    photo = _photo(0, shaded=False)
    cover = _cover(photo, [body], (0.0, 89.0))  # from nearly above
    columns, rows = np.floor(photo.places(np.array([[0.03, 0.03, 0.0], [0.03, -0.04, 0.0], [-0.04, 0.03, 0.0]]))).T
    assert cover[rows.astype(int), columns.astype(int)] == pytest.approx([0, 1, 1])
    area, outline = 0.12 * 0.04 + 0.04 * 0.08, 0.48
    assert area < cover.sum() * CELL**2 < area + CELL * outline  # discs reach beyond the outline


def _view(eye: np.ndarray, shape: tuple[int, int] = (96, 128)) -> SimpleNamespace:
    """Return a photo from `eye` [m] towards the middle of the box, with the box's mask."""
    pose = look_at(eye, np.array([0.0, 0.0, 0.05]), np.array([0.0, 0.0, 1.0]))
    K = np.array([[150.0, 0, 64], [0, 150, 48], [0, 0, 1]])
    camera = Camera(*shape[::-1], K, np.zeros(0), pose)
    corners = cv2.convexHull(camera.project(BOX)[0].astype(np.float32)).astype(np.int32)
    mask = cv2.fillConvexPoly(np.zeros(shape, np.uint8), corners, 1)
    cover = torch.as_tensor(mask)[None].float()
    return SimpleNamespace(cover=cover, camera=camera, size=shape[::-1])


def test_what_lies_within_a_body_leaves_the_background() -> None:
    places = [[0, 0, 0.05], [0.059, 0, 0.05], [0.0605, 0, 0.05], [0.07, 0, 0.05], [0, 0, 0.2], [0.1, 0.1, 0.05]]
    scene = Spheres(torch.tensor(places), torch.full((6,), 1e-3), torch.full((6,), 0.9), torch.rand(6, 3))
    views: Any = [_view(np.array([0.4 * np.cos(a), 0.4 * np.sin(a), 0.3])) for a in (0.3, 1.9, 3.5, 5.0)]
    kept = ground_module._without_insides(scene, [BOX], views)
    assert torch.equal(kept.means, scene.means[3:])
    # what photos show beside the masks is in a notch of the body, though it is within its hull
    around = np.concatenate([BOX, BOX + np.array([0.1, 0.1, 0.0])])
    kept = ground_module._without_insides(scene, [around], views)
    assert torch.equal(kept.means, scene.means[4:])


def test_the_shadow_is_lifted_from_the_ground_alone_and_hidden_ground_is_covered() -> None:
    photo = _photo(0, shaded=True)
    shadow = find_shadow(photo, [_caster(BOX)])
    assert shadow is not None
    rows, columns = (values.ravel() for values in np.meshgrid(np.arange(0, CELLS, 4), np.arange(0, CELLS, 4)))
    points = photo.points(np.stack([columns + 0.5, rows + 0.5], 1))
    inside = cv2.erode(shadow.cover, np.ones((3, 3)))[rows, columns] > 0.99
    colors = np.where(inside[:, None], 0.5 * shadow.factors, 0.5)
    above = points + np.array([0, 0, 0.1])
    scene = Spheres(
        torch.as_tensor(np.concatenate([points, above])).float(),
        torch.full((2 * len(points),), 1e-4),
        torch.full((2 * len(points),), 0.9),
        torch.as_tensor(np.concatenate([colors, colors])).float(),
    )
    lifted = ground_module._lifted(scene, photo, shadow)
    assert lifted.colors[: len(points)][inside].numpy() == pytest.approx(0.5, abs=1e-3)
    assert torch.equal(lifted.colors[len(points) :], scene.colors[len(points) :])
    hidden = ground_module._hidden(photo, [BOX])
    assert hidden.sum() * CELL**2 == pytest.approx(4 * HALF[0] * HALF[1], rel=0.1)
    bare = ground_module._inpainted(photo.colors, photo.seen, hidden)
    filled = ground_module._filled(scene, photo, hidden, bare)
    places = np.floor(photo.places(filled.means.double().numpy())).astype(int)
    ground = filled.means[:, 2].numpy() < 1e-6
    covered = np.zeros((CELLS, CELLS), bool)
    covered[places[ground, 1], places[ground, 0]] = True
    assert cv2.dilate(covered.astype(np.uint8), np.ones((3, 3)))[hidden].mean() > 0.95
    assert filled.colors[len(filled) - 50 :].min() > 0.2
    # they end below the ground: on it they would stand before the foot of a body
    new = filled.means[:, 2].numpy() < -1e-6
    depth = -filled.means[new, 2] / filled.scales[new]
    assert new.sum() > 50
    assert float((filled.opacities[new] * torch.exp(-0.5 * depth**2)).max()) < 0.2
    assert on_plane(filled.means[new], torch.tensor([0.0, 0, 1]), 0.0, filled.scales[new], 0.1).all()
