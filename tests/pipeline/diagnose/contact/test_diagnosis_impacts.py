"""Impacts of a ball: Routh's law against closed forms, and what measured impacts tell of restitution and friction."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose.contact.contact_test import ContactData, selected, with_effect
from cgwm.pipeline.diagnose.contact.impact import ImpactTest, gains_beside_slip
from cgwm.pipeline.diagnose.contact.rebound_by_slip import held_out_gains
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.verdict import find
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics import State, World
from cgwm.pipeline.physics.contact_law import Touch, restitution
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.parameters import DAMPING_RATIO, FRICTION
from cgwm.pipeline.segments.candidates import Candidate, variants_of
from cgwm.pipeline.segments.impact_law import Impact, _cone, after_impact, point_velocity, rebound_speed, within_cone
from cgwm.pipeline.segments.impacts.fit import BASE, ImpactBase, ImpactProblem, fit_impacts, fits_to_weighted
from cgwm.pipeline.segments.impacts.velocities import Impacts, measured_impacts
from cgwm.pipeline.segments.prepare import Prepared, prepare
from helpers.diagnosis_data import NOISE, Effects, tosses, world_with
from helpers.worlds import F64, ball_body, law

RADIUS, MASS = 0.04, 0.2
LIBRARY = [
    Candidate(name, load_effect(name))
    for name in ("linear_drag", "velocity_restitution", "anisotropic_friction", "rolling_resistance", "adhesion")
]


def data_of(prepared: Prepared, world: World) -> ContactData:
    """Return data of which the impact test reads the episodes and the world."""
    return ContactData(prepared=prepared, world=world, segments=None, sliding=None)


def named_by_impacts(prepared: Prepared, world: World) -> list[Evidence]:
    data = data_of(prepared, world)
    return selected(ImpactTest(), ImpactTest().evidence(data, LIBRARY), data)


def impact(twist: list[list[float]], bounce: float = 0.5) -> Impact:
    """Impacts of a ball with twists before them, the normal impulse that of a restitution."""
    before, body = torch.tensor(twist, dtype=F64), ball_body(RADIUS, MASS)
    count = len(before)
    return Impact(
        before=before,
        impulse=-(1 + bounce) * MASS * before[:, 2],
        place=torch.zeros(count, 3, dtype=F64),
        rotation=torch.eye(3, dtype=F64).expand(count, 3, 3),
        arm=torch.tensor([0.0, 0.0, -RADIUS], dtype=F64).expand(count, 3),
        inertia=body.inertia.expand(count, 3, 3),
        mass=body.mass.expand(count),
        normal=torch.tensor([0.0, 0.0, 1.0], dtype=F64),
        weight=torch.zeros(count, dtype=F64),
        body=body,
    )


def test_without_friction_an_elastic_bounce_mirrors() -> None:
    before = [[1.5, -0.4, -2.0, 3.0, 5.0, 7.0]]
    after = after_impact(impact(before, bounce=1.0), law(friction=0.0), [])
    assert after[0].tolist() == pytest.approx([1.5, -0.4, 2.0, 3.0, 5.0, 7.0], abs=1e-9)


def test_a_solid_ball_that_sticks_loses_two_sevenths_of_its_slip() -> None:
    one = impact([[1.0, 0.5, -3.0, 2.0, 4.0, 6.0]])
    slip = point_velocity(one.before, one.arm)[0, :2]
    after = after_impact(one, law(friction=2.0), [])
    assert (after[0, :2] - one.before[0, :2]).tolist() == pytest.approx((-2 / 7 * slip).tolist(), abs=1e-9)
    assert point_velocity(after, one.arm)[0, :2].tolist() == pytest.approx([0.0, 0.0], abs=1e-9)
    assert float(after[0, 5]) == 6.0


def test_a_ball_that_slides_takes_the_friction_of_its_whole_impulse() -> None:
    one = impact([[5.0, 0.0, -1.0, 0.0, 0.0, 0.0]])
    after = after_impact(one, law(friction=0.2), [])
    assert float(after[0, 0]) == pytest.approx(5.0 - 0.2 * 1.5)
    # about y: r x p over the inertia 2/5 m r^2
    assert float(after[0, 4]) == pytest.approx(0.2 * 1.5 / (0.4 * RADIUS))


def test_no_impact_gains_energy() -> None:
    rng = np.random.default_rng(2)
    twist = np.concatenate([rng.normal(0, 2, (200, 3)), rng.normal(0, 40, (200, 3))], 1)
    twist[:, 2] = -np.abs(twist[:, 2])
    effects = [
        ActiveEffect.of(load_effect("anisotropic_friction"), {"a": 0.1, "b": 0.05}),
        ActiveEffect.of(load_effect("rolling_resistance"), {"c_r": 0.001}),
        ActiveEffect.of(load_effect("torsional_friction"), {"c_t": 0.001}),
    ]
    one = impact(twist.tolist(), bounce=1.0)
    after = after_impact(one, law(friction=0.25), effects)

    def energy(x: torch.Tensor) -> torch.Tensor:
        return 0.5 * MASS * x[:, :3].square().sum(1) + 0.5 * 0.4 * MASS * RADIUS**2 * x[:, 3:].square().sum(1)

    assert bool((energy(after) <= energy(one.before) + 1e-9).all())


@pytest.mark.parametrize("zeta", [0.05, 0.3, 0.9, 1.5])
def test_the_rebound_is_that_of_spring_and_damper(zeta: float) -> None:
    one = impact([[0.0, 0.0, -0.5, 0.0, 0.0, 0.0], [1.0, 0.0, -3.0, 0.0, 0.0, 0.0]])
    found = rebound_speed(one, law(damping_ratio=zeta), [])
    expected = float(restitution(torch.tensor(zeta, dtype=F64)))
    assert (found / -one.before[:, 2]).tolist() == pytest.approx([expected] * 2, abs=6e-4)


def test_effects_are_asked_for_the_rebound() -> None:
    one = impact([[0.0, 0.0, -0.5, 0.0, 0.0, 0.0], [0.0, 0.0, -2.0, 0.0, 0.0, 0.0]])
    bare = rebound_speed(one, law(), [])
    softer = [ActiveEffect.of(load_effect("velocity_restitution"), {"r": 0.05})]
    lost = rebound_speed(one, law(), softer) / bare
    assert lost.tolist() == pytest.approx([math.exp(-0.025), math.exp(-0.1)], rel=0.01)
    sticky = ActiveEffect.of(load_effect("adhesion"), {"F": 2.0, "g": 0.002})
    # on the way up the pull takes its work F g 8/15, on the way down it gives as much
    work = 2 * 2.0 * 0.002 * 8 / 15 / MASS
    speed, bounce = -one.before[:, 2], bare / -one.before[:, 2]
    expected = (bounce.square() * (speed.square() + work) - work).sqrt()
    assert rebound_speed(one, law(contact_time_s=1e-4), [sticky]).tolist() == pytest.approx(expected.tolist(), rel=0.01)


def test_a_slow_spin_is_stopped_and_not_reversed() -> None:
    """Friction against spinning takes c_t J from the angular momentum about the normal, down to none."""
    effects = [ActiveEffect.of(load_effect("torsional_friction"), {"c_t": 1e-4})]
    one = impact([[0.0, 0.0, -1.0, 0.0, 0.0, spin] for spin in (0.9, -0.9, 0.2)])
    spins = after_impact(one, law(), effects)[:, 5]
    change = 1e-4 * float(one.impulse[0]) / (0.4 * MASS * RADIUS**2)
    assert 0.2 < change < 0.9
    assert spins.tolist() == pytest.approx([0.9 - change, change - 0.9, 0.0])


def test_the_grain_of_friction_keeps_its_mean() -> None:
    """M = mu I + [[a, b], [b, -a]]: the friction at right angles is less by what it is more along the grain."""
    touch = SimpleNamespace(friction=torch.tensor([0.4]), anisotropy=torch.tensor([[[0.1, 0.05]]]))
    expected = torch.tensor([[[0.5, 0.05], [0.05, 0.3]]])
    assert torch.allclose(_cone(cast(Touch, touch))[:, None], expected[:, None])


def test_an_oblique_slip_turns_where_friction_has_a_grain() -> None:
    cone = torch.diag(torch.tensor([0.4, 0.2], dtype=F64)).expand(3, 2, 2)
    slip = torch.tensor([[3.0, 3.0], [2.0, 0.0], [0.1, 0.1]], dtype=F64)
    wanted = torch.tensor([[-9.0, -9.0], [-9.0, 0.0], [-0.1, -0.1]], dtype=F64)
    found = within_cone(wanted, slip, cone, torch.ones(3, dtype=F64))
    # -P M^2 v / |M v|; what lies within the ellipse stops the slip
    assert found[0].tolist() == pytest.approx([-0.16 / math.hypot(0.4, 0.2), -0.04 / math.hypot(0.4, 0.2)])
    assert found[1].tolist() == pytest.approx([-0.4, 0.0])
    assert found[2].tolist() == [-0.1, -0.1]


def throws(
    effects: Effects | None = None, fast: bool = False, seed: int = 5, noise: tuple[float, float] = NOISE
) -> tuple[Prepared, World]:
    """Balls thrown by our own engine: steep ones that stick, or fast flat ones that slide through their impacts."""
    plain = world_with("ball")
    truth = replace(
        world_with("ball", effects),
        contact=law(0.15 if fast else 0.3, 0.002, 0.2),
        step_s=2.5e-4,
    )
    rng, count = np.random.default_rng(seed), 8
    heading, speed = (
        rng.uniform(0, 2 * np.pi, count),
        rng.uniform(3.0, 5.0, count) if fast else rng.uniform(0, 1, count),
    )
    position, quat, velocity = np.zeros((count, 1, 3)), np.zeros((count, 1, 4)), np.zeros((count, 1, 3))
    position[:, 0, 2], quat[..., 0] = rng.uniform(0.15, 0.25, count) if fast else rng.uniform(0.1, 0.8, count), 1.0
    velocity[:, 0, :2] = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    omega = rng.normal(0, 4, (count, 1, 3))
    times = torch.arange(101, dtype=F64) / 100
    with torch.no_grad():
        motion = measure(truth, State(*map(torch.as_tensor, (position, quat, velocity, omega))), times)
    moved = motion.position_m[:, :, 0].numpy() + noise[0] * rng.standard_normal((count, 101, 3))
    jitter = quat_exp(torch.as_tensor(noise[1] * rng.standard_normal((count, 101, 3))))
    turned = quat_multiply(motion.quat_wxyz[:, :, 0], jitter).numpy()
    name = plain.bodies[0].name
    episodes = [(f"{k:03d}", {name: Track(times.numpy(), moved[k], turned[k])}) for k in range(count)]
    return prepare(plain, episodes), plain


def test_measured_impacts_tell_restitution_and_friction() -> None:
    prepared, world = throws(fast=True)
    impacts = measured_impacts(prepared, world)
    assert impacts is not None and len(impacts) >= 12
    speed = -impacts.before[:, 2]
    error = impacts.after[:, 2] - speed * float(restitution(torch.tensor(0.2, dtype=F64)))
    spread = impacts.covariance_after[:, 2, 2].sqrt() + 0.02 * speed
    assert bool((error.abs() < 4 * spread).all())
    start = torch.tensor([p.encode(p.prior[0]) for p in BASE], dtype=F64)
    problem = ImpactProblem(world, BASE, impacts).whitened(start)
    found = fit_impacts(problem, start)
    found = fit_impacts(problem.whitened(torch.as_tensor(found.values)), start)
    deviation = np.sqrt(np.diag(np.linalg.inv(found.information)))
    for parameter, truth in ((FRICTION, 0.15), (DAMPING_RATIO, 0.2)):
        place = BASE.index(parameter)
        assert abs(found.values[place] - math.log(truth)) < 3 * deviation[place] + 0.02
        assert deviation[place] < 0.1
    weightless = fits_to_weighted(problem, start, np.zeros((1, len(impacts))), start + 0.2)[0]
    width = np.array([p.prior[1] for p in BASE])
    np.testing.assert_allclose(np.diag(weightless.information), 1 / width**2, rtol=1e-6)  # only the priors speak
    np.testing.assert_allclose(weightless.values, start + 0.2, atol=1e-6)
    high = torch.tensor([[p.limits[1] for p in BASE]], dtype=F64)
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            ImpactProblem, "rows", lambda self, values: asked.append(values) or torch.zeros(len(values), 1, 6)
        )
        problem.linear(high)
    assert bool((asked[0] <= high).all()) and bool((asked[0] < high).any(0).all())  # differences go inwards at a bound


@pytest.mark.parametrize("fast", [pytest.param(False, marks=pytest.mark.evidence), True])
def test_impacts_are_silent_where_nothing_is_missing(fast: bool) -> None:
    prepared, world = throws(fast=fast, seed=7)
    assert not named_by_impacts(prepared, world)


@pytest.mark.parametrize(
    ("name", "values", "fast"),
    [
        ("velocity_restitution", {"r": 0.15}, False),
        pytest.param("anisotropic_friction", {"a": 0.05, "b": 0.0}, True, marks=pytest.mark.evidence),
    ],
)
def test_impacts_name_what_is_hidden(name: str, values: dict[str, float], fast: bool) -> None:
    prepared, world = throws({name: values}, fast)
    named = named_by_impacts(prepared, world)
    assert [one.name for one in named] == [name]
    assert named[0].numbers is not None
    for key, value in values.items():
        estimate, error = named[0].numbers[key]
        assert abs(estimate - value) < 3 * error + 0.1 * value
    after = with_effect(world, named[0])
    assert after.effects[-1].effect.name == name


# In the suite: what impacts name is tested above, how it becomes a verdict by glides.
@pytest.mark.evidence
def test_what_impacts_tell_is_the_verdict() -> None:
    prepared, world = throws({"velocity_restitution": {"r": 0.3}})
    found = find(prepared, world, LIBRARY[:2])
    assert found.verdict == "missing_effect"
    assert [one.evidence.name for one in found.chosen] == ["velocity_restitution"]
    before, after = found.errors["velocity_restitution"]
    assert after < before


def test_a_box_tells_nothing_by_impacts() -> None:
    world = world_with("cube")
    prepared = prepare(world, tosses(world, 1, count=3))
    assert measured_impacts(prepared, world) is None
    assert ImpactTest().evidence(data_of(prepared, world), LIBRARY) == []


def impacts_with_rebound(by_slip: float, by_speed: float) -> Impacts:
    """Impacts of ten throws, of which the fast ones slip, with log e = log 0.7 - by_slip q - by_speed v."""
    rng = np.random.default_rng(0)
    fall = rng.uniform(0.5, 3.0, 30)
    slip = rng.uniform(0.0, 1.0, 30) * fall * (fall > 1.2)
    bounce = np.exp(math.log(0.7) - by_slip * slip / (slip + fall) - by_speed * fall + rng.normal(0, 0.01, 30))
    twists = np.zeros((2, 30, 6))
    twists[:, :, 0], twists[0, :, 2], twists[1, :, 2] = slip, -fall, bounce * fall
    twists[1, :, 0] -= 2 / 7 * slip
    twists[1, :, 4] = 5 / 7 * slip / RADIUS
    before, after = torch.as_tensor(twists)
    known = 1e-6 * torch.eye(6, dtype=F64).expand(30, 6, 6)
    return Impacts(
        episode=np.repeat(np.arange(10), 3),
        place=torch.zeros(30, 3, dtype=F64),
        rotation=torch.eye(3, dtype=F64).expand(30, 3, 3),
        before=before,
        after=after,
        covariance_before=known,
        covariance_after=known,
    )


@pytest.mark.parametrize(
    ("by_slip", "by_speed"),
    [*(pytest.param(*two, marks=pytest.mark.evidence) for two in ((0.4, 0.0), (0.0, 0.1))), (0.4, 0.1)],
)
def test_a_rebound_that_falls_with_the_slip_is_no_rebound_that_falls_with_the_speed(
    by_slip: float, by_speed: float
) -> None:
    world = world_with("ball")
    base = ImpactBase.of(world, impacts_with_rebound(by_slip, by_speed))
    (variant,) = variants_of([LIBRARY[1]], world.gravity[0, :1])
    problem, start = base.beside(variant)
    fit = fit_impacts(problem, start, centre=base.centre_of(start))
    gains = gains_beside_slip(base, problem, fit)
    error = gains.std(ddof=1) / math.sqrt(len(gains))
    assert (gains.mean() > 2 * error) == (by_speed > 0)
    if not by_speed:  # as a law of speed alone it would have been believed
        alone = base.gains(problem, fit.values)
        assert alone.sum() > 5
        assert gains.sum() < 1


def test_bounces_of_one_episode_are_predicted_by_none() -> None:
    rows = np.array([[1.0, 0.2, 0.1], [1.0, 0.4, 0.3]])
    assert held_out_gains(rows, np.array([0.5, 0.6]), np.ones(2), np.zeros(2, np.int64)).tolist() == [0.0]


def test_the_only_impact_that_slips_tells_nothing_of_the_speed() -> None:
    """Three episodes have slow impacts that roll, the last one also a fast one that slips and rebounds less."""
    slip, fast = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.45]), np.array([0.1, 0.2, 0.15, 0.25, 0.1, 1.0])
    rows = np.stack([np.ones(6), slip, slip**2, fast], 1)
    value, sigma = np.array([0.01, -0.01, 0.0, -0.02, 0.01, -0.2]), np.full(6, 0.02)
    episode = np.repeat(np.arange(3), 2)
    assert abs(held_out_gains(rows, value, sigma, episode)[2]) < 1
    rolling = rows * np.array([1.0, 0.0, 0.0, 1.0])  # where nothing slips, the same fall is one of the speed
    rolling[:4, 3], value[:4] = [0.1, 1.0, 0.2, 0.9], [0.0, -0.2, -0.02, -0.18]
    assert held_out_gains(rolling, value, sigma, episode)[2] > 5
