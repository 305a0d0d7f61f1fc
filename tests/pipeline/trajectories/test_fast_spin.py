"""Motion that turns by far more than half a turn within a few frames."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.spin import require_told_spin
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.geometry.rotation import continuous_turns, quat_exp, quat_log, quat_multiply
from cgwm.pipeline.physics import State, World, world_of_model
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.trajectories.initial_state import estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import InputDataError
from helpers.small_model import HALF, small_model

RATE_HZ = 100.0
AXIS = torch.tensor([0.6, 0.0, 0.8]).double()


def spun(turn_rad: float, frames: int) -> tuple[World, Track, torch.Tensor]:
    """Return a world, the track of a cube that spins in flight by an angle a frame, and its angular velocity."""
    world = world_of_model(small_model())
    omega = turn_rad * RATE_HZ * AXIS
    state = State(
        torch.tensor([[[0.0, 0.0, 3 * HALF + 1.0]]]).double(),
        quat_exp(torch.tensor([[[0.3, -0.2, 0.5]]]).double()),
        torch.tensor([[[0.4, 0.1, 1.0]]]).double(),
        omega[None, None],
    )
    times = np.arange(frames) / RATE_HZ
    rollout = roll_out(world, state, torch.tensor(times))
    return world, Track(times, rollout.position_m[0, :, 0].numpy(), rollout.quat_wxyz[0, :, 0].numpy()), omega


@pytest.mark.parametrize("turn_rad", [0.3, 1.1, 2.0, 0.8 * math.pi])
def test_the_state_of_a_spinning_body_is_found(turn_rad: float) -> None:
    world, track, omega = spun(turn_rad, 12)
    name = world.bodies[0].name
    seen = Observations.of(world, [Episode("a", {name: track})], [(0.0, 1.0)])
    assert torch.allclose(seen.state.omega_body_rad_s[0, 0], omega, rtol=1e-2)
    found, _ = estimate_states(world, seen, warmup_frames(world, seen, 0.1), Noise(1e-4, 1e-3))
    assert torch.allclose(found.state.omega_body_rad_s[0, 0], omega, rtol=1e-3)


def test_the_measured_spin_of_a_centroid_is_its_start() -> None:
    """Without orientations the spin's columns are along the world's axes; with them the turns count alone."""
    world, track, omega = spun(0.5, 12)
    spins = np.tile(omega.numpy(), (12, 1))
    name = world.bodies[0].name
    for orientation, expected in ((None, omega), (track.quat_wxyz, omega)):
        given = spins if orientation is None else 0 * spins
        measured = replace(track, quat_wxyz=orientation, omega_body_rad_s=given)
        seen = Observations.of(world, [Episode("a", {name: measured})], [(0.0, 1.0)])
        assert torch.allclose(seen.state.omega_body_rad_s[0, 0], expected, rtol=1e-2)
        found, _ = estimate_states(world, seen, warmup_frames(world, seen, 0.1), Noise(1e-4, 1e-3))
        assert torch.allclose(found.state.omega_body_rad_s[0, 0], expected, rtol=1e-2)
    silent = Observations.of(world, [Episode("a", {name: replace(track, quat_wxyz=None)})], [(0.0, 1.0)])
    assert not silent.state.omega_body_rad_s.any() and silent.spin_rad_s is None


def test_turns_go_on_beyond_half_a_turn_and_equal_the_logarithm_below() -> None:
    times = torch.arange(9).double() / RATE_HZ
    base, known, middle = quat_exp(torch.tensor([0.3, -0.2, 0.5]).double()), torch.ones(9).double(), torch.tensor(4)
    for rate in (20.0, 70.0, 240.0):
        quat = quat_multiply(base, quat_exp(rate * times[:, None] * AXIS))
        turns = continuous_turns(times, quat, known, middle)
        assert torch.allclose(turns, rate * (times - times[4])[:, None] * AXIS, atol=1e-9)
        mirrored = continuous_turns(times, -quat, known, middle)  # the same rotations
        assert torch.allclose(turns, mirrored)
    slow = quat_multiply(base, quat_exp(20.0 * times[:, None] * AXIS))
    assert torch.equal(
        continuous_turns(times, slow, known, torch.tensor(0)),
        quat_log(quat_multiply(slow[:1] * torch.tensor([1.0, -1.0, -1.0, -1.0]).double(), slow)),
    )


def test_frames_without_an_orientation_take_no_part() -> None:
    times = torch.arange(9).double() / RATE_HZ
    quat = quat_exp(150.0 * times[:, None] * AXIS)
    quat[3] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    known = torch.ones(9).double()
    known[3] = 0.0
    turns = continuous_turns(times, quat, known, torch.tensor(0))
    assert torch.allclose(turns[known > 0], 150.0 * times[known > 0][:, None] * AXIS, atol=1e-9)


@pytest.mark.parametrize(("turn_rad", "needed_hz"), [(0.85 * math.pi, 144), (0.95 * math.pi, 132)])
def test_a_spin_that_cannot_be_told_is_refused_with_the_frame_rate_needed(
    tmp_path: Path, turn_rad: float, needed_hz: int
) -> None:
    _, track, _ = spun(turn_rad, 12)
    with pytest.raises(InputDataError, match=rf"(?s)a.csv: body 'cube' turns by .* record at {needed_hz} frames/s"):
        require_told_spin(tmp_path / "a.csv", "cube", track)


def test_orientations_that_are_wrong_are_no_spin() -> None:
    _, track, _ = spun(1.1, 400)
    quat = np.random.default_rng(0).standard_normal((400, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    require_told_spin(Path("a.csv"), "cube", replace(track, quat_wxyz=quat))


def test_single_jumps_and_gaps_are_no_spin() -> None:
    _, track, _ = spun(1.1, 12)
    assert track.quat_wxyz is not None
    quat = track.quat_wxyz.copy()
    quat[5] = quat[5, [1, 0, 3, 2]] * [-1, 1, -1, 1]  # a flipped marker: two wrong turns
    require_told_spin(Path("a.csv"), "cube", replace(track, quat_wxyz=quat))
    kept = np.arange(0, 12, 3)  # three frames a step: 189 deg, but these steps are the usual ones
    with pytest.raises(InputDataError):
        require_told_spin(
            Path("a.csv"),
            "cube",
            replace(
                track, time_s=track.time_s[kept], position_m=track.position_m[kept], quat_wxyz=track.quat_wxyz[kept]
            ),
        )
