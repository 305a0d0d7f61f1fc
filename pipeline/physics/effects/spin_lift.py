"""Lift of a body in flight whose spin was not measured."""

from __future__ import annotations

from ...geometry.rotation import cross
from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench, vector


class SpinLift(Effect):
    """a = q x u, q = s omega of the Magnus lift for a spin that nobody has seen and that lasts for the flight."""

    name = "spin_lift"
    summary = "Magnus lift of a spin that was not measured, as of a ball of which the centre alone was tracked."
    formula = "a = q x u, q = s omega of magnus_lift"
    parameters = tuple(EffectParameter(name=f"q_{axis}", unit="1/s", scale=0.2, limit=10.0) for axis in "xyz")
    phase = "flight"
    needs = ("unmeasured_spin",)
    reveals = "free flights in different directions; a measured spin makes it magnus_lift"
    source = "Rubinow and Keller 1961, see magnus_lift; q is constant as long as the spin is"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the lift."""
        q = vector(values, "q_x", "q_y", "q_z")
        return Wrench(force=motion.mass[:, None] * cross(q.expand_as(motion.airspeed), motion.airspeed))
