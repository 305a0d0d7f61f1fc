"""Effects of one's own that docs/real-data.md works through: faces that are not flat, the height of a tracker."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from cgwm.pipeline.physics import World, simulate
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.effects.effect import changed_by_effects
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.observation_model import as_measured
from helpers.diagnosis_data import world_with
from helpers.worlds import F64, box_body, law, state_of, times, world_of

EXAMPLES = Path(__file__).resolve().parents[4] / "docs" / "real-data"
STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def with_effect(world: World, file: str, **values: float) -> World:
    return replace(world, effects=(ActiveEffect.of(load_effect(f"{EXAMPLES / file}"), values),))


def test_a_box_whose_corners_stand_out_stands_on_them() -> None:
    half, out = 0.05, 2e-4
    plain = world_of(box_body((half, half, half)), contact=law(0.3, 0.004, 0.8), step_s=0.002)
    warped = with_effect(plain, "face_warp.py:FaceWarp", z_minus_even=out)
    before = plain.bodies[0].centers[0]
    moved = changed_by_effects(warped).bodies[0].centers[0] - before
    chosen = (before[:, 2] < 0) & (before[:, 0] * before[:, 1] > 0)
    assert torch.allclose(moved, torch.tensor([0.0, 0.0, -out], dtype=F64) * chosen[:, None])
    # tipped over to either side of its diagonal, it comes to rest on three corners there
    tilts = []
    for side in (1.0, -1.0):
        start = state_of(((0, 0, half + 1e-3), (1.0, 0.01 * side, 0.01 * side, 0.0), *STILL))
        quat = rollout(warped, start, times(1.0, 50.0)).quat_wxyz[0, -1, 0]
        tilts.append(float(2 * (quat[1] + quat[2]) / 2**0.5))
    assert np.allclose(tilts, np.array([1, -1]) * out / (half * 2**0.5), rtol=0.05)


def test_a_frame_that_is_too_high_lifts_positions_alone() -> None:
    world = with_effect(world_with("cube"), "frame_height.py:FrameHeight", h=0.002)
    start = state_of(((0, 0, 0.4), (1.0, 0.0, 0.0, 0.0), *STILL))
    true = simulate(world, start, times(0.1, 50.0))
    seen = as_measured(world, true, times(0.1, 50.0))
    assert torch.allclose(seen.position_m - true.position_m, torch.tensor([0.0, 0.0, 0.002], dtype=F64))
    assert torch.equal(seen.quat_wxyz, true.quat_wxyz)


def test_spheres_may_be_each_items_own() -> None:
    world = world_with("cube")
    body = world.bodies[0]
    centers = body.centers * torch.tensor([1.0, 1.02], dtype=F64)[:, None, None]
    own = replace(world, bodies=(replace(body, centers=centers),))
    start = state_of(((0, 0, 0.1), (1.0, 0.1, 0.2, 0.0), *STILL), count=2)
    fast, slow = (run(own, start, times(0.4, 50.0)).position_m for run in (rollout, simulate))
    assert torch.allclose(fast, slow, atol=1e-9) and not torch.allclose(fast[0], fast[1])
