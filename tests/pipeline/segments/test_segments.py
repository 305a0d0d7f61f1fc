"""Segments: their degrees of freedom, states of straight lines, and what a linearization weighs."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.physics.parameters import Parameter
from cgwm.pipeline.segments import prepare as prepare_module
from cgwm.pipeline.segments import segments as segments_module
from cgwm.pipeline.segments.first_contact_fit import MAX_WINDOWS, _prior, windows_of
from cgwm.pipeline.segments.ground_contact import on_the_ground
from cgwm.pipeline.segments.held_out_gain import HeldOutGain
from cgwm.pipeline.segments.prepare import LIMITS as PREPARE_LIMITS
from cgwm.pipeline.segments.prepare import Prepared, _outlier_warnings
from cgwm.pipeline.segments.segment_fit import Linear, Refit, robust_excess
from cgwm.pipeline.segments.segments import Segments, _line
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.segmentation import Segment
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.fixed_surfaces import box
from helpers.worlds import F64, ball_body, world_of

BEGIN_S, RATE_HZ, FRAMES = 7.0, 100.0, 12
VELOCITY, SPIN = np.array([0.8, -0.3, 1.2]), np.array([0.0, 0.0, 9.0])


def _flight(turned: bool = True, flat: bool = False) -> Segments:
    """A ball in free fall whose clock begins at 7 s, exactly measured."""
    t = np.arange(FRAMES) / RATE_HZ
    position = np.array([0.1, 0.2, 1.5]) + t[:, None] * VELOCITY
    position[:, 2] -= 0.5 * 9.81 * t**2
    if flat:
        position[:, 1] = 0.2
    half = 0.5 * SPIN[2] * t
    quat = np.stack([np.cos(half), 0 * t, 0 * t, np.sin(half)], -1) if turned else None
    episodes = [("one", {"ball": Track(BEGIN_S + t, position, quat)})]
    world = world_of(ball_body(), ground=False)
    whole = Observations.of(world, episodes, [(BEGIN_S, math.inf)])
    return Segments.of("flight", world, whole, [Segment(0, 2, FRAMES - 1)], Noise(1e-3, 1e-2))


def test_states_are_those_of_the_first_frame_whatever_the_clock() -> None:
    state, t = _flight().observations.state, 2 / RATE_HZ
    expected = np.array([0.1, 0.2, 1.5]) + t * VELOCITY - [0, 0, 0.5 * 9.81 * t**2]
    np.testing.assert_allclose(state.position_m[0, 0], expected, atol=1e-9)
    np.testing.assert_allclose(state.velocity_m_s[0, 0], VELOCITY - [0, 0, 9.81 * t], atol=1e-7)
    np.testing.assert_allclose(state.omega_body_rad_s[0, 0], SPIN, atol=1e-7)


@pytest.mark.parametrize(("turned", "flat", "expected"), [(True, False, 48), (False, False, 24), (False, True, 16)])
def test_degrees_of_freedom_are_measured_coordinates_less_those_of_the_state(
    turned: bool, flat: bool, expected: float
) -> None:
    """Ten frames of three coordinates less two each; a coordinate that never changes was not measured."""
    assert float(_flight(turned, flat).dof) == expected


def test_an_excess_weighs_like_the_slope_of_its_loss() -> None:
    excess = torch.tensor([-5.0, 0.0, 3.0, 400.0], dtype=F64, requires_grad=True)
    loss, weight = robust_excess(excess)
    (slope,) = torch.autograd.grad(loss.sum(), excess)
    torch.testing.assert_close(slope[[0, 2, 3]], weight[[0, 2, 3]])
    linear = Linear(
        information=torch.zeros(2, 1, 1),
        score=torch.zeros(2, 1),
        chi2=torch.tensor([10.0, 90.0]),
        dof=torch.tensor([10.0, 10.0]),
    )
    assert float(linear.weight[0]) == 1.0 and float(linear.weight[1]) == float(robust_excess(torch.tensor(80.0))[1])


@pytest.mark.parametrize(("logarithmic", "error"), [(True, 0.2), (False, 0.1)])
def test_the_error_of_a_logarithm_is_that_of_the_number_times_it(logarithmic: bool, error: float) -> None:
    one = Parameter(
        name="c", unit="1", bounds=(0.1, 10.0), logarithmic=logarithmic, reveals="sliding", prior=(1.0, 1.0)
    )
    fit = Refit(
        world=world_of(ball_body()),
        parameters=(one,),
        values=torch.tensor([one.encode(2.0)], dtype=F64),
        covariance=torch.tensor([[0.01]], dtype=F64),
        segments=(),
        cost=0.0,
        by_segment=(),
    )
    assert fit.number("c") == pytest.approx((2.0, error))


def test_the_standard_error_of_a_gain_is_that_of_a_sum_of_independent_episodes() -> None:
    gains, misfit = np.array([1.0, 2.5, -0.5, 4.0]), 20.0
    variance = np.mean([(a - b) ** 2 / 2 for k, a in enumerate(gains) for b in gains[:k]])
    assert HeldOutGain(gains, misfit).std_error == pytest.approx(math.sqrt(len(gains) * variance) / misfit)


@pytest.mark.parametrize(
    ("gains", "misfit", "matters"),
    [
        ([9.0, 10.0, 11.0, 10.0, 9.5], 100.0, True),
        ([9.0, 10.0, 11.0, 10.0, 9.5], 1e6, False),  # all agree on next to nothing
        ([90.0, -30.0, 2.0, -20.0, 8.0], 100.0, False),  # one episode alone
        ([-9.0, -10.0, -11.0, -10.0, -9.5], 100.0, False),
    ],
)
def test_a_gain_matters_where_episodes_agree_and_it_shows(gains: list[float], misfit: float, matters: bool) -> None:
    assert HeldOutGain(np.array(gains), misfit).matters is matters


def test_only_wanted_parameters_have_a_prior_in_windows_of_first_contacts() -> None:
    parameters = [
        Parameter(name=name, unit="1", bounds=(0.01, 10.0), logarithmic=True, reveals="", prior=(median, 0.5))
        for name, median in (("a", 0.3), ("b", 2.0))
    ]
    centre, information = _prior(parameters, 1, torch.zeros((), dtype=F64))
    torch.testing.assert_close(centre, torch.tensor([0.3, 2.0], dtype=F64).log())
    assert information.tolist() == [pytest.approx(1 / 0.5**2), 0.0]


@pytest.mark.parametrize("lead", [None, 5])
def test_windows_reach_from_frames_before_the_first_contact_to_a_time_after_it(lead: int | None) -> None:
    """A ball falls at 1 m/s from 0.1 m; another one flies on."""
    world, t = world_of(ball_body(0.04)), np.arange(21) / 100
    high, rest = np.array([0.0, 0.0, 0.14]), np.array([-9.0, -9.0, 0.04])
    places = [np.maximum(np.outer(t, [0.5, 0.0, -1.0]) + high, rest), np.outer(t, [0.5, 0.0, 1.0]) + high]
    turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    episodes = [(f"{k}", {"ball": Track(3.0 + t, place, turned)}) for k, place in enumerate(places)]
    picked, windows, contacts = windows_of(world, episodes, lead, 0.06)
    assert [name for name, _ in picked] == ["0", "1"]
    assert 3.08 < contacts[0] <= 3.1 + 1e-9 and contacts[1] == math.inf
    first = contacts[0] - 0.05 if lead else 3.0
    np.testing.assert_allclose(windows[0], (first, contacts[0] + 0.06), atol=1e-8)
    np.testing.assert_allclose(windows[1], (3.16 if lead else 3.0, 3.2 + 0.06), atol=1e-8)


def test_windows_are_of_episodes_evenly_spread_and_no_more_than_determine_the_mass() -> None:
    world, t = world_of(ball_body(0.04)), np.arange(4) / 100
    track = Track(t, np.array([[0.0, 0.0, 0.2 + s] for s in t]), np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)))
    picked, windows, _ = windows_of(world, [(str(k), {"ball": track}) for k in range(2 * MAX_WINDOWS - 1)], None, 0.0)
    assert [name for name, _ in picked] == [str(2 * k) for k in range(MAX_WINDOWS)] and len(windows) == MAX_WINDOWS


def test_a_line_goes_through_what_counts_of_it() -> None:
    t = torch.tensor([[0.0, 1.0, 2.0, 4.0], [1.0, 2.0, 3.0, 5.0]], dtype=F64)
    start, slope = torch.tensor([[1.0, -2.0, 0.5]], dtype=F64), torch.tensor([[0.3, 0.0, -4.0]], dtype=F64)
    values = (start + t[..., None] * slope).clone()
    values[0, 2] += 9.0  # does not count
    weight = torch.ones(2, 4, dtype=F64)
    weight[0, 2] = 0.0
    for found, expected in zip(_line(t, values, weight), (start, slope), strict=True):
        torch.testing.assert_close(found, expected.expand(2, 3))
    noisy = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    found = torch.stack(_line(t, noisy, weight))
    for k in range(2):
        kept = weight[k] > 0
        wanted = torch.as_tensor(np.polyfit(t[k, kept].numpy(), noisy[k, kept].numpy(), 1)[::-1].copy())
        torch.testing.assert_close(found[:, k], wanted)
    nothing = _line(t, noisy, torch.zeros_like(weight))
    assert all(bool((part == 0).all()) for part in nothing)


def test_chunks_hold_each_segment_once_and_as_many_variations_as_are_rolled_at_once(monkeypatch) -> None:
    many = _flight().select([0] * 7)
    monkeypatch.setattr(segments_module, "rollouts_at_once", lambda world: 10)
    chunks = many.chunks(4)
    assert [k for chunk in chunks for k in chunk] == list(range(7))
    assert len(chunks) == 3 and all(4 * len(chunk) <= 12 for chunk in chunks)


def test_the_least_force_is_that_of_parabolas_through_the_flights() -> None:
    """The error of the acceleration of a parabola, by least squares, over as many points as are close together."""
    count, std_m = 400, 2e-3
    t = np.linspace(0.0, 0.8, count)
    design = np.stack([np.ones(count), t, 0.5 * t**2], 1)
    error = std_m * math.sqrt(np.linalg.inv(design.T @ design)[2, 2])
    one = SimpleNamespace(
        flight=SimpleNamespace(items=[Segment(0, 0, count - 1)] * 2),
        observations=SimpleNamespace(times_s=torch.as_tensor(t)[None]),
        noise=Noise(std_m, 1e-2),
    )
    least = cast(Any, Prepared.least_force_m_s2).fget
    assert least(one) == pytest.approx(PREPARE_LIMITS.sure * error / math.sqrt(2), rel=0.02)
    assert least(SimpleNamespace(flight=None)) == math.inf


def test_frames_that_something_supports_are_cut_anew_before_the_noise_is_measured(monkeypatch) -> None:
    mask, steps = torch.tensor([[False, True, True]]), []
    state = SimpleNamespace(
        world=world_of(ball_body()), observations=None, flight=["flight"], noise=None, supported=~mask, warnings=[],
        segment=steps.append, measure_noise=lambda flight, _: steps.append(flight),
    )  # fmt: skip
    monkeypatch.setattr(prepare_module, "supported_frames", lambda *given: mask)
    prepare_module._mark_supported_frames(state)  # pyright: ignore[reportArgumentType]
    assert steps == [mask, ["flight"]] and state.supported is mask
    assert state.warnings[0].startswith("2 frames look airborne")


def test_contact_with_a_surface_is_contact_where_there_is_no_ground() -> None:
    """A ball of which the centre alone is measured slides along the top of a fixed box, in a world without ground."""
    ball = ball_body(0.02)
    t = np.arange(60) / 120
    noise = np.random.default_rng(0).normal(0, 1e-4, (2, len(t), 3))
    place = np.stack([0.2 * t, 0 * t, 0 * t + 0.02], 1)
    episodes = [(f"e{k}", {"ball": Track(t, place * (1 - 2 * k, 1, 1) + noise[k], None)}) for k in range(2)]
    table = box((1.0, 1.0, 0.1), position=(0, 0, -0.1))
    world = world_of(ball, ground=False)
    bare = prepare_module.prepare(world, episodes)
    found = prepare_module.prepare(replace(world, surfaces=(table,)), episodes)
    assert not bare.contact_items and bare.flight is not None
    assert {item.episode for item in found.contact_items} == {0, 1} and found.flight is None


def test_a_warning_names_the_episodes_with_the_most_wrong_measurements_first() -> None:
    times = {"a": (0.1,), "b": (0.1, 0.2, 0.3, 0.4, 0.5), "d": (3.0,), "c": (1.0, 2.0)}
    assert _outlier_warnings(9, times) == [
        "9 measurements in flight are wrong and were left out: b at 0.100, 0.200, 0.300 s and 2 more; "
        "c at 1.000, 2.000 s; a at 0.100 s; and 1 more episodes."
    ]
    assert _outlier_warnings(0, {}) == []


def test_contact_is_that_of_the_ground_where_there_are_walls() -> None:
    """A ball rolls towards a wall: what was measured at the wall is left out, and so is the wall."""
    t = np.arange(100) / 120
    x = 0.6 * t
    noise = np.random.default_rng(0).normal(0, 1e-4, (2, len(t), 3))
    place = np.stack([x, 0 * t, 0 * t + 0.02], 1)
    episodes = [(f"e{k}", {"ball": Track(t, place + noise[k], None)}) for k in range(2)]
    wall = box((0.1, 1.0, 0.3), position=(0.45, 0, 0.3))
    world = replace(world_of(ball_body(0.02)), surfaces=(wall,))
    prepared = prepare_module.prepare(world, episodes)
    alone, found = on_the_ground(world, prepared)
    assert not alone.surfaces and alone.bodies is world.bodies
    assert 0 < len(found.contact_items) < len(prepared.contact_items)
    assert f"{len(prepared.contact_items) - len(found.contact_items)} of" in found.warnings[-1]
    before, after = (one.observations.seen[:, : len(t), 0] > 0 for one in (prepared, found))
    at_wall = torch.as_tensor((x > 0.33) & (x < 0.57))
    assert bool((before & at_wall).any()) and not bool((after & at_wall).any())
    assert torch.equal(before[:, x < 0.32], after[:, x < 0.32])
    plain = replace(world, surfaces=())
    assert on_the_ground(plain, prepared) == (plain, prepared)
