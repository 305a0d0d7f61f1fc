"""Scales of lengths that differ between sessions: they are no scatter of effects, and no vertical force."""

from dataclasses import replace

import pytest
from cgwm.pipeline.diagnose.evidence.effect_selection import _simplest_within, select_next
from cgwm.pipeline.diagnose.evidence.falsification import repetition
from cgwm.pipeline.diagnose.evidence.score_test import score_test
from cgwm.pipeline.diagnose.evidence.session_scales import NAME, linearize_beside_scales, scale_spread
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate, variants_of
from cgwm.pipeline.segments.linearization import Linearization, linearize
from cgwm.pipeline.segments.prepare import Prepared, prepare
from helpers.diagnosis_data import tosses, world_with

GROUPS = (0, 1, 0, 1, 0, 1)
CANDIDATES = [Candidate(name, load_effect(name)) for name in ("gravity_scale", "gravity_tilt", "constant_force")]


def recorded(scales: tuple[float, float], effects: dict | None = None) -> tuple[Prepared, object]:
    world, episodes = world_with("cube", None, False), tosses(world_with("cube", effects, False), 5, duration_s=0.4)
    for group, (_, tracks) in zip(GROUPS, episodes, strict=True):
        for track in tracks.values():
            track.position_m[:] *= 1 + scales[group]
    return prepare(world, episodes, groups=GROUPS), world


def both(prepared: Prepared, world: object) -> tuple[Linearization, Linearization, list[list[str]]]:
    assert prepared.flight is not None
    variants = variants_of(CANDIDATES, world.gravity[0, :1])  # pyright: ignore[reportAttributeAccessIssue]
    plain = linearize(prepared.flight, world, variants, GROUPS, robust=False)  # pyright: ignore[reportArgumentType]
    beside = linearize_beside_scales(prepared.flight, world, variants, GROUPS)  # pyright: ignore[reportArgumentType]
    return plain, beside, [v.parameters for v in variants]


def test_scales_that_differ_between_sessions_are_no_scatter_of_an_effect() -> None:
    plain, beside, columns = both(*recorded((0.01, -0.01)))
    gravity = columns[0]
    assert repetition(plain, plain.columns(gravity), 1.0).scatter > 10
    assert repetition(beside, beside.columns(gravity), 1.0).scatter < 2.5
    assert [p.name for p in beside.parameters[: beside.base]] == [f"{NAME}.s0"]


def test_sessions_of_one_scale_take_nothing_from_an_effect() -> None:
    plain, beside, columns = both(*recorded((0.0, 0.0), {"gravity_scale": {"s": 0.01}}))
    for names in columns:
        tests = [score_test(one, one.columns(names)).statistic for one in (plain, beside)]
        assert tests[1] == pytest.approx(tests[0], rel=0.1)


def test_a_tilt_and_a_scale_are_no_constant_force_alone() -> None:
    prepared, world = recorded((0.012, 0.004), {"gravity_tilt": {"tilt_x": 0.02, "tilt_y": 0.01}})
    assert prepared.flight is not None
    step = select_next(prepared.flight, world, CANDIDATES, GROUPS, True)  # pyright: ignore[reportArgumentType]
    assert [one.name for one in step.equals] == ["gravity_tilt", "constant_force"]


def test_two_halves_of_a_force_that_explain_as_much_as_each_other_are_no_rivals() -> None:
    prepared, world = recorded((0.0, 0.0), {"constant_force": {"f_x": 0.1, "f_y": 0.0, "f_z": 0.1}})
    assert prepared.flight is not None
    step = select_next(prepared.flight, world, CANDIDATES, GROUPS, True)  # pyright: ignore[reportArgumentType]
    found = {one.name: one for one in step.evidence}
    best, equal = found["constant_force"], replace(found["gravity_tilt"], delta_bic=found["gravity_scale"].delta_bic)
    assert best.delta_bic is not None and equal.delta_bic is not None and best.delta_bic < equal.delta_bic
    variants = variants_of(CANDIDATES, prepared.flight.world.gravity[0, :1])
    linear = linearize(prepared.flight, prepared.flight.world, variants, GROUPS, robust=False)
    within = _simplest_within([best], [best, found["gravity_scale"], equal], linear, CANDIDATES, variants)
    assert [one.name for one in within] == ["gravity_scale", "constant_force"]


def test_two_sessions_that_agree_hardly_tell_how_far_sessions_scatter() -> None:
    """Their scales may differ by chance as little as here: the usual spread counts beside them."""
    prepared, world = recorded((0.0, 0.0))
    spread = scale_spread(both(prepared, world)[1])
    assert spread is not None and 0.8 < spread / THRESHOLDS.verdict.usual_scale < 1.0
