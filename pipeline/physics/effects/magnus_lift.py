"""Magnus lift of a spinning body in flight."""

from __future__ import annotations

from ...geometry.rotation import cross
from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench


class MagnusLift(Effect):
    """a = s omega x u."""

    name = "magnus_lift"
    summary = "Sideways force on a body that spins while it moves through the air."
    formula = "a = s omega x u"
    parameters = (EffectParameter(name="s", unit="1", scale=0.02, limit=2.0),)
    phase = "flight"
    needs = ("spin",)
    reveals = "fast free flight with fast spin across the path, both ways round"
    source = "Rubinow and Keller 1961: s = pi r^3 rho / m for a sphere of radius r at low Reynolds numbers"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the lift."""
        return Wrench(force=(values["s"] * motion.mass)[:, None] * cross(motion.omega, motion.airspeed))
