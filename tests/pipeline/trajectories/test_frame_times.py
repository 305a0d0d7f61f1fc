"""Times that scatter about a regular clock are put on it where the motion follows it; wrong times are measured."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.frame_times import with_regular_times
from cgwm.pipeline.trajectories.innovations import WHITE, CorrelatedNoise, NoiseModel, body_innovations
from cgwm.pipeline.trajectories.segmentation import Segment, whole_episodes
from cgwm.pipeline.trajectories.time_errors import time_errors, without_time_errors
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import world_with

Said = Callable[[list[Episode]], list[Episode]]
STEP_S, NOISE_M, JITTER_S = 1 / 240, 2e-4, 5e-4


def throws(seed: int, exposed: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> list[Episode]:
    """Return throws of a point in which some frames are lost; `exposed`: exposures, by the times of a clock."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(6):
        clock = STEP_S * np.flatnonzero(rng.uniform(size=100) > 0.1)
        t = exposed(clock, rng)
        v = rng.uniform((-2, -2, 3), (2, 2, 5))
        path = np.array([0, 0, 3.0]) + t[:, None] * v + 0.5 * t[:, None] ** 2 * np.array([0, 0, -9.81])
        found.append(Episode(f"{k}", {"ball": Track(clock, path + rng.normal(0, NOISE_M, path.shape))}))
    return found


def scattered(episodes: list[Episode]) -> list[Episode]:
    rng = np.random.default_rng(9)

    def moved(track: Track) -> Track:
        return Track(track.time_s + rng.normal(0, JITTER_S, len(track.time_s)), track.position_m)

    return [Episode(name, {body: moved(track) for body, track in tracks.items()}) for name, tracks in episodes]


def rounded(episodes: list[Episode]) -> list[Episode]:
    """Return times in whole milliseconds."""
    return [Episode(n, {"ball": replace(t["ball"], time_s=np.round(t["ball"].time_s, 3))}) for n, t in episodes]


def regular(clock: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return clock


def late(clock: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return clock + rng.normal(0, JITTER_S, len(clock))


@pytest.mark.parametrize("said", [scattered, rounded])
def test_times_that_scatter_are_put_on_the_clock_that_the_motion_follows(said: Said) -> None:
    made = throws(1, regular)
    found, warnings = with_regular_times(said(made), {"ball"})
    assert len(warnings) == 1 and "240 Hz" in warnings[0]
    for (_, tracks), (_, true) in zip(found, made, strict=True):
        away = tracks["ball"].time_s - true["ball"].time_s
        assert np.abs(away).max() < 0.5 * JITTER_S and np.ptp(np.diff(away)) < 1e-5


def test_what_logs_its_own_times_keeps_them() -> None:
    made = [
        Episode(n, t | {"robot": replace(t["ball"], time_s=t["ball"].time_s + 1e-4), "pad": t["ball"]})
        for n, t in scattered(throws(7, regular))
    ]
    (_, tracks), *_ = with_regular_times(made, {"ball"})[0]
    assert tracks["robot"] is made[0].tracks["robot"]
    np.testing.assert_array_equal(tracks["pad"].time_s, tracks["ball"].time_s)
    assert (tracks["ball"].time_s != made[0].tracks["ball"].time_s).any()


@pytest.mark.parametrize("bodies", [{"ball"}, {"other"}])
def test_right_times_stay(bodies: set[str]) -> None:
    """Exposures that scatter, with their own times, are not put on a clock."""
    rng = np.random.default_rng(3)
    right = []
    for name, tracks in throws(3, regular):
        clock = tracks["ball"].time_s
        t = clock + rng.normal(0, JITTER_S, len(clock))
        path = t[:, None] * np.array([1.5, 0.5, 4.0]) + 0.5 * t[:, None] ** 2 * np.array([0, 0, -9.81])
        right.append(Episode(name, {"ball": Track(t, path + rng.normal(0, NOISE_M, path.shape))}))
    for episodes in (right, throws(4, regular)):
        found, warnings = with_regular_times(episodes, bodies)
        assert warnings == () and all(a is b for (_, a), (_, b) in zip(found, episodes, strict=True))


def test_wrong_times_of_exposures_are_measured_and_said_and_part_of_the_noise() -> None:
    """What is left of flights is of unit variance, and so are the numbers of an effect that is not there."""
    world = world_with("ball")
    prepared = prepare(world, throws(5, late), (None, None))
    assert prepared.time_error_s == pytest.approx(JITTER_S, rel=0.15)
    assert prepared.noise.position_m == pytest.approx(NOISE_M, rel=0.2)
    assert any("0.5 ms" in text and "trigger the shutter" in text for text in prepared.warnings)
    assert prepared.flight is not None
    rows = prepared.flight.residuals([], world.gravity.new_zeros(0), jacobian=False)[0]
    assert float(rows.square().sum() / prepared.flight.dof.sum()) == pytest.approx(1.0, abs=0.15)
    plain = prepare(world, throws(6, regular), Noise(NOISE_M, 0.01))
    assert plain.time_error_s == 0.0


@pytest.mark.parametrize("smeared", [True, False])
def test_smeared_ends_of_flights_are_no_errors_of_times(smeared: bool) -> None:
    world, rng = world_with("ball"), np.random.default_rng(11)
    episodes = throws(8, regular if smeared else late)
    if smeared:
        for _, tracks in episodes:
            path = tracks["ball"].position_m
            path[-9:] += np.gradient(path[-9:], STEP_S, axis=0) * 4 * JITTER_S * rng.standard_normal((9, 1))
    whole = whole_episodes(world, episodes)
    flights = [Segment(k, 0, len(tracks["ball"].time_s) - 1) for k, (_, tracks) in enumerate(episodes)]
    assert time_errors(whole, flights)[0] == (0.0 if smeared else pytest.approx(JITTER_S, rel=0.15))


@pytest.mark.parametrize(
    "memory",
    [WHITE, NoiseModel(CorrelatedNoise(0.6, 0.02, 1.2, 1.5, 0.3, 30.0, order=1.5), CorrelatedNoise(0.5, 0.01))],
)
def test_residuals_without_errors_of_times_are_independent_and_of_unit_variance(memory: NoiseModel) -> None:
    """The covariance is that of tracking plus s^2 of each frame's velocity and angular velocity, of two bodies."""
    rng = torch.Generator().manual_seed(0)
    frames, bodies, size = 7, 2, 7 * 2 * 6
    times = torch.cumsum(0.002 + 0.01 * torch.rand(2, frames, generator=rng, dtype=torch.float64), 1)
    masks = torch.ones(2, frames, bodies, 2, dtype=torch.float64)
    masks[0, 3, 0, 0] = masks[1, -2:] = 0.0
    shifts = torch.randn(2, frames, bodies, 6, generator=rng, dtype=torch.float64) * masks.repeat_interleave(3, -1)
    unit = torch.eye(size, dtype=torch.float64).unflatten(0, (frames * bodies, 6)).expand(2, -1, -1, -1)
    tracked = body_innovations(unit, times, masks, memory)
    whitened = without_time_errors(tracked, shifts, times, masks, memory).reshape(2, size, size)
    root = torch.linalg.inv(tracked.reshape(2, size, size))
    moved = (shifts[..., None] * torch.eye(frames).to(shifts)[:, None, None]).reshape(2, size, frames)
    covariance = root @ root.mT + moved @ moved.mT
    torch.testing.assert_close(whitened @ covariance @ whitened.mT, torch.eye(size).to(shifts).expand(2, -1, -1))
