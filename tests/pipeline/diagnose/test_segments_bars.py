"""What contact segments have to show before an effect is named from them: they confirm what other tests saw."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.diagnose.contact_tests.segments import SegmentsTest
from cgwm.pipeline.diagnose.evidence import Evidence
from cgwm.pipeline.diagnose.falsification import Repetition
from cgwm.pipeline.diagnose.score_test import ScoreTest
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate

LIMITS = THRESHOLDS.segments
REPEATS = Repetition(1.0, 1e-6, 1e-3)


def evidence(name: str, score: float = 300.0, share: float = 0.9) -> Evidence:
    size = len(load_effect(name).parameters)
    test = ScoreTest(
        statistic=1.0, dof=size, p_value=1.0, estimate=np.ones(size), covariance=np.eye(size), admissible=True
    )  # fmt: skip
    candidate = Candidate(name, load_effect(name))
    return Evidence(
        candidate=candidate, constants={}, test=test, p_value=1.0, score=score, share=share, repetition=REPEATS
    )


def bars(one: Evidence, sliding: tuple[str, ...] = ()) -> list[float]:
    data: Any = SimpleNamespace(earlier={"sliding": [evidence(n) for n in sliding]})
    return [bar.score for bar in SegmentsTest().bars([one], data)]


@pytest.mark.parametrize("name", ["velocity_restitution", "ground_magnet", "adhesion", "viscous_friction"])
def test_segments_alone_name_nothing(name: str) -> None:
    assert bars(evidence(name, 1e6)) == []
    assert bars(evidence(name, 1e6), sliding=("stribeck_friction", name)) == []


def test_an_effect_that_ranks_first_among_slides_is_confirmed() -> None:
    assert bars(evidence("viscous_friction"), sliding=("viscous_friction",)) == [LIMITS.agreed_score]
    assert bars(evidence("anisotropic_friction"), sliding=("anisotropic_friction",)) == []  # two numbers fit two slides


def test_a_torque_about_the_normal_needs_no_slides() -> None:
    """No law of contact has one at a point, whatever its restitution and friction are."""
    assert bars(evidence("torsional_friction")) == [LIMITS.alone_score]
    assert bars(replace(evidence("torsional_friction"), repetition=Repetition(3.0, 0.2, 0.3))) == []


@pytest.mark.parametrize("repetition", [None, Repetition(3.0, 0.2, 0.3), Repetition(1.0, 1e-6, 0.5)])
def test_what_does_not_repeat_from_episode_to_episode_is_not_confirmed(repetition: Repetition | None) -> None:
    one = replace(evidence("viscous_friction"), repetition=repetition)
    assert bars(one, sliding=("viscous_friction",)) == []
