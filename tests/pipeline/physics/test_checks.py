"""Worlds, starts and rollouts that cannot be right are refused by name and number."""

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cgwm.pipeline.physics import PaperLaw, State, World, simulate
from cgwm.pipeline.physics.checks import largest_step, overlaps, require_apart
from cgwm.pipeline.physics.contact_law import damping_ratio_of
from cgwm.pipeline.physics.effects import ActiveEffect, Effect, EffectParameter, Values
from cgwm.pipeline.physics.rollout import require_finite
from cgwm.schemas import InputDataError, NotConvergedError
from helpers.worlds import F64, ball_body, box_body, law, state_of, times, world_of

UP = (1.0, 0.0, 0.0, 0.0)
HIGH = state_of(((0, 0, 1), UP, (0, 0, 0), (0, 0, 0)))


def values(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=F64)


@pytest.mark.parametrize(
    ("world", "found"),
    [
        (world_of(box_body(mass=-0.4)), r"body 'box': mass is -0.4 kg"),
        (world_of(replace(box_body(), mass=values(1.0, math.nan, 1.0))), r"mass is nan kg in environment 1"),
        (
            world_of(replace(box_body(), inertia=torch.diag(values(1e-3, 1e-3, 3e-3))[None])),
            r"largest moment of inertia is 0.003 kg m2(.|\n)*the sum of the two smaller ones",
        ),
        (
            world_of(replace(box_body(), inertia=torch.diag(values(1e-3, 1e-3, -1e-3))[None])),
            r"smallest moment of inertia is -0.001",
        ),
        (world_of(replace(box_body(), radii=0 * box_body().radii)), r"body 'box': radius is 0 m"),
        (world_of(box_body(), contact=law(friction=-0.1)), r"friction is -0.1 1(.|\n)*0 or more"),
        (world_of(box_body(), contact=law(contact_time_s=0.0)), "contact_time_s is 0 s"),
        (world_of(box_body(), contact=law(damping_ratio=-1.0)), "damping_ratio is -1"),
        (world_of(box_body(), step_s=0.02), r"step of 20 ms is beyond the bound of its contacts, 13.2 ms"),
        (
            world_of(
                box_body(),
                contact=PaperLaw.of_rows(values(0.3), values(2e5), values(10.0)),
            ),
            r"step of 1 ms is beyond the bound of its contacts, 0.8 ms",
        ),
    ],
)
def test_a_world_that_cannot_be_simulated_is_refused(world, found) -> None:
    with pytest.raises(InputDataError, match=found):
        simulate(world, HIGH, times(0.02))


def test_a_start_that_is_not_finite_is_refused_with_its_place() -> None:
    start = State(*(x.repeat(3, 1, 1) for x in vars(HIGH).values()))
    start.velocity_m_s[2, 0, 1] = math.nan
    with pytest.raises(InputDataError, match="environment 2: velocity_m_s of body 'box' is not finite"):
        simulate(world_of(box_body()), start, times(0.02))


def test_bodies_that_begin_deep_inside_each_other_are_refused_with_the_depth() -> None:
    world = world_of(ball_body(name="a"), ball_body(name="b"))
    apart = state_of(((0, 0, 0.04), UP, (0, 0, 0), (0, 0, 0)), ((0.0795, 0, 0.04), UP, (0, 0, 0), (0, 0, 0)))
    require_apart(world, apart)
    inside = state_of(((0, 0, 0.04), UP, (0, 0, 0), (0, 0, 0)), ((0.05, 0, 0.04), UP, (0, 0, 0), (0, 0, 0)))
    with pytest.raises(InputDataError, match=r"body 'a' begins 30.0 mm deep inside body 'b'(.|\n)*up to 10.0 mm"):
        require_apart(world, inside)
    sunk = state_of(((0, 0, 0.3), UP, (0, 0, 0), (0, 0, 0)), ((0.2, 0, 0.02), UP, (0, 0, 0), (0, 0, 0)))
    with pytest.raises(InputDataError, match=r"body 'b' begins 20.0 mm deep inside the ground"):
        require_apart(world, sunk)


def test_a_rollout_that_diverges_names_environment_step_and_start_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    world = world_of(ball_body(), ground=False)
    start = State(*(x.repeat(2, 1, 1) for x in vars(HIGH).values()))
    start.velocity_m_s[1] = 1e308
    rollout = simulate(world, start, times(0.2, 10.0))
    with pytest.raises(NotConvergedError, match=r"environment 1 diverged by step 100") as caught:
        require_finite(rollout, world, start)
    told = json.loads(caught.value.found.split("Its start: ")[1].removesuffix("."))
    assert told["ball"]["velocity_m_s"] == [1e308] * 3 and told["ball"]["quat_wxyz"] == [1.0, 0.0, 0.0, 0.0]
    assert not list(tmp_path.iterdir())


# In the suite: resting bodies of test_laws.py are at half of it.
@pytest.mark.evidence
@pytest.mark.parametrize("zeta", [0.05, pytest.param(0.5, marks=pytest.mark.evidence)])
def test_the_default_law_is_stable_up_to_its_bound(zeta: float) -> None:
    """At almost the largest step a box that falls and rests ends at rest, without a gain of energy."""
    contact = law(damping_ratio=zeta)
    world = world_of(box_body(), contact=contact)
    world = replace(world, step_s=0.98 * largest_step(world))
    rollout = simulate(world, state_of(((0, 0, 0.05), (0.99, 0.1, 0.05, 0), (0.1, 0, 0), (0, 0, 0))), times(6.0, 5.0))
    assert float(rollout.position_m[..., 2].max()) <= 0.0501
    assert float(rollout.velocity_m_s[0, -1].norm()) < 0.02


class Emptied(Effect):
    """A mass that loses more than there is: what a user's effect may do by mistake."""

    name = summary = formula = reveals = source = "emptied"
    parameters = (EffectParameter(name="m", unit="kg", scale=0.1, limit=10.0),)
    phase = "flight"

    def world(self, values: Values, world: World) -> World:
        return world.with_body(0, mass=world.bodies[0].mass - values["m"])


def test_a_body_that_an_effect_makes_impossible_is_refused() -> None:
    world = replace(world_of(box_body()), effects=(ActiveEffect.of(Emptied(), {"m": 1.0}),))
    with pytest.raises(InputDataError, match=r"body 'box': mass is -0.6 kg"):
        simulate(world, HIGH, times(0.02))


def test_messages_about_a_world_name_the_file_of_its_model() -> None:
    world = replace(world_of(box_body(mass=-0.4)), source="m/model.json")
    with pytest.raises(InputDataError, match=r"^m/model.json: body 'box': mass is -0.4 kg"):
        simulate(world, HIGH, times(0.02))


def test_the_depth_is_that_of_the_lowest_sphere_wherever_the_centre_of_mass_lies() -> None:
    ball = replace(ball_body(), com=values(0.01, -0.02, 0.015)[None])
    world = world_of(ball, replace(ball, name="other"))
    start = state_of(((0, 0, 0.037), UP, (0, 0, 0), (0, 0, 0)), ((0.078, 0, 0.04), UP, (0, 0, 0), (0, 0, 0)))
    depths = {(each.body, each.other): float(each.depth_m) for each in overlaps(world, start)}
    between = 0.08 - math.hypot(0.078, 0.003)
    assert depths == pytest.approx(
        {("ball", "the ground"): 0.003, ("other", "the ground"): 0.0, ("ball", "body 'other'"): between}, abs=1e-12
    )


def test_a_law_at_the_edge_of_what_is_allowed_is_taken() -> None:
    for contact in (PaperLaw.of_rows(values(0.0), values(0.5), values(0.0)), law(friction=0.0, damping_ratio=0.0)):
        simulate(world_of(box_body(), contact=contact), HIGH, times(0.02))


def test_restitutions_that_no_damping_gives_are_refused() -> None:
    for wanted in (0.005, 1.0):
        with pytest.raises(InputDataError, match=r"no damping ratio(.|\n)*0.005 < restitution < 1"):
            damping_ratio_of(values(0.5, wanted))
