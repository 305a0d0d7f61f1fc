"""States of segments from several starts, flights that begin in a hand, and turns of a ball at the ground."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.physics.parameters import FRICTION
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.segments import release_detection
from cgwm.pipeline.segments.impacts.bounces import LIMITS as BOUNCE
from cgwm.pipeline.segments.impacts.bounces import BounceSide, _turns, bounces_in
from cgwm.pipeline.segments.release_detection import LIMITS, _rotation_chi2, held_starts, without_held
from cgwm.pipeline.segments.segment_states import (
    DRAW_SPREAD,
    DRAWS,
    _draws,
    _merged,
    _placed,
    _put,
    _searched,
    best_of,
    costs_of,
    fit_states,
)
from cgwm.pipeline.segments.segments import PARAMETER_STEP, Segments
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.segmentation import Segment
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.worlds import F64, ball_body, world_of

RATE_HZ, FRAMES = 100.0, 14
NONE = torch.zeros(0, dtype=F64)


def flights(count: int = 3, last: tuple[int, ...] = ()) -> Segments:
    """Exactly measured flights of a ball, each with its own velocity and spin, in their true states."""
    t, episodes = np.arange(FRAMES) / RATE_HZ, []
    for k in range(count):
        velocity, spin = np.array([0.8, -0.3 * k, 1.2 + k]), 5.0 + 2 * k
        position = np.array([0.1, 0.2 * k, 1.5]) + t[:, None] * velocity
        position[:, 2] -= 0.5 * 9.81 * t**2
        quat = np.stack([np.cos(0.5 * spin * t), 0 * t, 0 * t, np.sin(0.5 * spin * t)], -1)
        episodes.append((str(k), {"ball": Track(t, position, quat)}))
    world = world_of(ball_body(), ground=False)
    whole = Observations.of(world, episodes, [(0.0, 9.0)] * count)
    ends = last or (FRAMES - 1,) * count
    return Segments.of("flight", world, whole, [Segment(k, 0, end) for k, end in enumerate(ends)], Noise(1e-3, 1e-2))


def moved(segments: Segments, sizes: list[float]) -> State:
    """Return the states of the segments, each with its velocity changed."""
    state = segments.observations.state
    change = torch.tensor(sizes, dtype=F64)[:, None, None] * torch.tensor([0.3, -0.2, 0.1], dtype=F64)
    return replace(state, velocity_m_s=state.velocity_m_s + change)


def test_each_segment_takes_the_start_that_fits_it_best() -> None:
    truth = flights()
    assert float(costs_of(truth, (), NONE).max()) < 1e-9
    given = truth.with_state(moved(truth, [0.0, 1.0, 2.0]))
    others = [moved(truth, [1.0, 0.0, 1.0]), moved(truth, [2.0, 2.0, 0.5])]
    for values in (NONE, torch.zeros(3, 0, dtype=F64)):
        found = best_of(given, others, (), values).observations.state
        torch.testing.assert_close(found.velocity_m_s, moved(truth, [0.0, 0.0, 0.5]).velocity_m_s)
        torch.testing.assert_close(found.position_m, truth.observations.state.position_m)
    assert best_of(truth, others, (), NONE).observations.state.velocity_m_s.equal(truth.observations.state.velocity_m_s)


def test_states_are_found_from_others_and_do_not_depend_on_the_other_segments() -> None:
    truth = flights()
    away = truth.with_state(moved(truth, [1.0, -1.0, 0.4]))
    found = fit_states(away)
    torch.testing.assert_close(
        found.observations.state.velocity_m_s, truth.observations.state.velocity_m_s, atol=1e-4, rtol=0
    )
    for k in range(3):
        alone = fit_states(away.select([k])).observations.state
        torch.testing.assert_close(alone.velocity_m_s[0], found.observations.state.velocity_m_s[k], atol=1e-9, rtol=0)
    given = fit_states(away, iterations=0, also=[truth.observations.state])
    torch.testing.assert_close(given.observations.state.velocity_m_s, truth.observations.state.velocity_m_s)
    cost = costs_of(away, (), NONE)
    searched, least = _searched(away, cost, [0, 2], (), NONE, 0, thorough=False)
    assert float(least[1]) == float(cost[1]) and float(least[[0, 2]].max()) < 1e-2
    torch.testing.assert_close(costs_of(searched, (), NONE), least)
    torch.testing.assert_close(searched.observations.state.velocity_m_s[1], away.observations.state.velocity_m_s[1])
    own, far = costs_of(truth, (), NONE), truth.with_state(moved(truth, [1.0, 1.0, 1.0]))
    kept, least = _searched(truth, own, [1], (), NONE, 0, thorough=True)  # nothing is better than the truth
    assert bool((least <= own + 1e-12).all()) and float(costs_of(kept, (), NONE).max()) < 1e-6
    choice = _merged(torch.tensor([True, False, True]), far, truth).observations.state.velocity_m_s
    torch.testing.assert_close(choice, moved(truth, [1.0, 0.0, 1.0]).velocity_m_s)
    placed = _placed(truth, [2, 0], far.select([2, 0])).observations.state.velocity_m_s
    torch.testing.assert_close(placed, moved(truth, [1.0, 0.0, 1.0]).velocity_m_s)
    assert _put(torch.arange(4.0), [3, 1], torch.tensor([9.0, 8.0])).tolist() == [0.0, 8.0, 2.0, 9.0]


def test_draws_spread_by_the_noise_of_a_state_between_two_frames() -> None:
    some = flights(2)
    drawn = _draws(some, 3)
    assert drawn.shape == (DRAWS, 2, 12) and torch.equal(drawn[:, 0], drawn[:, 1])
    size = drawn[:, 0].square().mean(0).sqrt().unflatten(0, (4, 3)).square().mean(1).sqrt()
    noise = torch.tensor([1e-3, 1e-2, 1e-3 * RATE_HZ, 1e-2 * RATE_HZ], dtype=F64)
    torch.testing.assert_close(size, DRAW_SPREAD * noise, rtol=0.25, atol=0.0)
    assert not torch.equal(drawn, _draws(some, 4))


def test_a_slope_is_finite_where_a_moved_rollout_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    some = flights(2)
    rows = some.residuals([], NONE, jacobian=False)[0]
    drag = replace(FRICTION, prior=(0.3, 0.5))
    beyond = torch.stack([torch.full_like(rows, torch.inf), -torch.inf * torch.ones_like(rows), rows + 1.0])
    monkeypatch.setattr(Segments, "residuals", lambda *_, **__: (beyond.flatten(0, 1), None))
    found = some.slopes([drag], torch.zeros(3, 1, dtype=F64), [0, 0, 0], rows)
    assert (found[..., :2] == 0).all()
    torch.testing.assert_close(found[..., 2], torch.full_like(rows, 1 / (PARAMETER_STEP * 0.5)))


def test_two_frames_leave_no_degree_of_freedom() -> None:
    some = flights(3, (1, 2, FRAMES - 1))
    axes = some.observations.measured_axes.sum(-1)[:, 0].tolist()
    assert some.dof.tolist() == [0.0, axes[1] + 3.0, (axes[2] + 3.0) * (FRAMES - 2)]
    chi2 = _rotation_chi2(some)
    assert bool(chi2[0].isnan()) and float(chi2[1:].max()) < 1e-9


def rotations(
    release: dict[int, int], ends: dict[int, int], known: tuple[int, ...] = (), hand: float = 50.0
) -> dict[int, int]:
    """Return where flights are found to leave hands, of which the rotations in a hand have a large chi-square.

    Args:
        release: First free frame, by episode.
        ends: Frames at the end of a flight that something else touches, by episode.
        known: Episodes that were found before.
        hand: Chi-square of a flight with frames in a hand.
    """
    items = [Segment(k, 0, 29) for k in range(6)]
    items[3] = Segment(3, 4, 29)  # frames before it are in contact: no beginning
    seen = torch.ones(6, 30, 1, dtype=F64)
    seen[4, :2] = 0
    items[4] = Segment(4, 2, 29)
    items[5] = Segment(5, 0, 3)
    whole: Any = SimpleNamespace(seen=seen)

    def chi2(flight: Any) -> torch.Tensor:
        held = [
            1.0 + hand * max(release.get(item.episode, 0) - item.first, 0)
            + hand * max(item.last - (29 - ends.get(item.episode, 0)), 0)
            for item in flight.items
        ]  # fmt: skip
        return torch.tensor(held, dtype=F64)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(release_detection, "_rotation_chi2", chi2)
        patch.setattr(release_detection, "_fitted", lambda flight, whole, some: SimpleNamespace(items=some))
        return held_starts(SimpleNamespace(items=items), whole, known)  # type: ignore[arg-type]


def test_a_flight_that_is_right_without_its_first_frames_begins_in_a_hand() -> None:
    assert rotations({}, {}) == {}
    assert rotations({0: 3}, {}) == {0: 3}
    assert rotations({0: 3, 1: 1}, {}) == {0: 3, 1: 1}
    assert rotations({4: 5}, {}) == {4: 5}  # the first measured frame is a beginning
    assert rotations({3: 6}, {}) == {}  # others are not
    assert rotations({2: 3}, {2: 3}) == {}  # what lasts to the end is no hand
    most = min(15, 30 - LIMITS.least_free)
    assert rotations({0: most}, {}) == {0: most} and rotations({0: most + 1}, {}) == {}
    assert rotations({5: 1}, {}) == {}  # too short
    slight = 1.02 * (LIMITS.free_chi2 - 1)
    assert LIMITS.free_chi2 < LIMITS.held_chi2
    assert rotations({0: 1}, {}, hand=slight) == {}
    found = {0: 1} if 1 + slight >= LIMITS.skew else {}
    assert rotations({0: 1}, {}, known=(0,), hand=slight) == found
    assert rotations({0: 1}, {}, hand=max(1.02 * (LIMITS.held_chi2 - 1), LIMITS.skew)) == {0: 1}


def test_frames_before_a_release_count_as_not_measured() -> None:
    whole = flights(2).observations
    held = without_held(whole, {1: 4})
    assert held.seen[:, :, 0].sum(1).tolist() == [FRAMES, FRAMES - 4] == held.has_orientation[:, :, 0].sum(1).tolist()
    assert not held.seen[1, :4].any() and bool(whole.seen.all())


def side(heights: list[float], times: np.ndarray | None = None) -> BounceSide:
    h = np.array(heights)
    t = 0.01 * np.arange(len(h)) if times is None else times
    return BounceSide(time_s=t, height_m=h, position_m=np.column_stack([0 * t, 0 * t, h]))


def test_a_turn_is_a_lowest_frame_between_a_fall_and_a_rise_that_are_fast_enough() -> None:
    """Speeds are those of the two frames beside the lowest one and its neighbour; frames need not be evenly spaced."""
    times = np.cumsum([0.0, 0.004, 0.006, 0.003, 0.005, 0.004, 0.007])

    def turns(fall: float, rise: float, low: float = 0.001, first: int = 0) -> list[int]:
        h = np.zeros(7)
        h[3] = low
        h[2], h[1] = low + 0.002, low + 0.002 + fall * (times[2] - times[1])
        h[4], h[5] = low + 0.001, low + 0.001 + rise * (times[5] - times[4])
        h[0], h[6] = h[1] + 0.5, h[5] + 0.5  # frames farther away do not matter
        return _turns(side(h[first:].tolist(), times[first:]))

    slow, share = BOUNCE.slowest_m_s, BOUNCE.least_rise
    assert turns(2.0, 1.0) == [3] and turns(2.0, 1.0, first=1) == [2]
    assert turns(1.02 * slow, slow) == [3] and turns(0.98 * slow, slow) == []
    assert turns(2.0, 2.04 * share) == [3] and turns(2.0, 1.96 * share) == []
    reach = BOUNCE.near_m + 2.0 * max(times[3] - times[2], times[4] - times[3])
    assert turns(2.0, 1.0, low=0.99 * reach) == [3] and turns(2.0, 1.0, low=1.01 * reach) == []
    assert turns(2.0, 1.0, low=-0.99 * reach) == [3] and turns(2.0, 1.0, low=-1.01 * reach) == []


def test_the_flights_of_a_bounce_end_before_the_contacts_of_its_neighbours() -> None:
    """Frames every 2 ms of a ball that bounces every 0.1 s, one of them on the ground at each bounce."""
    t = 0.002 * np.arange(201)
    since = (t + 0.05) % 0.1
    heights = 0.5 * 9.81 * since * (0.1 - since)
    frames = side(heights.tolist(), t)
    turns = _turns(frames)
    assert np.allclose(t[turns], [0.05, 0.15, 0.25, 0.35])
    found = list(bounces_in(7, frames, 9.81))
    assert len(found) == 4 and all(one.episode == 7 for one in found)
    for one, at in zip(found, t[turns], strict=True):
        for part, sign in ((one.before, -1), (one.after, 1)):
            assert (np.sign(part.time_s) == sign).all() and np.abs(part.time_s).min() > BOUNCE.apart_s
            assert np.abs(part.time_s).min() < BOUNCE.apart_s + 0.0021
            others = np.abs(part.time_s[:, None] + at - t[turns])
            assert others[:, :].min() > BOUNCE.apart_s
            np.testing.assert_allclose(part.height_m, np.interp(part.time_s + at, t, heights), atol=1e-12)
            np.testing.assert_allclose(part.position_m[:, 2], part.height_m)
            ends = {-1: max(at - 0.1, 0.0), 1: min(at + 0.1, t[-1])}[sign]
            assert (
                abs(np.abs(part.time_s).max() - (abs(ends - at) - (BOUNCE.apart_s if 0 < ends < t[-1] else 0))) < 0.0041
            )
    few = side(heights[:27].tolist(), t[:27])
    assert list(bounces_in(0, few, 9.81)) == []  # one frame after the bounce is no flight
