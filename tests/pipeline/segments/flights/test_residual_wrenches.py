"""Residual wrenches, beginnings, phases, contrasts and checks of the input, on numbers with known answers."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.diagnose.flight.omnibus import _noise_dof
from cgwm.pipeline.optimization.tails import chi2_tail
from cgwm.pipeline.segments import contact_phases as contact_phases_module
from cgwm.pipeline.segments.carried_starts import LIMITS as CARRIED
from cgwm.pipeline.segments.carried_starts import Beginning, Step, _shape, _spread, _step
from cgwm.pipeline.segments.contact_phases import LIMITS as PHASES
from cgwm.pipeline.segments.contact_phases import _round_share, _surface_speeds, contact_phases, is_round, phases_of
from cgwm.pipeline.segments.flights import residual_wrench
from cgwm.pipeline.segments.flights.contrasts import FRAMES, _spread_frames, moving
from cgwm.pipeline.segments.flights.residual_wrench import (
    BINS,
    COORDINATES,
    TERMS,
    WEAK_STD,
    ResidualWrenches,
    _bins,
    coordinates_of,
    covariates_of,
    dispersion,
    motion_axes,
    omnibus,
    sound_windows,
    unit_acceleration,
    wrench_windows,
)
from cgwm.pipeline.segments.flights.slow_errors import _level_axes
from cgwm.pipeline.segments.input_checks import LIMITS as INPUT
from cgwm.pipeline.segments.input_checks import _apart, _on_a_tilted_plane, _travel, _turns
from cgwm.pipeline.segments.thresholds import SEGMENT_THRESHOLDS
from cgwm.pipeline.trajectories.innovations import CorrelatedNoise, NoiseModel
from cgwm.pipeline.trajectories.segmentation import Segment, size_of
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.worlds import F64, ball_body, box_body, world_of
from scipy.spatial.transform import Rotation
from scipy.stats import f as fisher


def wrenches(wrench: np.ndarray, episode: np.ndarray, seed: int = 0) -> ResidualWrenches:
    rng = np.random.default_rng(seed)
    count = len(wrench)
    rows = rng.normal(size=(count, 12, 6))
    return ResidualWrenches(
        segments=tuple(SimpleNamespace(episode=k) for k in episode),  # pyright: ignore[reportArgumentType]
        wrench=wrench,
        information=rows.swapaxes(1, 2) @ rows,
        coordinates={"speed": rng.uniform(1, 3, count), "episode": episode.astype(float)},
        velocity=rng.normal(size=(count, 3)),
        omega=rng.normal(size=(count, 3)),
    )


def test_the_omnibus_test_is_chi_square_of_the_wrenches() -> None:
    rng = np.random.default_rng(1)
    found = wrenches(rng.normal(size=(20, 6)), np.arange(20) // 4)
    chi2 = sum(w @ m @ w for w, m in zip(found.wrench, found.information, strict=True))
    dof = sum(np.trace(m @ np.linalg.inv(m + np.eye(6) / WEAK_STD**2)) for m in found.information)
    one, wider = omnibus(found), omnibus(found, 2.0)
    assert one.dof == pytest.approx(dof) and one.statistic == pytest.approx(chi2 / dof)
    assert wider.statistic == pytest.approx(chi2 / dof / 2) and wider.p_value == pytest.approx(chi2_tail(chi2 / 2, dof))
    # the size of correlated noise is known from as many samples as it has
    rough = omnibus(found, 2.0, 40.0)
    assert rough.statistic == wider.statistic and rough.p_value == pytest.approx(fisher.sf(chi2 / dof / 2, dof, 40.0))
    assert omnibus(found, 2.0, 1e7).p_value == pytest.approx(wider.p_value, rel=1e-3)
    rows = torch.full((20, 5, 6), 3.0, dtype=F64)
    segments: Any = SimpleNamespace(
        residuals=lambda *_, jacobian: (rows, jacobian),
        world=SimpleNamespace(gravity=torch.zeros(1, 3, dtype=F64)),
        dof=torch.full((20,), 25.0, dtype=F64),
    )
    assert dispersion(segments, found) == pytest.approx((20 * 30 * 9 - chi2) / (20 * 25 - dof))
    rows *= 0.1
    assert dispersion(segments, found) == 1.0


def test_correlated_noise_is_known_from_as_many_samples_as_flights_last() -> None:
    seen = torch.ones(2, 5, 1, dtype=F64)
    seen[1, 4:] = 0.0
    times = 0.1 * torch.arange(5, dtype=F64).expand(2, 5)
    noise = NoiseModel(CorrelatedNoise(share=0.9, time_s=0.07), CorrelatedNoise())
    segments: Any = SimpleNamespace(observations=SimpleNamespace(seen=seen, times_s=times), noise_model=noise)
    assert _noise_dof(segments) == pytest.approx(3 * (0.4 + 0.3) / 0.07)
    segments.noise_model = NoiseModel()
    assert _noise_dof(segments) == np.inf


def test_covariates_explain_what_their_bins_share() -> None:
    """A wrench that is one in fast windows and another in slow ones: the speed explains nearly all, episodes do not."""
    rng = np.random.default_rng(2)
    found = wrenches(np.zeros((60, 6)), np.arange(60) % 5)
    bins = _bins(found.coordinates["speed"])
    assert np.bincount(bins.astype(int)).tolist() == [60 // BINS] * BINS
    strength = rng.normal(size=(BINS, 6))
    strength -= strength.mean(0)
    found = wrenches(3 * strength[bins.astype(int)] + rng.normal(size=(60, 6)), np.arange(60) % 5)
    by_name = {one.coordinate: one for one in covariates_of(found)}
    assert next(iter(by_name)) == "speed" and 0.7 < by_name["speed"].share < 1.0
    assert by_name["speed"].p_value < 1e-9 and by_name["constant"].share < 0.2
    score = np.einsum("nij,nj->ni", found.information, found.wrench)
    everywhere = score.sum(0) @ np.linalg.solve(found.information.sum(0) + np.eye(6) / WEAK_STD**2, score.sum(0))
    assert by_name["constant"].gain == pytest.approx(everywhere)
    chi2 = float((score * found.wrench).sum())
    gain = by_name["speed"].gain
    assert by_name["speed"].share == pytest.approx((gain - 6 * (BINS - 1)) / (chi2 - 6 * 60))
    assert by_name["speed"].p_value == pytest.approx(chi2_tail(gain, 6 * (BINS - 1)))
    same = wrenches(np.tile(rng.normal(size=6), (60, 1)), np.zeros(60))
    names = [one.coordinate for one in covariates_of(same)]
    assert names[0] == "constant" and "episode" not in names  # one bin explains what a constant does


def test_axes_of_a_motion_are_along_it_to_its_left_and_across() -> None:
    found = motion_axes(np.array([[2.0, 0.0, 0.0], [0.0, 3.0, 4.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(found[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found[1], [[0, 0.6, 0.8], [-1, 0, 0], [0, -0.8, 0.6]], atol=1e-12)
    np.testing.assert_allclose(found[2, :2], [[0, 0, -1], [0, 1, 0]], atol=1e-12)


def test_terms_are_accelerations_of_a_unit_body() -> None:
    found = wrenches(np.zeros((4, 6)), np.arange(4))
    velocity, omega = found.velocity, found.omega
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    wanted = {"-u": -velocity, "-|u| u": -speed * velocity, "omega x u": np.cross(omega, velocity)}
    wanted |= {name: np.tile(axis, (4, 1)) for name, axis in zip("xyz", np.eye(3), strict=True)}
    for term, value in wanted.items():
        np.testing.assert_allclose(unit_acceleration(found, term), np.concatenate([value, 0 * value], 1), atol=1e-12)
    np.testing.assert_allclose(unit_acceleration(found, "-omega"), np.concatenate([0 * omega, -omega], 1))
    assert {*wanted, "-omega"} == set(TERMS)


def beginning(width_s: float, size: float, release_s: float, noise: float = 0.0) -> Beginning:
    times = np.arange(40) / 200
    rng = np.random.default_rng(0)
    free = np.outer(times, [1.0, 0.5, 2.0]) - np.outer(0.5 * times**2, [0.0, 0.0, 9.81])
    step = size * np.outer(_shape(release_s - times, width_s), [0.0, 0.6, 0.8])
    places = free + step + noise * rng.normal(size=free.shape)
    return Beginning(
        episode=0, frames=np.arange(40), times_s=times, places_m=places, airborne=True, up=np.array([0.0, 0.0, 1.0])
    )


@pytest.mark.parametrize("width_s", [0.0, 0.012])
def test_a_step_of_acceleration_is_found_with_its_size_and_time(width_s: float) -> None:
    found = _step(beginning(width_s, 12.0, 0.06), width_s)
    assert found.release_s == pytest.approx(0.06) and found.size_m_s2 == pytest.approx(12.0, rel=1e-6)
    assert np.abs(found.residual_m).max() < 1e-9
    down = _step(beginning(width_s, -12.0, 0.06), width_s)  # nothing that carries a body pulls it down
    assert down.size_m_s2 < 6.0
    noise = 1e-4
    assert abs(_step(beginning(width_s, 12.0, 0.06, noise), width_s).size_m_s2 - 12.0) < 5 * noise * found.known_m_s2


def test_a_release_is_not_looked_for_where_too_little_flight_follows() -> None:
    one = beginning(0.0, 12.0, 0.06)
    latest = min(CARRIED.longest_s, one.times_s[-1] - CARRIED.free_s)
    assert _step(one, 0.0).release_s <= latest
    short = Beginning(
        episode=0,
        frames=one.frames[:5],
        times_s=one.times_s[:5],
        places_m=one.places_m[:5],
        airborne=True,
        up=one.up,
    )
    assert short.times_s[-1] < CARRIED.free_s and _step(short, 0.0).size_m_s2 == 0.0


def test_the_rounded_step_is_the_convolution_of_the_sharp_one() -> None:
    width, before = 0.01, np.array([-0.03, -0.004, 0.0, 0.006, 0.05])
    x, weight = np.polynomial.hermite_e.hermegauss(60)
    wanted = [(0.5 * np.clip(b + width * x, 0, None) ** 2 * weight).sum() / np.sqrt(2 * np.pi) for b in before]
    np.testing.assert_allclose(_shape(before, width), wanted, atol=2e-7)
    np.testing.assert_allclose(_shape(before, 0.0), [0, 0, 0, 1.8e-5, 1.25e-3])


def test_the_spread_of_beginnings_counts_their_correlation() -> None:
    rng = np.random.default_rng(0)

    def step(residual: np.ndarray) -> Step:
        return Step(release_s=0.0, size_m_s2=0.0, known_m_s2=0.0, residual_m=residual)

    white = [step(2e-3 * rng.normal(size=(200, 3))) for _ in range(9)]
    assert _spread(white) == pytest.approx(2e-3, rel=0.06)
    constant = step(np.full((200, 3), 2e-3))
    most = CARRIED.most_alike
    usual = 600 * 4e-6 / 591
    assert _spread([constant]) == pytest.approx(np.sqrt(usual * (1 + most) / (1 - most)), rel=1e-6)


def phases(normal: list[float], speed: float, sliding: float, round_body: bool = False) -> list[str]:
    """Return the phases of frames with given impulses, in weights times the frame time."""
    body = ball_body(0.04) if round_body else box_body()
    world = world_of(body)
    mass, step, frames = float(body.mass[0]), 0.01, len(normal)
    points = body.centers.shape[1]
    impulse = torch.zeros(1, frames, points, 3, dtype=F64)
    impulse[0, :, 0, 2] = torch.tensor(normal, dtype=F64) * mass * 9.81 * step
    up = torch.zeros(1, frames, points, 3, dtype=F64)
    up[..., 2] = 1
    record = SimpleNamespace(
        impulse_n_s=impulse,
        normal=up,
        sliding=torch.full((1, frames, points), sliding, dtype=F64),
        body_a=torch.zeros(points, dtype=torch.long),
    )
    velocity = torch.zeros(1, frames, 1, 3, dtype=F64)
    velocity[..., 0] = speed
    rollout = SimpleNamespace(contacts=record, velocity_m_s=velocity, omega_body_rad_s=0.1 * velocity)
    contact: Any = SimpleNamespace(
        rollout=lambda record_contacts: rollout,
        world=world,
        observations=SimpleNamespace(times_s=torch.arange(frames, dtype=F64)[None] * step),
        noise=SimpleNamespace(position_m=1e-5),
        lengths=[frames],
    )
    return list(contact_phases(contact)[0])


def test_phases_follow_from_impulses_slip_and_speed() -> None:
    hard = 1.2 * max(PHASES.impact_weights, PHASES.impact_m_s / (9.81 * 0.01))
    soft = 0.8 * max(PHASES.impact_weights, PHASES.impact_m_s / (9.81 * 0.01))
    assert phases([1.0, 0.0, hard, soft], 1.0, 0.0) == ["flight", "flight", "impact", "sticking"]
    above, below = 1.05 * PHASES.sliding_impulse, 0.95 * PHASES.sliding_impulse
    assert phases([1.0, 1.0], 1.0, above) == ["sliding"] * 2 and phases([1.0, 1.0], 1.0, below) == ["sticking"] * 2
    assert phases([1.0, 1.0], 1.0, below, round_body=True) == ["rolling"] * 2
    slow = 0.9 * PHASES.rest_m_s / 1.01
    assert phases([1.0, 1.0], slow, above) == ["rest"] * 2
    assert is_round(ball_body()) and not is_round(box_body())


def test_speeds_of_surfaces_and_the_share_of_large_spheres() -> None:
    world = world_of(ball_body(0.04), box_body())
    velocity = torch.tensor([[[[1.0, 0, 0], [0.0, 2.0, 0]]]], dtype=F64)
    omega = torch.tensor([[[[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]]]], dtype=F64)
    assert _surface_speeds(world, velocity, omega).tolist() == [[2.0]]
    assert _surface_speeds(world, velocity, 10 * omega)[0, 0] == pytest.approx(1 + 50 * size_of(world.bodies[0]))
    body_a = torch.tensor([0, *[1] * 8])
    normal = torch.tensor([[[3.0, *[0.0] * 7, 1.0]]], dtype=F64)
    assert _round_share(world, body_a, normal).tolist() == [[0.75]]
    assert _round_share(world, body_a[:5], normal).tolist() == [[0.0]]


def test_frames_are_spread_evenly_and_one_in_each_interval() -> None:
    times = torch.arange(400, dtype=F64) / 100
    mask = torch.ones(400, dtype=F64)
    mask[:7] = 0
    found = _spread_frames(mask, times, 0.0)
    assert len(found) == FRAMES and found[0] == 7 and found[-1] == 399
    assert int(found.diff().max()) - int(found.diff().min()) <= 1
    some = _spread_frames(mask[:40], times[:40], 0.05)
    assert some.tolist() == [7, 12, 17, 22, 27, 32, 37]
    assert _spread_frames(0 * mask, times, 0.05).tolist() == [0]


def test_states_are_determined_by_the_residuals_that_they_move_more() -> None:
    own, other = torch.zeros(2, 3, 3, 4, dtype=F64), torch.zeros(2, 3, 3, 4, dtype=F64)
    own[..., 0] = 1.0
    own[..., 1], other[..., 1] = 1.0, 2.0
    own[0, ..., 2] = 1.0  # in one flight only
    own[..., 3], other[..., 3] = 2.0, 1.0
    assert moving(own, other) == [0, 3]


def seen_motion(position: torch.Tensor, quat: torch.Tensor | None = None, seen: torch.Tensor | None = None) -> Any:
    marks = torch.ones(*position.shape[:2], 1, dtype=F64) if seen is None else seen[..., None]
    unit = torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(*position.shape[:2], 1, 4)
    return SimpleNamespace(
        position_m=position[:, :, None],
        quat_wxyz=unit if quat is None else quat[:, :, None],
        seen=marks,
        has_orientation=marks,
    )


def test_travel_is_the_largest_standard_deviation_within_an_episode() -> None:
    position = torch.zeros(2, 4, 3, dtype=F64)
    position[0, :, 0] = torch.tensor([0.0, 2.0, 0.0, 2.0])
    position[1] += 50.0
    position[1, 3] = 900.0
    seen = torch.ones(2, 4, dtype=F64)
    seen[1, 3] = 0
    assert _travel(seen_motion(position, seen=seen)) == pytest.approx(1.0)


def test_episodes_are_apart_by_their_distance_from_the_first() -> None:
    position = torch.zeros(3, 4, 3, dtype=F64)
    position[1] = 1.0
    position[2, :2, 0] = 3.0
    assert _apart(seen_motion(position)) == pytest.approx(np.sqrt(9 / 3 / 2))
    seen = torch.ones(3, 4, dtype=F64)
    seen[2, :2] = 0
    assert _apart(seen_motion(position, seen=seen)) == pytest.approx(1.0)
    seen[2] = 0
    assert _apart(seen_motion(position, seen=seen)) == np.inf
    assert _apart(seen_motion(position[:1])) == np.inf


def test_turning_is_more_than_its_noise() -> None:
    sigma = 0.01
    least = 2 * INPUT.alike_sigmas * sigma
    for share, found in ((1.1, True), (0.9, False)):
        quat = torch.zeros(1, 3, 4, dtype=F64)
        quat[0, :, 0], quat[0, 1, 1] = 1.0, -share * least  # q and -q are one orientation
        assert _turns(seen_motion(torch.zeros(1, 3, 3, dtype=F64), quat), sigma) is found
    unknown = seen_motion(torch.zeros(1, 3, 3, dtype=F64), quat * 9, torch.zeros(1, 3, dtype=F64))
    assert not _turns(unknown, sigma)
    still = torch.tensor([[[1.0, 0, 0, 0], [0, 1.0, 0, 0], [-1.0, 0, 0, 0]]], dtype=F64)
    for second in (0.0, 1.0):  # whether the orientation of that frame was measured
        partly = seen_motion(torch.zeros(1, 3, 3, dtype=F64), still, torch.tensor([[1.0, second, 1.0]], dtype=F64))
        assert _turns(partly, sigma) is (second > 0)


@pytest.mark.parametrize(("tilt", "offset_m", "found"), [(0.9, 0.0, True), (1.1, 0.0, False), (0.5, -0.05, False)])
def test_a_tilted_ground_explains_gaps_that_grow_along_it(tilt: float, offset_m: float, found: bool) -> None:
    rng = np.random.default_rng(0)
    place = torch.as_tensor(rng.uniform(-1, 1, (300, 3)))
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    gap = tilt * INPUT.most_tilt * place[:, 0] + offset_m
    gap[::9] += 0.3  # in flight
    assert _on_a_tilted_plane(gap, place, normal, 0.02) is found


def test_level_axes_are_those_across_gravity() -> None:
    world = world_of(ball_body())
    assert _level_axes(world) == [0, 1]
    assert _level_axes(world_of(ball_body(), gravity=0.0)) == [0, 1, 2]


def test_windows_overlap_by_half_and_fill_each_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(residual_wrench, "Segments", SimpleNamespace(of=lambda *given: given))
    monkeypatch.setattr(residual_wrench, "fit_states", lambda given: given)
    monkeypatch.setattr(residual_wrench, "residual_wrenches", lambda given: given)
    for rate, length in ((200.0, 28), (41.0, 6)):  # frames of 0.14 s, six at least
        times = (torch.arange(200, dtype=F64) / rate).expand(3, -1)
        whole: Any = SimpleNamespace(times_s=times)
        flights = [Segment(0, 5, 150), Segment(2, 0, length - 1), Segment(1, 7, 5 + length)]
        given: Any = wrench_windows(world_of(ball_body()), whole, flights, Noise(1e-3, 1e-2))
        assert given[0] == "flight" and given[2] is whole
        windows = given[3]
        assert all(one.last - one.first + 1 == length for one in windows)
        firsts = [one.first for one in windows if one.episode == 0]
        assert firsts[0] == 5 and set(np.diff(firsts)) == {length // 2}
        assert 150 - length // 2 < firsts[-1] + length - 1 <= 150
        assert [one for one in windows if one.episode == 2] == [flights[1]]
        assert not any(one.episode == 1 for one in windows)  # one frame too short
    assert wrench_windows(world_of(ball_body()), whole, flights[2:], Noise(1e-3, 1e-2)) is None


def test_coordinates_are_those_of_the_middle_of_each_window() -> None:
    rng = np.random.default_rng(0)
    count, frames = 3, 9
    position, velocity = (torch.as_tensor(rng.normal(size=(count, frames, 2, 3))) for _ in range(2))
    omega, quat = (
        torch.as_tensor(rng.normal(size=(count, frames, 2, 3))),
        torch.as_tensor(rng.normal(size=(count, frames, 2, 4))),
    )
    quat = quat / quat.norm(dim=-1, keepdim=True)
    motion = SimpleNamespace(position_m=position, velocity_m_s=velocity, omega_body_rad_s=omega, quat_wxyz=quat)
    normal = torch.tensor([0.6, 0.0, 0.8], dtype=F64)
    tilted = replace(
        world_of(box_body(), ball_body()), ground_normal=normal, ground_offset=torch.tensor([0.25], dtype=F64)
    )
    times = torch.as_tensor(np.sort(rng.uniform(0, 3, (count, frames))))
    for world, up, offset in ((tilted, normal.numpy(), 0.25), (world_of(ball_body(), ground=False), np.eye(3)[2], 0.0)):
        segments: Any = SimpleNamespace(
            rollout=lambda: motion,
            observations=SimpleNamespace(free=(1,), times_s=times),
            items=[SimpleNamespace(episode=k) for k in (4, 0, 4)],
            lengths=[9, 6, 3],
            world=world,
        )
        found, speeds, spins = coordinates_of(segments)
        assert tuple(found) == COORDINATES
        for k, middle in enumerate((4, 3, 1)):
            place, moving = position[k, middle, 1].numpy(), velocity[k, middle, 1].numpy()
            turn = Rotation.from_quat(quat[k, middle, 1].numpy(), scalar_first=True)
            np.testing.assert_allclose(speeds[k], moving)
            np.testing.assert_allclose(spins[k], turn.apply(omega[k, middle, 1].numpy()))
            wanted = [float(times[k, middle]), *place[:2], place @ up - offset, math.atan2(moving[1], moving[0])]
            wanted += [np.linalg.norm(moving), float(omega[k, middle, 1].norm()), (4.0, 0.0, 4.0)[k]]
            np.testing.assert_allclose([found[name][k] for name in COORDINATES], wanted, err_msg=str(k))


def test_loud_windows_are_left_out_unless_half_of_all_would_be() -> None:
    count = 8
    found = wrenches(np.zeros((count, 6)), np.arange(count))
    taken = np.einsum("nij,nji->n", found.information, found.covariance)

    def kept(sizes: list[float], dof: float = 24.0) -> int:
        """Windows with chi2 per degree of freedom of these sizes."""
        rows = torch.zeros(count, 5, 6, dtype=F64)
        rows[:, 0, 0] = torch.as_tensor(np.sqrt(np.array(sizes) * (dof - taken)))
        segments: Any = SimpleNamespace(
            residuals=lambda *_, jacobian: (rows, jacobian),
            world=SimpleNamespace(gravity=torch.zeros(1, 3, dtype=F64)),
            dof=torch.full((count,), dof, dtype=F64),
            select=list,
        )
        some, left = sound_windows(segments, found)
        assert len(left.segments) == (count if some is segments else len(some))
        return len(left.segments)

    most = SEGMENT_THRESHOLDS.slow_errors.unsound
    assert kept([1.0] * 7 + [1.01 * most]) == 7 and kept([1.0] * 7 + [0.99 * most]) == 8
    assert kept([0.3] * 7 + [1.01 * most]) == 7 and kept([0.3] * 7 + [0.99 * most]) == 8  # noise itself is one
    assert kept([2.0] * 7 + [1.5 * most]) == 8  # beside the quietest quarter
    assert kept([1.0] * 4 + [9 * most] * 4) == 4 and kept([1.0] * 3 + [9 * most] * 5) == 8
    assert kept([1.0] * 7 + [9 * most], dof=float(taken.max()) + 0.5) == 8  # nothing tells the noise


def test_a_ball_is_round_where_its_spheres_are_about_its_middle() -> None:
    ball = ball_body(0.04, copies=2)
    near, far = ball.centers.clone(), ball.centers.clone()
    near[0, 1], far[0, 1] = 0.9 * 0.04e-3 / 3**0.5, 1.1 * 0.04e-3 / 3**0.5  # in all three coordinates
    assert is_round(replace(ball, centers=near)) and not is_round(replace(ball, centers=far))
    assert not is_round(replace(ball, centers=0.5 * (ball.centers + 0.04)))
    many = ball_body(0.04, copies=50)
    assert is_round(replace(many, centers=many.centers + 0.3e-3 * 0.04))


def test_phases_are_those_of_measured_frames_up_to_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = torch.ones(3, 8, 2, dtype=F64)
    seen[0, 6:], seen[1, 2] = 0, 0
    seen[2, :, 0], seen[2, 7] = 0, 0  # of one body only
    airborne = torch.zeros(3, 8, dtype=torch.bool)
    airborne[0, :3], airborne[1, 4] = True, True
    whole: Any = SimpleNamespace(seen=seen, times_s=torch.arange(8, dtype=F64).expand(3, -1) / 100)
    contact: Any = SimpleNamespace(items=[Segment(0, 2, 4), Segment(1, 3, 5)])
    monkeypatch.setattr(
        contact_phases_module, "contact_phases", lambda _: [["impact", "sliding", "rest"], ["rolling"] * 3]
    )
    found = phases_of(["a", "b", "c"], whole, airborne, contact)
    assert [one.episode for one in found] == ["a", "b", "c"] and [len(one.phase) for one in found] == [6, 8, 7]
    assert found[0].phase.tolist() == ["flight"] * 3 + ["sliding", "rest", "flight"]  # what flies touches nothing
    assert found[1].phase.tolist() == ["flight"] * 3 + ["rolling", "flight", "rolling", "flight", "flight"]
    assert all((one.airborne == airborne[k, : len(one.phase)].numpy()).all() for k, one in enumerate(found))
    assert found[2].time_s.tolist() == pytest.approx([0.01 * k for k in range(7)])
    assert [set(one.phase) for one in phases_of(["a", "b", "c"], whole, airborne, None)] == [{"flight"}] * 3
