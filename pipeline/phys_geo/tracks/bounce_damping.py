"""The damping ratio of a ball's contact from the restitution of its bounces.

The law's restitution e(zeta) is that of an impact so fast that the weight does nothing and a step of the engine is
short. Of slower ones the weight takes g s (1 + 1 / e) / v, where v s is the penetration at which the force ends, s
about the contact time (first order; contact model notes, section 5.7), 5 % of a rebound at 1 m/s and 2.5 ms; steps take
another 1 to 2 % where they are 1 ms. Both are in the engine, which therefore tells what damping gives the restitution
that was measured, at the speeds at which it was measured. What the contact time leaves open belongs to the estimate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...physics.contact_law import ContactLaw, damping_ratio_of, restitution
from ...physics.engine import rollout
from ...physics.parameters import CONTACT_TIME, DAMPING_RATIO, Parameter
from ...physics.state import State
from ...physics.world import World
from ...segments.first_contact_fit import placed
from ...segments.impacts.bounces import gravity_into_ground
from ...segments.impacts.restitution import RestitutionFit

PHASES = 4
"""Places within a step at which a simulated impact begins: its restitution differs a little between them."""
SPEEDS = 6
"""Number of speeds, over the range of those of the bounces, at which impacts are simulated."""
STEPS, TOLERANCE = 8, 1e-6
"""Steps of the secant method (the restitution is nearly linear in the logarithm of the damping ratio), and the error of
the restitution that ends it."""
Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class BounceDamping:
    """The damping ratio in fitted coordinates from the bounces of a ball."""

    value: float
    """Its logarithm."""
    variance: float
    """Variance of the logarithm for a known contact time."""
    by_contact_time: float
    """Its change by the logarithm of the contact time."""
    bounces: int
    """Number of bounces."""


def damping_of(bounces: RestitutionFit, world: World, contact_time_s: float) -> BounceDamping:
    """Return the damping ratio with which a world's ball has the measured restitutions, for a contact time.

    It is that of generalised least squares: an error of the ground's height, too, changes slow rebounds most, so that
    restitutions which are taken for equal would bend it, and themselves, to explain what the weight does.

    Args:
        bounces: The measured restitutions, and the speeds of the impacts.
        world: The world, with one ball above a ground.
        contact_time_s: Contact time of the law [s].
    """
    information = np.linalg.inv(bounces.own_covariance).sum(1)
    impacts = _Impacts.of(world, bounces)

    def missed(log_damping: float, log_time: float) -> float:
        expected = impacts.restitution(math.exp(log_damping), math.exp(log_time))
        return float(information @ (bounces.own - expected) / information.sum())

    limits = restitution(torch.tensor(DAMPING_RATIO.bounds, dtype=torch.float64))
    first = min(max(bounces.estimate, float(limits[1]) + 1e-6), float(limits[0]) - 1e-6)
    first = float(damping_ratio_of(torch.tensor(first, dtype=torch.float64)).log())

    def solved(log_time: float) -> float:
        return _root(lambda x: missed(x, log_time), first, *(math.log(bound) for bound in DAMPING_RATIO.bounds))

    at = math.log(contact_time_s)
    value = solved(at)
    slope = (missed(value + 0.05, at) - missed(value - 0.05, at)) / 0.1
    return BounceDamping(
        value=value,
        variance=1 / (float(information.sum()) * slope**2),
        by_contact_time=(solved(at + 0.1) - solved(at - 0.1)) / 0.2,
        bounces=len(bounces.own),
    )


def with_bounces(
    world: World, start: list[tuple[Parameter, float]], bounces: RestitutionFit | None
) -> tuple[World, list[tuple[Parameter, float]]]:
    """Return the world with the damping of a ball's bounces, and the parameters that remain to be searched."""
    if bounces is None:
        return world, start
    contact_time_s = next((value for p, value in start if p.name == CONTACT_TIME.name), CONTACT_TIME.prior[0])
    damping = torch.tensor([damping_of(bounces, world, contact_time_s).value]).to(world.gravity)
    return placed(world, [DAMPING_RATIO], damping), [(p, value) for p, value in start if p.name != DAMPING_RATIO.name]


def _root(function: Callable[[float], float], start: float, low: float, high: float) -> float:
    """Return where an increasing, nearly linear function is zero, by the secant method within bounds."""
    x, f = start, function(start)
    other = x - math.copysign(0.1, f)
    for _ in range(STEPS):
        other = min(max(other, low), high)
        g = function(other)
        if abs(g) < TOLERANCE or abs(g - f) < 1e-3 * TOLERANCE:
            return other
        x, f, other = other, g, other - g * (other - x) / (g - f)
    return min(max(other, low), high)


@dataclass(frozen=True, kw_only=True)
class _Impacts:
    """Impacts of a world's ball on its ground, at speeds that span those of measured bounces (n)."""

    world: World
    """The world with the ball alone."""
    start: State
    """States a part of a step before the impacts, a phase of each speed after the other."""
    origin: Tensor
    """Where the ball touches the ground, shape (3,) [m]."""
    up: Tensor
    """Normal of the ground, shape (3,)."""
    gravity: float
    """Into the ground [m/s2]."""
    speeds: Array
    """Speeds at the ground, shape (K,) [m/s]."""
    wanted: Array
    """Those of the bounces, shape (n,) [m/s]."""

    @staticmethod
    def of(world: World, bounces: RestitutionFit) -> _Impacts:
        """Return the impacts at the speeds of bounces."""
        ball, normal = world.bodies[world.free[0]], world.ground_normal
        ground = world.ground_offset
        assert normal is not None and ground is not None  # bounces are on a ground
        gravity, up, step = gravity_into_ground(world), normal.flatten().to(world.gravity), float(world.step_s)
        wanted = bounces.speeds_m_s[:, 0]
        speeds = np.linspace(wanted.min(), max(wanted.max(), 1.01 * wanted.min()), SPEEDS)
        speed = torch.as_tensor(speeds).to(up).repeat_interleave(PHASES)
        above = speed * step * (torch.arange(len(speed)).to(up) % PHASES + 0.5) / PHASES
        falling = (speed.square() - 2 * gravity * above).clamp_min(0.0).sqrt()
        origin = up * (ground.flatten()[0] + ball.radii.amax()) - ball.centers.flatten(0, -2)[0]
        position = (origin + above[:, None] * up)[:, None]
        quat = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(up).expand(len(speed), 1, 4)
        still = torch.zeros_like(position)
        return _Impacts(
            world=replace(world, effects=()),
            start=State(position, quat, -falling[:, None, None] * up, still),
            origin=origin,
            up=up,
            gravity=gravity,
            speeds=speeds,
            wanted=wanted,
        )

    def restitution(self, damping_ratio: float, contact_time_s: float) -> Array:
        """Return the restitutions (n) at the speeds of the bounces, by energy from the heights beside the impacts."""
        law = self.world.contact
        assert isinstance(law, ContactLaw)
        time, damping = (torch.full((1,), value).to(self.up) for value in (contact_time_s, damping_ratio))
        world = replace(self.world, contact=replace(law, contact_time_s=time, damping_ratio=damping))
        lasts = math.pi * contact_time_s / math.sqrt(max(1 - damping_ratio**2, 0.1)) + 2 * world.step_s
        with torch.no_grad():
            rolled = rollout(world, self.start, torch.tensor([0.0, lasts]).to(self.up))
        over = (rolled.position_m[:, -1, 0] - self.origin) @ self.up
        after = (rolled.velocity_m_s[:, -1, 0] @ self.up).clamp_min(0.0)
        rebound = (after.square() + 2 * self.gravity * over).clamp_min(0.0).sqrt()
        found = rebound.view(-1, PHASES).mean(1).numpy(force=True).astype(np.float64) / self.speeds
        # the weight takes a share that falls with the speed
        line = np.polyfit(1 / self.speeds, found, 1)
        return line[0] / self.wanted + line[1]
