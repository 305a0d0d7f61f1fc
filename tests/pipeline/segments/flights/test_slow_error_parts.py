"""Slow errors: what flights count, what states and effects leave of them, and how far frames are thinned out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.segments.flights import slow_errors
from cgwm.pipeline.segments.flights.slow_errors import (
    FINER,
    FLIGHTS,
    LEAST_COUNT,
    LIMITS,
    SHORTEST,
    SPACING,
    THINNED,
    SlowErrors,
    tell_errors,
)
from cgwm.pipeline.segments.flights.variance_components import FAST_S, FASTEST_S
from cgwm.pipeline.trajectories.innovations import CorrelatedNoise, NoiseModel
from cgwm.pipeline.trajectories.segmentation import Segment
from cgwm.pipeline.trajectories.track_noise import FLOOR_M, FLOOR_RAD
from helpers.worlds import F64, ball_body, world_of


def flights(seen: torch.Tensor, turned: torch.Tensor, episodes: list[int] | None = None, bodies: int = 1) -> Any:
    """Flights (B) with measured frames (B, T), whose errors are independent."""
    items = [SimpleNamespace(episode=k) for k in (episodes or range(len(seen)))]
    observations = SimpleNamespace(seen=seen[..., None], has_orientation=turned[..., None], free=tuple(range(bodies)))
    return SimpleNamespace(items=items, observations=observations, innovations=lambda rows: rows)


def test_what_a_flight_leaves_is_that_of_least_squares_by_its_own_state_and_effects() -> None:
    rng = np.random.default_rng(0)
    seen, turned = torch.ones(3, 9, dtype=F64), torch.ones(3, 9, dtype=F64)
    seen[1, 5:], turned[1, 2:], turned[2] = 0, 0, 0
    rows, jacobian = torch.as_tensor(rng.normal(size=(3, 9, 6))), torch.as_tensor(rng.normal(size=(3, 9, 6, 5)))
    jacobian[..., 3] = 100 * jacobian[..., 0] - jacobian[..., 1]  # nothing that two others do not do
    jacobian[..., 4] *= 1e-5  # moves nothing
    jacobian[2, :, 3:] = torch.nan  # as rotations that were not measured have
    square, count = slow_errors._left(flights(seen, turned), rows, jacobian)
    for k in range(3):
        known = torch.stack((seen[k], turned[k]), -1).repeat_interleave(3, -1).flatten().bool()
        columns = torch.nan_to_num(jacobian[k]).flatten(0, 1)[known][:, :4].numpy()
        left = rows[k].flatten()[known].numpy()
        rest = left - columns @ np.linalg.lstsq(columns, left, rcond=1e-9)[0]
        assert float(square[k]) == pytest.approx(rest @ rest)
        assert float(count[k]) == int(known.sum()) - np.linalg.matrix_rank(columns)


@pytest.mark.parametrize(("size", "kept"), [(0.9, True), (1.15, False)])
def test_a_flight_counts_unless_it_is_far_louder_than_the_quiet_ones(size: float, kept: bool) -> None:
    loud = LIMITS.unsound * size
    variance = np.array([1.0, 1.0, 1.0, loud, 50.0, 1.0])
    seen = torch.ones(6, 20, dtype=F64)
    seen[4, 1:] = 0  # a single frame tells nothing of its variance
    rows = torch.as_tensor(np.sqrt(variance))[:, None, None].expand(-1, 20, 6)
    jacobian = torch.zeros(6, 20, 6, 2, dtype=F64)
    assert 6 < LEAST_COUNT < 120
    wanted = [0, 1, 2, 3, 4, 5] if kept else [0, 1, 2, 4, 5]
    assert slow_errors._sound_flights(flights(seen, seen), rows, jacobian) == wanted
    assert slow_errors._sound_flights(flights(seen, seen, bodies=2), rows, jacobian) == [0, 1, 2, 3, 4, 5]
    # without the loud one two episodes are left, which are too few
    few = flights(seen, seen, [0, 0, 0, 1, 2, 2])
    assert LIMITS.least_episodes == 3 and slow_errors._sound_flights(few, rows, jacobian) == [0, 1, 2, 3, 4, 5]
    seen[1:3, 1:], seen[5, 1:] = 0, 0  # two flights of which the variance is told are too few to compare
    assert slow_errors._sound_flights(flights(seen, seen), rows, jacobian) == [0, 1, 2, 3, 4, 5]


def thinned(
    monkeypatch: pytest.MonkeyPatch,
    known: CorrelatedNoise,
    found_s: list[float],
    counts: list[float | None],
    level: tuple[int, ...] = (0, 1),
) -> tuple[list[float], Any]:
    """Return the times between frames that were tried where estimates give times, and numbers of contrasts."""
    tried, times = [], iter(found_s)

    def contrasts(*arguments: Any) -> Any:
        tried.append(arguments[5])
        assert arguments[3:5] == (7, 0) and arguments[6] == (level or (0, 1, 2))
        count = counts[min(len(tried), len(counts)) - 1]
        return None if count is None else SimpleNamespace(count=count)

    def components(one: Any, given: Any, axes: Any) -> Any:
        assert one.count >= LIMITS.least_frames and given is known and axes == level
        time_s = next(times)
        return (time_s, CorrelatedNoise(size=1.0, share=0.5, time_s=time_s), 0.0, 0.0)

    monkeypatch.setattr(slow_errors, "FlightContrasts", SimpleNamespace(of=contrasts))
    monkeypatch.setattr(slow_errors, "variance_components", components)
    found = slow_errors._parts(SimpleNamespace(), (torch.zeros(1), torch.zeros(1)), 7, 0, known, level)  # pyright: ignore[reportArgumentType]
    return tried, found


def test_frames_are_thinned_out_again_while_the_errors_turn_out_to_be_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    enough: list[float | None] = [float(LIMITS.least_frames)]
    white, slow = CorrelatedNoise(), CorrelatedNoise(size=1.0, share=0.5, time_s=0.04)
    assert thinned(monkeypatch, white, [0.1], enough)[0] == [0.0]
    assert thinned(monkeypatch, white, [0.1], enough, ())[0] == [0.0]  # errors of rotations are alike in all axes
    first = SPACING * 0.04
    assert first < SPACING * FAST_S
    assert thinned(monkeypatch, slow, [0.04], enough)[0] == pytest.approx([first])
    assert thinned(monkeypatch, slow, [1.01 * FINER * 0.04], enough)[0] == pytest.approx([first])
    tried, found = thinned(monkeypatch, slow, [0.99 * FINER * 0.04, 0.04], enough)
    assert tried == pytest.approx([first, 0.99 * FINER * first]) and found[0] == 0.04
    ever = [0.02, 0.01, 0.004, 0.002]
    tried, found = thinned(monkeypatch, slow, ever, enough)
    assert len(tried) == THINNED and found[0] == ever[THINNED - 1]
    lasting = CorrelatedNoise(size=1.0, share=0.5, time_s=10 * FAST_S)
    assert thinned(monkeypatch, lasting, [FAST_S], enough)[0] == pytest.approx([SPACING * FAST_S])


def test_flights_that_show_too_little_are_thinned_out_less(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = CorrelatedNoise(size=1.0, share=0.5, time_s=0.04)
    few = float(LIMITS.least_frames - 1)
    tried, _ = thinned(monkeypatch, slow, [0.04], [few, None, few + 1])
    assert tried == pytest.approx([0.02, 0.01, 0.005])
    tried, found = thinned(monkeypatch, slow, [0.01], [few + 1, *[None] * 20])
    assert found[0] == 0.01 and tried[1] == pytest.approx(0.25 * tried[0]) and tried[-1] == 0.0  # the first stays
    tried, found = thinned(monkeypatch, slow, [], [None])
    assert found is None and tried[-1] == 0.0
    steps = tried[:-1]
    assert steps == pytest.approx([0.02 / 2**k for k in range(len(steps))]) and steps[-1] <= FASTEST_S < steps[-2]


def test_flights_are_enough_by_their_episodes_and_measured_frames() -> None:
    def told(frames: int, episodes: int, hidden: int = 0) -> bool:
        first = 3
        items = tuple(Segment(k, first, first + frames - 1) for k in range(episodes))
        seen = torch.zeros(episodes, frames + 5, 1, dtype=F64)
        seen[:, first : first + frames] = 1
        seen[0, first : first + hidden] = 0
        observations = SimpleNamespace(seen=seen)
        return tell_errors(SimpleNamespace(flight=SimpleNamespace(items=items), observations=observations))  # pyright: ignore[reportArgumentType]

    each = LIMITS.least_frames // LIMITS.least_episodes
    assert each * LIMITS.least_episodes == LIMITS.least_frames and each > SHORTEST
    assert told(each, LIMITS.least_episodes) and not told(each, LIMITS.least_episodes, hidden=1)
    assert told(each + 1, LIMITS.least_episodes, hidden=3)
    assert not told(10 * each, LIMITS.least_episodes - 1)
    many = -(-LIMITS.least_frames // (SHORTEST - 1))
    assert not told(SHORTEST - 1, many) and told(SHORTEST, many)  # flights of fewer frames are none
    assert not tell_errors(SimpleNamespace(flight=None, observations=SimpleNamespace(seen=torch.zeros(1, 1, 1))))  # pyright: ignore[reportArgumentType]


def test_components_below_the_floor_of_tracks_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions and rotations each have their components; gravity tells which axes of positions are level."""
    world, known = world_of(ball_body()), NoiseModel(CorrelatedNoise(), CorrelatedNoise())
    noise = SimpleNamespace(position_m=2 * FLOOR_M, rotation_rad=4 * FLOOR_RAD)
    noise = [noise.position_m, noise.rotation_rad]
    own = SimpleNamespace(select=lambda places: places, observations=SimpleNamespace(state=None))
    prepared: Any = SimpleNamespace(
        segments=lambda *_: None, observations=SimpleNamespace(), noise=noise, noise_model=known
    )
    asked: dict[int, Any] = {}
    sizes, slow = {0: 1.0, 1: 1.0}, {0: 0.2, 1: 0.2}

    def parts(flown: Any, linear: Any, count: int, kind: int, given: Any, level: tuple[int, ...]) -> Any:
        asked[kind] = (flown, linear, count, given, level)
        big = CorrelatedNoise(size=sizes[kind], slow=slow[kind], slow_time_s=0.3)
        return big, CorrelatedNoise(size=sizes[kind]), 3.0 + kind, 9.0 - kind

    rows, width = torch.arange(3.0, dtype=F64)[:, None, None].expand(3, 2, 6), 0.25
    jacobian = torch.ones(3, 2, 6, 4, dtype=F64)
    parameter = SimpleNamespace(prior=(0.0, width))
    monkeypatch.setattr(slow_errors, "replace", lambda one, **_: one)
    monkeypatch.setattr(slow_errors, "fit_states", lambda _: own)
    monkeypatch.setattr(slow_errors, "Segments", SimpleNamespace(of=lambda *_: SimpleNamespace(with_state=lambda _: 0)))
    monkeypatch.setattr(slow_errors, "derivatives", lambda *_: ([parameter], rows, jacobian.clone()))
    monkeypatch.setattr(slow_errors, "_sound_flights", lambda *_: [0, 2])
    monkeypatch.setattr(slow_errors, "_timed_forces", lambda some: torch.full((len(some), 2, 6, 2), 7.0, dtype=F64))
    monkeypatch.setattr(slow_errors, "_parts", parts)
    items: Any = ["a", "b", "c"]
    found, wrong = slow_errors._of_flights(prepared, world, [], items)
    assert found is not None and wrong == ["b"]
    assert (found.evidence, found.sway_evidence) == (4.0, 9.0)
    assert [part.slow for part in found.noise_model] == [0.2, 0.2] and not found.without_sway.slow
    assert [one[4] for one in asked.values()] == [(0, 1), ()] and {one[2] for one in asked.values()} == {3}
    flown, (some, slopes), *_ = asked[0]
    assert flown == [0, 2] and some[:, 0, 0].tolist() == [0.0, 2.0]
    assert slopes[0, 0, 0].tolist() == [7.0, 7.0, width, 1.0, 1.0, 1.0]  # effects in their usual sizes
    sizes[0], sizes[1] = 0.49, 0.26  # the floor is 1 / 2 and 1 / 4
    found, _ = slow_errors._of_flights(prepared, world, [], items)
    assert found is not None and found.noise_model.position == known.position and found.evidence == 4.0
    assert found.noise_model.rotation.size == 0.26
    sizes[1] = 0.24
    found, wrong = slow_errors._of_flights(prepared, world, [], items)
    assert (
        found is not None and found.noise_model == known and found.evidence == found.sway_evidence == 0.0
    )  # one flight counts for nothing
    slow[0] = 0.51
    found, _ = slow_errors._of_flights(prepared, world, [], items)
    assert found is not None and found.noise_model.position.slow == 0.51
    slow[0] = 0.2
    monkeypatch.setattr(slow_errors, "_sound_flights", lambda *_: [0, 1, 2])
    assert slow_errors._of_flights(prepared, world, [], items) == (None, [])


def test_errors_are_told_from_flights_evenly_spread_over_all(monkeypatch: pytest.MonkeyPatch) -> None:
    items = [Segment(k, 0, 2 * SHORTEST) for k in range(3 * FLIGHTS)]
    short = [Segment(k, 0, SHORTEST - 2) for k in range(3)]
    prepared: Any = SimpleNamespace(flight=SimpleNamespace(items=tuple(items)))
    chosen: list[Segment] = []
    wrong = [items[5]]

    def of_flights(_: Any, world: Any, variants: Any, some: list[Segment]) -> Any:
        chosen[:] = some
        return found, wrong

    monkeypatch.setattr(slow_errors, "whole_flights", list)
    monkeypatch.setattr(slow_errors, "_of_flights", of_flights)
    model = NoiseModel(CorrelatedNoise(slow=0.3))
    found: SlowErrors | None = SlowErrors(model, NoiseModel(), 1.0, 2.0, ())
    result = slow_errors.flight_errors(prepared, world_of(ball_body()), [])
    assert result is not None and result.flights == tuple(one for one in items if one not in wrong)
    episodes = [one.episode for one in chosen]
    assert len(chosen) == FLIGHTS and episodes[0] == 0 and episodes[-1] == 3 * FLIGHTS - 1
    assert set(np.diff(episodes)) == {3, 4}
    assert slow_errors.slow_errors(prepared, world_of(ball_body()), []) == result
    found = SlowErrors(NoiseModel(), NoiseModel(), 0.0, 0.0, ())  # errors that are not slow
    assert slow_errors.slow_errors(prepared, world_of(ball_body()), []) is None
    assert slow_errors.flight_errors(prepared, world_of(ball_body()), []) is not None
    prepared.flight.items = (*items[: LIMITS.least_episodes], *short)
    slow_errors.flight_errors(prepared, world_of(ball_body()), [])
    assert chosen == items[: LIMITS.least_episodes]
    prepared.flight.items = (*items[: LIMITS.least_episodes - 1], *short)
    assert slow_errors.flight_errors(prepared, world_of(ball_body()), []) is None
    prepared.flight.items, found = tuple(items), None
    assert slow_errors.flight_errors(prepared, world_of(ball_body()), []) is None
    prepared.flight = None
    assert slow_errors.flight_errors(prepared, world_of(ball_body()), []) is None
