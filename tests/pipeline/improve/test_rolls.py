"""Errors of rolls on fixed surfaces, by which an addition is judged."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.improve.held_out_errors import _open_loop_errors
from cgwm.pipeline.physics import engine
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers import fixed_surfaces as fixed
from helpers.worlds import ball_body, law, state_of, times, world_of

RADIUS, NOISE = 0.02, Noise(3e-4, 0.01)


def test_a_wrong_tilt_shows_in_whole_rolls_in_units_of_the_noise() -> None:
    world = world_of(ball_body(RADIUS), contact=law(0.4, 0.003, 1.0), ground=False)
    world, tilted = (
        replace(world, surfaces=(fixed.half_space(quat=fixed.turn((0, 1, 0), degrees)),)) for degrees in (5.0, 5.5)
    )
    down, up = np.array([np.cos(a := np.radians(5.0)), 0, -np.sin(a)]), np.array([np.sin(a), 0, np.cos(a)])
    start = state_of((tuple(RADIUS * up), (1, 0, 0, 0), tuple(0.2 * down), (0, 0.2 / RADIUS, 0)))
    made = engine.rollout(world, start, times(1.0, 60)).position_m[0, :, 0].numpy()
    noisy = made + NOISE[0] * np.random.default_rng(0).standard_normal(made.shape)
    whole = Observations.of(world, [Episode("roll", {"ball": Track(times(1.0, 60).numpy(), noisy)})], [(-1.0, 2.0)])
    right, wrong = (_open_loop_errors(one, whole, SimpleNamespace(noise=NOISE))["roll"] for one in (world, tilted))
    # the start is known to 0.3 mm / (0.03 s sqrt(7)) = 4 mm/s, 13 times the noise after 1 s; half a degree makes 30 mm
    assert right < 13 and wrong > 3 * right
