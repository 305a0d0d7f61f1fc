"""Adhesion of a sticky ground."""

from __future__ import annotations

from ...geometry.rotation import cross
from .effect import BodyMotion, Effect, EffectConstant, EffectParameter, Values, Wrench


class Adhesion(Effect):
    """Attraction F by the ground while a body is within the gap g, shared among the spheres within the gap."""

    name = "adhesion"
    summary = "A sticky ground: it pulls what touches it, and lets go within a small gap."
    formula = "force = -F w(h) n, w(h) = (1 - (h / g)^2)^2 for 0 < h < g, 1 below, 0 above; h of the lowest sphere"
    parameters = (EffectParameter(name="F", unit="N", scale=0.2, limit=100.0, nonnegative=True),)
    constants = (EffectConstant("g", "m", (5e-4, 1e-3, 2e-3, 5e-3)),)
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "low bounces and the last rocking of a light body"
    source = "a force with compact support and a continuous derivative; it does not depend on the number of spheres"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the attraction of the spheres within the gap."""
        arms, heights = motion.lowest_points()
        near = (1 - (heights / values["g"][:, None]).clamp(0.0, 1.0).square()).square()
        # the weights add up to that of the lowest sphere, so that more spheres do not pull more
        share = near * (near.amax(-1) / near.sum(-1).clamp_min(1e-12))[:, None]
        pulls = -(values["F"][:, None] * share)[..., None] * motion.normal[:, None]
        return Wrench(force=pulls.sum(1), torque=cross(arms, pulls).sum(1))
