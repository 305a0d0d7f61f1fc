"""Drag that is linear in the speed."""

from __future__ import annotations

from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench


class LinearDrag(Effect):
    """a = -c u."""

    name = "linear_drag"
    summary = "Resistance of a viscous fluid, or of the air to a slow and light body."
    formula = "a = -c u"
    parameters = (EffectParameter(name="c", unit="1/s", scale=0.2, limit=20.0, nonnegative=True),)
    phase = "flight"
    provides = ("drag",)
    reveals = "long free flight, at different speeds (against quadratic_drag) and directions (against wind)"
    source = "Stokes drag; c = 6 pi eta r / m for a sphere of radius r"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the drag."""
        return Wrench(force=-(values["c"] * motion.mass)[:, None] * motion.airspeed)
