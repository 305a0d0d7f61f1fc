"""`benchmarks/thresholds.py`: statistics of thresholds, and the value that keeps a rate of false alarms."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.diagnose.contact.contact_test import ContactData
from cgwm.pipeline.diagnose.contact.sliding import SlidingTest
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.score_test import ScoreTest
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from helpers.diagnosis_data import world_with

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import thresholds


def row(key: str, effect: str | None, **statistics: float) -> dict[str, Any]:
    """Return a stored row; of a null for no effect."""
    named = {name.replace("_", ".", 1): value for name, value in statistics.items()}
    return {"key": key, "effects": [effect] if effect else [], "statistics": named}


def recorded(name: str, score: float, share: float) -> dict[str, float]:
    """Return the statistics of the sliding test where it finds one effect of usual size."""
    effect = load_effect(name)
    values = np.array([p.scale for p in effect.parameters])
    test = ScoreTest(
        statistic=score, dof=len(values), p_value=0.0, estimate=values, covariance=np.eye(len(values)), admissible=True
    )
    one = Evidence(
        candidate=Candidate(name, effect),
        constants={},
        test=test,
        p_value=0.0,
        numbers={p.name: (p.scale, 0.0) for p in effect.parameters},
        score=score,
        share=share,
    )
    recorder = thresholds.Recorder(SlidingTest())
    world = world_with("ball")
    recorder.found = ([one], ContactData(prepared=None, world=world, segments=None, sliding=None))
    return recorder.statistics()


def test_a_statistic_counts_where_all_other_thresholds_are_passed() -> None:
    assert recorded("viscous_friction", 200.0, 0.7)["sliding.score"] == 200.0
    assert "sliding.score" not in recorded("viscous_friction", 200.0, 0.4)  # too little is explained
    assert recorded("viscous_friction", 250.0, 0.4)["sliding.explained"] == 0.4
    # it is selected by what it leaves, whatever the first score is
    assert "sliding.score" not in recorded("viscous_friction", 100.0, 0.9)
    assert recorded("viscous_friction", 100.0, 0.9)["sliding.score_sure"] == 100.0
    assert recorded("friction_patch", 300.0, 0.9)["sliding.score_flexible"] == 300.0


@pytest.mark.parametrize(("rate", "keeps", "alarms"), [(0.0, 9.0, 1), (0.25, 4.0, 1), (0.5, 3.0, 1), (0.75, None, 1)])
def test_the_value_that_keeps_a_rate(rate: float, keeps: float | None, alarms: int) -> None:
    rows = [row(str(k), None, impact_score=value) for k, value in enumerate((3.0, 9.0, 4.0))]
    rows += [row("3", None), row("found", "adhesion", impact_score=8.0), row("clear", "adhesion", impact_score=50.0)]
    found = thresholds.calibrated("impact.score", 6.0, rate, rows)
    assert (found.keeps, found.alarms, found.nulls) == (keeps, alarms, 4)
    assert sum(value > (keeps or 0.0) for value in (3.0, 9.0, 4.0)) <= rate * 4
    assert found.changed == (("found",) if keeps == 9.0 else ())


def test_a_p_value_is_an_alarm_below_its_threshold() -> None:
    rows = [row(str(k), None, flight_alpha=value) for k, value in enumerate((0.5, 0.001, 0.01))]
    found = thresholds.calibrated("flight.alpha", 0.002, 0.0, [*rows, row("weak", "wind", flight_alpha=0.0015)])
    assert (found.keeps, found.alarms, found.nulls) == (0.001, 1, 3)
    assert found.changed == ("weak",)


def test_thresholds_without_a_rate_are_named_as_such() -> None:
    text = thresholds.table([row("0", None, sliding_score=150.0), row("1", "adhesion", sliding_score=300.0)])
    assert "| sliding.score | 220 | 0 of 13 | 0 of 1 | 150 | none |" in text
    assert "sliding.lead" in text.rpartition("Without a false-alarm rate")[2]
