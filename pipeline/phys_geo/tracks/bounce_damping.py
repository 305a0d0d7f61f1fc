"""The damping ratio of a ball's contact from the restitution of its bounces."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ...optimization.forward_mode import batched_jacobian
from ...physics.contact_law import damping_ratio_of, restitution
from ...physics.parameters import DAMPING_RATIO, Parameter
from ...physics.world import World
from ...segments.first_contact_fit import placed
from ...segments.restitution_fit import RestitutionFit


@dataclass(frozen=True, kw_only=True)
class BounceDamping:
    """The damping ratio in fitted coordinates from the bounces of a ball."""

    value: float
    """Its logarithm."""
    variance: float
    """Variance of the logarithm."""
    bounces: int
    """Number of bounces."""


def damping_of(bounces: RestitutionFit) -> BounceDamping:
    """Return the damping ratio that gives a restitution, with its variance to first order."""
    limits = restitution(torch.tensor(DAMPING_RATIO.bounds, dtype=torch.float64))
    wanted = torch.tensor(bounces.estimate, dtype=torch.float64).clamp(float(limits[1]) + 1e-6, float(limits[0]) - 1e-6)
    z = damping_ratio_of(wanted).log()[None, None]
    _, slope = batched_jacobian(lambda values, _: restitution(values.exp()), z)
    variance = (bounces.std_error / float(slope)) ** 2
    return BounceDamping(value=float(z), variance=variance, bounces=len(bounces.own))


def with_bounces(
    world: World, start: list[tuple[Parameter, float]], bounces: RestitutionFit | None
) -> tuple[World, list[tuple[Parameter, float]]]:
    """Return the world with the damping of a ball's bounces, and the parameters that remain to be searched."""
    if bounces is None:
        return world, start
    damping = torch.tensor([damping_of(bounces).value]).to(world.gravity)
    return placed(world, [DAMPING_RATIO], damping), [(p, value) for p, value in start if p.name != DAMPING_RATIO.name]
