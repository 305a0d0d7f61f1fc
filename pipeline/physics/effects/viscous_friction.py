"""Friction that grows with the slip speed."""

from __future__ import annotations

from dataclasses import replace

from ..contact_law import Touch
from .effect import Effect, EffectParameter, Values


class ViscousFriction(Effect):
    """Force -c_v v_t, shared among the points that touch."""

    name = "viscous_friction"
    summary = "Drag of a lubricant: a force that grows with the slip, in addition to Coulomb friction."
    formula = "force = -c_v v_t, shared among the points that touch"
    parameters = (EffectParameter(name="c_v", unit="N s/m", scale=0.1, limit=20.0, nonnegative=True),)
    phase = "contact"
    needs = ("contact",)
    reveals = "long slides from different speeds: the deceleration falls with the speed"
    source = "a film of a Newtonian fluid"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the drag."""
        drag = values["c_v"][:, None]
        return replace(touch, viscous_n_s_m=drag if touch.viscous_n_s_m is None else touch.viscous_n_s_m + drag)
