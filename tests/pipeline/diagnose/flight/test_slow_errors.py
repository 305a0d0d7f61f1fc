"""Slow errors of the tracks: they are found in whole flights, are no effect, and hide none that repeats."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose.evidence.effect_selection import _with_unproven, select_next
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.flight import findings as flight_findings
from cgwm.pipeline.diagnose.flight import own_tilt
from cgwm.pipeline.diagnose.flight import selection as flight_selection
from cgwm.pipeline.diagnose.flight.findings import _Search
from cgwm.pipeline.diagnose.flight.group_values import _alike, in_several
from cgwm.pipeline.diagnose.flight.own_accelerations import OwnAccelerations  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.diagnose.flight.rest_tilts import rests_confirm  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.diagnose.flight.selection import FlightSelection
from cgwm.pipeline.diagnose.remaining import remaining_of
from cgwm.pipeline.diagnose.report.pictures import effect_picture
from cgwm.pipeline.diagnose.verdict import Findings, _verdict, find
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.candidates import Candidate, base_parameters
from cgwm.pipeline.segments.flights.contrasts import moving  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.segments.flights.repeated_forces import RepeatedForce, repeated_force  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.segments.flights.residual_wrench import Omnibus, ResidualWrenches
from cgwm.pipeline.segments.flights.slow_errors import SlowErrors  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.segments.prepare import Prepared, prepare, whole_flights
from cgwm.pipeline.segments.segment_fit import refit
from cgwm.pipeline.trajectories.innovations import FALLS, CorrelatedNoise, NoiseModel, axis_innovations, matern  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.trajectories.segmentation import Segment
from helpers.diagnosis_data import tosses, world_with

LIBRARY = [
    Candidate(name, load_effect(name)) for name in ("linear_drag", "gravity_scale", "gravity_tilt", "frame_tilt")
]
WINDY = [*LIBRARY, Candidate("wind", load_effect("wind"))]
SLOW_M, SLOW_S, WHITE_M = 7e-4, 0.2, 1e-4


def drifting(track: Track, rng: np.random.Generator, tilt_m_s2: float = 0.0) -> Track:
    """The centroid alone, with slow errors and an acceleration across gravity of its own."""
    away = np.zeros((len(track.time_s), 3))
    away[0] = rng.standard_normal(3)
    for k, step in enumerate(np.diff(track.time_s), 1):
        kept = np.exp(-step / SLOW_S)
        away[k] = kept * away[k - 1] + np.sqrt(1 - kept**2) * rng.standard_normal(3)
    push = tilt_m_s2 * rng.standard_normal(3) * (1, 1, 0)
    path = 0.5 * (track.time_s - track.time_s[0])[:, None] ** 2 * push
    noise = WHITE_M * rng.standard_normal(away.shape)
    return replace(track, position_m=track.position_m + SLOW_M * away + noise + path, quat_wxyz=None)


def found(effects: dict, tilt_m_s2: float = 0.0, seed: int = 1, library: Sequence[Candidate] = LIBRARY) -> Findings:
    rng = np.random.default_rng(seed)
    flying = tosses(world_with("ball", effects, False), seed, count=8, duration_s=0.8, noise=(1e-9, 1e-8))
    episodes = [(name, {b: drifting(t, rng, tilt_m_s2) for b, t in tracks.items()}) for name, tracks in flying]
    world = world_with("ball", ground=False)
    return find(prepare(world, episodes), world, library)


@pytest.mark.parametrize("order", FALLS)
def test_innovations_of_slow_errors_are_what_the_inverse_of_the_covariance_says(order: float) -> None:
    rng = np.random.default_rng(0)
    times = torch.as_tensor(np.sort(rng.uniform(0, 0.8, (2, 10)), axis=1))
    mask = torch.ones(2, 10, dtype=torch.float64)
    mask[0, [3, 4, 8]] = 0
    rows = torch.as_tensor(rng.standard_normal((2, 10, 3, 4))) * mask[..., None, None]
    noise = CorrelatedNoise(share=0.6, time_s=0.02, size=1.5, slow=4.0, slow_time_s=0.3, sway=30.0, order=order)
    whitened = axis_innovations(rows, times, mask, noise)
    for k in range(2):
        kept = mask[k] > 0
        t = times[k, kept]
        gap, path = (t[:, None] - t).abs(), 0.5 * (t - times[k, 0]).square()
        common = 2.25 * (0.6 * matern(gap, 0.02, order) + 0.4 * torch.eye(len(t))) + 16 * torch.exp(-gap / 0.3)
        for axis in range(3):
            covariance = common + (900 * path[:, None] * path if axis < 2 else 0)
            known = torch.linalg.solve_triangular(
                torch.linalg.cholesky(covariance), rows[k, kept][:, axis], upper=False
            )
            torch.testing.assert_close(whitened[k, kept][:, axis], known, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("noise", [CorrelatedNoise(0.6, 0.02, 1.5), CorrelatedNoise(0.6, 0.02, 1.5, 4.0, 0.3, 30.0)])
def test_innovations_do_not_depend_on_the_other_items_of_a_batch(noise: CorrelatedNoise) -> None:
    rng = np.random.default_rng(1)
    grid = torch.arange(12, dtype=torch.float64) / 240
    times = torch.stack((grid, grid + 5.125, grid, grid.square()))  # the first three have one grid
    mask = torch.ones(4, 12, dtype=torch.float64)
    mask[1, 9:], mask[2, 4] = 0, 0
    rows = torch.as_tensor(rng.standard_normal((4, 12, 3))) * mask[..., None]
    together = axis_innovations(rows, times, mask, noise)
    for k in range(4):
        last = 9 if k == 1 else 12
        alone = axis_innovations(*(part[k : k + 1, :last] for part in (rows, times, mask)), noise)
        torch.testing.assert_close(together[k : k + 1, :last], alone, rtol=1e-6, atol=1e-8)
    lost = rows.clone()
    lost[0, 6:] = torch.nan
    torch.testing.assert_close(axis_innovations(lost, times, mask, noise)[0, :6], together[0, :6], rtol=1e-6, atol=1e-8)


def test_slow_errors_are_no_effect() -> None:
    silent = found({})
    assert silent.verdict == "none_missing" and not silent.chosen


# In the suite: each part of the search is tested in this file, a drag by group at its end.
@pytest.mark.evidence
def test_a_drag_is_named_beside_slow_errors_with_the_right_number() -> None:
    named = found({"linear_drag": {"c": 0.3}}, seed=2)
    assert [one.evidence.name for one in named.chosen] == ["linear_drag"]
    estimate, error = named.chosen[0].evidence.estimates["c"]
    assert abs(estimate - 0.3) < 3 * error and error < 0.03
    # beside a force that differs from episode to episode, what explains nearly all stands, and nothing else does
    assert not replace(named.flight, own_law="heading").doubtful
    assert replace(named.flight, own_law="heading", steps=()).doubtful


@pytest.mark.parametrize("repeats", [pytest.param(False, marks=pytest.mark.evidence), True])
def test_what_differs_from_episode_to_episode_beside_slow_errors_is_no_missing_physics(repeats: bool) -> None:
    """No model of slow errors is exact: those of smoothed tracks exceed it in every episode, each in its own way."""
    silent = found({}).flight
    law = RepeatedForce(coordinate="x", frame="world", gains=(9.0, 10.0, 11.0) if repeats else (-9.0, 10.0, -11.0))
    errors = SlowErrors(NoiseModel(), NoiseModel(), evidence=100.0, sway_evidence=0.0, flights=())
    left = replace(silent, slow=errors, left=law, after=Omnibus(3.0, 100.0, 1e-9), common_share=float(not repeats))
    assert left.remains and _verdict((), left) == ("unexplained" if repeats else "none_missing")
    assert _verdict((), replace(left, slow=None, left=None)) == "unexplained"
    # what contact shows stands beside a misfit of flights that repeats nowhere, and not beside one that does
    seen: Any = SimpleNamespace(equals=(SimpleNamespace(name="torsional_friction"),))
    assert _verdict((seen,), replace(left, slow=None)) == ("unexplained" if repeats else "missing_effect")


def test_rivals_in_the_presence_of_an_effect_that_has_gone_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside another drag, what is left of a drag may be a scale of gravity; without that one it may not."""

    def both(prepared: Prepared, world: World, candidates: Sequence[Candidate], scatter: float):
        flight, steps = prepared.flight, []
        assert flight is not None
        for name in ("quadratic_drag", "linear_drag"):
            step = select_next(flight, world, [Candidate(name, load_effect(name))], prepared.groups, False, scatter)
            refitted = step.best.refitted
            assert refitted is not None
            steps.append(step)
            world, flight = refitted.world, refitted.segments[0]
        other = Candidate("gravity_scale", load_effect("gravity_scale"))
        steps[-1] = replace(steps[-1], equals=(steps[-1].best, replace(steps[-1].best, candidate=other)))
        return steps, world, flight

    def the_last(found: FlightSelection) -> FlightSelection:
        return found.without({"quadratic_drag"})

    monkeypatch.setattr(flight_findings, "flight_search", both)
    monkeypatch.setattr(flight_selection, "_with_the_needed", the_last)
    flying = tosses(world_with("ball", {"linear_drag": {"c": 0.3}}, False), 2, count=4, duration_s=0.6)
    world = world_with("ball", ground=False)
    errors = NoiseModel(position=CorrelatedNoise(share=0.5, time_s=0.02, slow=1.0, slow_time_s=0.2))
    prepared = prepare(world, flying).with_slow_noise(world, errors)
    slow = SlowErrors(errors, errors, evidence=100.0, sway_evidence=0.0, flights=())
    search = _Search(prepared, world, LIBRARY)
    beside = search.beside(None)
    left = search.findings(beside, search.selection(beside), slow, None)
    assert [[one.name for one in step.equals] for step in left.steps] == [["linear_drag"]]
    remaining = remaining_of(left)
    # with the drag: the noise of three coordinates; without it, centimetres
    assert remaining is not None and remaining.position_rms_m < 3 * prepared.noise.position_m


def test_of_rivals_the_one_that_acts_alone_comes_first() -> None:
    """A wind acts through a drag, and a tilt without one: it is no simpler, however well it fits."""

    def rival(name: str, bic: float) -> Evidence:
        refitted = SimpleNamespace(by_segment=[torch.tensor([1.0, 2.0, 3.0])])
        return cast(Evidence, SimpleNamespace(candidate=Candidate(name, load_effect(name)), name=name,
                                              refitted=refitted, delta_bic=bic, odds=0.0, repetition=None))  # fmt: skip

    wind, tilt = rival("wind", -2.0), rival("gravity_tilt", -1.0)
    assert _with_unproven([wind], [wind, tilt], np.arange(3)) == [tilt, wind]


# In the suite: a tilt of each episode's own is found in the tests below and in test_diagnosis.py.
@pytest.mark.evidence
def test_a_tilt_that_differs_from_episode_to_episode_is_named_as_such() -> None:
    named = found({}, tilt_m_s2=0.15, seed=3)
    assert [one.evidence.candidate.spec for one in named.chosen] == ["gravity_tilt@episode"]
    (tilt,) = named.chosen
    assert {one.candidate.spec for one in tilt.equals} == {"gravity_tilt@episode", "frame_tilt@episode"}
    assert tilt.evidence.spread["tilt_x"] == pytest.approx(0.15 / 9.81, rel=0.5)
    remaining = remaining_of(named.flight)
    # 0.15 m/s2 alone are some 5 mm; what each episode has of its own does not count as left
    assert remaining is not None and remaining.position_rms_m < 3 * SLOW_M


@pytest.mark.parametrize(("own", "repeats"), [(False, True), (True, False)])
def test_what_repeats_is_told_from_what_each_episode_has_of_its_own(own: bool, repeats: bool) -> None:
    """A force by place, and one of the same size that is turned in another way in each episode."""
    rng = np.random.default_rng(4)
    count, each = 8, 10
    place = rng.uniform(-1, 1, count * each)
    wrench = np.zeros((count * each, 6))
    wrench[:, 0] = np.sign(place) * (np.repeat(rng.choice([-1.0, 1.0], count), each) if own else 1.0)
    wrench += 0.3 * rng.standard_normal(wrench.shape)
    windows = ResidualWrenches(
        segments=tuple(Segment(k // each, 0, 9) for k in range(count * each)),
        wrench=wrench,
        information=np.tile(np.eye(6) / 0.09, (count * each, 1, 1)),
        coordinates={"x": place, "speed": rng.uniform(1, 2, count * each)},
        velocity=rng.standard_normal((count * each, 3)),
        omega=rng.standard_normal((count * each, 3)),
    )
    law = repeated_force(windows)
    assert law is not None and (law.p_value < 1e-3) == repeats
    if repeats:
        assert law.coordinate == "x" and law.frame == "world"


@pytest.mark.parametrize(
    ("kind", "law"), [("tilts", None), ("heading", "heading"), ("place", "place"), ("lift", "upward")]
)
def test_what_is_of_each_episode_s_own_is_told_from_a_law_of_its_motion(kind: str, law: str | None) -> None:
    rng = np.random.default_rng(7)
    count, each = 8, 4
    heading, place = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, (count, 2))
    along = np.stack((np.cos(heading), np.sin(heading)), 1)
    across = np.stack((-np.sin(heading), np.cos(heading)), 1)
    own = {
        "tilts": 0.3 * rng.standard_normal((count, 2)),
        "lift": 0.3 * rng.standard_normal((count, 2)),
        "heading": np.sin(2 * heading)[:, None] * across,
        "place": 0.5 - 2 * place,
    }[kind]
    measured = np.repeat(own, each, 0) + 0.02 * rng.standard_normal((count * each, 2))
    information = np.tile(np.eye(2) / 0.02**2, (count * each, 1, 1))
    upward = np.repeat(0.3 * rng.standard_normal(count) * (kind == "lift"), each)
    upward += 0.02 * rng.standard_normal(count * each)
    found = OwnAccelerations(
        score=measured / 0.02**2,
        information=information,
        episode=np.repeat(np.arange(count), each),
        motion={"velocity": np.repeat(along, each, 0), "place": np.repeat(place, each, 0)},
        upward=(upward / 0.02**2, np.full(count * each, 1 / 0.02**2)),
    )
    assert found.law() == law
    # each piece is predicted by the others of its episode, but not where the push changes within it
    assert found.held_out_gains(0.3).sum() > 100
    flipped = replace(found, score=found.score * np.tile([1, -1], count * each // 2)[:, None])
    assert flipped.held_out_gains(0.3).sum() < 0


@pytest.mark.parametrize(("level", "confirmed"), [("tilt", True), ("ground turned", True), ("chance", False)])
def test_bodies_at_rest_tell_a_tilt_of_each_episode_from_a_force(level: str, confirmed: bool) -> None:
    rng = np.random.default_rng(3)
    count, frames = 10, 12
    tilt = 0.01 * rng.standard_normal((count, 2))
    shown = {"tilt": tilt, "ground turned": tilt @ np.array([[0.8, 0.6], [-0.6, 0.8]])}.get(level)
    shown = 0.01 * rng.standard_normal((count, 2)) if shown is None else shown
    # the measured frame is turned, so that a face on the ground points along (shown, 1), on either side of the box
    turn = quat_exp(torch.as_tensor(np.stack((-shown[:, 1], shown[:, 0], np.zeros(count)), 1)))
    turn = quat_multiply(turn, quat_exp(torch.as_tensor(rng.choice([0, np.pi], (count, 1)) * [1.0, 0, 0])))
    quat = turn[:, None, None].expand(count, frames, 1, 4)
    seen = SimpleNamespace(has_orientation=torch.ones(count, frames, 1), quat_wxyz=quat)
    prepared = SimpleNamespace(
        has_orientation=True,
        observations=seen,
        names=tuple("abcdefghij"),
        airborne=torch.zeros(count, frames, dtype=torch.bool),
        noise=SimpleNamespace(rotation_rad=1e-4),
    )
    values = -9.81 * tilt + 0.005 * rng.standard_normal((count, 2))
    found = OwnAccelerations(
        score=values, information=np.tile(np.eye(2), (count, 1, 1)), episode=np.arange(count), motion={}
    )
    body = world_with("cube").bodies[0]
    assert rests_confirm(prepared, body, 9.81, found) == confirmed  # pyright: ignore[reportArgumentType]


def test_a_state_is_determined_by_the_residuals_that_it_moves_more() -> None:
    own, other = torch.zeros(2, 5, 3, 3), torch.zeros(2, 5, 3, 3)
    own[..., 0], own[..., 1], other[..., 1] = 1.0, 0.1, 3.0  # the third moves nothing
    assert moving(own, other) == [0]
    assert moving(other, own) == [1]


@pytest.mark.parametrize("drags", [(0.15, 0.6), pytest.param((0.3, 0.3), marks=pytest.mark.evidence)])
def test_an_effect_that_each_group_has_of_its_own_is_named_for_groups(drags: tuple[float, float]) -> None:
    rng = np.random.default_rng(4)
    world, episodes = world_with("ball", ground=False), []
    for group, c in enumerate(drags):
        flying = tosses(
            world_with("ball", {"linear_drag": {"c": c}}, False), group, count=3, duration_s=0.45, noise=(1e-9, 1e-8)
        )
        episodes += [(f"{group}{name}", {b: drifting(t, rng) for b, t in tracks.items()}) for name, tracks in flying]
    found = find(prepare(world, episodes, groups=[0, 0, 0, 1, 1, 1]), world, LIBRARY)
    named = [one.evidence.candidate.spec for one in found.chosen]
    assert named == (["linear_drag@group"] if drags[0] != drags[1] else ["linear_drag"])
    values = found.world.own_values
    if values:
        for episode, c in (("0", drags[0]), ("1", drags[1])):
            mine = [value["linear_drag.c"] for name, value in values.items() if name.startswith(episode)]
            assert np.allclose(mine, c, atol=0.02)


@pytest.mark.parametrize(
    ("name", "values", "several"),
    [
        ("linear_drag", ([0.0], [0.08]), False),
        ("linear_drag", ([0.0], [0.08], [0.1]), True),
        ("gravity_tilt", ([0.01, 0.0], [0.0, 0.02]), True),
    ],
)
def test_a_drag_that_one_group_alone_has_is_none(name: str, values: tuple[list[float], ...], several: bool) -> None:
    by_group = {k: np.array(value) for k, value in enumerate(values)}
    assert in_several(Candidate(name, load_effect(name)), by_group) == several


@pytest.mark.parametrize(
    ("name", "present", "again"),
    [
        ("clock_scale", {"length_scale"}, True),
        ("frame_tilt", {"constant_force"}, True),
        ("clock_scale", {"linear_drag", "gravity_tilt"}, False),
        ("linear_drag", {"linear_drag", "length_scale"}, False),
    ],
)
def test_groups_have_no_value_beside_one_for_all_that_does_the_same(name: str, present: set[str], again: bool) -> None:
    assert _alike(Candidate(name, load_effect(name)), present) == again


@pytest.mark.evidence
def test_a_drag_beside_a_tilt_of_each_episode_is_named() -> None:
    named = found({"linear_drag": {"c": 0.3}}, tilt_m_s2=0.15, seed=3, library=WINDY)
    assert [one.evidence.candidate.spec for one in named.chosen] == ["linear_drag", "gravity_tilt@episode"]
    assert {one.candidate.spec for one in named.chosen[1].equals} == {
        "gravity_tilt@episode",
        "frame_tilt@episode",
        "wind@episode",
    }


@pytest.mark.parametrize(("rate", "told"), [(0.5, 1), (4e-3, 0), (0.0, 0)])
def test_tilts_of_each_episode_may_be_winds_where_a_drag_carries_them(rate: float, told: int) -> None:
    """Through a drag of 0.004 / s, tilts of 30 mrad would be winds of 75 m/s, which do not blow in a room."""
    effects = {"linear_drag": {"c": rate}} if rate else {}
    world = world_with("ball", effects, False)
    flying = tosses(world_with("ball", {**effects, "gravity_tilt": {"tilt_x": 0.03}}, False), 2, count=4)
    prepared = prepare(world, flying)
    assert prepared.flight is not None
    tilted = world_with("ball", {**effects, "gravity_tilt": {}}, False)
    fit = refit([prepared.flight], tilted, base_parameters(tilted, "flight"))
    winds = own_tilt._own_winds(fit.segments[0], world, "gravity_tilt", fit, WINDY, 40.0)
    assert [one.candidate.spec for one in winds] == ["wind@episode"] * told


def test_a_drag_through_which_a_wind_acts_is_drawn_without_both() -> None:
    world = world_with("ball", {"quadratic_drag": {"k": 0.1}, "wind": {"w_x": 1.0}}, ground=False)
    prepared = prepare(world, tosses(world, 1, count=1, duration_s=0.3))
    assert effect_picture(prepared, world, "quadratic_drag") is not None


def test_parts_of_one_flight_are_joined_and_others_are_not() -> None:
    parts = [Segment(0, 0, 9), Segment(0, 10, 19), Segment(0, 25, 30), Segment(1, 31, 40)]
    assert whole_flights(parts) == [Segment(0, 0, 19), Segment(0, 25, 30), Segment(1, 31, 40)]
