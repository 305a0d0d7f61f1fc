"""Drag that is quadratic in the speed."""

from __future__ import annotations

from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench, length


class QuadraticDrag(Effect):
    """a = -k |u| u."""

    name = "quadratic_drag"
    summary = "Air resistance of a fast body."
    formula = "a = -k |u| u"
    parameters = (EffectParameter(name="k", unit="1/m", scale=0.05, limit=5.0, nonnegative=True),)
    phase = "flight"
    provides = ("drag",)
    reveals = "fast free flight, at different speeds"
    source = "turbulent drag; k = rho C_d A / (2 m)"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the drag."""
        u = motion.airspeed
        return Wrench(force=-(values["k"] * motion.mass)[:, None] * length(u) * u)
