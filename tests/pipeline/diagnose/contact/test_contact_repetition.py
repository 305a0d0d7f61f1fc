"""Evidence of contact that repeats: an effect in every episode against one episode's, and equals by sessions."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.diagnose.contact.flight_equals import _not_ruled_out, _undoubled
from cgwm.pipeline.diagnose.contact.impact import ImpactTest
from cgwm.pipeline.diagnose.contact.sliding import SlidingTest
from cgwm.pipeline.diagnose.evidence.effect_selection import SelectionStep
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.robust_fit import robust_repetition
from cgwm.pipeline.diagnose.flight import findings as flight_findings
from cgwm.pipeline.diagnose.flight.findings import _Search
from cgwm.pipeline.diagnose.flight.group_values import _Scored, _unlike
from cgwm.pipeline.diagnose.report.wording import noisy_warnings
from cgwm.pipeline.physics.parameters import Parameter
from cgwm.pipeline.segments.candidates import Variant
from cgwm.pipeline.segments.flights.slow_errors import SlowErrors
from cgwm.pipeline.segments.linearization import Linearization
from cgwm.pipeline.trajectories.innovations import CorrelatedNoise, NoiseModel
from helpers.diagnosis_data import evidence_of
from helpers.quadratic_segments import quadratic_segments
from numpy.typing import NDArray


def linear(effect: NDArray[np.float64], noise: float = 1.0) -> Linearization:
    """Forty contact segments of eight episodes, in which one parameter beside the friction has the values `effect`."""
    rng, count = np.random.default_rng(0), 40
    episode = np.arange(count) % len(effect)
    rows = rng.standard_normal((count, 30, 2))
    seen = rows @ [0.3, 0.0] + rows[..., 1] * effect[episode, None] + noise * rng.standard_normal((count, 30))
    return quadratic_segments(rows, seen, episode, 5.0, np.array([1 / 25, 0.0]))


def test_an_effect_of_all_episodes_repeats_and_one_episodes_does_not() -> None:
    every = robust_repetition(linear(np.full(8, 0.5)), [0], [1], 10)
    assert every.p_value < 1e-4
    assert every.without_best < 1e-4
    assert every.scatter < 1.5
    single = robust_repetition(linear(np.array([3.0, 0, 0, 0, 0, 0, 0, 0])), [0], [1], 10)
    assert single.without_best > 0.05
    assert single.scatter > 2
    signs = robust_repetition(linear(np.array([0.5, -0.5] * 4)), [0], [1], 10)
    assert signs.p_value > 0.1


def test_what_another_law_leaves_is_scatter() -> None:
    """Noise three times as large as stated is the law's own misfit: its square divides the evidence."""
    quiet, rough = (robust_repetition(linear(np.full(8, 0.15), noise), [0], [1], 1) for noise in (1.0, 3.0))
    assert rough.p_value > 10 * quiet.p_value


def evidence(name: str, values: tuple[float, ...] = (1.0,)) -> Evidence:
    return evidence_of(name, values, score=500.0)


@pytest.mark.parametrize(("rise", "count"), [(0.2, 2), (-0.2, 0)])
def test_friction_that_is_lower_at_rest_is_the_smeared_end_of_a_slip(rise: float, count: int) -> None:
    data: Any = SimpleNamespace(flown=False, explained=True, sliding=None)
    assert len(SlidingTest().bars([evidence("stribeck_friction", (rise,))], data)) == count


@pytest.mark.parametrize(
    ("total", "kept", "alone"),
    [
        ((0.0, 90.0, 95.0), {"length_scale", "clock_scale", "buoyancy"}, {"length_scale"}),
        ((90.0, 0.0, 95.0), {"length_scale", "clock_scale"}, {"clock_scale"}),
    ],
)
def test_a_scale_of_lengths_neither_rules_out_nor_is_ruled_out_where_sessions_may_have_their_own(
    total: tuple[float, ...], kept: set[str], alone: set[str]
) -> None:
    equals = [evidence(name) for name in ("length_scale", "clock_scale", "buoyancy")]
    gains = [np.full(8, (100 - cost) / 8) for cost in total]
    found = [
        _not_ruled_out(equals, gains, np.array(total), linear(np.zeros(8)), sessions) for sessions in (True, False)
    ]
    assert [{one.name for one in some} for some in found] == [kept, alone]


def test_a_constant_force_rules_no_tilt_out_that_is_a_part_of_it() -> None:
    names, total = ("constant_force", "gravity_tilt", "frame_tilt"), (0.0, 60.0, 200.0)
    gains = [np.full(8, (100 - cost) / 8) for cost in total]
    equals = [evidence(name) for name in names]
    found = _not_ruled_out(equals, gains, np.array(total), linear(np.zeros(8)), False)
    assert {one.name for one in found} == {"constant_force", "gravity_tilt"}
    # where none of them describes contact better than nothing does, none is ruled out
    worse = [one - 100 for one in gains]
    assert len(_not_ruled_out(equals, worse, np.array(total), linear(np.zeros(8)), False)) == 3


def test_effects_that_do_the_same_are_kept_beside_the_first() -> None:
    rows = np.random.default_rng(1).standard_normal((6, 20, 2))
    rows = np.concatenate((rows, 2 * rows[..., :1]), -1)  # the third does what the first does
    names = ("a.x", "b.x", "c.x")
    parameters = tuple(
        Parameter(name=n, unit="1", prior=(0.0, 5.0), bounds=(-9.0, 9.0), logarithmic=False, reveals="") for n in names
    )
    whole = Linearization(
        parameters=parameters,
        base=0,
        information=np.einsum("bti,btj->bij", rows, rows),
        score=np.zeros((6, 3)),
        weight=np.ones(6),
        episode=np.arange(6),
        group=np.arange(6) % 2,
        prior=np.zeros(3),
        chi2=np.zeros(6),
        dof=np.full(6, 20.0),
    )

    def variant(name: str) -> Any:
        effect = SimpleNamespace(name=name[0], parameters=[SimpleNamespace(name="x")])
        return Variant(names.index(name), SimpleNamespace(effect=effect), {})  # pyright: ignore[reportArgumentType]

    scored = [_Scored(gain=3.0 - k, variant=variant(name), values={}) for k, name in enumerate(names)]
    found = [(one.variant.place, [twin.variant.place for twin in twins]) for one, twins in _unlike(whole, scored)]
    assert found == [(0, [2]), (1, [])]


def test_episodes_of_which_no_flight_was_searched_are_named() -> None:
    def flights(*episodes: int) -> Any:
        return SimpleNamespace(items=[SimpleNamespace(episode=k) for k in episodes])

    prepared: Any = SimpleNamespace(names=("a", "b", "c"), flight=flights(0, 0, 1, 2))
    findings: Any = SimpleNamespace(flight=SimpleNamespace(prepared=SimpleNamespace(flight=flights(0, 2))))
    assert [text.split(":")[0] for text in noisy_warnings(prepared, findings)] == ["b"]
    findings.flight.prepared.flight = flights(0, 1, 2)
    assert noisy_warnings(prepared, findings) == []


@pytest.mark.parametrize(("before", "beside", "searched"), [(0.0, 2.0, True), (2.0, 0.0, True), (2.0, 2.1, False)])
def test_flights_are_searched_again_where_their_own_accelerations_come_or_go(
    monkeypatch: pytest.MonkeyPatch, before: float, beside: float, searched: bool
) -> None:
    """A tilt of each episode's own that only shows beside a drag is a part of the errors then, and has a size."""
    errors, told = (
        SlowErrors(NoiseModel(CorrelatedNoise(sway=sway), CorrelatedNoise()), NoiseModel(), 9.0, 20.0, ())
        for sway in (before, beside)
    )
    search: Any = _Search
    monkeypatch.setattr(search, "errors", lambda *_: told)
    monkeypatch.setattr(search, "told", lambda _, __, errors: (errors, None))
    monkeypatch.setattr(search, "beside", lambda _, errors: errors)
    monkeypatch.setattr(search, "selection", lambda _, errors: errors)
    monkeypatch.setattr(search, "likelier", lambda _, __, found, ___: found)
    monkeypatch.setattr(flight_findings, "_differ", lambda *_: False)
    chosen: Any = SimpleNamespace(world=None, names=["linear_drag"])
    found = search(None, None, ()).settled(errors, errors, chosen)
    assert (found[3] is told) == searched


def test_a_constant_force_is_no_second_name_of_a_tilt() -> None:
    tilt, force, scale = (evidence(name) for name in ("gravity_tilt", "constant_force", "length_scale"))
    across, along = SelectionStep((), (tilt, force), True), SelectionStep((), (force, scale), True)
    world: Any = SimpleNamespace()
    found, same = _undoubled([across, along], world)
    assert [one.best.name for one in found] == ["gravity_tilt", "length_scale"]
    assert same is world  # neither was refitted
    assert [one.name for one in found[1].equals] == ["length_scale", "constant_force"]
    assert _undoubled([along], world)[0][0].best.name == "constant_force"  # alone it may be both


@pytest.mark.parametrize(("cost", "named"), [(1000.0, False), (1100.0, False), (1400.0, True)])
def test_slides_that_the_model_explains_down_to_the_noise_name_nothing(cost: float, named: bool) -> None:
    """A thousand degrees of freedom scatter by 45: what falls below them is a noise that was taken for too large."""
    sliding = SimpleNamespace(base=SimpleNamespace(cost=cost), segments=SimpleNamespace(dof=np.array([400.0, 600.0])))
    data: Any = SimpleNamespace(flown=False, explained=True, sliding=sliding)
    assert bool(SlidingTest().bars([evidence("viscous_friction")], data)) == named


@pytest.mark.parametrize(("gains", "named"), [((0.0, -0.2, 33.9, 0.0, 0.7), False), ((9.0, 8.0, 12.0, 0.5, 4.0), True)])
def test_a_friction_map_is_not_named_from_the_impacts_of_one_episode(gains: tuple[float, ...], named: bool) -> None:
    one = replace(evidence("friction_patch", (1.0,) * 9), gains=gains, share=0.9, score=94.0)
    one = replace(one, numbers={p.name: (1.0, 0.5) for p in one.candidate.effect.parameters})
    data: Any = None
    assert any(bar.passed(one) for bar in ImpactTest().bars([one], data)) == named
