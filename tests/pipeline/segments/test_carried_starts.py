"""What is carried or pushed when a recording begins is seen by its acceleration, in each episode alone."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.segments.carried_starts import Beginning, _shape, _step, carried_ends, carried_starts
from cgwm.pipeline.segments.release_detection import find_releases, from_releases
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers import fixed_surfaces as fixed
from helpers.diagnosis_data import tosses, world_with
from helpers.worlds import ball_body, world_of

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


def caught(episodes: Episodes, frames: int, slowing_1_s: float) -> Episodes:
    """All tosses with a net or a hand that slows the body down over the last frames."""
    found = []
    for name, tracks in episodes:
        ((body, track),) = tracks.items()
        place, last = track.position_m.copy(), len(track) - 1 - frames
        velocity = (place[last] - place[last - 4]) / (track.time_s[last] - track.time_s[last - 4])
        since = track.time_s[last:, None] - track.time_s[last]
        place[last:] = place[last] + velocity * (1 - np.exp(-slowing_1_s * since)) / slowing_1_s
        found.append((name, {body: replace(track, position_m=place)}))
    return found


@pytest.mark.parametrize("slowing", [20.0, 60.0])
def test_what_ends_in_a_net_or_a_hand_is_left_out(slowing: float) -> None:
    world = world_with("ball")
    tracks, warnings = from_releases(world, caught(thrown(), 10, slowing), (None, None))
    free = [len(own["ball"]) for _, own in thrown()]
    assert all(-3 <= len(own["ball"]) - (count - 10) <= 1 for (_, own), count in zip(tracks, free, strict=True))
    assert len(warnings) == 6 and "ends in a hand or a net: for the last" in warnings[0]


@pytest.mark.parametrize(
    "effects", [{}, {"quadratic_drag": {"k": 0.3}}, {"magnus_lift": {"s": 0.02}}, {"gravity_scale": {"s": 0.2}}]
)
def test_a_flight_that_ends_in_the_air_was_not_caught(effects: Mapping[str, Mapping[str, float]]) -> None:
    world = world_with("ball")
    assert carried_ends(world, whole_episodes(world, thrown(effects)), NOISE) == {}


@pytest.mark.parametrize("width_s", [0.0, 0.01, 0.03])
def test_the_step_of_a_release_is_found_through_the_filter_that_rounds_it(width_s: float) -> None:
    """The path of an acceleration that ends, convolved with a normal density, beside a free flight."""
    times, release, size = np.arange(40) / 100, 0.12, 30.0
    fine = np.linspace(-6, 6, 2001)
    density = np.exp(-0.5 * fine**2) / np.exp(-0.5 * fine**2).sum()
    ahead = (release - times[:, None] + width_s * fine).clip(0.0)
    carried = size * (0.5 * ahead**2 @ density)
    np.testing.assert_allclose(size * _shape(release - times, width_s), carried, atol=1e-7)
    up, along = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8])
    places = 0.3 + times[:, None] * [1.0, 0.5, 2.0] - 0.5 * 9.81 * times[:, None] ** 2 * up + carried[:, None] * along
    begun = Beginning(episode=0, frames=np.arange(40), times_s=times, places_m=places, airborne=True, up=up)
    found = _step(begun, width_s)
    assert (found.release_s, found.size_m_s2) == (pytest.approx(release), pytest.approx(size, rel=1e-3))
    assert np.abs(found.residual_m).max() < 1e-5


@pytest.mark.parametrize("row", [-1, -2, 20])
def test_one_wrong_row_is_no_hand(row: int) -> None:
    world, episodes = world_with("ball"), thrown()
    track = episodes[2][1]["ball"]
    position = track.position_m.copy()
    position[row, 2] -= 0.07  # a number that was cut off
    wrong = [*episodes[:2], ("cut", {"ball": replace(track, position_m=position)}), *episodes[3:]]
    assert carried_starts(world, whole_episodes(world, wrong), NOISE) == {}


def test_a_ball_that_rocks_in_a_half_pipe_is_in_no_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    radius, pipe = 0.02, 0.08
    angles = np.linspace(-np.pi / 2, np.pi / 2, 61)
    ring = pipe * np.stack((np.sin(angles), 1 - np.cos(angles)), 1)
    vertices = np.concatenate([np.column_stack((np.full(61, x), ring)) for x in (-0.5, 0.5)])
    number = np.arange(60)[:, None]
    faces = np.concatenate((number + np.array([0, 1, 62]), number + np.array([0, 62, 61])))
    world = replace(world_of(ball_body(radius), ground=False), surfaces=(fixed.mesh_surface(vertices, faces),))
    time = np.arange(60) / 120
    arm, angle, speed, path = pipe - radius, 1.0, 0.0, []
    for _ in time:
        path.append((0.0, arm * np.sin(angle), pipe - arm * np.cos(angle)))
        for _ in range(100):  # as a pendulum, with the inertia of rolling
            speed -= 5 / 7 * 9.81 / arm * np.sin(angle) / 12000
            angle += speed / 12000
    track = Track(time, np.array(path) + 2e-4 * np.random.default_rng(0).standard_normal((60, 3)))
    seen = Observations.of(world, [Episode("rock", {"ball": track})], [(-1.0, 2.0)])
    assert carried_starts(world, seen, Noise(2e-4, 0.01)) == {}
    monkeypatch.setattr("cgwm.pipeline.segments.carried_starts._bends", lambda *_: False)
    assert carried_starts(world, seen, Noise(2e-4, 0.01)) != {}
