"""Diagnosis: phases, segments, score tests and verdicts, on tosses of our own engine whose truth is known."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar, cast

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline.diagnose import diagnose, stage
from cgwm.pipeline.diagnose.contact import flight_equals
from cgwm.pipeline.diagnose.contact.flight_equals import fitted_contact, resolved_flight, separated
from cgwm.pipeline.diagnose.evidence import falsification
from cgwm.pipeline.diagnose.evidence.effect_selection import SelectionStep, are_slight, repeats, select_next
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.falsification import consistency, fitted_numbers, repetition
from cgwm.pipeline.diagnose.evidence.score_test import ScoreTest, score_test
from cgwm.pipeline.diagnose.flight import search as flight_search
from cgwm.pipeline.diagnose.sparse_regression import residual_law
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.optimization.tails import student_quantile, student_tail
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.physics.effects.gravity_tilt import GravityTilt
from cgwm.pipeline.physics.effects.registry import BUILT_IN
from cgwm.pipeline.physics.parameters import Parameter
from cgwm.pipeline.segments.candidates import Candidate, variants_of
from cgwm.pipeline.segments.contact_phases import phases_of
from cgwm.pipeline.segments.flights.residual_wrench import covariates_of, omnibus, residual_wrenches, wrench_windows
from cgwm.pipeline.segments.linearization import Linearization, linearize
from cgwm.pipeline.segments.prepare import Prepared, prepare
from cgwm.pipeline.segments.segment_states import fit_states
from cgwm.pipeline.segments.segments import FLIGHT_STEP_S, Segments
from cgwm.pipeline.trajectories.flight_noise import flight_noise, without_outliers
from cgwm.pipeline.trajectories.segmentation import cut_episodes, whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import InputDataError
from helpers.diagnosis_data import NOISE, evidence_of, tosses, world_with, write_capture
from scipy.stats import kstest

LIBRARY = [Candidate(name, load_effect(name)) for name in BUILT_IN]
NOTHING = torch.zeros(0, dtype=torch.float64)


def ready(body: str, effects: dict, seed: int = 1, **options: object) -> tuple[Prepared, object]:
    """Tosses with an effect, prepared for the world without it."""
    ground = options.pop("ground", True)
    truth, world = world_with(body, effects, bool(ground)), world_with(body, None, bool(ground))
    return prepare(world, tosses(truth, seed, **options)), world  # pyright: ignore[reportArgumentType]


def flight_slot(
    effects: dict, seed: int = 1, library: list[Candidate] | None = None, body: str = "cube"
) -> SelectionStep:
    prepared, world = ready(body, effects, seed, count=5, duration_s=0.4, ground=False)
    assert prepared.flight is not None
    chosen = LIBRARY if library is None else library
    return select_next(prepared.flight, world, chosen, prepared.groups, prepared.has_orientation)  # pyright: ignore[reportArgumentType]


def names(slot: SelectionStep) -> set[str]:
    return {e.name for e in slot.equals} if slot.flagged else set()


def test_a_bounce_between_two_frames_is_no_flight() -> None:
    world = world_with("ball")
    for rate in (60.0, 100.0, 300.0):
        noise = Noise(1e-5, 1e-4)
        episodes = tosses(world, 5, count=6, duration_s=0.8, rate_hz=rate, noise=noise, height_m=(0.15, 0.4))
        whole = whole_episodes(world, episodes)
        flight, _, _ = cut_episodes(world, whole, noise)
        assert len(flight) >= 6
        fitted = fit_states(Segments.of("flight", world, whole, flight, Noise(1e-4, 1e-3)))
        # a bounce in a flight leaves millimetres; without one the model is exact
        assert float(fitted.residuals([], NOTHING, False)[0].abs().max()) < 1.0


def test_phases_follow_the_motion_of_a_ball() -> None:
    world = world_with("ball")
    episodes = tosses(world, 2, count=3, duration_s=1.2)
    prepared = prepare(world, episodes)
    contact = prepared.contact(world)
    found = phases_of([name for name, _ in episodes], prepared.observations, prepared.airborne, contact)
    for one in found:
        assert set(one.phase) <= {"flight", "impact", "sliding", "rolling", "sticking", "rest"}
        assert (one.phase[one.airborne] == "flight").all()
        assert one.phase[0] == "flight" and "impact" in one.phase
        assert "rolling" in one.phase[-10:] or "sliding" in one.phase[-10:]


def test_without_ground_all_is_flight() -> None:
    prepared, _ = ready("cube", {}, ground=False, count=3)
    assert prepared.airborne.all() and not prepared.contact_items


def test_where_nothing_can_be_touched_what_is_no_flight_is_no_contact_either() -> None:
    bouncing = tosses(world_with("ball"), 2, count=3, duration_s=1.2)
    prepared = prepare(world_with("ball", ground=False), bouncing)
    assert not prepared.airborne.all() and prepared.contact_items == ()


def test_segments_recover_states_and_the_noise() -> None:
    world = world_with()
    episodes = tosses(world, 4, count=6, duration_s=0.9)
    prepared = prepare(world, episodes)
    assert prepared.noise == pytest.approx(NOISE, rel=0.12)
    whole = prepared.observations
    for fitted in (prepared.flight, prepared.contact(world)):
        assert fitted is not None
        chi2 = fitted.residuals([], NOTHING, False)[0].square().sum((1, 2))
        assert float((chi2 / fitted.dof).median()) == pytest.approx(1.0, abs=0.25)
        first = torch.tensor([item.first for item in fitted.items])
        episode = torch.tensor([item.episode for item in fitted.items])
        away = fitted.observations.state.position_m[:, 0] - whole.position_m[episode, first, 0]
        assert float(away.square().mean().sqrt()) < 2 * NOISE[0]


def test_wrong_measurements_are_left_out_and_a_hidden_bounce_is_no_flight() -> None:
    world = world_with("ball")
    episodes = tosses(world, 6, count=3, duration_s=0.4, height_m=(0.9, 1.2))
    track = episodes[0][1]["ball"]
    track.position_m[10] += 0.05
    # the second touches something half-way up that nobody spoke of
    kinked = episodes[1][1]["ball"]
    kinked.position_m[20:, 0] += 1.5 * (kinked.time_s[20:] - kinked.time_s[20])
    whole = whole_episodes(world, episodes)
    flight, _, _ = cut_episodes(world, whole, NOISE)
    seen, count, touched = without_outliers(whole, flight, NOISE)
    assert count == 1 and float(seen.seen[0, 10, 0]) == 0
    assert bool(touched[1, 18:23].all()) and not bool(touched[0].any()) and not bool(touched[2].any())
    flight, _, _ = cut_episodes(world, seen, NOISE, touched)
    assert flight_noise(seen, flight)[0] == pytest.approx(NOISE[0], rel=0.15)


def test_score_tests_in_flight_are_calibrated() -> None:
    world = world_with(ground=False)
    chosen = [c for c in LIBRARY if c.spec in ("linear_drag", "magnus_lift", "gravity_tilt", "length_scale")]
    variants = variants_of(chosen, world.gravity[0, :1])
    # all data sets as one batch, each of two episodes
    episodes = [episode for seed in range(100) for episode in tosses(world, 100 + seed, count=2, duration_s=0.15)]
    whole = whole_episodes(world, episodes)
    flight, _, _ = cut_episodes(world, whole, NOISE)
    fitted = fit_states(Segments.of("flight", world, whole, flight, NOISE), iterations=3)
    seen = linearize(fitted, world, variants, [0] * len(episodes), robust=False)
    found: list[list[float]] = []
    wholes: list[float] = []
    for seed in range(100):
        own = replace(seen, weight=(seen.episode // 2 == seed).astype(float))
        found.append([score_test(own, own.columns(v.parameters)).p_value for v in variants])
        if seed < 50:
            mine = [k for k, item in enumerate(fitted.items) if item.episode // 2 == seed]
            wholes.append(omnibus(residual_wrenches(fitted.select(mine))).p_value)
    for values in (*np.array(found).T, np.array(wholes)):
        # 0.1 % of uniform samples are farther away
        assert kstest(values, "uniform").pvalue > 1e-3
    assert float((np.array(found) < 0.05).mean()) == pytest.approx(0.05, abs=0.03)


def test_flight_finds_what_is_hidden() -> None:
    for effects, wanted in (
        ({"quadratic_drag": {"k": 0.15}}, {"quadratic_drag"}),
        ({"linear_drag": {"c": 0.4}}, {"linear_drag"}),
        ({"spin_damping": {"d": 0.6}}, {"spin_damping"}),
    ):
        slot = flight_slot(effects)
        assert names(slot) == wanted
        (name,) = wanted
        ((parameter, true),) = effects[name].items()
        estimate, error = slot.best.numbers[parameter]  # pyright: ignore[reportOptionalSubscript]
        assert abs(estimate - true) < 4 * error and error < 0.1 * true


def test_the_constants_of_a_large_effect_are_those_of_where_it_ends() -> None:
    """At the first step from neutral half the range is the better one, and leaves a gap that gravity seems to fill."""
    library = [Candidate(name, load_effect(name)) for name in ("ground_magnet", "gravity_scale")]
    prepared, world = ready("ball", {"ground_magnet": {"A": 10.0, "l": 0.1}}, 3, duration_s=0.6)
    assert prepared.flight is not None
    slot = select_next(prepared.flight, world, library, prepared.groups, prepared.has_orientation)  # pyright: ignore[reportArgumentType]
    assert slot.best.name == "ground_magnet" and slot.best.constants == {"l": 0.1}
    assert slot.best.numbers is not None
    estimate, error = slot.best.numbers["A"]
    assert abs(estimate - 10.0) < 3 * error < 1.5


@pytest.mark.parametrize(("share", "wanted"), [(0.5, ["quadratic_drag"]), (0.7, ["quadratic_drag", "gravity_tilt"])])
def test_what_patches_up_the_law_of_another_is_no_second_effect(
    monkeypatch: pytest.MonkeyPatch, share: float, wanted: list[str]
) -> None:
    """It is significant and predicts held-out episodes, and explains a part of the excess that is left."""
    prepared, world = ready("cube", {"quadratic_drag": {"k": 0.15}}, count=3, duration_s=0.3, ground=False)
    assert prepared.flight is not None
    least, excess = float(prepared.flight.dof.sum()), 300.0
    costs = [least + excess, least + (1 - share) * excess]
    slots = []
    for name, cost in zip(("quadratic_drag", "gravity_tilt"), costs, strict=True):
        refitted = SimpleNamespace(cost=cost, world=world, segments=[prepared.flight])
        one = SimpleNamespace(name=name, refitted=refitted, repetition=None)
        slots.append(SelectionStep((), (one,), True))  # pyright: ignore[reportArgumentType]
    last, first = SelectionStep((), (SimpleNamespace(name="wind", refitted=None),), False), iter(slots)  # pyright: ignore
    monkeypatch.setattr(flight_search, "select_next", lambda *_: next(first, last))
    losses = iter((3.0, 2.0))
    monkeypatch.setattr(flight_search, "held_out_loss", lambda *_: next(losses))
    monkeypatch.setattr(flight_search, "_coupled", lambda *_: None)
    found, _, _ = flight_search.flight_search(prepared, world, LIBRARY, 1.0)  # pyright: ignore[reportArgumentType]
    assert [slot.best.name for slot in found] == wanted


def test_flight_is_silent_where_nothing_is_missing() -> None:
    for seed in (11, 12):
        assert not flight_slot({}, seed).flagged


def test_what_flight_alone_cannot_tell_apart_is_stated_whole() -> None:
    assert names(flight_slot({"gravity_tilt": {"tilt_x": 0.03}})) == {"gravity_tilt", "frame_tilt", "constant_force"}
    assert names(flight_slot({"com_offset": {"d_x": 0.004}})) == {"com_offset", "marker_offset"}
    lighter = {"gravity_scale", "buoyancy", "length_scale", "clock_scale", "constant_force"}
    assert names(flight_slot({"length_scale": {"s": -0.03}})) == lighter
    # nothing buoyant makes a body heavier
    assert names(flight_slot({"gravity_scale": {"s": 0.03}})) == lighter - {"buoyancy"}


# In the suite: the same steps: what flight alone cannot tell apart, and the next test.
@pytest.mark.evidence
def test_contact_separates_a_scale_from_gravity() -> None:
    prepared, world = ready("ball", {"length_scale": {"s": 0.02}}, 3, count=4, duration_s=0.7, height_m=(0.1, 0.25))
    assert prepared.flight is not None
    slot = select_next(prepared.flight, world, LIBRARY, prepared.groups, True)  # pyright: ignore[reportArgumentType]
    assert "length_scale" in names(slot) and len(slot.equals) > 3
    fitted = fitted_contact(prepared, world)  # pyright: ignore[reportArgumentType]
    assert fitted is not None
    kept, _ = separated(slot.equals, fitted[1], fitted[0].world, prepared.groups)
    assert [e.name for e in kept] == ["length_scale"]


def test_contact_is_not_asked_which_drag_it_is_that_the_wind_acts_through() -> None:
    """Both steps have equals; without any drag the wind could not even be computed."""
    effects = {"quadratic_drag": {"k": 0.3}, "constant_force": {"f_x": 0.4, "f_y": 0.2}}
    prepared, world = ready("ball", effects, 3, count=4, duration_s=0.7, height_m=(0.1, 0.25))
    assert prepared.flight is not None
    by_name = {one.effect.name: one for one in LIBRARY}
    steps, current, flight = [], world, prepared.flight
    for pair in (("quadratic_drag", "linear_drag"), ("constant_force", "wind")):
        chosen = [by_name[name] for name in pair]
        slot = select_next(flight, current, chosen, prepared.groups, True)  # pyright: ignore[reportArgumentType]
        equals = sorted((e for e in slot.evidence if e.refitted is not None), key=lambda e: pair.index(e.name))
        assert [e.name for e in equals] == list(pair)
        steps.append(SelectionStep(slot.evidence, tuple(equals), True))
        refitted = equals[0].refitted
        assert refitted is not None
        current, flight = refitted.world, refitted.segments[0]
    found = resolved_flight(prepared, current, steps)
    assert [e.name for e in found.chosen[0]] == ["quadratic_drag", "linear_drag"]
    assert found.segments is not None
    assert {a.effect.name for a in found.after_flight.effects} == {"quadratic_drag", found.chosen[1][0].name}


def test_contact_is_asked_of_measured_tracks_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The errors of poses found in videos are alike over the few frames by which contacts tell drags apart."""
    prepared, world = ready("ball", {}, 3, count=2, duration_s=0.3, height_m=(0.1, 0.25))
    equals = tuple(SimpleNamespace(name=name, refitted=None) for name in ("quadratic_drag", "linear_drag"))
    contact = SimpleNamespace(world=world), None
    monkeypatch.setattr(flight_equals, "_is_asked", lambda *_: True)
    monkeypatch.setattr(flight_equals, "fitted_contact", lambda *_: contact)
    monkeypatch.setattr(flight_equals, "refitted_contact", lambda *_: contact)
    monkeypatch.setattr(flight_equals, "separated", lambda both, *_: (list(both[1:]), {}))
    step = SelectionStep((), equals, True)  # pyright: ignore[reportArgumentType]
    for filmed, kept in ((False, ["linear_drag"]), (True, ["quadratic_drag", "linear_drag"])):
        found = resolved_flight(replace(prepared, filmed=filmed), world, [step])
        assert [e.name for e in found.chosen[0]] == kept


def test_neither_order_nor_names_of_candidates_matter() -> None:
    class Slope(GravityTilt):
        name = "slope"

    effects = {"gravity_tilt": {"tilt_x": 0.03}}
    chosen = ("linear_drag", "magnus_lift", "gravity_tilt", "com_offset", "length_scale")
    library = [c for c in LIBRARY if c.spec in chosen]
    first, turned = flight_slot(effects, library=library), flight_slot(effects, library=library[::-1])
    assert [e.name for e in first.evidence] == [e.name for e in turned.evidence]
    assert [e.p_value for e in first.evidence] == pytest.approx([e.p_value for e in turned.evidence], rel=1e-6)
    renamed = [Candidate("slope", Slope()) if c.spec == "gravity_tilt" else c for c in library]
    assert names(flight_slot(effects, library=renamed)) == {"slope"}


def test_an_effect_may_have_a_value_for_each_episode() -> None:
    class Sway(GravityTilt):
        name = "sway"
        parameters: ClassVar = tuple(replace(p, shared="episode") for p in GravityTilt.parameters)

    tilts = [0.03, -0.03, 0.03, -0.03]
    world = world_with(ground=False)
    episodes = [
        (f"{k}", tosses(world_with("cube", {"gravity_tilt": {"tilt_y": t}}, False), 30 + k, 1, 0.4)[0][1])
        for k, t in enumerate(tilts)
    ]
    prepared = prepare(world, episodes)
    assert prepared.flight is not None
    library = [Candidate("sway", Sway()), Candidate("gravity_tilt", GravityTilt())]
    variants = variants_of(library, world.gravity[0, :1])
    seen = linearize(prepared.flight, world, variants, prepared.groups, robust=False)
    own, shared = (score_test(seen, seen.columns(v.parameters)) for v in variants)
    assert own.dof == 8 and shared.dof == 2
    assert own.statistic > 5 * shared.statistic
    assert own.estimate[4:] == pytest.approx(tilts, abs=5e-3)


def test_the_residual_wrench_tells_what_organises_it_and_which_law() -> None:
    prepared, world = ready("ball", {"linear_drag": {"c": 0.6}}, 8, count=6, duration_s=0.5, ground=False)
    assert prepared.flight is not None
    windows = wrench_windows(world, prepared.observations, prepared.flight.items, prepared.noise)  # pyright: ignore[reportArgumentType]
    assert windows is not None
    law = residual_law(windows)
    assert [t.name for t in law.terms] == ["-u"]
    assert law.terms[0].coefficient == pytest.approx(0.6, abs=0.05)
    best, low, high = law.exponents["-u"]
    assert low <= 1.0 <= high and best == pytest.approx(1.0, abs=0.5)
    assert law.left_chi2 < 1.6
    tilted, world = ready("ball", {"gravity_tilt": {"tilt_x": 0.06}}, 8, count=6, duration_s=0.5, ground=False)
    windows = wrench_windows(world, tilted.observations, tilted.flight.items, tilted.noise)  # pyright: ignore
    assert covariates_of(windows)[0].coordinate == "constant"  # pyright: ignore[reportArgumentType]


def test_the_test_split_is_never_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "next_motions", lambda *_: None)  # they take seconds, and have tests of their own
    truth = world_with("ball", {"magnus_lift": {"s": 0.04}})
    root = tmp_path / "capture"
    model = write_capture(root, world_with("ball"), tosses(truth, 3, count=5, duration_s=0.45), test=1)
    (root / "tracks" / "004.csv").write_text("this is no track\n")  # whoever opens it is refused
    found = diagnose(model, root)
    assert found.verdict == "missing_effect" and found.selected == ("magnus_lift",)
    with pytest.raises(InputDataError):
        Capture.open(root, check=False).tracks("004")


def test_data_that_carry_no_verdict_are_refused(tmp_path: Path) -> None:
    world = world_with("ball")
    episodes = tosses(world, 3, count=5, duration_s=0.3)
    model = write_capture(tmp_path / "few", world, episodes[:3], test=1)
    with pytest.raises(InputDataError, match="has 2 episodes"):
        diagnose(model, tmp_path / "few")
    slow = [(name, {b: replace(t, time_s=1e3 * t.time_s) for b, t in tracks.items()}) for name, tracks in episodes]
    model = write_capture(tmp_path / "slow", world, slow)
    with pytest.raises(InputDataError, match="milliseconds"):
        diagnose(model, tmp_path / "slow")
    sunk = [
        (name, {b: replace(t, position_m=t.position_m - [0, 0, 0.3]) for b, t in tracks.items()})
        for name, tracks in episodes
    ]
    shutil.rmtree(tmp_path / "slow")
    model = write_capture(tmp_path / "sunk", world, sunk)
    with pytest.raises(InputDataError, match="under the ground"):
        diagnose(model, tmp_path / "sunk")


def test_a_drag_in_wind_is_found_as_the_two() -> None:
    world, hidden = world_with("ball"), {"quadratic_drag": {"k": 0.3}, "wind": {"w_x": 3.0, "w_y": -1.0}}
    prepared = prepare(world, tosses(world_with("ball", hidden), 4, count=6, duration_s=0.6, height_m=(1.0, 2.0)))
    slots, found, _ = flight_search.flight_search(prepared, world, LIBRARY, 1.0)
    chosen = [slot.best for slot in slots if slot.flagged]
    assert {one.name for one in chosen} == set(hidden) == {active.effect.name for active in found.effects}
    (wind,) = (one.numbers for one in chosen if one.name == "wind")
    assert wind is not None and wind["w_x"][0] == pytest.approx(3.0, abs=4 * wind["w_x"][1])
    assert all(one.delta_bic is not None for one in chosen)


def test_a_tilt_that_is_another_in_every_episode_is_no_tilt() -> None:
    world = world_with("ball", ground=False)
    one, other = (
        tosses(world_with("ball", {"gravity_tilt": {"tilt_x": x, "tilt_y": y}}, False), seed, count=3)
        for seed, x, y in ((1, 0.05, 0.0), (2, -0.03, 0.04))
    )
    alike = tosses(world_with("ball", {"gravity_tilt": {"tilt_x": 0.05, "tilt_y": 0.0}}, False), 2, count=3)
    found = []
    for second in (alike, other):
        prepared = prepare(world, [*one, *((f"b{name}", tracks) for name, tracks in second)])
        assert prepared.flight is not None
        library = [Candidate("gravity_tilt", load_effect("gravity_tilt"))]
        refitted = select_next(prepared.flight, world, library, prepared.groups, True).best.refitted
        assert refitted is not None
        found.append(consistency(refitted.segments[0], refitted.world, ["gravity_tilt"], prepared.groups, 1.0))
    same, changing = found
    assert same is not None and not same.doubtful and same.share > 0.97
    assert changing is not None and changing.doubtful


def test_a_body_that_slides_above_the_ground_does_not_fly() -> None:
    world = world_with("cube")
    sliding = tosses(world_with("cube", {"frame_tilt": {"tilt_x": 0.0, "tilt_y": 0.0}}), 3, count=4, duration_s=1.0)
    raised = [
        (
            name,
            {
                body: replace(track, position_m=track.position_m + np.array([0.0, 0.0, 0.02]))
                for body, track in tracks.items()
            },
        )
        for name, tracks in sliding
    ]
    prepared = prepare(world, raised)
    assert any("the body is not in free fall" in words for words in prepared.warnings)
    flying = prepared.airborne.float().mean(1)
    assert float(flying.max()) < 0.75  # they rest on the ground at their ends


@pytest.mark.parametrize(
    ("size", "delta_bic", "slight"),
    [(0.1, -15.0, True), (0.1, -25.0, False), (0.2, -15.0, False), (0.1, None, False)],
)
def test_what_is_small_needs_more_evidence(size: float, delta_bic: float | None, slight: bool) -> None:
    effect = load_effect("marker_offset")
    numbers = {p.name: ((-size if k else 0.0) * p.scale, 0.0) for k, p in enumerate(effect.parameters)}
    test = ScoreTest(statistic=30.0, dof=3, p_value=1e-5, estimate=np.zeros(3), covariance=np.eye(3), admissible=True)
    found = Evidence(
        candidate=Candidate("marker_offset", effect),
        constants={},
        test=test,
        p_value=1e-5,
        delta_bic=delta_bic,
        numbers=numbers,
    )
    assert are_slight([found]) == slight


def test_what_is_small_as_one_effect_is_told_by_the_evidence_of_the_likeliest_of_its_equals() -> None:
    small, large = (
        _refitted(name, size, bic) for name, size, bic in (("com_offset", 0.1, -15.0), ("wind", 0.5, -25.0))
    )
    assert are_slight([small]) and not are_slight([small, large]) and not are_slight([large, small])


def _refitted(name: str, size: float, delta_bic: float) -> Evidence:
    effect = load_effect(name)
    numbers = {p.name: (size * p.scale, 0.0) for p in effect.parameters}
    return replace(evidence_of(name), numbers=numbers, delta_bic=delta_bic)


def one_parameter(information: np.ndarray, scores: np.ndarray) -> Linearization:
    """Information on a scale of gravity, and scores, of episodes with one segment each."""
    count = len(scores)
    parameter = Parameter(
        name="gravity_scale.s", unit="1", bounds=(-9.0, 9.0), logarithmic=False, reveals="", prior=(0.0, 1.0)
    )
    return Linearization(
        parameters=(parameter,), base=0, information=information[:, None, None], score=scores[:, None],
        weight=np.ones(count), episode=np.arange(count), group=np.zeros(count, np.int64), prior=np.zeros(1),
        chi2=np.zeros(count), dof=np.ones(count),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("scores", "wider"), [((5.0, -5.0, 4.0, -4.0, 0.0), True), ((0.1, -0.1, 0.0, 0.0, 0.0), False)]
)
def test_standard_errors_hold_the_scatter_between_episodes(
    scores: tuple[float, ...], wider: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    linear = one_parameter(np.full(5, 5.0), np.array(scores))
    monkeypatch.setattr(falsification, "linearize", lambda *_, **__: linear)
    world = world_with("ball", {"gravity_scale": {"s": 0.01}}, False)
    value, std = fitted_numbers(cast(Segments, None), world, ["gravity_scale"], [0] * 5, 1.0)["gravity_scale"]["s"]
    # Huber's sandwich over five episodes, with Student's t of four degrees of freedom; at least that of the noise
    sandwich = np.sqrt(5 / 4 * np.square(scores).sum()) / 25 * student_quantile(0.975, 4) / 1.96
    assert value == pytest.approx(0.01)
    assert std == pytest.approx(max(sandwich, 1 / 5)) and (std > 0.201) == wider


@pytest.mark.parametrize(
    ("information", "scores", "named"),
    [
        ((5.0, 5.0, 5.0, 5.0, 5.0), (6.0, 6.0, 6.0, 6.0, 6.0), True),
        ((5.0, 5.0, 5.0, 5.0, 5.0), (30.0, 0.0, 0.0, 0.0, 0.0), False),
        ((5.0, 5.0, 5.0, 5.0, 5.0), (24.0, 28.0, -12.0, -10.0, 0.0), False),
        ((96.0, 1.0, 1.0, 1.0, 1.0), (60.0, 0.0, 0.0, 0.0, 0.0), False),
    ],
)
def test_what_is_named_shows_beside_the_scatter_of_episodes(
    information: tuple[float, ...], scores: tuple[float, ...], named: bool
) -> None:
    """The statistic is 36 and more; in the last case it is that of one episode, from which no other differs."""
    m, g, d = np.array(information), np.array(scores), THRESHOLDS.verdict.model_counts
    found = repetition(one_parameter(m, g), [0], 1.0)
    q = float((g**2 / m).sum() - g.sum() ** 2 / m.sum())
    assert found.scatter == pytest.approx(max(1.0, (d + q) / (d + 4)))
    t = g.sum() / np.sqrt(m.sum() * found.scatter)
    assert found.p_value == pytest.approx(2 * student_tail(t, d + 4), rel=1e-6)
    candidate = Candidate("gravity_scale", load_effect("gravity_scale"))
    test = ScoreTest(statistic=36.0, dof=1, p_value=1e-9, estimate=np.zeros(1), covariance=np.eye(1), admissible=True)
    evidence = Evidence(candidate=candidate, constants={}, test=test, p_value=1e-9, repetition=found)
    assert repeats(evidence, 5) == named


def test_the_scatter_of_all_effects_tells_what_that_of_one_may_be_by_chance() -> None:
    """Six effects whose scores scatter three times as the noise says, and one among them whose scores hardly do."""
    rng, count = np.random.default_rng(0), 6
    scores = np.concatenate((np.full((5, 1), 2.0), 3 * rng.standard_normal((5, count))), 1)
    linear = one_parameter(np.ones(5), scores[:, 0])
    parameters = tuple(replace(linear.parameters[0], name=f"p{k}") for k in range(count + 1))
    linear = replace(
        linear,
        parameters=parameters,
        information=np.broadcast_to(np.eye(count + 1), (5, count + 1, count + 1)),
        score=scores,
        prior=np.zeros(count + 1),
    )
    every = range(count + 1)
    q, dof = float(np.square(scores - scores.mean(0)).sum()), 4 * (count + 1)
    limits = THRESHOLDS.verdict
    usual = (limits.model_counts + q) / (limits.model_counts + dof)
    found, alone = repetition(linear, [0], 1.0, every), repetition(linear, [0], 1.0)
    assert alone.scatter == 1.0 and usual > 3
    assert found.scatter == pytest.approx(limits.effects_count * usual / (limits.effects_count + 4))
    t = 10.0 / np.sqrt(5 * found.scatter)
    assert found.p_value == pytest.approx(2 * student_tail(t, limits.effects_count + 4), rel=1e-6)


@pytest.mark.parametrize(
    ("others", "named"), [((0.0,) * 11, True), ((4.0, -5.0, 3.0, 5.0, -4.0, 0, 3.0, 4.0, 0, 0, 0), False)]
)
def test_one_long_flight_tells_an_effect_from_a_misfit_that_can_look_like_anything(
    others: tuple[float, ...], named: bool
) -> None:
    """One of five flights has nearly all the information; what it shows is one of twelve effects, or a bit of each."""
    count, share = 1 + len(others), np.array([96.0, 1.0, 1.0, 1.0, 1.0])
    first = one_parameter(share, np.array([60.0, 0.3, 0.3, 0.3, 0.3]))
    scores = np.zeros((5, count))
    scores[:, 0], scores[0, 1:] = first.score[:, 0], np.sqrt(96.0) * np.array(others)
    linear = replace(
        first,
        parameters=tuple(replace(first.parameters[0], name=f"p{k}") for k in range(count)),
        information=share[:, None, None] * np.eye(count),
        score=scores,
        prior=np.zeros(count),
    )
    found = repetition(linear, [0], 1.0, range(count))
    assert found.without_best > THRESHOLDS.flight.without_best
    assert (found.beyond_one > THRESHOLDS.flight.beyond_one) == named


def test_steps_in_flight_are_short_enough_for_fine_measurements() -> None:
    """Through a noise of 0.05 mm the error of a drag in steps of 2.5 ms looked like buoyancy or another scale."""
    truth, world = world_with("cube", {"linear_drag": {"c": 0.6}}, ground=False), world_with("cube", ground=False)
    truth = replace(truth, step_s=2e-4)
    noise = Noise(3e-5, 3e-4)
    prepared = prepare(world, tosses(truth, 1, count=5, duration_s=0.5, noise=noise))
    assert prepared.flight is not None and prepared.flight.world.step_s < 0.0005
    slots, found, _ = flight_search.flight_search(prepared, world, LIBRARY, 1.0)
    assert [slot.best.name for slot in slots if slot.flagged] == ["linear_drag"]
    assert found.effects[0].values["c"].item() == pytest.approx(0.6, rel=2e-3)
    coarse = prepare(world, tosses(truth, 1, count=5, duration_s=0.5))
    assert coarse.flight is not None and coarse.flight.world.step_s == FLIGHT_STEP_S
