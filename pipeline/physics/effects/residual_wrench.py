"""Constant residual wrench that a model lacks in a short window, whatever its cause."""

from __future__ import annotations

from torch import Tensor

from .effect import BodyMotion, Effect, EffectParameter, Values, Wrench, vector

AXES = ("a_x", "a_y", "a_z", "alpha_x", "alpha_y", "alpha_z")


class ResidualWrench(Effect):
    """a = (a_x, a_y, a_z), alpha = (alpha_x, alpha_y, alpha_z), world frame; not a candidate for a missing effect."""

    name = "residual_wrench"
    summary = "A constant acceleration and angular acceleration."
    formula = "a = (a_x, a_y, a_z), alpha = (alpha_x, alpha_y, alpha_z), world frame"
    parameters = tuple(
        EffectParameter(name=name, unit=unit, scale=scale, limit=1e6)
        for name, unit, scale in zip(AXES, ("m/s2",) * 3 + ("rad/s2",) * 3, (0.3,) * 3 + (3.0,) * 3, strict=True)
    )
    phase = "flight"
    reveals = "any motion"
    source = "Newton and Euler"

    def acceleration(self, values: Values) -> Tensor:
        """Return the acceleration (1 or n, 3) [m/s2]."""
        return vector(values, *AXES[:3])

    def angular_acceleration(self, values: Values) -> Tensor:
        """Return the angular acceleration (1 or n, 3) [rad/s2]."""
        return vector(values, *AXES[3:])

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the wrench."""
        torque = (motion.inertia @ self.angular_acceleration(values)[..., None]).squeeze(-1)
        return Wrench(motion.mass[:, None] * self.acceleration(values), torque)
