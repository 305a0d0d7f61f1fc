"""Resistance to rolling."""

from __future__ import annotations

from dataclasses import replace

from ..contact_law import Touch
from .effect import Effect, EffectParameter, Values


class RollingResistance(Effect):
    """Torque of at most c_r N against the spin along the surface."""

    name = "rolling_resistance"
    summary = "Resistance to rolling, of a soft ground or a soft body."
    formula = "torque = -c_r N omega_t / |omega_t|"
    parameters = (EffectParameter(name="c_r", unit="m", scale=5e-4, limit=0.02, nonnegative=True),)
    phase = "contact"
    needs = ("contact",)
    reveals = "a long, slow roll to rest: deceleration (5/7) c_r g / r of a ball of radius r"
    source = "Coulomb's law of rolling; dry, so that a body comes to rest and stays there"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the resistance."""
        arm = values["c_r"][:, None]
        return replace(touch, rolling_m=arm if touch.rolling_m is None else touch.rolling_m + arm)
