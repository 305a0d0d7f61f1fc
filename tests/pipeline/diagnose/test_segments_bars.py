"""What contact segments have to show before an effect is named from them, by what slides and flights say of it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.diagnose.contact_tests.segments import SegmentsTest
from cgwm.pipeline.diagnose.evidence import Evidence
from cgwm.pipeline.diagnose.score_test import ScoreTest
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate

LIMITS = THRESHOLDS.segments


def evidence(name: str, score: float = 30.0) -> Evidence:
    test = ScoreTest(
        statistic=1.0, dof=1, p_value=1.0, estimate=np.ones(1), covariance=np.eye(1), admissible=True
    )  # fmt: skip
    return Evidence(candidate=Candidate(name, load_effect(name)), constants={}, test=test, p_value=1.0, score=score)


@pytest.mark.parametrize(
    ("name", "explained", "slides", "score"),
    [
        ("adhesion", True, ("anisotropic_friction",), None),
        ("velocity_restitution", True, ("anisotropic_friction",), LIMITS.score),
        ("viscous_friction", True, ("anisotropic_friction",), None),
        ("viscous_friction", True, (), LIMITS.alone_score),
        ("ground_magnet", True, (), LIMITS.score),
        ("ground_magnet", False, (), LIMITS.alone_score),
    ],
)
def test_the_bar_of_an_effect(name: str, explained: bool, slides: tuple[str, ...], score: float | None) -> None:
    data: Any = SimpleNamespace(
        explained=explained, flown=False, earlier={"sliding": [evidence(one, 200.0) for one in slides]}
    )
    assert [bar.score for bar in SegmentsTest().bars([evidence(name)], data)] == ([] if score is None else [score])
