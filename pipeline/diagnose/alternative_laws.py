"""Alternative functional forms of selected effects that are no candidates themselves.

For lack of another candidate, a spin damping is taken to be linear in the spin, though it may be quadratic. A law that
is no candidate cannot be selected, but a better fit shows that the selected effect has the wrong law.

An engine that limits the tangential impulse along each of two axes by itself admits a square of impulses, the base of a
friction pyramid, instead of a disc: a body that slides between the axes is braked more and turns towards one of them.
A few slides along few directions look so on a ground with a grain, too, whose friction is an ellipse. No surface has
corners in its friction, but data of an engine do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from ..physics.contact_law import Touch
from ..physics.effects.effect import ActiveEffect, BodyMotion, Effect, EffectParameter, Values, Wrench
from ..physics.impulse_solver import tangent_axes
from ..physics.world import World
from ..segments.candidates import base_parameters, base_values, without_effect
from ..segments.segment_fit import refit
from ..segments.segments import Segments
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict
FLATTEST = 0.02
"""Smallest share of the slip along an axis that is told from none: it keeps the ellipse from degenerating."""


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


class FrictionPyramid(Effect):
    """Friction -N mu (sign v_x, sign v_y) on the ground, in its axes."""

    name = "friction_pyramid"
    summary = "Friction limited along each of two axes by itself, as in engines with a friction pyramid."
    formula = "force = -N mu (sign v_x, sign v_y), v the slip in the ground's axes; at rest at most N mu along each"
    parameters = ()
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "slides along the axes and between them: those between are braked more, and turn towards an axis"
    source = "the square that a linear complementarity problem admits along two axes (Stewart & Trinkle 1996)"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the ellipse whose friction is that of the square at the slip that it has.

        Derived: the ellipse with the principal frictions m_x = mu sqrt(s / |v_x|) and m_y = mu sqrt(s / |v_y|), where
        s = |v_x| + |v_y|, has M^2 v / |M v| = mu (sign v_x, sign v_y).
        """
        if not touch.ground:
            return touch
        slip = (tangent_axes(touch.normal)[..., 1:, :] @ touch.slip_m_s[..., None]).squeeze(-1).abs() + 1e-9
        share = (slip / slip.sum(-1, keepdim=True)).clamp_min(FLATTEST)
        principal = share.rsqrt()
        mean, half = principal.mean(-1), 0.5 * (principal[..., 0] - principal[..., 1])
        grain = touch.friction[..., None] * torch.stack((half, torch.zeros_like(half)), -1)
        return replace(touch, friction=touch.friction * mean, anisotropy=grain)


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
