"""Restitution that falls with the speed of the impact."""

from __future__ import annotations

from dataclasses import replace

from ..contact_law import Touch
from .effect import Effect, EffectParameter, Values


class VelocityRestitution(Effect):
    """Damping that grows with the speed of the gap, so that e(v) = e exp(-r v) to first order in r v.

    Derived for small zeta: with a damping ratio zeta + c |u| the force 2 m (zeta + c |u|) u / tau takes, over the half
    period u = v cos(t / tau), the energy m v^2 (pi zeta + (8/3) c v), as if the ratio were zeta + 8 c v / (3 pi). With
    ln e = -pi zeta, e falls by exp(-(8/3) c v), hence c = (3/8) r. At larger zeta the same c does less. The first
    variation of the damped half period (derived; by quadrature) gives the factor that compensates for it, here as
    1 + 3.28 zeta + 1.16 zeta^2, within 1.2 % for zeta up to 0.95.
    """

    name = "velocity_restitution"
    summary = "Hard impacts lose a larger part of their speed than soft ones."
    formula = "e(v) = e exp(-r v) to first order, by zeta(u_n) = zeta + (3/8) (1 + 3.28 zeta + 1.16 zeta^2) r |u_n|"
    parameters = (EffectParameter(name="r", unit="s/m", scale=0.1, limit=5.0, nonnegative=True),)
    phase = "contact"
    needs = ("contact",)
    reveals = "drops from different heights, without spin: of a round body, or of one that falls flat on a face"
    source = "derived: the energy that a damper whose ratio grows with the speed dissipates over a half period"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the damping at its speed."""
        zeta = touch.damping_ratio
        rate = 0.375 * (1 + zeta * (3.28 + 1.16 * zeta)) * values["r"][:, None]
        return replace(touch, damping_ratio=zeta + rate * touch.approach_m_s.abs())
