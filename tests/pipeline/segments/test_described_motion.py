"""A model that describes nothing is told first: nothing touches what should, or a resting body is nearer."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.physics.body import Body
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments import described_motion
from cgwm.pipeline.segments.described_motion import LIMITS, _Predicted, _sentence, _supported, not_described
from cgwm.pipeline.trajectories.initial_state import clearance
from cgwm.pipeline.trajectories.observations import Observations
from helpers.diagnosis_data import NOISE, tosses, world_with
from helpers.worlds import ball_body, batch

DRAG, ROLLING = {"quadratic_drag": {"k": 0.5}}, {"rolling_resistance": {"c_r": 0.005}}


def lowered(world: World, by_m: float) -> World:
    assert world.ground_offset is not None
    return replace(world, ground_offset=world.ground_offset - by_m)


@pytest.mark.parametrize(("body", "effects"), [("cube", {}), ("ball", {}), ("ball", DRAG), ("ball", ROLLING)])
def test_a_model_that_lacks_an_effect_describes_the_motion(body: str, effects: dict) -> None:
    episodes = tosses(world_with(body, effects), 4, count=4, duration_s=0.7)
    assert not_described(world_with(body), episodes, NOISE) is None


def test_flight_alone_is_described_without_contact() -> None:
    episodes = tosses(world_with("ball", DRAG, ground=False), 5, count=4, duration_s=0.7)
    assert not_described(world_with("ball"), episodes, NOISE) is None


def test_a_ground_that_is_too_low_or_missing_is_the_likely_cause() -> None:
    world = world_with("ball")
    episodes = tosses(world, 3, count=4, duration_s=0.7)
    low = not_described(lowered(world, 12.0), episodes, NOISE)
    assert low is not None and low.never_touches and "ground lies too low" in low.cause
    assert low.sentence.startswith("The model does not describe this motion: nothing touches anything in it")
    none = not_described(world_with("ball", ground=False), episodes, NOISE)
    assert none is not None and none.never_touches and "no ground, no surface and no other body" in none.cause
    flights = tosses(world_with("ball", ground=False), 5, count=7, duration_s=0.3)
    assert not_described(world_with("ball", ground=False), [episodes[0], *flights], NOISE) is None


def test_a_body_that_falls_between_spheres_of_a_rail_is_told() -> None:
    """A ball rests on a row of spheres, of which the model has every fourth."""
    ball = ball_body(0.02)
    rail = row_of_spheres(0.01)
    world = replace(world_with("ball", ground=False), bodies=(ball, rail), step_s=0.008)
    times = np.arange(0, 0.3, 1 / 40)
    rng = np.random.default_rng(0)
    episodes = []
    for k in range(2):
        place = np.stack([0.05 * k + 0.3 * times, 0 * times, 0 * times + 0.03], 1)
        track = Track(times, place + rng.normal(0, 1e-4, place.shape), None)
        episodes.append((str(k), {"ball": track}))
    seen = Observations.of(world, episodes, [(-np.inf, np.inf)] * 2)
    torch.testing.assert_close(clearance(world, seen).abs().amax(), batch(0.0)[0], atol=1e-3, rtol=0)
    gaps = replace(world, bodies=(ball, row_of_spheres(0.08)))
    found = not_described(gaps, episodes, NOISE)
    assert found is not None and found.worse_than == "steady"
    assert "the colliding spheres of 'rail' leave gaps" in found.cause and "[[surfaces]]" in found.cause


def row_of_spheres(apart_m: float) -> Body:
    """A fixed body of spheres of 1 cm along x."""
    along = torch.arange(-0.08, 0.2, apart_m, dtype=torch.float64)
    centers = torch.stack([along, 0 * along, 0 * along], -1)[None]
    like = ball_body(0.01)
    place = batch((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    radii = torch.full((1, len(along)), 0.01, dtype=torch.float64)
    return replace(like, name="rail", motion="fixed", centers=centers, radii=radii, place=place)


def test_heights_that_stay_level_or_turn_at_once_show_a_support() -> None:
    times = torch.arange(0, 0.6, 0.01, dtype=torch.float64)
    falling = 3 * times - 4.905 * times**2
    assert not _supported(times, falling, 9.81) and not _supported(times[:3], 0 * times[:3], 9.81)
    assert _supported(times, 0 * times, 9.81)
    bounce = 2 * (times - 0.3).abs()
    assert _supported(times, bounce, 9.81)
    assert not _supported(times, -bounce, 9.81)  # turns from rising to falling
    assert not _supported(times, 3 * times + 5 * times**2, 9.81)  # rises ever faster


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((0.5, 0.1, "still", 0), "it is 0.5 m off, a body that stands still 0.1 m"),
        ((np.inf, 0.2, "steady", 0), "its rollout diverges, a body that keeps its velocity 0.2 m"),
        ((0.5, 0.1, None, 3), "nothing touches anything in it, while the tracks show contact in 3 of the episodes"),
    ],
)
def test_the_sentence_says_what_describes_the_motion_better(numbers: tuple, said: str) -> None:
    sentence = _sentence(*numbers, "a wrong ground")
    assert sentence == f"The model does not describe this motion: {said}. Likely cause: a wrong ground."


SIZE_M = 0.07


def predicted(model: torch.Tensor, measured: torch.Tensor, free: torch.Tensor | None = None) -> _Predicted:
    """Predictions (E, T, 3) beside measured motion (E, T, 3) at 100 Hz, the first three frames being the warm-up."""
    count, frames, _ = measured.shape
    body = replace(ball_body(0.04), centers=batch([[0.0, 0.0, 0.03]]))
    seen = torch.ones(count, frames, 1, dtype=torch.float64)
    times = (torch.arange(frames, dtype=torch.float64) / 100).expand(count, -1)
    after = (seen > 0) & (torch.arange(frames)[None, :, None] > 2)
    measured_at: Any = SimpleNamespace(position_m=measured[:, :, None], times_s=times, seen=seen, free=(0,))
    return _Predicted(
        world=replace(world_with("ball"), bodies=(body,)),
        seen=measured_at,
        after=after,
        last=torch.full((count,), 2),
        model=model[:, :, None],
        free=(model if free is None else free)[:, :, None],
        noise=NOISE,
    )


def moving(count: int, frames: int = 43) -> torch.Tensor:
    """Straight motion at 1 m/s along x, each episode at another place, in free flight for all that heights show."""
    times = torch.arange(frames, dtype=torch.float64) / 100
    falls = torch.stack([times, 0 * times, 3 * times - 4.905 * times**2], -1)
    return falls + torch.arange(count, dtype=torch.float64)[:, None, None] * torch.tensor([0.0, 5.0, 0.0])


def test_errors_count_after_the_warm_up_and_bodies_that_stay_or_go_on_start_there() -> None:
    measured = moving(2)
    off = measured.clone()
    off[0, :3] += 7.0  # in the warm-up
    off[0, 3:, 0] += 0.3
    off[1, 23:, 1] -= 0.4  # in half of the frames after it
    one = predicted(off, measured)
    assert one.size_m == pytest.approx(SIZE_M)
    assert one._errors(one.model).tolist() == pytest.approx([0.3, 0.2])
    still, steady = one._held(False), one._held(True)
    torch.testing.assert_close(still, measured[:, 2:3, None].expand_as(still))
    along = (measured[:, 2] - measured[:, 0]) / 0.02
    torch.testing.assert_close(steady[:, 12, 0], measured[:, 2] + 0.1 * along)
    torch.testing.assert_close(steady[:, 0, 0], measured[:, 0])


@pytest.mark.parametrize("steady", [False, True])
def test_a_model_has_to_be_twice_as_good_as_no_model(steady: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(described_motion, "clearance", lambda *_: torch.zeros(4, 43, dtype=torch.float64))
    times = torch.arange(43, dtype=torch.float64) / 100
    # a curve that a body at rest, or one that keeps its velocity, misses by a known distance
    away = 0.2 * (times > 0.025) if not steady else 5 * times - 0.2 * (times > 0.025)
    measured = torch.stack([away, 0 * times, 0.5 + 0 * times], -1).expand(4, -1, -1)
    least = LIMITS.times_worse * 0.2 + LIMITS.sizes_worse * SIZE_M
    for error, found in ((0.99 * least, False), (1.01 * least, True)):
        one = predicted(measured + torch.tensor([0.0, error, 0.0]), measured, measured)
        verdict = one.verdict()
        assert (verdict is not None) is found
        if verdict is not None:
            assert verdict.worse_than == ("steady" if steady else "still") and not verdict.never_touches
            assert verdict.error_m == pytest.approx(error) and verdict.episodes == 4
            assert (verdict.steady_error_m if steady else verdict.still_error_m) == pytest.approx(0.2)
    some = measured + torch.tensor([0.0, 3 * least, 0.0]) * torch.tensor([1.0, 1.0, 0.0, 0.0])[:, None, None]
    assert predicted(some, measured, measured).verdict() is None  # in half of the episodes
    gone = predicted(torch.full_like(measured, torch.inf), measured, measured).verdict()
    assert gone is not None and gone.error_m is None


def test_contact_is_what_changes_the_prediction_and_what_tracks_show() -> None:
    measured = moving(4)
    model, free = measured.clone(), measured.clone()
    free[0, 10, 2] -= 1.01 * LIMITS.touch_m
    free[1, 10, 2] -= 0.99 * LIMITS.touch_m
    free[2, 1, 2] -= 1.0  # before the warm-up ends
    one = predicted(model, measured, free)
    assert one._touches_in_model().tolist() == [True, False, False, False]
    level = measured.clone()
    level[1, :, 2] = 0.5
    assert predicted(model, level)._touched_in_tracks().tolist() == [False, True, False, False]
    hidden = predicted(model, level)
    hidden.seen.seen[1, 5:] = 0
    assert not bool(hidden._touched_in_tracks().any())
    weightless = replace(hidden, world=replace(hidden.world, gravity=0 * hidden.world.gravity))
    assert not bool(weightless._touched_in_tracks().any())


def test_the_cause_follows_from_the_distance_to_what_could_be_touched(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = moving(3)
    sunk = measured.clone()
    sunk[:2, 10, 2] -= 1.01 * SIZE_M
    one = predicted(sunk, measured)
    assert one._sinks() and not predicted(measured + sunk - sunk, measured)._sinks()
    sunk[:, 10, 2] = measured[:, 10, 2] - 0.99 * SIZE_M
    assert not predicted(sunk, measured)._sinks()
    near, inside = LIMITS.near_sizes * SIZE_M, -LIMITS.inside_sizes * SIZE_M
    for gap, said in (
        (torch.inf, "nothing to touch"),
        (1.01 * near, "too low"),
        (0.99 * near, "wrong shape"),
        (0.99 * inside, "wrong shape"),
        (1.01 * inside, "too high"),
    ):
        gaps = torch.full((3, 43), gap, dtype=torch.float64)
        gaps[:, 7:] += 1.0  # the nearest frame counts
        monkeypatch.setattr(described_motion, "clearance", lambda *_, gaps=gaps: gaps)
        assert said in one._cause()


def test_a_bounce_is_fast_and_a_support_lasts() -> None:
    times = torch.arange(0, 0.6, 0.01, dtype=torch.float64)
    for speed, found in ((1.05 * LIMITS.turn_m_s, True), (0.95 * LIMITS.turn_m_s, False)):
        # falls ever more slowly before, rises ever faster after: level nowhere
        bounce = speed * (times - 0.295).abs() + 20 * (times - 0.295).square()
        bounce[27:33] = speed * (times[27:33] - 0.295).abs()
        assert _supported(times, bounce, 9.81) is found
    free_m = 0.5 * 9.81 * (LIMITS.level_s / 2) ** 2 * LIMITS.level_share
    for change, found in ((0.97 * free_m, True), (1.1 * free_m, False)):
        assert _supported(times, change / LIMITS.level_s * times, 9.81) is found
    short = times[times < 0.95 * LIMITS.level_s]
    assert not _supported(short, 0 * short, 9.81)


def test_noise_swapped_markers_and_flat_tops_are_no_support() -> None:
    rng = np.random.default_rng(3)
    times = torch.arange(0, 0.8, 0.001, dtype=torch.float64)
    thrown = 3 * times - 4.905 * times**2
    noisy = thrown + 5e-4 * torch.as_tensor(rng.normal(size=len(times)))
    assert not _supported(times, noisy, 9.81, 5e-4)
    bounced = torch.where(times < 0.4, 0.785 - 4.905 * times**2, 3 * (times - 0.4) - 4.905 * (times - 0.4) ** 2)
    assert _supported(times, bounced + (noisy - thrown), 9.81, 5e-4)
    slow = times[::8]
    swapped = torch.where(slow < 0.5, 0.3 - slow, 1.0 + slow)  # on to a body that rises
    assert not _supported(slow, swapped, 9.81, 5e-4)
    lifted = 1.2 * (slow - 0.4) ** 2  # a spin that carries most of the weight
    assert not _supported(slow, -lifted, 9.81, 5e-4) and _supported(slow, lifted, 9.81, 5e-4)
