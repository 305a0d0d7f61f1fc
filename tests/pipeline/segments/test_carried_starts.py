"""What is carried or pushed when a recording begins is seen by its acceleration, in each episode alone."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.segments.carried_starts import Beginning, _shape, _step, carried_starts
from cgwm.pipeline.segments.release_detection import find_releases
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with

NOISE = Noise(3e-4, 1e-3)
RATE_HZ = 148.0
HELD_FRAMES = 9
UP = np.array([0.0, 0.0, 1.0])
Episodes = list[tuple[str, dict[str, Track]]]


def thrown(effects: Mapping[str, Mapping[str, float]] | None = None) -> Episodes:
    return tosses(world_with("ball", effects or {}), 3, 6, 0.3, RATE_HZ, NOISE, (0.6, 0.9))


def carried(episodes: Episodes, acceleration_m_s2: np.ndarray) -> Episodes:
    """All tosses with a hand that carries the body with an additional acceleration until the release."""
    found = []
    for name, tracks in episodes:
        ((body, track),) = tracks.items()
        before = np.clip(track.time_s[HELD_FRAMES] - track.time_s, 0, None)
        moved = track.position_m + 0.5 * before[:, None] ** 2 * acceleration_m_s2
        found.append((name, {body: replace(track, position_m=moved)}))
    return found


@pytest.mark.parametrize("acceleration", [9.81 * UP, np.array([12.0, -8.0, 15.0])], ids=["held still", "thrown"])
def test_releases_are_found_though_every_episode_begins_in_a_hand(acceleration: np.ndarray) -> None:
    world = world_with("ball")
    released, warnings = find_releases(world, carried(thrown(), acceleration), (None, None))
    assert len(released) == len(warnings) == 6
    for at in released.values():
        assert HELD_FRAMES / RATE_HZ <= at + 1e-9 <= (HELD_FRAMES + 4) / RATE_HZ


@pytest.mark.parametrize(
    "effects", [{}, {"quadratic_drag": {"k": 0.3}}, {"magnus_lift": {"s": 0.02}}, {"gravity_scale": {"s": 0.2}}]
)
def test_what_acts_all_along_the_flight_carries_nothing(effects: Mapping[str, Mapping[str, float]]) -> None:
    world = world_with("ball")
    assert carried_starts(world, whole_episodes(world, thrown(effects)), NOISE) == {}


def test_a_step_down_is_the_rounded_beginning_of_an_impact() -> None:
    world = world_with("ball")
    assert carried_starts(world, whole_episodes(world, carried(thrown(), -20.0 * UP)), NOISE) == {}


def test_a_rounded_step_is_the_step_smoothed_by_a_normal_density() -> None:
    before, width = np.array([-0.03, -0.004, 0.0, 0.006, 0.05]), 0.01
    offsets = np.linspace(-8, 8, 4001) * width
    density = np.exp(-0.5 * (offsets / width) ** 2)
    smoothed = (0.5 * (before[:, None] - offsets).clip(0) ** 2) @ density / density.sum()
    np.testing.assert_allclose(_shape(before, width), smoothed, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(_shape(before, 1e-9), _shape(before, 0.0), atol=1e-15)


@pytest.mark.parametrize("width_s", [0.0, 0.004])
def test_a_step_of_acceleration_is_found_exactly_where_nothing_else_moves(width_s: float) -> None:
    times, added = np.arange(40) / RATE_HZ, np.array([3.0, -2.0, 14.0])
    flight = np.array([0.1, 0.2, 1.0]) + times[:, None] * [1.0, 0.5, 2.0] - 0.5 * 9.81 * times[:, None] ** 2 * UP
    places = flight + _shape(times[HELD_FRAMES] - times, width_s)[:, None] * added
    one = Beginning(episode=0, frames=np.arange(40), times_s=times, places_m=places, airborne=True, up=UP)
    step = _step(one, width_s)
    assert step.release_s == times[HELD_FRAMES]
    assert step.size_m_s2 == pytest.approx(np.linalg.norm(added), rel=1e-9)
    np.testing.assert_allclose(step.residual_m, 0.0, atol=1e-12)
    # that of a least-squares fit beside a parabola, for errors of 1 m
    shape = _shape(times[HELD_FRAMES] - times, width_s)
    columns = np.column_stack([np.vander(times, 3), shape])
    assert step.known_m_s2 == pytest.approx(np.sqrt(np.linalg.inv(columns.T @ columns)[3, 3]), rel=1e-6)
    nothing = _step(replace(one, places_m=flight), width_s)
    assert nothing.size_m_s2 < 1e-9
