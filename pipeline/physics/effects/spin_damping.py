"""Damping of spin by the air."""

from __future__ import annotations

from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench


class SpinDamping(Effect):
    """alpha = -d omega, by a torque -d I omega."""

    name = "spin_damping"
    summary = "Resistance of the air to spinning."
    formula = "alpha = -d omega"
    parameters = (EffectParameter(name="d", unit="1/s", scale=0.2, limit=20.0, nonnegative=True),)
    phase = "flight"
    needs = ("orientation",)
    reveals = "long free flight with fast spin"
    source = "viscous torque; d = 8 pi eta r^3 / I for a sphere of radius r"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the torque."""
        momentum = (motion.inertia @ motion.omega[..., None]).squeeze(-1)
        return Wrench(torque=-values["d"][:, None] * momentum)
