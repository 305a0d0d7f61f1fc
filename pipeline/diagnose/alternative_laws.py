"""Laws that nobody offers: does an effect that was found follow another law than its own?

A damping of spin is taken for one that grows with the spin, for lack of another candidate, though it may grow with its
square. What no candidate has is no name to give, but it can be told that the name found is the wrong one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from ..physics.effects.effect import ActiveEffect, BodyMotion, Effect, EffectParameter, Values, Wrench
from ..physics.world import World
from .candidates import base_parameters, base_values, without_effect
from .refit import refit
from .segments import Segments

BETTER_CHI2 = 12.0
"""Another law explains the flights better where chi2 is lower by this, as odds of 400; equally, where by less."""


class QuadraticSpinDamping(Effect):
    """alpha = -q |omega| omega, by a torque -q |omega| I omega."""

    name = "quadratic_spin_damping"
    summary = "Resistance of turbulent air to spinning."
    formula = "alpha = -q |omega| omega"
    parameters = (EffectParameter("q", "1/rad", scale=0.02, limit=5.0, nonnegative=True),)
    phase = "flight"
    needs = ("spin",)
    reveals = "long free flight, with fast spin and with slow"
    source = "turbulent torque, by dimensions: it grows with the density of the air and the square of the spin"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the torque."""
        momentum = (motion.inertia @ motion.omega[..., None]).squeeze(-1)
        return Wrench(torque=-values["q"][:, None] * motion.omega.norm(dim=-1, keepdim=True) * momentum)


@dataclass(frozen=True)
class OtherLaw:
    """By how much chi2 is lower under another law of a found effect; better: clearly so; as_good: neither is."""

    effect: str
    formula: str
    gain: float

    @property
    def better(self) -> bool:
        """Whether the flights follow the other law."""
        return self.gain > BETTER_CHI2

    @property
    def as_good(self) -> bool:
        """Whether the flights do not tell the two apart."""
        return abs(self.gain) <= BETTER_CHI2


def other_laws(flight: Segments, world: World, names: Sequence[str], dispersion: float) -> list[OtherLaw]:
    """Return how another law does in the place of each effect of which one is known.

    Args:
        flight: Segments with states fitted by the world.
        world: With the effects at their fitted numbers.
        names: Of the effects that were found.
        dispersion: By what factor variances exceed those of the noise.
    """
    if "spin_damping" not in names:
        return []
    law, name = QuadraticSpinDamping(), "spin_damping"
    own = next(active for active in world.effects if active.effect.name == name)
    spin = flight.observations.state.omega_body_rad_s[:, list(flight.observations.free)].norm(dim=-1)
    weight = spin.square()  # where the spin is, the damping is told
    usual = float((spin * weight).sum() / weight.sum().clamp_min(1e-9))
    active = ActiveEffect.of(law, {"q": float(own.values["d"][0]) / max(usual, 0.1)}, world.gravity[0, :1])
    other = without_effect(world, name)
    other = replace(other, effects=(*other.effects, active))
    costs = []
    for tried in (world, other):
        parameters = base_parameters(tried, "flight")
        costs.append(refit([flight], tried, parameters, base_values(tried, parameters).to(torch.float64)).cost)
    return [OtherLaw(name, law.formula, float(costs[0] - costs[1]) / dispersion)]
