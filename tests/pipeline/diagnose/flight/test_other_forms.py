"""A named force is told from forms of it that are in no library: one that sets in late, swings, or acts at speed."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose.flight import other_forms as forms_module
from cgwm.pipeline.diagnose.flight.form_families import Family, families_of, own_field, weights_of
from cgwm.pipeline.diagnose.flight.other_forms import OtherForms, _forces, log_mean, other_forms, own_form
from cgwm.pipeline.diagnose.report import wording
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.effects.effect import BodyMotion, Effect, EffectParameter, Values, Wrench
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.candidates import Candidate, base_parameters
from cgwm.pipeline.segments.flights.force_fields import FlownMotion
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.segments.segment_fit import refit
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with
from numpy.typing import NDArray

Array = NDArray[np.float64]
NOISE = Noise(3e-4, 1e-3)
LIBRARY = ("gravity_scale", "gravity_tilt", "linear_drag", "magnus_lift", "spin_damping")


class SpinDampingBySquare(Effect):
    """alpha = -q |omega| omega, which is in no library."""

    name = "spin_damping_by_square"
    summary = formula = reveals = source = "alpha = -q |omega| omega"
    parameters = (EffectParameter(name="q", unit="1/rad", scale=0.02, limit=5.0),)
    phase = "flight"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        momentum = (motion.inertia @ motion.omega[..., None])[..., 0]
        return Wrench(torque=-values["q"][:, None] * motion.omega.norm(dim=-1, keepdim=True) * momentum)


class DragAboveSpeed(Effect):
    """a = -c v above 1.6 m/s, which is in no library."""

    name = "drag_above_speed"
    summary = formula = reveals = source = "a = -c v where v > 1.6 m/s"
    parameters = (EffectParameter(name="c", unit="1/s", scale=0.1, limit=5.0),)
    phase = "flight"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        fast = (motion.velocity.norm(dim=-1, keepdim=True) > 1.6).to(motion.velocity)
        return Wrench(force=-motion.mass[:, None] * values["c"][:, None] * fast * motion.velocity)


class ForceByHeight(Effect):
    """An upward acceleration f z, which is in no library."""

    name = "force_by_height"
    summary = formula = reveals = source = "a = f z"
    parameters = (EffectParameter(name="f", unit="1/s2", scale=0.1, limit=5.0),)
    phase = "flight"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        height = (motion.com * motion.up).sum(-1, keepdim=True)
        return Wrench(force=motion.mass[:, None] * values["f"][:, None] * height * motion.up)


class Fan(Effect):
    """a = f along y where x > 0, which is in no library."""

    name = "fan"
    summary = formula = reveals = source = "a = f e_y where x > 0"
    parameters = (EffectParameter(name="f", unit="m/s2", scale=0.1, limit=5.0),)
    phase = "flight"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        on = (motion.com[:, :1] > 0).to(motion.com) * motion.com.new_tensor([0.0, 1.0, 0.0])
        return Wrench(force=motion.mass[:, None] * values["f"][:, None] * on)


class Attractor(Effect):
    """a = k (line - x) level, which is in no library."""

    name = "attractor"
    summary = formula = reveals = source = "a = k (line - x), level"
    parameters = (EffectParameter(name="k", unit="1/s2", scale=0.1, limit=5.0),)
    phase = "flight"
    turned = False

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        x, y, _ = (motion.com.new_tensor([0.4, -0.2, 0.0]) - motion.com).unbind(-1)
        level = torch.stack((-y, x, 0 * x) if self.turned else (x, y, 0 * x), -1)
        return Wrench(force=motion.mass[:, None] * values["k"][:, None] * level)


class Vortex(Attractor):
    """a = k up x (line - x), which is in no library."""

    name = "vortex"
    turned = True


def late(time_s: Array) -> Array:
    """Return how far a push upwards from 0.2 s on moves a body [m]."""
    return 0.5 * np.clip(time_s - 0.2, 0.0, None) ** 2


def swinging(time_s: Array) -> Array:
    """Return how far a push upwards that swings at 4 Hz moves a body [m]."""
    rate = 2 * np.pi * 4
    return time_s / rate - np.sin(rate * time_s) / rate**2


def form_of(truth: World, named: str, push: Callable[[Array], Array] | None = None, equal: str = "") -> OtherForms:
    """Return the other forms of an effect that is fitted to tosses of another world, and pushed upwards beside it."""
    episodes = tosses(truth, 3, 4, 0.4, 60.0, NOISE, (0.9, 1.2))
    if push is not None:
        episodes = [(name, {body: _pushed(track, push) for body, track in tracks.items()}) for name, tracks in episodes]
    plain = replace(truth, effects=())
    return forms_of(plain, episodes, [named], equal)[0]


def _pushed(track: Track, push: Callable[[Array], Array]) -> Track:
    return replace(track, position_m=track.position_m + push(track.time_s)[:, None] * np.array([0.0, 0.0, 1.0]))


def forms_of(
    plain: World, episodes: list[tuple[str, dict[str, Track]]], names: list[str], equal: str = ""
) -> list[OtherForms]:
    """Return the other forms of effects that are fitted to episodes, the first one with an equal."""
    prepared = prepare(plain, episodes, NOISE)
    assert prepared.flight is not None
    like = plain.gravity[0, :1]
    named = [
        ActiveEffect.of(load_effect(name), {c.name: c.default for c in load_effect(name).constants}, like)
        for name in names
    ]
    world = replace(plain, effects=tuple(named))
    fitted = refit([prepared.flight], world, base_parameters(world, "flight"))
    library = [Candidate(name, load_effect(name)) for name in LIBRARY]
    classes = [(name,) if k or not equal else (name, equal) for k, name in enumerate(names)]
    return other_forms(fitted.segments[0], fitted.world, classes, 1.0, library)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("spin_damping", {"d": 0.5}),
        ("gravity_scale", {"s": 0.03}),
        ("gravity_tilt", {"tilt_x": 0.03, "tilt_y": 0.02}),
        ("linear_drag", {"c": 0.3}),
    ],
)
def test_the_law_of_a_true_effect_is_likelier_than_its_forms(name: str, values: dict[str, float]) -> None:
    assert not form_of(world_with("ball", {name: values}), name).likelier


@pytest.mark.parametrize(("push", "word"), [(late, "flight"), (swinging, "swinging at")])
def test_a_force_that_sets_in_late_or_swings_is_no_other_gravity(push: Callable[[Array], Array], word: str) -> None:
    found = form_of(world_with("ball"), "gravity_scale", push)
    assert found.likelier and word in found.words and "spin" not in found.words


@pytest.mark.parametrize(
    ("effect", "named", "equal", "word"),
    [
        (Attractor(), "gravity_tilt", "", "towards a place"),
        (Attractor(), "linear_drag", "constant_force", "across the room"),
        pytest.param(Vortex(), "gravity_tilt", "", "around a place", marks=pytest.mark.evidence),
    ],
)
def test_a_force_of_a_place_is_no_constant_force(effect: Effect, named: str, equal: str, word: str) -> None:
    ball = world_with("ball")
    pulled = replace(ball, effects=(ActiveEffect.of(effect, {"k": 1.0}, ball.gravity[0, :1]),))
    found = form_of(pulled, named, equal=equal)
    assert found.likelier and word in found.words and "elsewhere" in found.then


@pytest.mark.parametrize("own", [False, True])
def test_places_of_flights_with_accelerations_of_their_own_are_left_to_their_own_test(
    own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight: Any = SimpleNamespace(noise_model=SimpleNamespace(position=SimpleNamespace(sway=40.0 * own)))
    assert forms_module.sways(flight) == own
    monkeypatch.setattr(forms_module, "sways", lambda _: own)
    ball = world_with("ball")
    pulled = replace(ball, effects=(ActiveEffect.of(Attractor(), {"k": 1.0}, ball.gravity[0, :1]),))
    assert ("place" in form_of(pulled, "gravity_tilt").words) != own


def test_a_drag_above_a_speed_is_no_drag() -> None:
    ball = world_with("ball")
    braked = replace(ball, effects=(ActiveEffect.of(DragAboveSpeed(), {"c": 0.3}, ball.gravity[0, :1]),))
    found = form_of(braked, "linear_drag")
    assert found.likelier and "where the speed is above" in found.words and "faster" in found.then


def test_where_two_drags_are_not_told_apart_other_forms_have_to_beat_both() -> None:
    ball = world_with("ball")
    data = tosses(world_with("ball", {"quadratic_drag": {"k": 0.2}}), 3, 4, 0.4, 60.0, NOISE, (0.9, 1.2))
    (alone,), (either,) = forms_of(ball, data, ["linear_drag"]), forms_of(ball, data, ["linear_drag"], "quadratic_drag")
    assert alone.likelier and alone.words == "the same force times the speed to the power 1"
    assert not either.likelier


def test_steps_along_what_a_law_follows_are_many_and_together_as_likely_as_few() -> None:
    ball = world_with("ball", {"linear_drag": {"c": 0.3}})
    prepared = prepare(ball, tosses(ball, 1, 1, 0.3, 60.0, NOISE, (0.9, 1.2)), NOISE)
    assert prepared.flight is not None
    motion = FlownMotion(refit([prepared.flight], ball, []).segments[0])
    own = own_field(motion, ball.effects[0])
    assert own is not None
    families = {family.coordinate: family for family in families_of(motion, own, ("linear_drag",))}
    speed = families["speed"]
    steps = [share for words, share in zip(speed.forms, speed.shares, strict=True) if "alone" in words]
    assert 10 < len(steps) <= 18 and sum(steps) == pytest.approx(8.0)
    assert set(families["height"].shares) == {1.0}


def test_forms_that_differ_in_what_a_law_follows_are_as_likely_as_all_others() -> None:
    families = [Family(coordinate, {}, "") for coordinate in ("time", "height", "place", "speed", "spin", "swinging")]
    assert weights_of(families, "linear_drag") == [1, 1, 1, 5, 1, 1]
    assert weights_of(families, "magnus_lift") == [1, 1, 1, 2, 2, 1]
    assert weights_of(families, "gravity_tilt") == [1] * 6
    assert log_mean([0.0, np.log(3.0)], [1.0, 3.0]) == pytest.approx(np.log(2.5))
    library = [Candidate(name, load_effect(name)) for name in (*LIBRARY, "length_scale", "clock_scale")]
    assert _forces(("gravity_scale", "length_scale", "clock_scale"), library) == pytest.approx(1 / 3)
    assert _forces(("length_scale",), library) == 1  # a scale that sets in is a force all the same


def test_a_damping_by_the_square_of_the_spin_is_no_spin_damping() -> None:
    ball = world_with("ball")
    damped = replace(ball, effects=(ActiveEffect.of(SpinDampingBySquare(), {"q": 0.05}, ball.gravity[0, :1]),))
    found = form_of(damped, "spin_damping")
    assert found.likelier and found.words == "the same torque times the spin to the power 1"


def test_a_force_by_height_is_not_two_effects_that_imitate_it_together() -> None:
    ball, names = world_with("ball"), ["gravity_scale", "linear_drag"]
    rising = replace(ball, effects=(ActiveEffect.of(ForceByHeight(), {"f": 1.0}, ball.gravity[0, :1]),))
    found = forms_of(ball, tosses(rising, 3, 3, 0.4, 60.0, NOISE, (0.9, 1.2)), names)
    assert found[0].likelier and found[0].words == "the same force times height"


@pytest.mark.parametrize(
    ("gain", "odds", "words"),
    [
        (3.0, 1.0, " Nearest is wind, but the flights fit the same force times x better."),
        (-2.0, -1.0, " Nearest is wind, but these flights hardly tell it from the same force times x. Next, go on."),
        (1.0, -3.0, ""),
    ],
)
def test_the_sentence_says_in_which_other_form_a_force_comes_near(gain: float, odds: float, words: str) -> None:
    form = OtherForms(effect="wind", words="the same force times x", gain=gain, odds=odds, then="go on")
    findings: Any = SimpleNamespace(flight=SimpleNamespace(others=[form]))
    assert wording._nearest(findings) == words


def test_a_fan_on_one_side_is_no_tilt_of_each_episode() -> None:
    ball, rng = world_with("ball"), np.random.default_rng(0)
    fan = replace(ball, effects=(ActiveEffect.of(Fan(), {"f": 0.6}, ball.gravity[0, :1]),))
    tilts = [
        world_with("ball", {"gravity_tilt": dict(zip(("tilt_x", "tilt_y"), rng.normal(0, 0.04, 2), strict=True))})
        for _ in range(6)
    ]
    odds = []
    each = [tosses(world, k, 1, 0.5, 60.0, NOISE, (1.2, 1.4))[0][1] for k, world in enumerate(tilts)]
    for data in (tosses(fan, 1, 6, 0.5, 60.0, NOISE, (1.2, 1.4)), [(f"{k}", one) for k, one in enumerate(each)]):
        whole = prepare(ball, data, NOISE).pieces(ball, 60.0)
        assert whole is not None
        odds.append(own_form(whole, ball, 0.4).odds)
    assert odds[0] > 6 and odds[1] < -6


def test_what_is_no_force_has_no_other_form() -> None:
    world = world_with("cube")
    named = replace(world, effects=(ActiveEffect.of(load_effect("com_offset"), {}, world.gravity[0, :1]),))
    prepared = prepare(world, tosses(world, 3, 3, 0.3, 60.0, NOISE, (0.9, 1.2)), NOISE)
    assert prepared.flight is not None and other_forms(prepared.flight, named, [("com_offset",)], 1.0) == []
