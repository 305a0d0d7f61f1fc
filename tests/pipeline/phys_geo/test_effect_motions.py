"""Effects of contact in a fit, found where they show: in glides, in impacts, or about first contacts."""

import numpy as np
import pytest
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.optimization import uncertainty
from cgwm.pipeline.phys_geo.effects.by_motion import ImpactStart, SlidingStart
from cgwm.pipeline.phys_geo.effects.effect_fit import fit_effects
from cgwm.pipeline.physics import World
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, effect_parameters
from cgwm.pipeline.segments import first_contact_fit
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import FittedParameter
from helpers.diagnosis_data import NOISE, Effects, tosses, world_with
from scipy.integrate import solve_ivp

LOW = {"height_m": (0.04, 0.04), "lift_m_s": (0.0, 0.0)}
"""Balls that begin on the ground."""


def values(world: World) -> list[tuple]:
    """The contact's numbers with where a search for them starts, all off."""
    return [(p, p.prior[0]) for p in CONTACT_PARAMETERS]


def rolls(effects: Effects, seed: int = 3, count: int = 3) -> list:
    return tosses(world_with("ball", effects), seed, count=count, duration_s=0.5, **LOW)


def inside(found: FittedParameter, truth: float) -> bool:
    assert found.interval_95 is not None
    return found.interval_95[0] < truth < found.interval_95[1]


def test_glides_give_an_effect_with_the_friction_where_a_search_starts() -> None:
    truth = {"rolling_resistance": {"c_r": 0.001}, "torsional_friction": {"c_t": 5e-4}}
    nothing = world_with("ball", {name: {} for name in truth})
    found = fit_effects(nothing, rolls(truth), values(nothing), NOISE)
    assert found.record["glides"] >= 3 and "windows" not in found.record
    for parameter in found.parameters:
        name, _, number = parameter.name.partition(".")
        assert inside(parameter, truth[name][number]) and parameter.state == "fitted"
        assert parameter.std_error is not None and parameter.std_error < 0.1 * truth[name][number]
    assert {p.name for p in found.parameters} == {p.name for p in effect_parameters(nothing)}
    assert found.contact_start["friction"] == pytest.approx(0.3, rel=0.05)
    placed = {a.effect.name: a.values for a in found.world.effects}
    assert float(placed["rolling_resistance"]["c_r"]) == found.parameters[0].estimate


def test_a_tilt_that_no_flight_shows_is_fitted_together_with_the_resistance_of_a_ball_that_rolls_on_it() -> None:
    """Fitted alone to glides, the resistance took what the tilt does: both were wrong, with intervals of no width."""
    truth = {"gravity_tilt": {"tilt_x": 0.01, "tilt_y": -0.03}, "rolling_resistance": {"c_r": 0.0008}}
    nothing = world_with("ball", {name: {} for name in truth})
    found = fit_effects(nothing, rolls(truth, count=5), values(nothing), NOISE)
    assert "in_glides" not in found.record
    for parameter in found.parameters:
        name, _, number = parameter.name.partition(".")
        assert parameter.estimate == pytest.approx(truth[name][number], rel=0.05), parameter.name
        assert inside(parameter, truth[name][number])


@pytest.mark.evidence
def test_intervals_from_glides_hold_the_truth() -> None:
    """Of 40 that are to hold it in 95 %, fewer than 34 would come about once in 700 times."""
    truth = {"rolling_resistance": {"c_r": 0.001}, "torsional_friction": {"c_t": 5e-4}}
    nothing = world_with("ball", {name: {} for name in truth})
    held = []
    for seed in range(20):
        bare = world_with("ball")
        glides = SlidingStart.of(prepare(bare, rolls(truth, seed), NOISE), bare)
        assert glides is not None
        for parameter in glides.fit(nothing, list(truth)).parameters:
            name, _, number = parameter.name.partition(".")
            held.append(inside(parameter, truth[name][number]))
    assert len(held) == 40 and sum(held) >= 34


def test_glides_say_nothing_of_what_presses_on_the_ground() -> None:
    assert not SlidingStart.may_identify(load_effect("adhesion"))
    assert not SlidingStart.may_identify(load_effect("quadratic_drag"))
    assert SlidingStart.may_identify(load_effect("viscous_friction"))


def test_episodes_without_glides_or_impacts_are_left_to_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_contact_fit, "ITERATIONS", 1)
    nothing = world_with("cube", {"viscous_friction": {}})
    thrown = tosses(world_with("cube"), 5, count=2, duration_s=0.35)
    prepared = prepare(world_with("cube"), thrown, NOISE)
    assert SlidingStart.of(prepared, world_with("cube")) is None
    assert ImpactStart.of(prepared, world_with("cube")) is None
    assert fit_effects(nothing, thrown, values(nothing), NOISE).record["windows"] == 2


def test_impacts_of_a_ball_give_a_restitution_that_falls_with_the_speed() -> None:
    truth = {"velocity_restitution": {"r": 0.3}}
    nothing = world_with("ball", {"velocity_restitution": {}})
    dropped = tosses(world_with("ball", truth), 2, count=6, duration_s=0.8, height_m=(0.1, 1.2), lift_m_s=(-0.5, 0.0))
    found = fit_effects(nothing, dropped, values(nothing), NOISE)
    assert found.record["impacts"] >= 6 and "windows" not in found.record
    (only,) = found.parameters
    assert only.name == "velocity_restitution.r" and inside(only, 0.3) and only.estimate > 0.1
    assert found.record["costs"][1] < found.record["costs"][0]
    assert found.contact_start["damping_ratio"] == pytest.approx(0.4, rel=0.3)


def test_what_no_episode_shows_keeps_the_width_of_its_prior() -> None:
    """Many episodes that pull at nothing are no proof of nothing."""
    information, prior = np.diag([100.0, 0.0]), np.diag([0.0, 4.0])
    scores = np.array([[10.0, 0.0], [-10.0, 0.0]] * 5)
    covariance = uncertainty.few_covariance(information + prior, scores, prior)
    assert covariance[0, 0] == pytest.approx(10 * 100 / 1e4 * 10 / 9 * (2.2622 / 1.96) ** 2, rel=1e-3)
    assert covariance[1, 1] == pytest.approx(0.25)


def test_a_number_that_windows_hardly_show_ends_on_no_bound() -> None:
    """More noise than is said, as of a law of contact that misses something, would lead it there."""
    nothing = world_with("cube", {"friction_patch": {"p": 0.2}})
    thrown = tosses(world_with("cube"), 5, count=2, duration_s=0.35, noise=(2e-3, 2e-2))
    wanted = [(p, 0.0) for p in effect_parameters(nothing)]
    found = first_contact_fit.fit_first_contacts(nothing, thrown, wanted, values(nothing), NOISE, True, 0.2)
    assert max(abs(p.estimate) for p in found.parameters) < 0.8  # the bounds are at 1


def test_a_drag_has_no_error_of_the_steps() -> None:
    """Exact flights: with steps that are exact below the noise of a frame, the drag was off by 0.07 %."""
    drag, times = 0.08, np.arange(90) / 120

    def pull(_: float, state: np.ndarray) -> np.ndarray:
        velocity = state[3:]
        return np.r_[velocity, [0, 0, -9.81] - drag * np.linalg.norm(velocity) * velocity]

    episodes = []
    for k in range(4):
        start = np.r_[0, 0, 1.5, 3 + k, 1 - k, 3.5]
        path = solve_ivp(pull, (0, 1), start, t_eval=times, rtol=1e-10, atol=1e-12).y[:3].T
        episodes.append(Episode(str(k), {"ball": Track(times, path, None)}))
    found = fit_effects(world_with("ball", {"quadratic_drag": {}}), episodes, [], Noise(5e-4, 5e-3))
    assert found.parameters[0].estimate == pytest.approx(drag, rel=3e-4)
