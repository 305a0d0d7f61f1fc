"""Alternative functional forms of selected effects that are no candidates themselves.

For lack of another candidate, a spin damping is taken to be linear in the spin, though it may be quadratic. A law that
is no candidate cannot be selected, but a better fit shows that the selected effect has the wrong law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from ..physics.effects.effect import ActiveEffect, BodyMotion, Effect, EffectParameter, Values, Wrench
from ..physics.world import World
from ..segments.candidates import base_parameters, base_values, without_effect
from ..segments.segment_fit import refit
from ..segments.segments import Segments
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict


class QuadraticSpinDamping(Effect):
    """alpha = -q |omega| omega, by a torque -q |omega| I omega."""

    name = "quadratic_spin_damping"
    summary = "Resistance of turbulent air to spinning."
    formula = "alpha = -q |omega| omega"
    parameters = (EffectParameter(name="q", unit="1/rad", scale=0.02, limit=5.0, nonnegative=True),)
    phase = "flight"
    needs = ("orientation",)
    reveals = "long free flight, with fast spin and with slow"
    source = "turbulent torque, by dimensions: it grows with the density of the air and the square of the spin"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the torque."""
        momentum = (motion.inertia @ motion.omega[..., None]).squeeze(-1)
        return Wrench(torque=-values["q"][:, None] * motion.omega.norm(dim=-1, keepdim=True) * momentum)


@dataclass(frozen=True)
class OtherLaw:
    """Comparison of a selected effect with an alternative law."""

    effect: str
    """Name of the effect."""
    formula: str
    """The alternative law."""
    gain: float
    """Fall of chi2 under the alternative law, in units of the dispersion."""

    @property
    def better(self) -> bool:
        """Whether the alternative law explains the flights clearly better."""
        return self.gain > LIMITS.better_chi2

    @property
    def as_good(self) -> bool:
        """Whether the flights do not separate the two laws."""
        return abs(self.gain) <= LIMITS.better_chi2


def other_laws(flight: Segments, world: World, names: Sequence[str], dispersion: float) -> list[OtherLaw]:
    """Compare each selected effect that has an alternative law with this law.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        names: Names of the selected effects.
        dispersion: Factor by which variances exceed those of the noise.
    """
    if "spin_damping" not in names:
        return []
    law, name = QuadraticSpinDamping(), "spin_damping"
    own = next(active for active in world.effects if active.effect.name == name)
    spin = flight.observations.state.omega_body_rad_s[:, list(flight.observations.free)].norm(dim=-1)
    weight = spin.square()  # the damping is estimated from frames with spin
    usual = float((spin * weight).sum() / weight.sum().clamp_min(1e-9))
    active = ActiveEffect.of(law, {"q": float(own.values["d"][0]) / max(usual, 0.1)}, world.gravity[0, :1])
    other = without_effect(world, name)
    other = replace(other, effects=(*other.effects, active))
    costs = []
    for tried in (world, other):
        parameters = base_parameters(tried, "flight")
        costs.append(refit([flight], tried, parameters, base_values(tried, parameters).to(torch.float64)).cost)
    return [OtherLaw(name, law.formula, float(costs[0] - costs[1]) / dispersion)]
