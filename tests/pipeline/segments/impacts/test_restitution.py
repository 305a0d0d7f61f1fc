"""Restitution from the heights on both sides of bounces: exact on exact flights, right under drag and slow errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.phys_geo.tracks.contact_fit import RestitutionFit, damping_of, restitution_of
from cgwm.pipeline.physics.contact_law import restitution
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.segments.impact_law import changes_rebound
from cgwm.pipeline.segments.impacts.bounces import Bounce, BounceSide, _turns, bounces_of
from cgwm.pipeline.segments.impacts.restitution import (
    CONTACT_PRIOR,
    DRAG_PRIOR,
    LIFT_MEAN,
    LIMITS,
    NOISE_PRIOR,
    SCATTER_PRIOR,
    SHAKEN_MEAN,
    SHAKEN_S,
    _Flight,
    _Flights,
    _flights,
    _found_noise,
    _ground,
    _Noise,
    _Solved,
    _Speeds,
)
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from helpers.diagnosis_data import world_with
from helpers.worlds import ball_body, law, state_of, world_of
from scipy.stats import expon, norm
from scipy.stats import t as student_t

RADIUS_M, GRAVITY_M_S2, STEP_S = 0.02, 9.81, 1e-3


def path(velocity: np.ndarray, duration_s: float, drag_per_m: float, direction: float) -> np.ndarray:
    """Return positions (n, 3) every `STEP_S` of a ball under gravity and quadratic drag, forwards or backwards."""
    position, places = np.zeros(3), [np.zeros(3)]
    for _ in range(int(duration_s / STEP_S) + 1):
        pull = np.array([0.0, 0.0, -GRAVITY_M_S2]) - drag_per_m * np.linalg.norm(velocity) * velocity
        middle = velocity + 0.5 * direction * STEP_S * pull
        position = position + direction * STEP_S * middle
        velocity = velocity + direction * STEP_S * pull
        places.append(position)
    return np.array(places)


def bounce(
    rng: np.random.Generator, rate_hz: float, rebound: float, drag_per_m: float, slow_m: float, ground_m: float = 0.0
) -> Track:
    """Return the centroid of a ball for some frames before and after one impact that also slows it sideways."""
    before = np.array([rng.uniform(0, 3), 0.0, -rng.uniform(1.5, 4.0)])
    after = before * np.array([0.7, 1.0, -rebound])
    count, first = (rng.integers(8, 16, 2) * max(1.0, rate_hz / 143)).astype(int), rng.uniform(0, 1 / rate_hz)
    time = first + np.arange(-count[0], count[1]) / rate_hz
    sides = (path(before, 0.3, drag_per_m, -1.0), path(after, 0.3, drag_per_m, 1.0))
    inside = np.arange(len(sides[0])) * STEP_S
    rows = [[np.interp(abs(t), inside, sides[int(t >= 0)][:, k]) for k in range(3)] for t in time]
    memory, error = np.exp(-1 / rate_hz / 0.015), rng.normal(0, 1, (len(time), 3))
    for k in range(1, len(time)):
        error[k] = memory * error[k - 1] + np.sqrt(1 - memory**2) * error[k]
    position = np.array(rows) + slow_m * error + np.array([0.0, 0.0, RADIUS_M + ground_m])
    return Track(time_s=time - time[0], position_m=position, quat_wxyz=None)


def fitted(tracks: list[Track]) -> RestitutionFit:
    """Return the restitution of tracks of one ball over the ground at 0."""
    world = world_of(ball_body(RADIUS_M))
    whole = whole_episodes(world, [Episode(str(k), {"ball": track}) for k, track in enumerate(tracks)])
    found = restitution_of(world, whole)
    assert found is not None
    return found


@pytest.mark.parametrize(("rebound", "ground_m"), [(0.5, 0.0), (0.95, 0.003)])
def test_exact_flights_give_the_exact_restitution(rebound: float, ground_m: float) -> None:
    rng = np.random.default_rng(0)
    found = fitted([bounce(rng, 143.0, rebound, 0.0, 0.0, ground_m) for _ in range(4)])
    assert found.estimate == pytest.approx(rebound, abs=0.003)


@pytest.mark.parametrize("rate_hz", [60.0, 143.0, 400.0])
def test_drag_and_slow_errors_do_not_bias_a_light_ball(rate_hz: float) -> None:
    rng = np.random.default_rng(1)
    found = fitted([bounce(rng, rate_hz, 0.95, 0.13, 5e-4) for _ in range(8)])
    assert found.estimate == pytest.approx(0.95, abs=0.02)
    assert abs(found.estimate - 0.95) < 3 * found.std_error < 0.06
    assert found.drag_per_m == pytest.approx(0.13, abs=0.06)


@pytest.mark.parametrize(("contact_time_s", "damping_ratio"), [(0.0017, 0.35), (0.005, 0.5), (0.008, 0.09)])
def test_bounces_of_the_engine_give_its_damping_ratio(contact_time_s: float, damping_ratio: float) -> None:
    """The weight takes a share of a slow rebound, and short contacts feel the length of a step."""
    world = world_of(ball_body(RADIUS_M), contact=law(0.3, contact_time_s, damping_ratio))
    rng, times, count = np.random.default_rng(3), np.arange(81) / 120, 8
    start = state_of(((0, 0, RADIUS_M), (1, 0, 0, 0), (0.3, 0, 0), (0, 0, 0)), count=count)
    start.position_m[:, 0, 2] += torch.as_tensor(rng.uniform(0.05, 0.2, count))
    start.velocity_m_s[:, 0, 2] = torch.as_tensor(rng.uniform(-1, 0, count))
    path = rollout(world, start, torch.as_tensor(times)).position_m[:, :, 0].numpy()
    path = path + rng.normal(0, 2e-4, path.shape)
    episodes = [Episode(str(k), {"ball": Track(times, path[k], None)}) for k in range(count)]
    found = restitution_of(world, whole_episodes(world, episodes))
    assert found is not None
    damping = damping_of(found, world, contact_time_s)
    std = damping.variance**0.5
    assert abs(damping.value - np.log(damping_ratio)) < 3 * std < 0.1
    # the law's restitution is that of a fast impact
    assert float(restitution(torch.tensor(damping_ratio))) > found.estimate + 0.005


def test_what_a_ball_does_after_its_last_flight_is_none_of_it() -> None:
    world = world_of(ball_body(RADIUS_M), contact=law(0.3, 0.0025, 0.3))
    start = state_of(((0, 0, 0.2), (1, 0, 0, 0), (0.3, 0, 0), (0, 0, 0)))
    times = np.arange(100) / 100
    path = rollout(world, start, torch.as_tensor(times)).position_m[0, :, 0].numpy()
    bounces = bounces_of(world, whole_episodes(world, [Episode("0", {"ball": Track(times, path, None)})]))
    assert bounces
    for one in bounces:  # only free fall between contacts
        bent = np.diff(one.after.height_m, 2) / np.diff(one.after.time_s).mean() ** 2
        np.testing.assert_allclose(bent, -GRAVITY_M_S2, atol=0.2)


def test_a_ball_that_does_not_turn_at_the_ground_has_no_bounce() -> None:
    world = world_of(ball_body(RADIUS_M))
    time = np.arange(40) / 143
    falling = np.column_stack([time, 0 * time, 0.5 + RADIUS_M - 0.5 * GRAVITY_M_S2 * time**2])
    rolling = np.column_stack([time, 0 * time, RADIUS_M + 0 * time])
    turning = np.column_stack([time, 0 * time, 0.5 + RADIUS_M + 2 * np.abs(time - time[20])])  # in a hand
    for position in (falling, rolling, turning):
        track = Track(time_s=time, position_m=position, quat_wxyz=None)
        assert restitution_of(world, whole_episodes(world, [Episode("0", {"ball": track})])) is None


def test_errors_of_heights_have_their_covariance() -> None:
    """White and slow noise, the scatter of a flight's own acceleration, and after an impact the ball's own shaking."""
    noise = _Noise(white_m=2e-3, slow_m=3e-3, time_s=0.05, lift_m_s2=0.4, shaken_m=5e-3)
    time = np.array([0.02, 0.05, 0.11])
    a, b = time[:, None], time[None]
    plain = 4e-6 * np.eye(3) + 9e-6 * np.exp(-np.abs(a - b) / 0.05) + 0.16 * (a**2 / 2) * (b**2 / 2)
    shaken = 25e-6 * np.exp(-2 * np.maximum(a, b) / SHAKEN_S)
    assert noise.covariance(time) == pytest.approx(plain + shaken, rel=1e-6)
    assert noise.covariance(-time) == pytest.approx(plain, rel=1e-6)  # before the impact nothing shakes it


def test_flights_are_solved_as_one_linear_model() -> None:
    """States of all flights and a common drag with its prior: the normal equations of the whole, and its likelihood."""
    rng = np.random.default_rng(1)
    noise = _Noise(white_m=2e-3, slow_m=1e-3, time_s=0.05, lift_m_s2=0.3, shaken_m=2e-3)
    flights = []
    for count in (6, 9, 9):
        time = np.sort(rng.uniform(0.01, 0.2, count))
        basis = np.column_stack([np.ones(count), time])
        flights.append(_Flight(time=time, height=rng.normal(0, 0.01, count), basis=basis, drag=-3 * time**2))
    found = _Solved.of(_Flights.of(flights), noise)
    size = sum(len(flight.time) for flight in flights)
    design, cover, row = np.zeros((size, 7)), np.zeros((size, size)), 0
    for k, flight in enumerate(flights):
        rows = slice(row, row + len(flight.time))
        design[rows, 2 * k : 2 * k + 2], design[rows, 6] = flight.basis, flight.drag
        cover[rows, rows] = noise.covariance(flight.time)
        row += len(flight.time)
    height = np.concatenate([flight.height for flight in flights])
    weight = np.linalg.inv(cover)
    normal = design.T @ weight @ design
    normal[6, 6] += 1 / DRAG_PRIOR**2
    solution = np.linalg.solve(normal, design.T @ weight @ height)
    drag = found.drag[0]
    assert drag == pytest.approx(solution[6])
    assert found.drag[1] == pytest.approx(np.linalg.inv(normal)[6, 6])
    assert (found.states - drag * found.slopes).ravel() == pytest.approx(solution[:6])
    left = height - design @ solution
    cost = np.linalg.slogdet(cover)[1] + np.linalg.slogdet(normal)[1] + left @ weight @ left + (drag / DRAG_PRIOR) ** 2
    assert found.cost == pytest.approx(cost)


def test_thinned_frames_keep_both_ends_and_a_ball_that_stays_down_does_not_bounce() -> None:
    time = np.arange(12) * 0.01
    fall = np.clip(0.06 - 1.2 * time, 0.012, None)
    side = BounceSide(time_s=time, height_m=fall, position_m=np.zeros((12, 3)))
    assert side.thinned(4).time_s.tolist() == pytest.approx([time[k] for k in (0, 4, 7, 11)])
    assert _turns(side) == []
    rising = replace(side, height_m=np.where(time > 0.041, 0.012 + 0.8 * (time - 0.04), fall))
    assert _turns(rising) == [4]


@pytest.mark.parametrize(
    ("effects", "changed"),
    [
        ({}, False),
        ({"velocity_restitution": {"r": 0.2}}, True),
        ({"adhesion": {"F": 1.0}}, True),
        ({"anisotropic_friction": {"a": 0.1}}, False),
    ],
)
def test_effects_that_change_a_rebound_are_told_from_those_of_friction(effects: dict, changed: bool) -> None:
    assert changes_rebound(world_with("ball", effects)) is changed


def test_drag_of_a_vertical_flight_is_the_integral_of_the_square_of_its_speed() -> None:
    """Up all the time, at u - g t: k D(t) is twice the integral of -k (u - g t)^2; nothing moves sideways."""
    t, u = np.linspace(0.0, 0.3, 31), 4.0
    height = u * t - 0.5 * GRAVITY_M_S2 * t**2
    side = BounceSide(time_s=t, height_m=height, position_m=np.outer(height, [0.0, 0.0, 1.0]))
    known = -(u**2 * t**2 / 2 - u * GRAVITY_M_S2 * t**3 / 3 + GRAVITY_M_S2**2 * t**4 / 12)
    np.testing.assert_allclose(_Flight.of(side, GRAVITY_M_S2).drag, known, atol=1e-3 * abs(known[-1]))
    sideways = replace(side, position_m=np.column_stack([3.0 * t, 0 * t, height]))  # more drag, as it is faster
    assert _Flight.of(sideways, GRAVITY_M_S2).drag[-1] < 1.1 * known[-1]


def test_flights_meet_under_the_ground_by_what_the_contact_takes() -> None:
    """Two flights of speeds a and b meet a b / (a + b) T under the ground; slow and fast bounces tell both apart."""
    ground, contact_s = 0.003, 1.5 * CONTACT_PRIOR[0]
    fall, rise = np.array([1.0, 2.0, 4.0]), np.array([0.8, 1.5, 2.5])
    meet = ground - fall * rise / (fall + rise) * contact_s
    states = np.stack([np.stack([meet, -fall], -1), np.stack([meet, rise], -1)], 1)
    height, found_s, variance = _ground(states, np.tile(1e-12 * np.eye(2), (3, 2, 1, 1)))
    assert height == pytest.approx(ground, abs=2e-5) and found_s == pytest.approx(contact_s, rel=0.01)
    assert 0 < variance < 1e-6


def test_an_error_that_both_speeds_share_is_none_of_their_ratio() -> None:
    """The first bounce has its two speeds wrong by one factor, the second each on its own: the first tells more."""
    speeds = np.array([[2.0, 1.6], [2.0, 1.2]])
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = 0.2**2 * np.outer(speeds[0], speeds[0])
    covariance[2:, 2:] = 0.2**2 * np.diag(speeds[1] ** 2)
    measured = _Speeds(speeds=speeds, covariance=covariance, contacts=[], drag=0.0)
    noise = _Noise(white_m=1e-3, slow_m=1e-3, time_s=0.05, lift_m_s2=0.1, shaken_m=1e-3)
    found = measured.restitution(noise, degrees=10)
    assert found.own.tolist() == [0.8, 0.6] and found.own_std[0] < 1e-6
    assert found.own_std[1] == pytest.approx(0.6 * 0.2 * 2**0.5)
    assert found.estimate > 0.75


def four_bounces() -> tuple[list[Bounce], _Noise]:
    """Bounces of a ball with slow errors, and some noise."""
    rng = np.random.default_rng(3)
    world = world_of(ball_body(RADIUS_M))
    tracks = [bounce(rng, 143.0, 0.8, 0.13, 3e-4) for _ in range(4)]
    whole = whole_episodes(world, [Episode(str(k), {"ball": track}) for k, track in enumerate(tracks)])
    return bounces_of(world, whole), _Noise(white_m=2e-4, slow_m=4e-4, time_s=0.02, lift_m_s2=0.3, shaken_m=2e-4)


def test_speeds_at_the_ground_and_their_covariance_follow_from_states_drag_and_ground() -> None:
    """First-order propagation, by differences of v = sqrt(u^2 + 2 g (h0 - ground)) with states that drag changes."""
    bounces, noise = four_bounces()
    found, solved = (
        _Speeds.of(bounces, GRAVITY_M_S2, noise),
        _Solved.of(_Flights.of(_flights(bounces, GRAVITY_M_S2)), noise),
    )
    drag, variance = solved.drag
    states = (solved.states - drag * solved.slopes).reshape(-1, 2, 2)
    ground, contact_s, ground_var = _ground(states, solved.covariance.reshape(-1, 2, 2, 2))

    def speeds(own: np.ndarray, k: float, at: float) -> np.ndarray:
        moved = solved.states + own - k * solved.slopes
        return np.sqrt(moved[:, 1] ** 2 + 2 * GRAVITY_M_S2 * (moved[:, 0] - at))

    nothing, step = np.zeros_like(solved.states), 1e-6
    np.testing.assert_allclose(found.speeds.ravel(), speeds(nothing, drag, ground), rtol=1e-12)

    def slope(axis: int | None, k: float = 0.0, at: float = 0.0) -> np.ndarray:
        own = nothing if axis is None else nothing + np.eye(2)[axis]
        ends = [speeds(s * step * own, drag + s * step * k, ground + s * step * at) for s in (1, -1)]
        return (ends[0] - ends[1]) / (2 * step)

    by_state = np.stack([slope(0), slope(1)], -1)
    wanted = np.diag(np.einsum("ni,nij,nj->n", by_state, solved.covariance, by_state))
    wanted += variance * np.outer(slope(None, k=1.0), slope(None, k=1.0))
    wanted += ground_var * np.outer(slope(None, at=1.0), slope(None, at=1.0))
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-5, atol=1e-6 * wanted.max())
    # frames of a contact are those from the time at which one flight is on the ground to that of the other
    assert found.drag == drag and len(found.contacts) == len(bounces)
    for (begin, end), (before, after) in zip(found.contacts, states, strict=True):
        fallen, risen = (np.roots([-0.5 * GRAVITY_M_S2, up, height - ground]) for height, up in (before, after))
        assert begin + LIMITS.apart_s == pytest.approx(fallen.max())
        assert end - LIMITS.apart_s == pytest.approx(max(risen.min(), fallen.max() + contact_s))


@pytest.mark.parametrize("count", [1, 4])
def test_the_noise_of_flights_is_where_likelihood_and_priors_are_highest(count: int) -> None:
    """Log-normal priors of white and slow noise and its time, exponential ones of what lifts and shakes."""
    bounces, _ = four_bounces()
    flights = _flights(bounces[:count], GRAVITY_M_S2)
    found = _found_noise(flights)
    names = ("white_m", "slow_m", "time_s", "lift_m_s2", "shaken_m")
    batch_of_flights = _Flights.of(flights)

    def cost(noise: _Noise) -> float:
        prior = sum(
            norm.logpdf(np.log(getattr(noise, n)), np.log(m), w)
            for n, (m, w) in zip(names[:3], NOISE_PRIOR, strict=True)
        )
        for name, mean in (("lift_m_s2", LIFT_MEAN), ("shaken_m", SHAKEN_MEAN)):
            prior += expon.logpdf(getattr(noise, name), scale=mean) + np.log(getattr(noise, name))
        return _Solved.of(batch_of_flights, noise).cost - 2 * float(prior)

    best = cost(found)
    for name in names:
        for factor in (np.exp(-0.4), np.exp(0.4)):
            assert cost(replace(found, **{name: factor * getattr(found, name)})) > best - 0.15


def test_a_restitution_does_not_depend_on_the_unit_of_speed_and_is_told_better_by_more_impacts() -> None:
    rng = np.random.default_rng(0)
    fall = rng.uniform(1.5, 3.0, 6)
    speeds = np.stack([fall, 0.8 * fall], -1)
    own = rng.normal(size=(12, 12))
    cover = 1e-4 * (own @ own.T / 12 + np.eye(12))
    noise = _Noise(white_m=1e-3, slow_m=1e-3, time_s=0.05, lift_m_s2=0.1, shaken_m=1e-3)

    def found(scale: float = 1.0, degrees: int = 40, chosen: int = 6) -> RestitutionFit:
        n = 2 * chosen
        some = _Speeds(speeds=scale * speeds[:chosen], covariance=scale**2 * cover[:n, :n], contacts=[], drag=0.1)
        return some.restitution(noise, degrees)

    one, other = found(), found(3.0)
    assert one.estimate == pytest.approx(0.8) and other.estimate == pytest.approx(one.estimate)
    assert other.std_error == pytest.approx(one.std_error) and other.scatter == pytest.approx(one.scatter)
    assert 0 < one.scatter < 2 * SCATTER_PRIOR and one.std_error < found(chosen=2).std_error
    # Student's quantile for the degrees of freedom that the noise was found with, at least two
    wider = float(student_t.ppf(0.975, 2) / student_t.ppf(0.975, 40))
    assert found(degrees=0).std_error == pytest.approx(wider * one.std_error, rel=1e-6)
    assert found(degrees=10**7).std_error < one.std_error
    slope = np.zeros((6, 12))
    for k in range(6):
        slope[k, 2 * k], slope[k, 2 * k + 1] = -0.8 / fall[k], 1 / fall[k]
    np.testing.assert_allclose(one.own_std, np.sqrt(np.diag(slope @ cover @ slope.T)))
    assert one.drag_per_m == 0.1 and one.lift_m_s2 == noise.lift_m_s2 and one.noise_m == (1e-3, 1e-3, 0.05)
    scattered = _Speeds(
        speeds=np.stack([fall, [0.5, 0.9, 0.6, 0.95, 0.7, 0.85] * fall], -1), covariance=cover, contacts=[], drag=0.0
    )
    assert scattered.restitution(noise, 40).scatter > 0.08 > 3 * one.scatter


def test_the_scatter_of_impacts_is_its_mean_over_what_it_may_be() -> None:
    """Restricted likelihood of values with a common mean, an exponential prior, integrated on a fine grid."""
    rng = np.random.default_rng(5)
    count, fall = 7, rng.uniform(1.5, 3.0, 7)
    own = 0.8 + 0.02 * rng.normal(size=count)
    std = np.geomspace(0.003, 0.04, count)  # of each restitution, by errors of the speed after it
    covariance = np.zeros((2 * count, 2 * count))
    covariance[1::2, 1::2] = np.diag((std * fall) ** 2) + 0.01**2 * np.outer(fall, fall)
    measured = _Speeds(speeds=np.stack([fall, own * fall], -1), covariance=covariance, contacts=[], drag=0.0)
    noise = _Noise(white_m=1e-3, slow_m=1e-3, time_s=0.05, lift_m_s2=0.1, shaken_m=1e-3)
    found = measured.restitution(noise, 10**6)
    grid, ones = np.linspace(0, 0.3, 601), np.ones((count, 1))
    weight, means, variances = np.zeros_like(grid), np.zeros_like(grid), np.zeros_like(grid)
    for k, scatter in enumerate(grid):
        cover = np.diag(std**2) + 0.01**2 + scatter**2 * np.eye(count)
        inverse = np.linalg.inv(cover)
        variances[k] = 1 / (ones.T @ inverse @ ones).item()
        means[k] = variances[k] * (ones.T @ inverse @ own).item()
        left = own - means[k]
        likelihood = np.sqrt(variances[k] / np.linalg.det(cover)) * np.exp(-0.5 * left @ inverse @ left)
        weight[k] = likelihood * expon.pdf(scatter, scale=SCATTER_PRIOR)
    weight /= weight.sum()
    mean = weight @ means
    assert found.scatter == pytest.approx(weight @ grid, rel=0.03)
    assert found.estimate == pytest.approx(mean, abs=2e-4)
    assert found.std_error == pytest.approx(np.sqrt(weight @ (variances + (means - mean) ** 2)), rel=0.01)
