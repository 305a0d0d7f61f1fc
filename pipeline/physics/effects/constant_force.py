"""Constant acceleration."""

from __future__ import annotations

from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench, vector


class ConstantForce(Effect):
    """a = f, world frame."""

    name = "constant_force"
    summary = "A constant acceleration that nothing else explains."
    formula = "a = (f_x, f_y, f_z), world frame"
    parameters = tuple(EffectParameter(name=f"f_{axis}", unit="m/s2", scale=0.3, limit=10.0) for axis in "xyz")
    phase = "flight"
    reveals = "long free flight from different heights, and rest on a turned or weighed set-up"
    source = "Newton's second law"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the force."""
        return Wrench(force=motion.mass[:, None] * vector(values, "f_x", "f_y", "f_z"))
