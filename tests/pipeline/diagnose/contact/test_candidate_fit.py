"""Contact segments at the fit of a candidate: the same quadratic from another origin, sizes that one step misses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.diagnose.contact.candidate_fit import measured_from
from cgwm.pipeline.diagnose.contact.contact_test import ContactData
from cgwm.pipeline.diagnose.contact.flight_equals import fitted_contact
from cgwm.pipeline.diagnose.contact.segments import SegmentsTest
from cgwm.pipeline.diagnose.evidence.robust_fit import robust_fit
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.linearization import Linearization
from cgwm.pipeline.segments.prepare import prepare
from helpers.diagnosis_data import tosses, world_with
from helpers.quadratic_segments import quadratic_segments


def quadratics(rows: Any, seen: Any) -> Linearization:
    """Segments with residuals `seen` and slopes `rows`; the second parameter is one of a candidate."""
    return quadratic_segments(rows, seen, np.arange(len(rows)), 1e6, np.zeros(2))


def test_a_linearization_at_a_fit_is_that_of_the_same_rows_at_the_origin() -> None:
    rng = np.random.default_rng(0)
    rows, seen, offset = rng.standard_normal((12, 20, 2)), rng.standard_normal((12, 20)), np.array([0.3, -2.0])
    at_fit = quadratics(rows, seen - rows @ offset)  # the residuals there, of rows that are linear
    moved, direct = measured_from(at_fit, offset), quadratics(rows, seen)
    np.testing.assert_allclose(moved.score, direct.score, atol=1e-9)
    np.testing.assert_allclose(moved.chi2, direct.chi2, atol=1e-9)


def test_a_robust_fit_from_the_fitted_values_keeps_the_segments_that_only_the_effect_explains() -> None:
    """Without the effect, which half of the segments show, these lose their weight; the fit begins where they fit."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((12, 20, 2)) * np.repeat([[1.0, 0.0], [1.0, 1.0]], 6, 0)[:, None]
    linear = quadratics(rows, rows @ [0.0, 60.0] + rng.standard_normal((12, 20)))
    alone = robust_fit(linear, [0])
    found = robust_fit(linear, [0, 1], np.array([0.0, 60.0]))
    assert found.value[1] == pytest.approx(60.0, abs=0.3)
    assert found.cost < alone.cost
    np.testing.assert_allclose(found.weight[6:], 1.0, atol=0.3)
    assert alone.weight[6:].max() < 0.01


@pytest.mark.evidence
def test_a_friction_that_stops_the_spin_at_once_is_found_at_its_size() -> None:
    """15 mm stop the spin of a box in a frame or two: one step from zero finds a fraction of it."""
    truth, world = world_with("cube", {"torsional_friction": {"c_t": 0.015}}), world_with("cube")
    prepared = prepare(world, tosses(truth, 3, count=5, duration_s=0.7))
    fitted = fitted_contact(prepared, world)
    assert fitted is not None
    data = ContactData(prepared=prepared, world=fitted[0].world, segments=fitted[1], sliding=None)
    names = ("torsional_friction", "viscous_friction", "stribeck_friction")
    library = [Candidate(name, load_effect(name)) for name in names]
    found = SegmentsTest().evidence(data, library)
    assert found[0].name == "torsional_friction"
    assert found[0].test.estimate[0] > 0.006
    unfitted = SegmentsTest(limits=replace(THRESHOLDS.segments, alone=()))
    linear = next(one for one in unfitted.evidence(data, library) if one.name == "torsional_friction")
    assert found[0].score > linear.score + 50
    assert linear.test.estimate[0] < 0.5 * found[0].test.estimate[0]
