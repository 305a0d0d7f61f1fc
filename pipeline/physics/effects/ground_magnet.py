"""Attraction by the ground that decays with the height."""

from __future__ import annotations

from .effect import BodyMotion, Effect, EffectConstant, EffectParameter, Values, Wrench


class GroundMagnet(Effect):
    """a = -A exp(-h / l) n; h is the height of the lowest sphere."""

    name = "ground_magnet"
    summary = "An attraction by the ground, magnetic or electrostatic, that fades with the height."
    formula = "a = -A exp(-h / l) n, h the height of the lowest sphere"
    parameters = (EffectParameter(name="A", unit="m/s2", scale=1.0, limit=100.0, nonnegative=True),)
    constants = (EffectConstant("l", "m", (0.01, 0.02, 0.05, 0.1)),)
    phase = "flight"
    needs = ("ground",)
    reveals = "low bounces and slow passes just over the ground, and flights high above it"
    source = "a stand-in with one range for the fields of magnets and charges"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the attraction."""
        # a contact lets spheres sink in by a little, where the pull shall not go on growing
        fading = (-motion.height.clamp_min(0.0) / values["l"]).exp()
        return Wrench(force=-(values["A"] * motion.mass * fading)[:, None] * motion.normal)
