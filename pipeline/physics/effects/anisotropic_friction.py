"""Friction of the ground that depends on the direction."""

from __future__ import annotations

from dataclasses import replace

from ..contact import Touch
from ..sweeps import tangent_axes
from .effect import Effect, EffectParameter, Values

SLOW_M_S = 1e-3
"""Below this slip [m/s] the direction fades, as it means nothing at rest."""


class AnisotropicFriction(Effect):
    """mu + t^T [[a, b], [b, -a]] t for a slip along the unit vector t, on the ground."""

    name = "anisotropic_friction"
    summary = "A ground with a grain: friction that depends on the direction of the slip."
    formula = "mu(t) = mu + a (t_x^2 - t_y^2) + 2 b t_x t_y, at least 0; t the slip's direction in the ground's axes"
    parameters = (
        EffectParameter("a", "1", scale=0.05, limit=1.0),
        EffectParameter("b", "1", scale=0.05, limit=1.0),
    )
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "slides from the same speed along at least three directions"
    source = "second harmonic of the friction in the direction; the force stays opposite to the slip (derived)"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the friction of the slip's direction."""
        if not touch.ground:
            return touch
        slip = (tangent_axes(touch.normal)[..., 1:, :] @ touch.slip_m_s[..., None]).squeeze(-1)
        x, y = slip.unbind(-1)
        even, mixed = x.square() - y.square(), 2 * x * y
        change = values["a"][:, None] * even + values["b"][:, None] * mixed
        return replace(touch, friction=touch.friction + change / (x.square() + y.square() + SLOW_M_S**2))
