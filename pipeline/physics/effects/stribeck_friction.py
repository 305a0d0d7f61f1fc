"""Friction that changes with the slip speed."""

from __future__ import annotations

from dataclasses import replace

from ..contact_law import Touch
from .effect import Effect, EffectConstant, EffectParameter, Values, length


class StribeckFriction(Effect):
    """mu + d exp(-|v_t| / v_s)."""

    name = "stribeck_friction"
    summary = "Friction that is higher (or lower) at slow slip than at fast."
    formula = "mu(v_t) = mu + d exp(-|v_t| / v_s), at least 0"
    parameters = (EffectParameter(name="d", unit="1", scale=0.1, limit=2.0),)
    constants = (EffectConstant("v_s", "m/s", (0.02, 0.05, 0.1, 0.2, 0.5)),)
    phase = "contact"
    needs = ("contact",)
    reveals = "slides from different speeds down to rest: the deceleration changes over the last centimetres"
    source = "Stribeck 1902, in the exponential form of Bo and Pavelescu 1982"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with its friction at the slip that it has."""
        slow = (-length(touch.slip_m_s).squeeze(-1) / values["v_s"][:, None]).exp()
        return replace(touch, friction=touch.friction + values["d"][:, None] * slow)
