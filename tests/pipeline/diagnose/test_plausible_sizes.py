"""A mistake of measurement that is larger than instruments make has to beat a force by its odds."""

from dataclasses import replace

import pytest
from cgwm.pipeline.diagnose.evidence.effect_selection import select_next
from cgwm.pipeline.diagnose.evidence.evidence import implausible, prior_odds
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.diagnose.unlike_episodes import unlike_episodes, unlike_warnings
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.prepare import prepare
from helpers.diagnosis_data import tosses, world_with

ODDS = THRESHOLDS.flight.implausible


@pytest.mark.parametrize(
    ("name", "values", "odds"),
    [
        ("clock_scale", {"s": -0.075}, ODDS),
        ("clock_scale", {"s": 0.001}, 0.0),
        ("length_scale", {"s": 0.019}, 0.0),
        ("gravity_scale", {"s": 0.02}, ODDS),
        ("gravity_scale", {"s": -0.3}, 2 * ODDS),
        ("buoyancy", {"b": 3.0}, 2 * ODDS),
        ("clock_scale", {"s": 0.2}, ODDS),
        ("quadratic_drag", {"k": 4.0}, 0.0),
        ("clock_scale", {}, 0.0),
    ],
)
def test_sizes_beyond_what_instruments_and_nature_have_cost_their_odds(name: str, values: dict, odds: float) -> None:
    assert prior_odds(load_effect(name), values) == odds
    assert bool(implausible(load_effect(name), values)) == (odds > 0)


def test_of_what_flights_do_not_tell_apart_the_plausible_comes_first() -> None:
    fast = tosses(world_with("ball", {"clock_scale": {"s": 0.006}}, False), 4)
    world, prepared = world_with("ball", None, False), prepare(world_with("ball", None, False), fast)
    assert prepared.flight is not None
    candidates = [Candidate(name, load_effect(name)) for name in ("clock_scale", "buoyancy")]
    step = select_next(prepared.flight, world, candidates, [0] * len(fast), True)
    found = {one.name: one for one in step.equals}
    assert list(found) == ["buoyancy", "clock_scale"]
    assert found["clock_scale"].odds == ODDS and found["buoyancy"].odds == 0


def test_a_clock_that_is_wrong_by_a_fifth_comes_before_a_lift_by_a_third_of_the_weight() -> None:
    slow = tosses(world_with("ball", {"clock_scale": {"s": 0.2}}, False), 4)
    world, prepared = world_with("ball", None, False), prepare(world_with("ball", None, False), slow)
    assert prepared.flight is not None
    candidates = [Candidate(name, load_effect(name)) for name in ("buoyancy", "clock_scale", "gravity_scale")]
    step = select_next(prepared.flight, world, candidates, [0] * len(slow), True)
    assert [one.name for one in step.equals] == ["clock_scale", "buoyancy", "gravity_scale"]


def test_an_episode_of_another_frame_rate_is_left_out() -> None:
    world = world_with("ball", None, False)
    episodes = tosses(world, 7)
    name, tracks = episodes[2]
    fast = {body: replace(track, time_s=track.time_s / 2) for body, track in tracks.items()}
    assert unlike_episodes(prepare(world, episodes)) == {}
    found = unlike_episodes(prepare(world, [*episodes[:2], (name, fast), *episodes[3:]]))
    assert list(found) == [name]
    assert found[name] == pytest.approx((4 * 9.81, 9.81), rel=0.02)
    assert unlike_warnings(found)[0].startswith(f"episode '{name}' falls with 39.")
