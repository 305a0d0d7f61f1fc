"""Rollouts of batches of different lengths: the same motion, and fewer frames."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from cgwm.pipeline.physics import Rollout, State, simulate
from cgwm.pipeline.physics.effects.effect import ActiveEffect
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.physics.engine import LEAST_SAVED, length_groups, ragged_rollout
from cgwm.pipeline.physics.observation_model import measure
from helpers.worlds import F64, ball_body, state_of, world_of


def test_items_of_one_length_stay_together() -> None:
    assert length_groups([7, 7, 7], 10**6) == [([0, 1, 2], 7)]


def test_groups_are_few_and_save_frames() -> None:
    lengths = [5, 50, 5, 5, 49]
    assert length_groups(lengths, 10**6) == [([0, 2, 3], 5), ([1, 4], 50)]
    assert length_groups(lengths, LEAST_SAVED // 200) == [([0, 1, 2, 3, 4], 50)]  # it saves 135 frames a repeat


def test_the_motion_is_the_same_up_to_each_end_and_then_keeps_its_last_frame() -> None:
    world = world_of(ball_body(), step_s=0.01)
    state = State.joined(*(state_of(((0, 0, 1 + 0.1 * k), (1, 0, 0, 0), (k, 0, 0), (0, k, 1))) for k in range(3)))
    lengths, repeats = [3, 9, 4], LEAST_SAVED // 10 + 1  # a second group saves ten frames a repeat
    times = (torch.arange(9, dtype=F64) / 100).repeat(3, 1)
    every, rolled = state.repeat(repeats), []

    def roll(items: list[int], frames: int) -> Rollout:
        rolled.append((items, frames))
        rows = torch.arange(3 * repeats).view(repeats, 3)[:, items].flatten()
        return simulate(world, every.at(rows), times.repeat(repeats, 1)[rows, :frames])

    found = ragged_rollout(times.repeat(repeats, 1), lengths, repeats, roll)
    whole = simulate(world, state, times)
    assert rolled == [([0, 2], 4), ([1], 9)]
    for name in ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s"):
        values, expected = getattr(found, name).unflatten(0, (repeats, 3)), getattr(whole, name)
        for item, end in ((0, 4), (1, 9), (2, 4)):
            assert torch.equal(values[:, item, :end], expected[item, :end].expand(repeats, -1, -1, -1))
            assert torch.equal(values[:, item, end:], values[:, item, end - 1 : end].expand(-1, 9 - end, -1, -1))


@pytest.mark.parametrize("varied", ["nothing", "contact_time", "clock_scale"])
def test_times_whose_rows_repeat_need_not_be_repeated(varied: str) -> None:
    world = world_of(ball_body(), step_s=0.01)
    rows = torch.linspace(0.9, 1.1, 6, dtype=F64)
    if varied == "contact_time":
        world = replace(world, contact=replace(world.contact, contact_time_s=0.02 * rows))
    elif varied == "clock_scale":
        clock = ActiveEffect.of(load_effect("clock_scale"), {}, world.gravity[0, :1])
        world = replace(world, effects=(replace(clock, values={"s": rows - 1}),))
    state = State.joined(*(state_of(((0, 0, 0.1 + 0.1 * k), (1, 0, 0, 0), (k, 0, 0), (0, k, 1))) for k in range(6)))
    times = torch.arange(9, dtype=F64) / 50 * torch.tensor([[1.0], [1.5]], dtype=F64)
    for roll in (measure, simulate):
        if roll is simulate and varied == "clock_scale":
            continue  # an effect of the measurement
        short, full = roll(world, state, times), roll(world, state, times.repeat(3, 1))
        assert torch.equal(short.position_m, full.position_m)
        assert torch.equal(short.omega_body_rad_s, full.omega_body_rad_s)
        assert not torch.equal(full.position_m[0], full.position_m[1])
