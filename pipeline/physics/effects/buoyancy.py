"""Buoyancy in air or in a liquid."""

from __future__ import annotations

from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench


class Buoyancy(Effect):
    """a = b upwards."""

    name = "buoyancy"
    summary = "Lift of the displaced air or liquid; its added mass is neglected."
    formula = "a = +b upwards"
    # air of 1.2 kg/m3 about a table tennis ball of 80 kg/m3; a tenth of the weight is an inflated toy of 12 kg/m3
    parameters = (
        EffectParameter(name="b", unit="m/s2", scale=0.2, limit=20.0, nonnegative=True, plausible=0.15, possible=1.0),
    )
    phase = "flight"
    reveals = "slow drops of a light body, and of a heavy one of the same size"
    source = "Archimedes; b = g rho_fluid / rho_body"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the lift."""
        return Wrench(force=(values["b"] * motion.mass)[:, None] * motion.up)
