"""The first-order change of flights by a force field is what rollouts with the effect of that field show."""

from dataclasses import replace

import pytest
import torch
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.segments.candidates import base_parameters, base_values
from cgwm.pipeline.segments.force_fields import FlownMotion
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with

NOISE = Noise(3e-4, 1e-3)


@pytest.mark.parametrize("name", ["quadratic_drag", "magnus_lift", "spin_damping"])
def test_a_field_changes_flights_as_its_effect_does(name: str) -> None:
    world = world_with("cube")
    (body,) = world.bodies
    # a long body, whose spin changes without a torque, with its frame off the centre of mass
    own = replace(body, inertia=body.inertia * torch.diag(torch.tensor([1.0, 2.0, 2.5])), com=body.com + 0.01)
    world = replace(world, bodies=(own,))
    prepared = prepare(world, tosses(world, 3, 2, 0.4, 148.0, NOISE, (0.9, 1.2)), NOISE)
    assert prepared.flight is not None
    added = replace(world, effects=(ActiveEffect.of(load_effect(name), {}, world.gravity[0, :1]),))
    flight = prepared.flight.in_world(added)
    parameters = base_parameters(added, "flight")
    expected = flight.residuals(parameters, base_values(added, parameters))[1][..., 0]
    motion = FlownMotion(flight)
    field = motion.field_of(flight.world.effects[0])
    assert field is not None
    found = motion.innovations(field)[..., 0]
    assert float((found - expected).norm() / expected.norm()) < 0.02
    half = motion.innovations(field.times(motion.inside * 0.5))[..., 0]
    assert torch.allclose(2 * half, found, rtol=1e-6, atol=1e-9 * float(found.abs().max()))
