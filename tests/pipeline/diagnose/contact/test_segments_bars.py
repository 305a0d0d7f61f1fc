"""What contact segments have to show before an effect is named: with slides that show it, and alone."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from cgwm.pipeline.diagnose.contact import segments as segments_module
from cgwm.pipeline.diagnose.contact.segments import SegmentsTest
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.falsification import Repetition
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from helpers.diagnosis_data import evidence_of

LIMITS = THRESHOLDS.segments
REPEATS = Repetition(1.0, 1e-6, 1e-3)


def evidence(name: str, score: float = 300.0, share: float = 0.9) -> Evidence:
    return evidence_of(name, score=score, share=share, repetition=REPEATS)


def bars(one: Evidence, sliding: tuple[str, ...] = (), flown: bool = False, explained: bool = True) -> list[float]:
    shown = [evidence(name, LIMITS.shown_score + 1) for name in sliding]
    data: Any = SimpleNamespace(earlier={"sliding": shown}, flown=flown, explained=explained)
    return [bar.score for bar in SegmentsTest().bars([one], data)]


IMITATED = ["velocity_restitution", "ground_magnet", "rolling_resistance", "friction_patch"]


@pytest.mark.parametrize("name", IMITATED)
def test_segments_alone_do_not_name_what_laws_of_contact_imitate(name: str) -> None:
    assert bars(evidence(name, 1e6)) == []
    assert bars(evidence(name, 1e6), sliding=("stribeck_friction", name)) == []


@pytest.mark.parametrize("name", ["viscous_friction", "stribeck_friction"])
def test_an_effect_that_ranks_first_among_slides_needs_less(name: str) -> None:
    alone = dict(LIMITS.alone)[name]
    assert bars(evidence(name)) == [alone, LIMITS.sure * alone]
    assert bars(evidence(name), sliding=(name,)) == [LIMITS.agreed_score, alone, LIMITS.sure * alone]
    assert LIMITS.agreed_score < alone
    # two numbers and nine fit laws that they are not; slides cannot show a restitution, and follow a pull by friction
    for other in ("friction_patch", "velocity_restitution", "ground_magnet"):
        assert bars(evidence(other), sliding=() if other == "ground_magnet" else (other,)) == []
    for other in ("adhesion", "anisotropic_friction"):
        assert bars(evidence(other), sliding=(other,)) == bars(evidence(other)) != []


@pytest.mark.parametrize("name", ["viscous_friction", "adhesion", "torsional_friction", "rolling_resistance"])
@pytest.mark.parametrize("flown", [False, True])
@pytest.mark.parametrize("slides", [False, True])
def test_effects_are_fitted_only_where_one_of_them_could_be_named(
    name: str, flown: bool, slides: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of those that segments alone may name has a score, and one of all with a score has a bar to pass."""
    shown = [evidence(name, LIMITS.shown_score + 1)] if slides else []
    data: Any = SimpleNamespace(
        earlier={"sliding": shown}, flown=flown, explained=True, segments=1, world=1,
        prepared=SimpleNamespace(groups=()), variants=lambda *_: [SimpleNamespace(active=evidence(name).candidate)],
    )  # fmt: skip

    def fits(first: list[Evidence]) -> bool:
        with monkeypatch.context() as patch:
            patch.setattr(segments_module, "_linear_tests", lambda *_: [])
            patch.setattr(segments_module, "linearize", lambda *_, **__: 1)
            patch.setattr(segments_module, "_ranked", lambda *_: first)
            patch.setattr(segments_module, "candidate_fits", lambda *_: fitted())
            try:
                SegmentsTest().evidence(data, [])
            except InterruptedError:
                return True
            return False

    def fitted() -> Any:
        raise InterruptedError

    one, likely = evidence(name, 1.0), evidence("stribeck_friction", 1.0)
    could = bool(bars(one, sliding=(name,) if slides else (), flown=flown))
    assert fits([one, likely]) is (could or not flown)
    assert fits([one]) is (could and name in dict(LIMITS.alone))
    assert not fits([replace(one, score=-1.0), replace(likely, score=-1.0)])


@pytest.mark.parametrize(("under_law", "beside_errors", "named"), [(100.0, 300.0, 100.0), (50.0, 300.0, 300.0)])
def test_what_the_law_alone_names_stands_and_beside_errors_of_impulses_more_is_named(
    under_law: float, beside_errors: float, named: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of impulses are those of a model without the effect: a large effect widens and hides behind them."""
    scores = {"plain": under_law, "beside": beside_errors}
    lists = {kind: [replace(evidence("adhesion", one), gains=(20.0, 22.0, 24.0))] for kind, one in scores.items()}
    segments = SimpleNamespace(in_world=lambda _: None)
    data: Any = SimpleNamespace(
        earlier={}, flown=False, explained=True, segments=segments, world=1, prepared=SimpleNamespace(groups=()),
        variants=lambda *_: [SimpleNamespace(active=evidence("adhesion").candidate)],
    )  # fmt: skip
    at = SimpleNamespace(plain="plain", beside="beside")
    monkeypatch.setattr(segments_module, "linearize", lambda *_, **__: at.plain)
    monkeypatch.setattr(segments_module, "linearize_contact", lambda *_: at)
    monkeypatch.setattr(segments_module, "_linear_tests", lambda linear, *_: [linear])
    monkeypatch.setattr(segments_module, "_ranked", lambda tests, _: lists[tests[0]])
    monkeypatch.setattr(segments_module, "_can_be_fitted", lambda _: False)
    monkeypatch.setattr(segments_module, "tries_of", lambda _: {})
    none = SimpleNamespace(segments=segments, errors=None)
    monkeypatch.setattr(segments_module, "candidate_fits", lambda *_: (none, {}))
    found = SegmentsTest().evidence(data, [])
    assert [one.score for one in found] == [named]
    assert found[0].beside_errors is (named == beside_errors)


def test_a_fit_names_no_effect_without_a_score_where_it_is_absent() -> None:
    assert bars(replace(evidence("stribeck_friction"), first_score=0.1)) != []
    assert bars(replace(evidence("stribeck_friction"), first_score=-0.1)) == []


def test_dry_friction_at_rest_is_not_below_that_of_sliding() -> None:
    one = evidence("stribeck_friction")
    assert bars(one, sliding=("stribeck_friction",)) != []
    less = replace(one, test=replace(one.test, estimate=-one.test.estimate))
    assert bars(less, sliding=("stribeck_friction",)) == []


def test_a_torque_about_the_normal_needs_no_slides_and_no_clear_flight() -> None:
    """No law of contact has one at a point, whatever its restitution and friction are."""
    alone = [factor * dict(LIMITS.alone)["torsional_friction"] for factor in (1.0, LIMITS.sure)]
    assert bars(evidence("torsional_friction"), flown=True, explained=False) == alone
    assert bars(evidence("viscous_friction"), flown=True) == bars(evidence("viscous_friction"), explained=False) == []
    assert bars(replace(evidence("torsional_friction"), repetition=Repetition(3.0, 0.2, 0.3))) == []


@pytest.mark.parametrize("repetition", [None, Repetition(3.0, 0.2, 0.3), Repetition(1.0, 1e-6, 0.5)])
def test_what_does_not_repeat_from_episode_to_episode_is_not_confirmed(repetition: Repetition | None) -> None:
    one = replace(evidence("viscous_friction"), repetition=repetition)
    assert bars(one, sliding=("viscous_friction",)) == []
