"""Friction against spinning about the contact's normal."""

from __future__ import annotations

from dataclasses import replace

from ..contact_law import Touch
from .effect import Effect, EffectParameter, Values


class TorsionalFriction(Effect):
    """Torque of at most c_t N against the spin about the normal."""

    name = "torsional_friction"
    summary = "Friction against spinning on the spot, of a contact that is a small area."
    formula = "torque = -c_t N sign(omega_n) n"
    parameters = (EffectParameter(name="c_t", unit="m", scale=5e-4, limit=0.02, nonnegative=True),)
    phase = "contact"
    needs = ("contact", "orientation")
    reveals = "a ball or a rounded body that spins on the spot: it stops at c_t m g / I"
    source = "soft-finger contact; c_t = (2/3) mu R of an evenly loaded disc of radius R"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the resistance."""
        arm = values["c_t"][:, None]
        return replace(touch, torsion_m=arm if touch.torsion_m is None else touch.torsion_m + arm)
