"""Names that a diagnosis withholds: no number, no fall of held-out errors, a friction pyramid, a scale that sets in."""

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose import verdict
from cgwm.pipeline.diagnose.contact import flight_equals, sliding
from cgwm.pipeline.diagnose.contact.contact_test import selected
from cgwm.pipeline.diagnose.contact.friction_pyramid import FrictionPyramid
from cgwm.pipeline.diagnose.contact.friction_step import FrictionStep, lines_across
from cgwm.pipeline.diagnose.contact.search import Chosen
from cgwm.pipeline.diagnose.contact.sliding import SlidingTest
from cgwm.pipeline.diagnose.evidence.effect_selection import SelectionStep
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.flight import selection as flight_selection
from cgwm.pipeline.diagnose.flight.lasting_forces import without_lasting
from cgwm.pipeline.diagnose.flight.other_forms import OtherForms
from cgwm.pipeline.diagnose.flight.selection import FlightSelection
from cgwm.pipeline.diagnose.report.wording import _called, law_warnings
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.physics import World
from cgwm.pipeline.physics.contact_law import Touch
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.friction_ellipse import Ellipse
from cgwm.pipeline.segments.candidates import base_parameters, without_effects
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.segments.segment_fit import refit
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import evidence_of, tosses, world_with

F64 = torch.float64


def evidence(name: str, numbers: dict[str, tuple[float, float]] | None = None, **more: Any) -> Evidence:
    return evidence_of(name, score=1e4, share=0.9, numbers=numbers, **more)


@pytest.mark.parametrize(
    ("name", "numbers", "known"),
    [
        ("ground_magnet", {"A": (0.3, 0.31)}, False),
        ("ground_magnet", {"A": (0.3, 0.1)}, True),
        ("com_offset", {"d_x": (1e-3, 2e-3), "d_y": (5e-3, 1e-3), "d_z": (0.0, 1e-3)}, True),
        ("com_offset", {"d_x": (1e-3, 2e-3), "d_y": (-9e-4, 1e-3), "d_z": (0.0, 1e-3)}, False),
        ("stribeck_friction", {"d": (2.0, 0.05)}, False),
        ("stribeck_friction", {"d": (-2.0, 0.05)}, False),
        ("stribeck_friction", {"d": (1.9, 0.05)}, True),
        ("stribeck_friction", None, True),
    ],
)
def test_an_effect_has_a_number_where_it_is_not_within_its_errors_of_zero_nor_at_its_limit(
    name: str, numbers: dict[str, tuple[float, float]] | None, known: bool
) -> None:
    one = evidence(name, numbers)
    assert one.is_number == known
    test: Any = SimpleNamespace(
        leads=lambda best: (), bars=lambda equals, data: (SimpleNamespace(passed=lambda e: True),)
    )
    second, data = evidence("rolling_resistance", {"c_r": (1e-3, 1e-4)}), SimpleNamespace()
    found = selected(test, [one, second], data)  # type: ignore[arg-type]
    assert [e.name for e in found] == ([name] if known else [])  # none is named in its place


@pytest.mark.parametrize(("score", "others"), [(9_700.0, []), (9_900.0, ["friction_patch"])])
def test_a_map_that_explains_less_than_one_number_is_no_rival(score: float, others: list[str]) -> None:
    near = [replace(evidence(name), score=s) for name, s in (("viscous_friction", 1e4), ("friction_patch", score))]
    test = SlidingTest()
    assert all(lead.shared(near[0], near[1]) for lead in test.leads(near[0])[:1])
    assert [one.name for one in near[1:] if not test.outdone(near[0], one)] == others
    assert not test.outdone(near[1], near[0])


def selection(names: list[str], numbers: dict[str, dict[str, tuple[float, float]]]) -> FlightSelection:
    steps = [SelectionStep((), (evidence(name, numbers.get(name)),), True) for name in names]
    return FlightSelection(steps, SimpleNamespace(names=names), SimpleNamespace())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("names", "needed", "left"),
    [
        (["linear_drag", "ground_magnet"], {"linear_drag"}, ["linear_drag"]),
        ([], set[str](), []),
        (["ground_magnet"], set[str](), []),
        (["ground_magnet"], {"ground_magnet"}, ["ground_magnet"]),
        (["linear_drag", "wind"], {"wind"}, ["linear_drag", "wind"]),  # wind acts through the drag
    ],
)
def test_an_effect_without_which_held_out_flights_are_predicted_as_well_is_not_named(
    monkeypatch: pytest.MonkeyPatch, names: list[str], needed: set[str], left: list[str]
) -> None:
    def without(self: FlightSelection, gone: set[str]) -> FlightSelection:
        return selection([name for name in self.names if name not in gone], {})

    def loss(flight: Any, world: Any) -> float:
        return float(len(needed - set(world.names)))

    monkeypatch.setattr(FlightSelection, "without", without)
    monkeypatch.setattr(flight_selection, "held_out_loss", loss)
    found = selection(names, {}).without_idle()
    assert found.names == left and [step.best.name for step in found.steps] == (left or names)
    zero = selection(
        names, {"ground_magnet": {"A": (0.0, 1.0)}, "wind": {"w_x": (0.0, 1.0), "w_y": (-0.5, 1.0)}}
    ).without_idle()
    assert zero.names == [name for name in left if name in needed and name == "linear_drag"]


def test_a_wind_goes_with_the_drag_through_which_it_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"linear_drag": {"c": 0.3}, "wind": {"w_x": 1.0, "w_y": 0.0}, "gravity_tilt": {"tilt_x": 0.01}}
    steps = [SelectionStep((), (evidence(name),), True) for name in values]
    monkeypatch.setattr(
        flight_selection, "_without", lambda flight, world, names: (without_effects(world, *names), flight)
    )
    found = FlightSelection(steps, world_with("ball", values), SimpleNamespace())  # type: ignore[arg-type]
    left = found.without({"linear_drag"})
    assert left.names == ["gravity_tilt"] == [active.effect.name for active in left.world.effects]


@pytest.mark.parametrize(("odds", "bic", "mostly"), [(20.0, -50.0, True), (5.0, -50.0, False), (20.0, -500.0, False)])
def test_beside_a_force_of_another_law_nothing_smaller_is_named(odds: float, bic: float, mostly: bool) -> None:
    first, second = (evidence(name, delta_bic=b) for name, b in (("length_scale", -200.0), ("gravity_tilt", bic)))
    found = FlightSelection([SelectionStep((), (one,), True) for one in (first, second)], world_with("ball"), None)
    form = OtherForms(effect="length_scale", words="", gain=0.0, odds=odds, then="")
    assert flight_selection._is_mostly_other(found, [form]) == mostly


@pytest.mark.parametrize(
    ("equals", "asked"), [(("frame_tilt", "gravity_tilt"), True), (("linear_drag", "quadratic_drag"), False)]
)
def test_contact_does_not_decide_between_drags(equals: tuple[str, str], asked: bool) -> None:
    step = SelectionStep((), tuple(evidence(name) for name in equals), True)
    assert flight_equals._is_asked(step, [step]) == asked


@pytest.mark.parametrize(("gain", "odds", "wrong"), [(5.0, 0.0, "ab"), (-1.0, 0.0, "a"), (5.0, -3.0, "")])
def test_what_another_law_that_fits_better_does_too_is_not_named_beside_it(
    gain: float, odds: float, wrong: str
) -> None:
    form = OtherForms(effect="a", words="", gain=gain, odds=odds, then="", instead=frozenset({"b", "gone"}))
    assert flight_selection._imitating([form], ["a", "b", "c"]) == set(wrong)


@pytest.mark.parametrize(("fall", "least", "stays"), [(-1.2, -1.0, False), (-0.5, -1.0, True), (1.5, 2.0, False)])
def test_an_effect_of_contact_that_raises_held_out_errors_is_not_named(
    monkeypatch: pytest.MonkeyPatch, fall: float, least: float, stays: bool
) -> None:
    one = evidence("viscous_friction")
    monkeypatch.setattr(verdict, "held_out_fall", lambda segments, world, name: fall)
    world = replace(world_with("cube"), effects=(ActiveEffect.of(load_effect("viscous_friction"), {"c_v": 0.1}),))
    contact: Any = verdict.ContactFindings(
        chosen=[Chosen(one, (one,), "contact")],
        evidence=[],
        world=world,
        segments=SimpleNamespace(),  # type: ignore[arg-type]
    )
    found = verdict._without_useless(contact, least)
    assert bool(found.chosen) == stays and len(found.world.effects) == int(stays)


@pytest.mark.parametrize("slip", [(0.3, 0.2), (-1.0, 0.05), (0.0, 2.0), (-0.4, -0.4)])
def test_a_friction_pyramid_brakes_along_each_axis_by_itself(slip: tuple[float, float]) -> None:
    velocity = torch.tensor([[[*slip, 0.0]]], dtype=F64)
    one = torch.ones(1, 1, dtype=F64)
    touch = Touch(
        ground=True,
        position=torch.zeros(1, 1, 3, dtype=F64),
        normal=torch.tensor([[[0.0, 0.0, 1.0]]], dtype=F64),
        gap=0 * one,
        velocity=velocity,
        spin_rad_s=torch.zeros(1, 3, dtype=F64),
        step_s=1e-3 * one,
        friction=0.4 * one,
        contact_time_s=1e-3 * one,
        damping_ratio=one,
    )
    changed = FrictionPyramid().contact({}, touch)
    assert changed.anisotropy is not None
    ellipse = Ellipse.of(changed.friction, changed.anisotropy)
    push = ellipse.nearest(-1e6 * velocity[..., :2], one)[0, 0]  # what dissipates the most
    expected = -0.4 * torch.sign(velocity[0, 0, :2])
    across = torch.tensor(slip).abs() > 0.02 * max(map(abs, slip))  # along an axis nothing pushes sideways
    torch.testing.assert_close(push[across], expected[across], rtol=0.03, atol=0.0)
    assert bool((push[~across].abs() < 0.1).all())


def test_what_a_pyramid_explains_is_a_share_of_what_an_effect_explains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fitted beside the friction and the states of the effect's own fit; whole slides: `make evidence`."""
    world, tried = world_with("ball"), []

    def fit_pyramid(found: World, variants: list[Any], starts: list[Any], known: object) -> list[Any]:
        tried.append((found, variants, starts, known))
        return [SimpleNamespace(cost=70.0)]

    monkeypatch.setattr(sliding, "fit_sliding", fit_pyramid)
    started: Any = SimpleNamespace(segments=SimpleNamespace(world=world), flight_parameters="known")
    segments = SimpleNamespace(in_world=lambda found: ("segments in", found))
    fit: Any = SimpleNamespace(values=torch.arange(5.0)[None], segments=segments, cost=40.0)
    assert sliding.pyramid_share(started, SimpleNamespace(parameters=(1, 2)), fit, 100.0) == 0.5
    ((found, variants, ((where, values),), known),) = tried
    assert [type(one.effect) for one in found.effects] == [FrictionPyramid] and where == ("segments in", found)
    assert variants == [] and values.tolist() == [0.0, 1.0, 2.0] and known == "known"


def test_friction_by_direction_is_not_named_where_a_pyramid_explains_slides_as_well() -> None:
    data: Any = SimpleNamespace(flown=False, explained=True, sliding=None)
    share = THRESHOLDS.sliding.pyramid_share
    counts = [
        len(SlidingTest().bars([evidence("anisotropic_friction", pyramid_share=s)], data)) for s in (0.5, share, 1.1)
    ]
    assert counts == [2, 2, 0]
    findings: Any = SimpleNamespace(as_good=(), as_pyramid=("anisotropic_friction",), as_line=())
    (said,) = law_warnings(findings)
    assert "pyramid" in said and "Next, " in said and "slides along x, along y and between" in said


def slides(braking: Any, spread: float = 0.0) -> Any:
    """Straight slides from several speeds over 3 m along x, cut into pieces of 0.2 s, with a deceleration by place."""
    times, rng, places = torch.arange(21, dtype=torch.float64) / 100, np.random.default_rng(4), []
    for speed in (2.0, 2.6, 3.2, 3.8):
        at, v, way = 0.0, speed, []
        for _ in range(100):
            way.append((at, 0.1 * spread * at, 0.0))
            v = max(v - braking(at, v) * 0.01, 0.0)
            at += 0.01 * v
        places += [torch.tensor(way[k : k + 21], dtype=torch.float64) for k in range(0, 80, 20)]
    position = torch.stack(places)[:, :, None] + 1e-4 * torch.as_tensor(rng.normal(size=(len(places), 21, 1, 3)))
    seen = torch.ones(len(places), 21, 1, dtype=torch.float64)
    observed = SimpleNamespace(position_m=position, seen=seen, times_s=times.expand(len(places), -1))
    world = SimpleNamespace(gravity=torch.zeros(1, 3, dtype=torch.float64))
    return SimpleNamespace(observations=observed, lengths=[21] * len(places), world=world)


def test_a_line_is_looked_for_where_braking_changes_along_the_slides() -> None:
    lines = lines_across(slides(lambda at, _: 0.4 if at < 1.5 else 2.0))
    effects = [one.active.effect for one in lines]
    assert len(lines) == 3 and abs(abs(effects[1].axis[0]) - 1) < 0.01  # pyright: ignore[reportAttributeAccessIssue]
    assert min(abs(abs(one.place_m) - 1.5) for one in effects) < 0.25  # pyright: ignore[reportAttributeAccessIssue]
    few = slides(lambda *_: 1.0)
    few.lengths = [3] * len(few.lengths)
    assert lines_across(few) == []


def test_a_line_changes_the_friction_beyond_it() -> None:
    touch = Touch(
        friction=torch.full((1, 3), 0.1, dtype=torch.float64), ground=True,
        position=torch.tensor([[[0.0, 5.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]], dtype=torch.float64),
        **{f.name: None for f in fields(Touch) if f.name not in ("friction", "ground", "position")},
    )  # fmt: skip
    step = FrictionStep(torch.tensor([1.0, 0.0, 0.0]), 1.0, 0.01)
    found = step.contact({"d": torch.tensor([0.2], dtype=torch.float64)}, touch)
    assert found.friction[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert step.contact({}, replace(touch, ground=False)).friction is touch.friction


def test_friction_by_speed_is_not_named_where_a_line_explains_slides_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    costs = iter((95.0, 40.0, 70.0))
    monkeypatch.setattr(sliding, "fit_sliding", lambda *_: [SimpleNamespace(cost=next(costs))])
    monkeypatch.setattr(sliding, "lines_across", lambda _: ["a", "b", "c"])
    started: Any = SimpleNamespace(segments=SimpleNamespace(world=None), flight_parameters=())
    fit: Any = SimpleNamespace(values=torch.zeros(1, 3), segments=None, cost=50.0)
    assert sliding.line_share(started, SimpleNamespace(parameters=(1,)), fit, 100.0) == pytest.approx(1.2)
    data: Any = SimpleNamespace(flown=False, explained=True, sliding=None)
    counts = [len(SlidingTest().bars([evidence("viscous_friction", line_share=s)], data)) for s in (0.5, 1.2)]
    assert counts[0] > 0 and counts[1] == 0
    findings: Any = SimpleNamespace(as_good=(), as_pyramid=(), as_line=("stribeck_friction",))
    (said,) = law_warnings(findings)
    assert "changes at a line across the ground" in said and "Next, record slides of several speeds" in said


@pytest.mark.parametrize(
    ("share", "left", "called"),
    [(0.4, 3.0, "Nearest in the library, which explains 40 % "), (0.4, 1.2, "Missing"), (0.7, 3.0, "Missing")],
)
def test_a_name_that_leaves_most_is_the_nearest_in_the_library(share: float, left: float, called: str) -> None:
    after = SimpleNamespace(statistic=left, p_value=1e-9)
    findings: Any = SimpleNamespace(
        flight=SimpleNamespace(in_flight=["linear_drag"], after=after, explained_share=share)
    )
    assert _called(findings).startswith(called)


def test_a_gravity_that_sets_in_is_no_scale_of_lengths() -> None:
    noise, size = Noise(3e-4, 1e-3), 0.04

    def sinking(track: Track) -> Track:
        late = np.clip(track.time_s - 0.25, 0.0, None)
        return replace(track, position_m=track.position_m + 0.5 * 4 * size * -9.81 * late[:, None] ** 2 * np.eye(3)[2])

    world = world_with("ball", ground=False)
    plain = tosses(world, 3, 4, 0.5, 148.0, noise)
    late = [(name, {body: sinking(track) for body, track in tracks.items()}) for name, tracks in plain]
    prepared = prepare(world, late, noise)
    assert prepared.flight is not None
    named = replace(world, effects=(ActiveEffect.of(load_effect("length_scale"), {}, world.gravity[0, :1]),))
    fitted = refit([prepared.flight], named, base_parameters(named, "flight"))
    assert without_lasting(fitted.segments[0], fitted.world, ["length_scale"], 1.0) == {"length_scale"}
