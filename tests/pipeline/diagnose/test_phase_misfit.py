"""Where the law of contact itself is wrong, a verdict says in which phase, and that not nothing is missing."""

from dataclasses import replace

import pytest
from cgwm.pipeline.diagnose.remaining import bad_ones, misfits_of, slides_of
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.segments.sliding.fit import StartedSliding
from cgwm.schemas import PhaseMisfit
from helpers.diagnosis_data import tosses, world_with
from helpers.worlds import law


@pytest.mark.parametrize("bounce", [0.4, 0.02])
def test_a_right_law_is_off_by_the_noise_and_another_bounce_in_impacts(bounce: float) -> None:
    world = world_with("ball")
    # exact but for a tenth of a millimetre, as a good tracker has it
    prepared = prepare(world, tosses(world, 3, noise=(1e-4, 1e-3)))
    contact = prepared.contact(replace(world, contact=law(0.3, 0.004, bounce)))
    assert contact is not None
    found = misfits_of(contact)
    assert {one.phase for one in found} <= {"impact", "sliding", "rolling", "sticking", "rest"}
    bad = bad_ones(found)
    if bounce == 0.4:
        assert not bad and found[0].reduced_chi2 < 2
    else:
        assert bad[0].phase == "impact" and bad[0].position_rms_m > 3e-4


def test_an_error_that_lasts_through_a_slide_counts_from_two_standard_deviations_on() -> None:
    def phase(segment_s: float, chi2: float) -> PhaseMisfit:
        return PhaseMisfit(
            phase="sliding",
            segments=4,
            segment_s=segment_s,
            reduced_chi2=chi2,
            position_rms_m=1e-3,
            rotation_rms_rad=None,
            then="",
        )

    assert [bool(bad_ones([phase(*one)])) for one in ((0.1, 5.0), (0.1, 10.0), (0.4, 3.0), (0.4, 5.0))] == [
        False,
        True,
        False,
        True,
    ]
    assert slides_of(None) == []


@pytest.mark.evidence
@pytest.mark.parametrize("other", [0.3, 0.12])
def test_slides_with_another_friction_elsewhere_are_not_described_by_one(other: float) -> None:
    world = world_with("ball")
    told = {"height_m": (0.04, 0.04), "lift_m_s": (0.0, 0.0), "duration_s": 0.5, "noise": (1e-4, 1e-3)}
    episodes = [
        (f"{friction} {name}", tracks)
        for friction, seed in ((0.3, 3), (other, 4))
        for name, tracks in tosses(replace(world, contact=law(friction, 0.004, 0.4)), seed, count=3, **told)
    ]
    prepared = prepare(world, episodes)
    found = slides_of(StartedSliding.of(prepared, world, prepared.flight))
    assert bool(bad_ones(found)) == (other != 0.3)
    if other != 0.3:
        assert "0.12 to 0.3" in found[0].then
