"""Which spheres a tile shows: blocks of tiles find the pairs that all tiles find one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from cgwm.pipeline.rendering.contact_sheets import resized
from cgwm.pipeline.rendering.render import RenderOutput
from cgwm.pipeline.rendering.tiles import _cones_meet, _meet
from helpers.worlds import F64


@pytest.mark.parametrize("shape", [(3, 5), (9, 4), (17, 20)])
def test_blocks_of_tiles_find_what_each_tile_finds(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    rows, columns = shape
    v, u = np.meshgrid(np.linspace(-0.8, 0.8, rows), np.linspace(-1.0, 1.0, columns), indexing="ij")
    axes = torch.as_tensor(np.stack([u, v, np.ones_like(u)], -1))
    axes = axes / axes.norm(dim=-1, keepdim=True)
    half = torch.as_tensor(rng.uniform(0.02, 0.06, shape))
    direction = torch.as_tensor(rng.normal(size=(40, 3)) + np.array([0.0, 0.0, 1.5]))
    direction = direction / direction.norm(dim=-1, keepdim=True)
    cone = torch.as_tensor(rng.uniform(0.0, 0.2, 40))
    cone[3] = math.pi  # a camera within a sphere sees it everywhere
    tile, sphere = _meet(axes, half, direction, cone)
    found = set(zip(tile.tolist(), sphere.tolist(), strict=True))
    angle = torch.acos((axes.reshape(-1, 3) @ direction.T).clamp(-1, 1))
    inside = angle <= half.reshape(-1, 1) + cone
    assert found == {tuple(pair) for pair in inside.nonzero().tolist()} and len(found) == len(tile)
    assert {k for k, n in found if n == 3} == set(range(rows * columns))
    for k in range(rows * columns):  # nearest first in each tile
        mine = sphere[tile == k]
        assert bool((mine.diff() > 0).all())


def test_cones_meet_where_their_angles_reach_each_other() -> None:
    axes = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64)
    for angle in (0.3, 2.0, 3.0):
        direction = torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]], dtype=F64)
        for half, cone, meets in (
            (0.1, angle - 0.1 + 1e-9, True),
            (0.1, angle - 0.1 - 1e-9, False),
            (0.0, math.pi, True),
        ):
            tile, place = _cones_meet(axes, torch.tensor([half], dtype=F64), direction, torch.tensor([cone], dtype=F64))
            assert (len(tile) == len(place) == 1) is meets


def test_depth_is_that_of_what_is_seen() -> None:
    alpha = torch.tensor([[[0.0, 0.5, 0.25]]], dtype=F64)
    weighted = torch.tensor([[[0.0, 1.5, 0.5]]], dtype=F64, requires_grad=True)
    seen = RenderOutput(features=alpha[..., None], alpha=alpha, weighted_depth=weighted)
    assert seen.depth.tolist() == [[[0.0, 3.0, 2.0]]]
    (slope,) = torch.autograd.grad(seen.depth.sum(), weighted)
    assert slope.tolist() == [[[0.0, 2.0, 4.0]]]


def test_a_smaller_picture_is_made_of_means_of_areas() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (12, 8, 3), dtype=np.uint8)
    means = image.reshape(6, 2, 4, 2, 3).mean((1, 3))
    assert np.abs(resized(image, (4, 6)).astype(float) - means).max() <= 1
    larger = resized(image, (16, 24)).astype(float)
    assert larger.shape == (24, 16, 3) and abs(larger.mean() - image.mean()) < 3
    # between two neighbours a larger picture has values between theirs
    line = np.repeat(np.array([[0, 200]], np.uint8), 2, 0)
    row = resized(line, (8, 2))[0].astype(int)
    assert row[0] == 0 and row[-1] == 200 and (np.diff(row) >= 0).all() and 0 < row[3] < row[4] < 200
