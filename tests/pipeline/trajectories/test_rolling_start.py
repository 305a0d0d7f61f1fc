"""Spins of balls that begin in contact and whose turns nobody measured."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.physics import engine
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.initial_state import estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.rolling_start import rolling_items, rolling_spins
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers import fixed_surfaces as fixed
from helpers.worlds import F64, ball_body, box_body, law, state_of, times, world_of

RADIUS, SLOPE = 0.02, math.radians(20)
DOWN, NORMAL = (math.cos(SLOPE), 0.0, -math.sin(SLOPE)), (math.sin(SLOPE), 0.0, math.cos(SLOPE))


def _slope(friction: float = 0.4) -> World:
    plane = fixed.half_space(quat=fixed.turn((0, 1, 0), math.degrees(SLOPE)))
    world = world_of(ball_body(RADIUS), ground=False)
    return replace(world, surfaces=(plane,), contact=law(friction, 0.003, 1.0))


def _spin(world: World, place: tuple, velocity: tuple) -> list[float]:
    place, velocity = (torch.tensor([one], dtype=F64) for one in (place, velocity))
    return rolling_spins(world, place, velocity)[0].tolist()


@pytest.mark.parametrize("friction", [0.4, 0.05, 0.0])
def test_a_ball_on_a_slope_rolls_or_has_the_spin_that_its_friction_gave_it(friction: float) -> None:
    at, speed = tuple(RADIUS * x for x in NORMAL), 0.5
    # from rest: the velocity grows by g sin a - mu g cos a, the spin by 5/2 mu g cos a / r
    needed = 2 / 7 * math.tan(SLOPE)
    share = 1.0 if friction > needed else 2.5 * friction / (math.tan(SLOPE) - friction)
    found = _spin(_slope(friction), at, tuple(speed * x for x in DOWN))
    assert found == pytest.approx([0.0, share * speed / RADIUS, 0.0], abs=1e-9)
    # a velocity away from the surface does not count
    away = tuple(speed * x + 0.1 * y for x, y in zip(DOWN, NORMAL, strict=True))
    assert _spin(_slope(friction), at, away) == pytest.approx(found)


def test_a_ball_in_a_groove_turns_about_a_line_through_both_contacts() -> None:
    world = replace(world_of(ball_body(RADIUS), ground=False), surfaces=(fixed.mesh_surface(*fixed.groove()),))
    place, apart = (0.5, 0.0, RADIUS * math.sqrt(2)), (0.5, 0.0, RADIUS * math.sqrt(2) + 0.01)
    assert _spin(world, place, (0.4, 0, 0)) == pytest.approx([0, 0.4 / (RADIUS / math.sqrt(2)), 0], abs=1e-9)
    assert _spin(world, apart, (0.4, 0, 0)) == [0, 0, 0]


def _rolls(world: World, friction: float, turned: bool) -> tuple[Observations, torch.Tensor]:
    """Return the track of a ball that rolls from a speed of 0.5 m/s, and its true state at the first frame."""
    speed = 0.5
    start = state_of(
        (
            tuple((RADIUS - 2e-5) * x for x in NORMAL),
            (1, 0, 0, 0),
            tuple(speed * x for x in DOWN),
            (0, speed / RADIUS, 0),
        )
    )
    made = engine.rollout(replace(world, contact=law(friction, 0.003, 1.0)), start, times(0.4, 100))
    noise = 3e-4 * torch.randn(41, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    quat = made.quat_wxyz[0, :, 0].numpy() if turned else None
    track = Track(times(0.4, 100).numpy(), (made.position_m[0, :, 0] + noise).numpy(), quat)
    return Observations.of(world, [Episode("roll", {"ball": track})], [(-1.0, 1.0)]), made.position_m[0, :, 0]


def test_a_start_without_turns_is_a_roll_and_predicts_where_the_ball_rolls() -> None:
    world, noise = _slope(), Noise(3e-4, 0.01)
    seen, path = _rolls(world, 0.4, turned=False)
    warm = warmup_frames(world, seen, 0.1)
    assert rolling_items(world, seen, warm).tolist() == [True]
    found, _ = estimate_states(world, seen, warm, noise, 5)
    spin = float(found.state.omega_body_rad_s[0, 0, 1])
    assert spin == pytest.approx(0.5 / RADIUS, rel=0.05)
    predicted = engine.rollout(world, found.state, seen.times_s[0]).position_m[0, :, 0]
    # the velocity is known to 0.3 mm / (0.03 s * sqrt(11)) = 3 mm/s
    assert float((predicted - path).norm(dim=-1).max()) < 3 * 0.003 * 0.4
    measured, _ = _rolls(world, 0.4, turned=True)
    assert rolling_items(world, measured, warm).tolist() == [False]


def test_bodies_that_are_no_balls_or_fly_do_not_roll() -> None:
    world = _slope()
    seen, _ = _rolls(world, 0.4, turned=False)
    warm = warmup_frames(world, seen, 0.1)
    lifted = replace(seen, position_m=seen.position_m + 0.02 * torch.tensor(NORMAL, dtype=F64))
    assert rolling_items(world, lifted, warm).tolist() == [False]
    assert rolling_items(replace(world, bodies=(box_body(),)), seen, warm).tolist() == [False]
