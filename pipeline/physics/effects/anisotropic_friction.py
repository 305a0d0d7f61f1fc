"""Friction of the ground that depends on the direction of the slip."""

from __future__ import annotations

from dataclasses import replace

from ..contact_law import Touch
from .effect import Effect, EffectParameter, Values, vector


class AnisotropicFriction(Effect):
    """Friction -N M^2 v / |M v| on the ground, M = mu I + [[a, b], [b, -a]]."""

    name = "anisotropic_friction"
    summary = "A ground with a grain: friction that depends on the direction of the slip, and pushes across it."
    formula = (
        "force = -N M^2 v / |M v|, M = mu I + [[a, b], [b, -a]], v the slip in the ground's axes; at rest any force f "
        "with |M^-1 f| <= N; the lower principal friction mu - |(a, b)| at least a tenth of the higher one"
    )
    parameters = (
        EffectParameter(name="a", unit="1", scale=0.05, limit=1.0),
        EffectParameter(name="b", unit="1", scale=0.05, limit=1.0),
    )
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "slides from the same speed along at least three directions; oblique ones are curved"
    source = "elliptic cone with maximum dissipation (Moreau; Goyal, Ruina & Papadopoulos 1991)"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the ellipse of the ground's friction."""
        if not touch.ground:
            return touch
        own = vector(values, "a", "b")[:, None]
        return replace(touch, anisotropy=own if touch.anisotropy is None else touch.anisotropy + own)
