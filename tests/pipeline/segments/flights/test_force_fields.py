"""The first-order change of flights by a force field is what rollouts with the effect of that field show."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.segments.candidates import base_parameters, base_values
from cgwm.pipeline.segments.flights.force_fields import FlownMotion
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


def spinning(spin_rad_s: float, inertia: tuple[float, float, float]) -> tuple[FlownMotion, Any, Any]:
    """Return the motion of a body that spins about its third axis, with times (T,) and the spin's rotations."""
    t = torch.linspace(0.0, 0.2, 201, dtype=torch.float64)
    c, s, zero, one = (spin_rad_s * t).cos(), (spin_rad_s * t).sin(), torch.zeros_like(t), torch.ones_like(t)
    rotation = torch.stack((c, -s, zero, s, c, zero, zero, zero, one), -1).unflatten(-1, (3, 3))
    flight: Any = SimpleNamespace(observations=SimpleNamespace(times_s=t[None]))
    motion = FlownMotion(flight)
    body = SimpleNamespace(inertia=torch.diag(torch.tensor(inertia, dtype=torch.float64))[None])
    spin = torch.stack((zero, zero, spin_rad_s * one), -1)
    motion.__dict__.update(body=body, rotation=rotation[None], omega_body_rad_s=spin[None])
    return motion, t, rotation


def test_a_steady_torque_turns_a_resting_body_by_half_its_acceleration_times_time_squared() -> None:
    motion, t, _ = spinning(0.0, (1e-3, 2e-3, 4e-3))
    pull = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    found = motion._turned(pull.expand(1, len(t), 3)[..., None])[0, ..., 0]
    torch.testing.assert_close(found, 0.5 * t[:, None] ** 2 * pull, rtol=1e-9, atol=1e-12)


def test_the_angular_momentum_of_a_spinning_body_grows_by_the_torque() -> None:
    """In the world dL = R (I (theta' + w x theta) + theta x I w), of a top with spin w, and its rate is the torque."""
    spin, across, along = 6.0, 1e-3, 1.6e-3
    motion, t, _ = spinning(spin, (across, across, along))
    push = torch.tensor([4.0, 0.0, -3.0], dtype=torch.float64)
    found = motion._turned(push.expand(1, len(t), 3)[..., None])[0, ..., 0]
    torch.testing.assert_close(found[:, 2], -1.5 * t**2, rtol=1e-9, atol=1e-12)
    rate = torch.gradient(found, spacing=(t,), dim=0)[0]
    omega = torch.tensor([0.0, 0.0, spin], dtype=torch.float64).expand_as(found)
    moments = torch.tensor([across, across, along], dtype=torch.float64)
    change = rate + torch.linalg.cross(omega, found)
    grown = moments * change + torch.linalg.cross(found, moments * omega)
    rotation = motion.rotation[0]
    world = (rotation @ grown[..., None])[..., 0]
    torque = (rotation @ (moments * (rotation.mT @ push))[..., None])[..., 0]
    step = t.diff()[:, None]
    expected = torch.cat((torch.zeros(1, 3, dtype=torch.float64), (0.5 * step * (torque[1:] + torque[:-1])).cumsum(0)))
    assert float((world - expected)[2:-2].norm() / expected.norm()) < 2e-3
