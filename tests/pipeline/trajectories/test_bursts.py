"""Bursts of wrong measurements in flights: rows that the frames around them contradict, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.trajectories.bursts import bursts, filled_by_cubics, without_grounded_bursts
from cgwm.pipeline.trajectories.flight_noise import without_outliers
from cgwm.pipeline.trajectories.segmentation import cut_episodes, whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import NOISE, tosses, world_with

Episodes = list[tuple[str, dict[str, Track]]]


def flights(effects: dict | None = None, seed: int = 3) -> tuple[object, Episodes]:
    truth = world_with("cube", effects, False)
    return world_with("cube", None, False), tosses(truth, seed, count=4, duration_s=0.4)


def track_of(episode: tuple[str, dict[str, Track]]) -> Track:
    return next(iter(episode[1].values()))


def found(world: object, episodes: Episodes) -> dict[tuple[int, int], list[int]]:
    """Return the frames of bursts by kind and episode."""
    whole = whole_episodes(world, episodes)  # pyright: ignore[reportArgumentType]
    flight, _, _ = cut_episodes(world, whole, NOISE)  # pyright: ignore[reportArgumentType]
    noise = Noise(*NOISE)
    return {
        (kind, episode): frames.tolist() for kind in (0, 1) for episode, frames, _ in bursts(whole, flight, noise, kind)
    }


@pytest.mark.parametrize("first", [13, 27])
def test_a_row_of_wrong_positions_is_found_and_no_other_frame(first: int) -> None:
    world, episodes = flights()
    rng = np.random.default_rng(first)
    track_of(episodes[1]).position_m[first : first + 5] += 12 * NOISE[0] * rng.standard_normal((5, 3))
    rows = found(world, episodes)
    assert set(rows) == {(0, 1)}
    assert set(rows[0, 1]) <= set(range(first, first + 5)) and len(rows[0, 1]) >= 4


def test_the_first_tenth_of_a_second_is_left_to_the_search_for_hands() -> None:
    world, episodes = flights()
    track_of(episodes[1]).position_m[6:9] += 12 * NOISE[0] * np.random.default_rng(1).standard_normal((3, 3))
    assert (0, 1) not in found(world, episodes)


def test_a_lasting_force_and_a_marker_beside_the_centre_are_no_bursts() -> None:
    assert not found(*flights())
    assert not found(*flights({"marker_offset": {"d_x": 0.01, "d_y": -0.01, "d_z": 0.005}}))
    assert not found(*flights({"quadratic_drag": {"k": 0.5}, "gravity_tilt": {"tilt_x": 0.05, "tilt_y": 0.0}}))


def test_a_push_within_a_flight_is_no_burst() -> None:
    world, episodes = flights()
    track = track_of(episodes[2])
    track.position_m[20:, 0] += 0.8 * (track.time_s[20:] - track.time_s[20])
    assert (0, 2) not in found(world, episodes)


def test_a_burst_near_others_does_not_count_as_a_touch() -> None:
    world, episodes = flights()
    rng = np.random.default_rng(0)
    for episode in episodes:
        track_of(episode).position_m[15:20] += 15 * NOISE[0] * rng.standard_normal((5, 3))
    whole = whole_episodes(world, episodes)  # pyright: ignore[reportArgumentType]
    flight, _, _ = cut_episodes(world, whole, NOISE)  # pyright: ignore[reportArgumentType]
    seen, count, touched = without_outliers(whole, flight, Noise(*NOISE))
    assert 16 <= count <= 20 and not bool(touched.any())
    assert not bool(seen.seen[:, 16:19].any(1).all())


@pytest.mark.parametrize(("wrong", "stops_s"), [((30, 36), 9.0), ((70, 75), 9.0), (None, 9.0), (None, 0.42)])
def test_a_burst_of_a_slide_is_left_out_and_where_it_stops_nothing_is(
    wrong: tuple[int, int] | None, stops_s: float
) -> None:
    world, episodes = flights()
    whole, rng = whole_episodes(world, [episodes[0]] * 2), np.random.default_rng(7)  # pyright: ignore[reportArgumentType]
    times = torch.arange(100, dtype=torch.float64) * 0.01
    slid = times.clamp_max(stops_s)
    place = (2.0 * slid - 1.5 * slid**2)[:, None] * torch.tensor([1.0, 0.3, 0.0])
    place = place.expand(2, -1, -1) + 5e-4 * torch.from_numpy(rng.standard_normal((2, 100, 3)))
    if wrong is not None:
        place[1, slice(*wrong)] += 6e-3 * torch.from_numpy(rng.standard_normal((wrong[1] - wrong[0], 3)))
    still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(2, 100, 1, 4)
    seen = torch.ones(2, 100, 1, dtype=torch.float64)
    slides = replace(
        whole,
        times_s=times.expand(2, -1),
        position_m=place[:, :, None],
        quat_wxyz=still,
        seen=seen,
        has_orientation=seen,
    )
    left = without_grounded_bursts(slides, torch.zeros(2, 100, dtype=torch.bool), Noise(*NOISE))
    lost = (left.seen[..., 0] == 0).nonzero().tolist()
    if wrong is None:
        assert not lost
    else:
        assert {episode for episode, _ in lost} == {1} and len(lost) >= 3
        assert {frame for _, frame in lost} <= set(range(*wrong))


def test_what_is_missing_of_a_cubic_is_filled_in_as_the_cubic_is_at_the_ends_too() -> None:
    rng = np.random.default_rng(2)
    times, powers = np.sort(rng.uniform(0, 1, 30)), rng.standard_normal((4, 2, 3))
    true = np.tensordot(np.vander(times, 4), powers, 1)
    known = rng.uniform(size=30) > 0.3
    known[[0, 1, 14, 15, 16, 29]] = False
    given = np.where(known[:, None, None], true, np.nan)
    np.testing.assert_allclose(filled_by_cubics(times, given, known), true, atol=1e-9)
