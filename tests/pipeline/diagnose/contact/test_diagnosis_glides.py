"""Glides: bodies that slide, roll and spin on the ground tell effects of contact, whatever the law of contact."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose.contact import sliding
from cgwm.pipeline.diagnose.contact.contact_test import ContactData, selected, with_effect
from cgwm.pipeline.diagnose.contact.detection_limits import DetectionLimit, detection_limits
from cgwm.pipeline.diagnose.contact.sliding import SlidingTest
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.score_test import ScoreTest
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.diagnose.verdict import Findings, find
from cgwm.pipeline.geometry.rotation import quat_to_matrix
from cgwm.pipeline.physics import World, simulate
from cgwm.pipeline.physics.contact_law import ContactLaw
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.physics.parameters import FRICTION
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.prepare import Prepared, prepare
from cgwm.pipeline.segments.segments import Segments
from cgwm.pipeline.segments.sliding.fit import StartedSliding
from cgwm.pipeline.segments.sliding.residuals import TIME_S, LoadErrors, soft_world
from cgwm.pipeline.segments.sliding.segments import find_sliding_segments
from cgwm.pipeline.trajectories.segmentation import Segment
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import Effects, tosses, world_with
from helpers.worlds import ball_body, state_of, world_of

LIBRARY = [
    Candidate(name, load_effect(name))
    for name in ("linear_drag", "rolling_resistance", "torsional_friction", "viscous_friction")
]

GRAIN = Candidate("anisotropic_friction", load_effect("anisotropic_friction"))
"""Two balls with friction against spinning give it over a third of the score; it is no candidate there."""


@pytest.fixture(autouse=True)
def no_pyramids(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit no friction pyramid in the place of an effect: it takes seconds; its tests: test_withheld_names.py."""
    if request.node.get_closest_marker("evidence") is None:
        monkeypatch.setattr(sliding, "pyramid_share", lambda *_: 0.0)


def rolls(
    effects: Effects | None = None, law: dict[str, float] | None = None, seed: int = 3, thrown: int = 0
) -> tuple[Prepared, World]:
    """Balls that slide, then roll, by a world with effects and with numbers of contact of its own; and thrown ones."""
    truth, world = world_with("ball", effects), world_with("ball")
    assert isinstance(truth.contact, ContactLaw)
    changed = {name: torch.full((1,), value, dtype=torch.float64) for name, value in (law or {}).items()}
    truth = replace(truth, contact=replace(truth.contact, **changed))
    episodes = tosses(truth, seed, count=2, duration_s=0.5, height_m=(0.04, 0.04), lift_m_s=(0.0, 0.0))
    if thrown:
        flights = tosses(truth, seed + 1, count=thrown, duration_s=0.3, height_m=(0.6, 0.8))
        episodes += [(f"thrown {name}", tracks) for name, tracks in flights]
    return prepare(world, episodes), world


@cache
def plain_rolls() -> tuple[Prepared, World]:
    """Return rolls by the world itself."""
    return rolls()


BRAKED = {"rolling_resistance": {"c_r": 0.0015}}


@cache
def braked_and_thrown() -> tuple[Prepared, Findings]:
    """Return rolls that are braked, with two throws beside them, and what is found in them."""
    prepared, world = rolls(BRAKED, thrown=2)
    return prepared, find(prepared, world, LIBRARY)


def test_a_glide_ends_at_an_impact() -> None:
    world = world_with("ball")
    on = tosses(world, 1, count=2, duration_s=0.6, height_m=(0.04, 0.04), lift_m_s=(0.0, 0.0))
    off = tosses(world, 1, count=2, duration_s=0.6, height_m=(0.3, 0.4), lift_m_s=(0.0, 0.0))
    slid, bounced = (prepare(world, episodes) for episodes in (on, off))
    glides = find_sliding_segments(world, slid.observations, slid.airborne, slid.noise)
    assert {item.episode for item in glides} == {0, 1}
    covered = sum(item.last - item.first for item in glides)
    assert covered >= 0.9 * 2 * (len(slid.observations.times_s[0]) - 1)
    height = bounced.observations.position_m[:, :, 0, 2] - 0.04
    for item in find_sliding_segments(world, bounced.observations, bounced.airborne, bounced.noise):
        assert float(height[item.episode, item.first : item.last + 1].max()) < 0.01


def test_hidden_frames_shorten_no_glide() -> None:
    world = world_with("ball")
    episodes = tosses(world, 1, count=2, duration_s=0.6, height_m=(0.04, 0.04), lift_m_s=(0.0, 0.0))
    seen = prepare(world, episodes)
    whole = seen.observations
    hidden = {name: getattr(whole, name).clone() for name in ("seen", "has_orientation")}
    for mask in hidden.values():
        mask[:, :6] = 0  # in a hand
        mask[0, 20] = 0  # lost once
    parts = [
        (item.episode, item.first, item.last) for item in find_sliding_segments(world, whole, seen.airborne, seen.noise)
    ]
    later = find_sliding_segments(world, replace(whole, **hidden), seen.airborne, seen.noise)
    assert max(last for _, _, last in parts) == max(item.last for item in later) == len(whole.times_s[0]) - 1
    assert min(item.first for item in later) == 6
    covered = sum(item.last - item.first for item in later)
    assert covered >= sum(last - first for _, first, last in parts) - 2 * 7


def evidence(name: str, score: float, share: float, size: float = 1.0) -> Evidence:
    """An effect in glides, each of its numbers so many times what is usual."""
    effect = load_effect(name)
    values = np.array([size * p.scale for p in effect.parameters])
    test = ScoreTest(
        statistic=score, dof=len(values), p_value=0.0, estimate=values, covariance=np.eye(len(values)), admissible=True
    )
    numbers = {p.name: (float(v), 0.0) for p, v in zip(effect.parameters, values, strict=True)}
    return Evidence(
        candidate=Candidate(name, effect),
        constants={},
        test=test,
        p_value=0.0,
        numbers=numbers,
        score=score,
        share=share,
        contact={"friction": 0.3},
    )


def data_of(prepared: Prepared, world: World) -> ContactData:
    """Return data with sliding segments and without contact segments, of which the sliding test reads nothing."""
    sliding = StartedSliding.of(prepared, world, prepared.flight)
    return ContactData(prepared=prepared, world=world, segments=None, sliding=sliding)


def named_in_sliding(given: list[Evidence], flown: bool, explained: bool = True) -> list[Evidence]:
    """Return what the sliding test selects of given evidence, which alone decides."""
    prepared, world = plain_rolls()
    data = ContactData(prepared=prepared, world=world, segments=None, sliding=None, flown=flown, explained=explained)
    return selected(SlidingTest(), given, data)


@pytest.mark.parametrize(
    ("name", "gains", "named"),
    [
        ("viscous_friction", (300.0, 150.0, 0.0), True),
        ("viscous_friction", (440.0, 10.0, 0.0), False),  # one slide carries it
        ("viscous_friction", (500.0, 150.0, -200.0), False),  # the others predict each other worse than without it
        ("anisotropic_friction", (300.0, 290.0, 0.0), False),  # two slides are braked along and across: any law fits
        ("anisotropic_friction", (300.0, 290.0, 60.0), True),
        ("friction_patch", (-115.0, 44.0, 108.0, 3.0, 233.0), False),  # a map fits three of five
        ("friction_patch", (0.0, 44.0, 108.0, 3.0, 233.0), True),
    ],
)
def test_slides_of_other_episodes_have_to_predict_what_is_named(
    name: str, gains: tuple[float, ...], named: bool
) -> None:
    found = named_in_sliding([replace(evidence(name, 500, 0.9), gains=gains)], flown=False)
    assert [one.name for one in found] == [name] * named


@pytest.mark.parametrize(
    ("found", "flown", "named"),
    [
        ([("viscous_friction", 250, 0.7), ("rolling_resistance", 50, 0.1)], False, ["viscous_friction"]),
        ([("viscous_friction", 200, 0.7)], False, []),  # wrong ones reach as much
        ([("viscous_friction", 100, 0.9)], False, ["viscous_friction"]),  # it leaves next to nothing
        ([("friction_patch", 300, 0.9)], False, []),  # a map fits about anything
        ([("friction_patch", 500, 0.9)], False, ["friction_patch"]),
        ([("viscous_friction", 250, 0.7)], True, []),  # the law of what was found in flight is never quite the true one
        ([("viscous_friction", 500, 0.7)], True, ["viscous_friction"]),
        ([("anisotropic_friction", 500, 0.9, 0.2)], False, []),  # a hundredth by direction
        # a rival that is behind by less than wrong ones gain, and explains about as much
        (
            [("stribeck_friction", 250, 0.7), ("friction_patch", 150, 0.6), ("adhesion", 140, 0.2)],
            False,
            ["stribeck_friction", "friction_patch"],
        ),
        ([("stribeck_friction", 900, 0.7), ("friction_patch", 600, 0.6)], False, ["stribeck_friction"]),
        # engines brake the spin of a sliding box differently, which a map explains as well
        ([("torsional_friction", 250, 0.8), ("friction_patch", 190, 0.7)], False, []),
        ([("torsional_friction", 250, 0.8), ("friction_patch", 20, 0.7)], False, ["torsional_friction"]),
    ],
)
def test_what_glides_name(found: list[tuple], flown: bool, named: list[str]) -> None:
    given = [evidence(*one) for one in found]
    assert [one.name for one in named_in_sliding(given, flown)] == named


def test_what_a_single_episode_says_is_not_named_beside_an_effect_of_flight() -> None:
    told = evidence("anisotropic_friction", 900, 0.9)
    alone, twice = replace(told, without_best=20.0), replace(told, without_best=200.0)
    assert named_in_sliding([alone], flown=True) == []
    assert named_in_sliding([twice], flown=True) == [twice]
    assert named_in_sliding([alone], flown=False) == [alone]  # no law from flight can be off
    # a misfit of one episode is one error, where the slides of others tell
    gains = (300.0, 40.0, 30.0, 30.0)
    assert named_in_sliding([replace(alone, gains=gains)], flown=False) == []
    assert [one.name for one in named_in_sliding([replace(twice, gains=gains)], flown=False)] == [told.name]


def test_evidence_tells_what_the_other_episodes_say() -> None:
    prepared, world = rolls({"rolling_resistance": {"c_r": 1e-3}})
    (first, *_) = SlidingTest().evidence(data_of(prepared, world), LIBRARY)
    assert first.name == "rolling_resistance"
    assert 80 < first.without_best < 0.6 * first.score  # two balls


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("rolling_resistance", {"c_r": 0.0015}),
        pytest.param("torsional_friction", {"c_t": 0.0012}, marks=pytest.mark.evidence),
        pytest.param("anisotropic_friction", {"a": 0.1}, marks=pytest.mark.evidence),
    ],
)
def test_glides_name_what_is_hidden(name: str, values: dict[str, float]) -> None:
    # another contact than the model's, and a friction that it does not know
    prepared, world = rolls({name: values}, {"contact_time_s": 0.006, "damping_ratio": 0.2, "friction": 0.22}, thrown=2)
    library = [*LIBRARY, GRAIN] if name == GRAIN.spec else LIBRARY
    found = SlidingTest().evidence(data_of(prepared, world), library)
    assert found[0].name == name
    assert found[0].score > THRESHOLDS.sliding.score
    assert found[0].score > 3 * found[1].score
    assert found[0].numbers is not None
    (key, value) = next(iter(values.items()))
    estimate, error = found[0].numbers[key]
    assert abs(estimate - value) < max(4 * error, 0.1 * value)
    after = with_effect(world, found[0])
    assert after.effects[-1].effect.name == name
    assert float(after.contact.friction[0]) == pytest.approx(0.22, rel=0.1)  # pyright: ignore[reportAttributeAccessIssue]


def limits(prepared: Prepared, world: World, library: list[Candidate] = LIBRARY) -> dict[str, DetectionLimit]:
    started = StartedSliding.of(prepared, world, prepared.flight)
    blind_to = ("velocity_restitution",)
    found = detection_limits(
        started, world, library, (THRESHOLDS.sliding.score, 400.0), prepared.has_orientation, blind_to
    )
    return {one.candidate.effect.name: one for one in found}


# In the suite: limits grow with the noise in the next test, and glides name what is hidden in the one before.
@pytest.mark.evidence
def test_from_the_limit_on_an_effect_is_named() -> None:
    library = [*LIBRARY, *(Candidate(name, load_effect(name)) for name in ("friction_patch", "velocity_restitution"))]
    found = limits(*plain_rolls(), library)
    assert "linear_drag" not in found  # it acts in flight
    assert found["velocity_restitution"].sizes == found["friction_patch"].sizes == {}
    # as much of it as would show stops a ball's slide at once, as more friction does
    assert found["viscous_friction"].sizes == {}
    for name, number in (("rolling_resistance", "c_r"), ("torsional_friction", "c_t")):
        (limit,) = found[name].sizes.values()
        for times, seen in ((1.1, True),) if name == "torsional_friction" else ((1.1, True), (0.2, False)):
            prepared, world = rolls({name: {number: times * limit}})
            ranked = SlidingTest().evidence(data_of(prepared, world), LIBRARY)
            named = bool(ranked) and ranked[0].name == name and ranked[0].score > THRESHOLDS.sliding.score
            assert named == seen, (name, times, limit, [(one.name, one.score) for one in ranked])


def test_worse_data_have_larger_limits_and_no_glide_has_none() -> None:
    prepared, world = plain_rolls()
    worse = replace(prepared, noise=Noise(3 * prepared.noise[0], 3 * prepared.noise[1]))
    near, far = limits(prepared, world)["rolling_resistance"], limits(worse, world)["rolling_resistance"]
    assert far.sizes["c_r"] == pytest.approx(3 * near.sizes["c_r"], rel=0.5)
    tossed = prepare(world, tosses(world, 1, count=2, duration_s=0.3, height_m=(0.6, 0.7)))
    assert limits(tossed, world) == {}


def test_glides_are_silent_under_another_contact_law() -> None:
    prepared, world = rolls(None, {"contact_time_s": 0.002, "damping_ratio": 0.6, "friction": 0.25})
    found = SlidingTest().evidence(data_of(prepared, world), LIBRARY)
    assert not found or found[0].score < THRESHOLDS.sliding.score


def test_what_glides_tell_is_the_verdict() -> None:
    _, found = braked_and_thrown()
    assert found.verdict == "missing_effect"
    assert [one.evidence.name for one in found.chosen] == ["rolling_resistance"]
    assert found.chosen[0].where == "contact"
    before, after = found.errors["rolling_resistance"]
    assert np.isfinite([before, after]).all()


# In the suite: what a glide and a throw together name is tested above, rivals in test_diagnosis.py.
@pytest.mark.evidence
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("rolling_resistance", BRAKED["rolling_resistance"]),
        pytest.param("linear_drag", {"c": 0.3}, marks=pytest.mark.evidence),
    ],
)
def test_without_flight_what_acts_there_is_a_rival(name: str, values: dict[str, float]) -> None:
    """Two rolls of half a second do not tell rolling resistance from a drag, one throw does."""
    prepared, world = rolls({name: values})
    assert prepared.flight is None and prepared.least_force_m_s2 == np.inf
    (chosen,) = find(prepared, world, LIBRARY).chosen
    assert name in {one.name for one in chosen.equals}
    assert {"rolling_resistance", "linear_drag"} & {
        one.name for one in chosen.equals[1:]
    } or chosen.evidence.name == name
    if {name: values} == BRAKED:
        known, found = braked_and_thrown()
    else:
        known, world = rolls({name: values}, thrown=2)
        found = find(known, world, LIBRARY)
    assert known.least_force_m_s2 < 0.1
    assert [one.evidence.name for one in found.chosen] == [name]


def test_a_box_that_turns_over_an_edge_does_not_glide() -> None:
    world, times = world_with("cube"), np.linspace(0, 1, 101)
    angle = np.interp(times, (0.3, 0.6), (0.0, np.pi / 2))
    height = 0.05 * (np.abs(np.cos(angle)) + np.abs(np.sin(angle)))  # its lowest edge stays on the ground
    rng, zero = np.random.default_rng(0), np.zeros(101)
    position = np.stack([0.1 * times, zero, height], 1) + 2e-4 * rng.standard_normal((101, 3))
    found = {}
    for name, tilt in (("flat", 0 * angle), ("over", angle)):
        quat = np.stack([np.cos(tilt / 2), zero, np.sin(tilt / 2), zero], 1) + 5e-4 * rng.standard_normal((101, 4))
        level = position.copy()
        level[:, 2] += 0.05 * (np.abs(np.cos(tilt)) + np.abs(np.sin(tilt))) - height
        track = Track(times, level, quat / np.linalg.norm(quat, axis=1, keepdims=True))
        prepared = prepare(world, [(name, {world.bodies[0].name: track})])
        glides = find_sliding_segments(world, prepared.observations, prepared.airborne, prepared.noise)
        found[name] = sum(item.last - item.first for item in glides)
        assert all(name == "flat" or item.last <= 32 or item.first >= 58 for item in glides)
    assert found["flat"] > 90 and 40 < found["over"] < 70


def test_what_unknown_loads_turn_is_no_evidence() -> None:
    world = world_with("cube")
    episodes = tosses(world, 2, count=2, duration_s=0.5, height_m=(0.05, 0.05), lift_m_s=(0.0, 0.0))
    prepared = prepare(world, episodes)
    soft = soft_world(world)
    frames = [Segment(k, 0, 50) for k in range(2)]
    glides = Segments.of("contact", soft, prepared.observations, frames, prepared.noise)
    rows = glides.residuals([FRICTION], torch.zeros(2, 1, dtype=torch.float64), jacobian=False)[0]
    loads = LoadErrors.of(glides)
    weak, full = loads.whitened(rows[None])[0], rows
    up = quat_to_matrix(glides.observations.quat_wxyz[:, :, 0]).transpose(-1, -2) @ soft.ground_normal
    squared = glides.observations.times_s[..., None].square()
    constant = torch.cat((torch.zeros_like(up), squared * up), -1)  # a turn at constant angular acceleration
    for given, least, most in ((constant, 0.0, 0.05), (rows.roll(1, -1), 0.5, 1.0)):
        share = loads.whitened(given[None]).norm() / given.norm()
        assert least <= share <= most
    assert weak.norm() <= full.norm()


def test_a_body_rests_on_the_soft_ground_nearly_as_high_as_on_the_hard_one() -> None:
    start = state_of(((0, 0, 0.04), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0)))
    every = torch.tensor([0.0, 0.05, 0.1], dtype=torch.float64)
    height = simulate(soft_world(world_of(ball_body(0.04))), start, every).position_m[0, -1, 0, 2]
    assert abs(float(height) - 0.04) < 0.6 * 9.81 * TIME_S**2  # steps of half its time leave half of the depth
