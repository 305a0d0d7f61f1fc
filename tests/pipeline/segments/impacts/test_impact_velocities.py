"""Flights are followed from impact to impact by heights alone, and extrapolated to the ground on both sides."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.geometry.rotation import quat_exp, quat_to_matrix
from cgwm.pipeline.segments.impacts.velocities import (
    LIMITS,
    _chains,
    _Hops,
    _measurable,
    _neighbours,
    _on_ground,
    measured_impacts,
)
from cgwm.pipeline.trajectories.segmentation import Segment, whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.worlds import F64, ball_body, batch, box_body, world_of

FALL, RATE_HZ, NOISE_M = 9.81, 200.0, 1e-4
TIMES = np.arange(0, 2.0, 1 / RATE_HZ)


def landings(first_m_s: float = 2.5, rebound: float = 0.7, begin_s: float = -0.0525) -> list[float]:
    """Return the times at which flights from the ground begin, each slower than the last."""
    found, speed = [begin_s], first_m_s
    while found[-1] < TIMES[-1]:
        found.append(found[-1] + 2 * speed / FALL)
        speed *= rebound
        if speed < 0.02:
            break
    return found


def heights(ends: list[float]) -> np.ndarray:
    """Return the heights of a ball that leaves the ground at given times and lands at the next."""
    height = np.zeros_like(TIMES)
    for start, end in itertools.pairwise(ends):
        inside = (TIMES >= start) & (TIMES <= end)
        height[inside] = 0.5 * FALL * (TIMES[inside] - start) * (end - TIMES[inside])
    return height


def frames_between(start: float, end: float) -> tuple[int, int]:
    inside = np.flatnonzero((TIMES >= start) & (TIMES < end - 1e-4))
    return int(inside[0]), int(inside[-1])


def expected(ends: list[float], first: int) -> list[tuple[int, int]]:
    """Return the frames of the flights, the first from a given frame on, until one has too few."""
    found = [(first, frames_between(ends[0], ends[1])[1])]
    for start, end in itertools.pairwise(ends[1:]):
        a, b = frames_between(start + LIMITS.contact_s, min(end, TIMES[-1] + 2e-4))
        if b - a + 1 < LIMITS.min_frames:
            break
        found.append((a, b))
    return found


def test_flights_are_followed_from_impact_to_impact() -> None:
    ends = landings()
    rng = np.random.default_rng(0)
    for noise in (0.0, NOISE_M):
        hops = _Hops(TIMES, heights(ends) + noise * rng.normal(size=len(TIMES)), FALL, NOISE_M)
        chain = hops.chain(2, 9)
        assert chain == expected(ends, 2) and len(chain) >= 6
        assert all(b - a + 1 >= LIMITS.min_frames for a, b in chain)
    assert hops.chain(2, 2 + LIMITS.min_frames - 2) == []


def test_a_chain_ends_where_a_flight_is_no_parabola_or_its_landing_is_unseen() -> None:
    ends = landings()
    plain = expected(ends, 2)
    disturbed = heights(ends)
    middle = sum(plain[2]) // 2
    disturbed[middle : plain[2][1] + 1] += 20 * NOISE_M
    assert _Hops(TIMES, disturbed, FALL, NOISE_M).chain(2, 9) == plain[:2]
    cut = plain[1][1] - 2
    seen = _Hops(TIMES[: cut + 1], heights(ends)[: cut + 1], FALL, NOISE_M)
    assert seen.chain(2, 9) == [plain[0], (plain[1][0], cut)]
    a, b, landing = _Hops(TIMES, heights(ends), FALL, NOISE_M)._grown(2, 9) or (0, 0, 0.0)
    assert (a, b) == plain[0] and landing == pytest.approx(ends[1], abs=1e-9)
    unseen = seen._grown(plain[1][0], cut)
    assert unseen is not None and unseen[2] == np.inf
    assert _Hops(TIMES, heights(ends) - 3.0, FALL, NOISE_M)._grown(20, 60) is None  # it never comes that low


def test_neighbours_are_counted_through_all_chains() -> None:
    one = Segment(0, 0, 1)
    assert _neighbours([[one] * 3, [one], [one] * 2]) == [(0, 1), (1, 2), (4, 5)]
    assert _neighbours([]) == []


def test_chains_skip_hidden_frames_and_flights_that_an_earlier_one_reaches() -> None:
    world = world_of(ball_body(0.03))
    ends = landings()
    position = np.zeros((len(TIMES), 3))
    position[:, 2] = heights(ends) + 0.03
    unmoved = Track(TIMES, np.tile([0.0, 0.0, 3.0], (len(TIMES), 1)), None)
    both = [Episode("0", {"ball": replace(unmoved, position_m=position)}), Episode("1", {"ball": unmoved})]
    whole = whole_episodes(world, both)
    seen = whole.seen.clone()
    seen[0, [5, 6, 40]] = 0
    whole = replace(whole, seen=seen)
    flights: Any = SimpleNamespace(items=[Segment(0, 2, 9), Segment(0, 110, 125)])
    prepared: Any = SimpleNamespace(observations=whole, noise=Noise(NOISE_M, 1e-3))
    (chain,) = _chains(prepared, world, flights)
    assert [(item.episode, item.first, item.last) for item in chain] == [(0, a, b) for a, b in expected(ends, 2)]


def test_impacts_are_measured_of_one_ball_above_a_ground_with_orientation() -> None:
    ball = world_of(ball_body(0.03))

    def measurable(world: Any, free: tuple[int, ...] = (0,), turned: bool = True) -> bool:
        prepared: Any = SimpleNamespace(observations=SimpleNamespace(free=free), has_orientation=turned)
        return _measurable(prepared, world)

    assert measurable(ball)
    assert not measurable(ball, turned=False)
    assert not measurable(replace(ball, ground_normal=None))
    assert not measurable(world_of(box_body()))
    assert not measurable(world_of(ball_body(0.03), ball_body(0.03, name="other")), free=(0, 1))
    assert not measurable(world_of(ball_body(0.03), ball_body(0.03, name="other")))
    grounded: Any = SimpleNamespace(observations=SimpleNamespace(free=(0,)), has_orientation=True, flight=None)
    assert measured_impacts(grounded, ball) is None


NORMAL = torch.tensor([0.6, 0.0, 0.8], dtype=F64)
OFFSET_M, RADIUS_M = 0.2, 0.03


def motion_of(times: torch.Tensor, com: torch.Tensor, meets_s: float) -> tuple[Any, Any, dict[str, torch.Tensor]]:
    """Return a ball that flies without turning its axes and meets a tilted ground at a time, and what is true then."""
    gravity = -9.81 * NORMAL
    spin, spun_up = torch.tensor([3.0, -2.0, 5.0], dtype=F64), torch.tensor([1.0, 4.0, -2.0], dtype=F64)
    quat = quat_exp(torch.tensor([0.3, 0.2, -0.5], dtype=F64))
    turn = quat_to_matrix(quat)
    arm = turn @ com
    touching = torch.tensor([0.1, 0.4, 0.0], dtype=F64)
    touching = touching + (OFFSET_M + RADIUS_M - touching @ NORMAL) * NORMAL
    velocity = torch.tensor([0.5, -0.3, 0.0], dtype=F64) - (2.0 if meets_s > 0 else -1.5) * NORMAL
    since = (times - meets_s)[:, None]
    omega = spin + spun_up * since
    com_velocity = velocity + gravity * since
    motion = SimpleNamespace(
        position_m=(touching + velocity * since + 0.5 * gravity * since**2)[None, :, None],
        quat_wxyz=quat.expand(1, len(times), 1, 4),
        velocity_m_s=(com_velocity - torch.linalg.cross(omega, arm.expand_as(omega)))[None, :, None],
        omega_body_rad_s=(omega @ turn)[None, :, None],
    )
    body = replace(ball_body(RADIUS_M), com=com[None])
    world = replace(world_of(body), ground_normal=NORMAL, ground_offset=batch(OFFSET_M))
    every = SimpleNamespace(world=world, observations=SimpleNamespace(times_s=times[None]))
    true = {"place": touching - RADIUS_M * NORMAL, "twist": torch.cat([velocity, spin])}
    return every, motion, true


@pytest.mark.parametrize(("meets_s", "at", "towards"), [(0.024, 2, -1), (-0.007, 0, 1)])
def test_flights_are_extrapolated_to_the_ground(meets_s: float, at: int, towards: int) -> None:
    times = torch.tensor([0.0, 0.01, 0.02], dtype=F64)
    every, motion, true = motion_of(times, torch.zeros(3, dtype=F64), meets_s)
    found = _on_ground(every, motion, 0, torch.tensor([at]), towards)[0]
    assert float(found[0]) == pytest.approx(meets_s, abs=1e-12)
    torch.testing.assert_close(found[1:4], true["place"], atol=1e-12, rtol=0)
    torch.testing.assert_close(found[4:], true["twist"], atol=1e-10, rtol=0)


def test_twists_are_those_of_the_centre_of_mass() -> None:
    times = torch.tensor([0.0, 0.01, 0.02], dtype=F64)
    every, motion, true = motion_of(times, torch.tensor([0.004, -0.002, 0.003], dtype=F64), 0.02)
    found = _on_ground(every, motion, 0, torch.tensor([2]), -1)[0]
    assert float(found[0]) == pytest.approx(0.02, abs=1e-12)
    torch.testing.assert_close(found[1:4], true["place"], atol=1e-12, rtol=0)
    torch.testing.assert_close(found[4:], true["twist"], atol=1e-10, rtol=0)
