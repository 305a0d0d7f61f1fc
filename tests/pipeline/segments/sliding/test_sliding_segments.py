"""Sliding segments: windows, jumps and tilting of known size, cuts, and states that are put on the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply, quat_to_matrix
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.segments import Segments
from cgwm.pipeline.segments.sliding.segments import (
    LIMITS,
    SIDE_FRAMES,
    SIDE_S,
    _impacts,
    _parts,
    _SeenFrames,
    _tilting,
    find_sliding_segments,
    grounded_states,
)
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.segmentation import Segment, heights_of, size_of, whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.worlds import F64, ball_body, box_body, world_of

RATE_HZ, HALF_M = 100.0, 0.03
NOISE = Noise(1e-5, 1e-5)
TIMES = np.arange(60) / RATE_HZ
ALL = np.ones(60, bool)
SEEN = _SeenFrames(torch.arange(60), TIMES, [slice(0, 60)])
BOX, BALL = world_of(box_body()), world_of(ball_body(HALF_M))
UP = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def measured(world: World, height_m: np.ndarray, turn: np.ndarray | None = None) -> Observations:
    """Return one episode of a body at heights above its resting one, turned by rotation vectors (T, 3) [rad]."""
    position = np.column_stack([0.4 * TIMES, 0 * TIMES, HALF_M + height_m])
    quat = quat_exp(torch.as_tensor(np.zeros((len(TIMES), 3)) if turn is None else turn)).numpy()
    return whole_episodes(world, [Episode("a", {world.bodies[0].name: Track(TIMES, position, quat)})])


def test_windows_reach_equally_far_on_both_sides() -> None:
    times = np.delete(TIMES, [20, 21])
    side = max(SIDE_FRAMES, round(SIDE_S * RATE_HZ))
    track, seen = _SeenFrames(torch.arange(58), times, [slice(0, 58)]), []
    for places, frames, t in track.windows(ALL[:58]):
        for place, window, away in zip(places.tolist(), frames.tolist(), t, strict=True):
            seen.append(place)
            near = np.flatnonzero(np.abs(times - times[place]) < (side + 0.5) / RATE_HZ)
            assert window == near.tolist()
            np.testing.assert_allclose(away, times[near] - times[place])
    assert sorted(seen) == list(range(len(times)))
    slow = np.arange(20) * 0.05  # at least three frames on each side, however slow
    track = _SeenFrames(torch.arange(20), slow, [slice(0, 20)])
    assert max(frames.shape[1] for _, frames, _ in track.windows(ALL[:20])) == 2 * SIDE_FRAMES + 1
    both = _SeenFrames(torch.arange(80), np.append(TIMES, slow), [slice(0, 60), slice(60, 80)])  # each by itself
    found = dict(
        pair for places, frames, _ in both.windows(np.ones(80, bool)) for pair in zip(places, frames, strict=True)
    )
    assert found[59].tolist() == [55, 56, 57, 58, 59]
    assert found[60].tolist() == [60, 61, 62, 63]
    chosen = np.zeros(80, bool)
    chosen[[59, 70]] = True
    assert np.flatnonzero(both.beside(chosen)).tolist() == [58, 59, 69, 70, 71]


@pytest.mark.parametrize(("world", "share", "found"), [(BALL, 1.05, True), (BALL, 0.95, False), (BOX, 1.05, True)])
def test_a_jump_of_the_speed_is_an_impact_with_the_frames_beside_it(world: World, share: float, found: bool) -> None:
    kink = share * LIMITS.jump_m_s * np.maximum(TIMES - TIMES[30], 0.0)
    whole = measured(world, kink + 2 * TIMES**2)
    at = np.flatnonzero(_impacts(world.bodies[0], UP, whole, SEEN, NOISE, ALL))
    assert (at.tolist() == [29, 30, 31]) if found else (len(at) == 0)
    asked = ALL & (np.arange(60) < 30)  # only the frame before the jump knows of it
    at = np.flatnonzero(_impacts(world.bodies[0], UP, whole, SEEN, NOISE, asked)[:30])
    assert at.tolist() == [29] * found
    noisy = Noise(share * NOISE.position_m * 1e3, NOISE.rotation_rad)  # what noise may do is none
    assert not _impacts(world.bodies[0], UP, whole, SEEN, noisy, ALL).any()
    edge = measured(world, 9 * LIMITS.jump_m_s * np.maximum(TIMES - TIMES[1], 0.0))
    assert not _impacts(world.bodies[0], UP, edge, SEEN, NOISE, ALL)[:1].any()


@pytest.mark.parametrize(("share", "found"), [(1.05, True), (0.95, False)])
def test_a_jump_of_the_tilting_is_an_impact_of_a_body_with_edges(share: float, found: bool) -> None:
    rate = share * LIMITS.jump_m_s / size_of(BOX.bodies[0])
    tilt = np.outer(rate * np.maximum(TIMES - TIMES[30], 0.0), [0.6, 0.8, 0.0])
    at = np.flatnonzero(_impacts(BOX.bodies[0], UP, measured(BOX, 0 * TIMES, tilt), SEEN, NOISE, ALL))
    assert (at.tolist() == [29, 30, 31]) if found else (len(at) == 0)
    spin = np.outer(5 * rate * np.maximum(TIMES - TIMES[30], 0.0), [0.0, 0.0, 1.0])
    assert not _impacts(BOX.bodies[0], UP, measured(BOX, 0 * TIMES, spin), SEEN, NOISE, ALL).any()
    assert not _impacts(BALL.bodies[0], UP, measured(BALL, 0 * TIMES, 5 * tilt), SEEN, NOISE, ALL).any()
    unknown = measured(BOX, 0 * TIMES, tilt)
    unknown = replace(unknown, has_orientation=0 * unknown.has_orientation)
    assert not _impacts(BOX.bodies[0], UP, unknown, SEEN, NOISE, ALL).any()


@pytest.mark.parametrize(("share", "found"), [(1.03, True), (0.97, False)])
def test_a_body_that_tilts_turns_over_an_edge(share: float, found: bool) -> None:
    tilt = np.outer(share * LIMITS.tilting_rad_s * TIMES, [0.6, 0.8, 0.0])
    assert _tilting(UP, measured(BOX, 0 * TIMES, tilt), SEEN, NOISE.rotation_rad, ALL).all() == found
    spin = np.outer(9 * TIMES, [0.0, 0.0, 1.0])
    assert not _tilting(UP, measured(BOX, 0 * TIMES, spin), SEEN, NOISE.rotation_rad, ALL).any()
    assert not _tilting(UP, measured(BOX, 0 * TIMES, tilt), SEEN, 0.05, ALL).any()
    few = measured(BOX, 0 * TIMES, tilt)
    marks = torch.zeros_like(few.has_orientation)
    marks[:, ::6] = 1  # at most two in a window
    assert not _tilting(UP, replace(few, has_orientation=marks), SEEN, NOISE.rotation_rad, ALL).any()
    marks[:, ::3] = 1
    some = _tilting(UP, replace(few, has_orientation=marks), SEEN, NOISE.rotation_rad, ALL)
    assert bool(some[8:-8].any()) == found


def test_steady_stretches_are_cut_at_gaps_and_into_equal_parts() -> None:
    times = np.arange(200) / RATE_HZ
    steady = np.ones(200, np.bool_)
    steady[10], steady[150:] = False, False
    assert _parts(times, steady, LIMITS.longest_s) == [(11, 57), (57, 103), (103, 149)]  # 1.38 s in three
    short = np.zeros(200, np.bool_)
    least = round(LIMITS.shortest_s * RATE_HZ)
    short[20 : 20 + least + 2], short[90 : 90 + least - 1] = True, True
    assert _parts(times, short, LIMITS.longest_s) == [(20, 20 + least + 1)]
    late = times + 0.5 * (np.arange(200) >= 40)
    assert _parts(late, np.arange(200) < 80, LIMITS.longest_s) == [(0, 39), (40, 79)]


def test_a_body_slides_while_it_is_on_the_ground_between_impacts() -> None:
    whole = measured(BOX, 1.05 * LIMITS.jump_m_s * np.maximum(TIMES - TIMES[50], 0.0))
    clear = torch.zeros(1, len(TIMES), dtype=torch.bool)
    (found,) = find_sliding_segments(BOX, whole, clear, NOISE)
    assert (found.episode, found.first, found.last) == (0, 0, 48)
    clear[0, :20] = True
    (late,) = find_sliding_segments(BOX, whole, clear, NOISE)
    assert (late.first, late.last) == (20, 48)
    hidden = whole.seen.clone()
    hidden[0, :30] = 0
    turned = whole.has_orientation * hidden
    (some,) = find_sliding_segments(BOX, replace(whole, seen=hidden, has_orientation=turned), clear, NOISE)
    assert (some.first, some.last) == (30, 48)
    assert find_sliding_segments(replace(BOX, ground_normal=None), whole, clear, NOISE) == []
    above = measured(BOX, 0 * TIMES + 1.2 * LIMITS.near_m)
    assert find_sliding_segments(BOX, above, 0 * clear, NOISE) == []
    assert len(find_sliding_segments(BOX, measured(BOX, 0 * TIMES + 0.9 * LIMITS.near_m), 0 * clear, NOISE)) == 2
    nothing = replace(whole, seen=0 * whole.seen, has_orientation=0 * whole.has_orientation)
    assert find_sliding_segments(BOX, nothing, 0 * clear, NOISE) == []


def test_states_are_put_on_the_ground_in_their_mean_orientation() -> None:
    normal = torch.nn.functional.normalize(torch.tensor([0.1, -0.2, 1.0], dtype=F64), dim=0)
    world = replace(BOX, ground_normal=normal, ground_offset=torch.tensor([0.2], dtype=F64))
    whole = measured(world, 0 * TIMES, np.outer(np.ones(len(TIMES)), [0.05, -0.1, 0.7]))
    segments = Segments.of("contact", world, whole, [Segment(0, 0, 20)], NOISE)
    state = segments.observations.state
    bent = quat_multiply(quat_exp(torch.tensor([0.02, 0.03, -0.4], dtype=F64)), state.quat_wxyz)
    shaken = replace(state, quat_wxyz=bent, velocity_m_s=state.velocity_m_s + 0.3)
    found = grounded_states(segments, shaken)
    placed = replace(whole, position_m=found.position_m[:, None], quat_wxyz=found.quat_wxyz[:, None])
    placed = replace(placed, has_orientation=torch.ones(1, 1, 1, dtype=F64))
    assert float(heights_of(world, world.bodies[0], placed, 0).min()) == pytest.approx(0.0, abs=1e-12)
    # the normal in body axes is that of the measured frames, and the turn about it is that of the state
    up = quat_to_matrix(found.quat_wxyz[0, 0]).T @ normal
    torch.testing.assert_close(up, quat_to_matrix(whole.quat_wxyz[0, 3, 0]).T @ normal)
    turned = quat_multiply(found.quat_wxyz[0, 0], bent[0, 0] * torch.tensor([1.0, -1, -1, -1], dtype=F64))
    assert float(turned[1:] @ normal) == pytest.approx(0.0, abs=1e-9)  # the shortest turn is about a level axis
    along = found.velocity_m_s[0, 0]
    assert float(along @ normal) == pytest.approx(0.0, abs=1e-12)
    before = shaken.velocity_m_s[0, 0]
    torch.testing.assert_close(along, before - (before @ normal) * normal)
    shift = found.position_m[0, 0] - shaken.position_m[0, 0]
    torch.testing.assert_close(shift, (shift @ normal) * normal)
    torch.testing.assert_close(found.omega_body_rad_s, shaken.omega_body_rad_s)
