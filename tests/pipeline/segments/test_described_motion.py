"""A model that describes nothing is told first: nothing touches what should, or a resting body is nearer."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.physics.world import Body, World
from cgwm.pipeline.segments.described_motion import _sentence, _supported, not_described
from cgwm.pipeline.trajectories.initial_state import clearance
from cgwm.pipeline.trajectories.observations import Observations
from helpers.diagnosis_data import NOISE, tosses, world_with
from helpers.worlds import ball_body, batch

DRAG, ROLLING = {"quadratic_drag": {"k": 0.5}}, {"rolling_resistance": {"c_r": 0.005}}


def lowered(world: World, by_m: float) -> World:
    assert world.ground_offset is not None
    return replace(world, ground_offset=world.ground_offset - by_m)


@pytest.mark.parametrize(("body", "effects"), [("cube", {}), ("ball", {}), ("ball", DRAG), ("ball", ROLLING)])
def test_a_model_that_lacks_an_effect_describes_the_motion(body: str, effects: dict) -> None:
    episodes = tosses(world_with(body, effects), 4, count=4, duration_s=0.7)
    assert not_described(world_with(body), episodes, NOISE) is None


def test_flight_alone_is_described_without_contact() -> None:
    episodes = tosses(world_with("ball", DRAG, ground=False), 5, count=4, duration_s=0.7)
    assert not_described(world_with("ball"), episodes, NOISE) is None


def test_a_ground_that_is_too_low_or_missing_is_the_likely_cause() -> None:
    world = world_with("ball")
    episodes = tosses(world, 3, count=4, duration_s=0.7)
    low = not_described(lowered(world, 12.0), episodes, NOISE)
    assert low is not None and low.never_touches and "ground lies too low" in low.cause
    assert low.sentence.startswith("The model does not describe this motion: nothing touches anything in it")
    none = not_described(world_with("ball", ground=False), episodes, NOISE)
    assert none is not None and none.never_touches and "no ground, and no other body" in none.cause
    flights = tosses(world_with("ball", ground=False), 5, count=7, duration_s=0.3)
    assert not_described(world_with("ball", ground=False), [episodes[0], *flights], NOISE) is None


def test_a_body_that_falls_between_spheres_of_a_rail_is_told() -> None:
    """A ball rests on a row of spheres, of which the model has every fourth."""
    ball = ball_body(0.02)
    rail = row_of_spheres(0.01)
    world = replace(world_with("ball", ground=False), bodies=(ball, rail), step_s=0.008)
    times = np.arange(0, 0.3, 1 / 40)
    rng = np.random.default_rng(0)
    episodes = []
    for k in range(2):
        place = np.stack([0.05 * k + 0.3 * times, 0 * times, 0 * times + 0.03], 1)
        track = Track(times, place + rng.normal(0, 1e-4, place.shape), None)
        episodes.append((str(k), {"ball": track}))
    seen = Observations.of(world, episodes, [(-np.inf, np.inf)] * 2)
    torch.testing.assert_close(clearance(world, seen).abs().amax(), batch(0.0)[0], atol=1e-3, rtol=0)
    gaps = replace(world, bodies=(ball, row_of_spheres(0.08)))
    found = not_described(gaps, episodes, NOISE)
    assert found is not None and found.worse_than == "steady"
    assert "the colliding spheres of 'rail' leave gaps" in found.cause


def row_of_spheres(apart_m: float) -> Body:
    """A fixed body of spheres of 1 cm along x."""
    along = torch.arange(-0.08, 0.2, apart_m, dtype=torch.float64)
    centers = torch.stack([along, 0 * along, 0 * along], -1)[None]
    like = ball_body(0.01)
    place = batch((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    radii = torch.full((1, len(along)), 0.01, dtype=torch.float64)
    return replace(like, name="rail", motion="fixed", centers=centers, radii=radii, place=place)


def test_heights_that_stay_level_or_turn_at_once_show_a_support() -> None:
    times = torch.arange(0, 0.6, 0.01, dtype=torch.float64)
    falling = 3 * times - 4.905 * times**2
    assert not _supported(times, falling, 9.81) and not _supported(times[:3], 0 * times[:3], 9.81)
    assert _supported(times, 0 * times, 9.81)
    bounce = 2 * (times - 0.3).abs()
    assert _supported(times, bounce, 9.81)
    assert not _supported(times, -bounce, 9.81)  # turns from rising to falling
    assert not _supported(times, 3 * times + 5 * times**2, 9.81)  # rises ever faster


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((0.5, 0.1, "still", 0), "it is 0.5 m off, a body that stands still 0.1 m"),
        ((np.inf, 0.2, "steady", 0), "its rollout diverges, a body that keeps its velocity 0.2 m"),
        ((0.5, 0.1, None, 3), "nothing touches anything in it, while the tracks show contact in 3 of the episodes"),
    ],
)
def test_the_sentence_says_what_describes_the_motion_better(numbers: tuple, said: str) -> None:
    sentence = _sentence(*numbers, "a wrong ground")
    assert sentence == f"The model does not describe this motion: {said}. Likely cause: a wrong ground."
