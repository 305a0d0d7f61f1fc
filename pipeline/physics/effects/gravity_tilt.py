"""Tilt of gravity against the world's axes."""

from __future__ import annotations

from dataclasses import replace

from ...geometry.rotation import quat_exp, quat_rotate
from ..world import World
from .effect import Effect, EffectParameter, Values, horizontal, vector


class GravityTilt(Effect):
    """g turned by the rotation vector tilt_x e_x + tilt_y e_y; the ground stays."""

    name = "gravity_tilt"
    summary = "A ground that is not level: gravity is turned against the world's axes, the ground is not."
    formula = "g becomes exp(tilt_x e_x + tilt_y e_y) g; the ground stays"
    parameters = (
        EffectParameter(name="tilt_x", unit="rad", scale=0.02, limit=0.5),
        EffectParameter(name="tilt_y", unit="rad", scale=0.02, limit=0.5),
    )
    phase = "flight"
    reveals = "free flight, then the same slide in several directions on the ground"
    source = "a rotation; about the two horizontal axes, as one about gravity changes nothing"

    def world(self, values: Values, world: World) -> World:
        """Return the world with gravity turned."""
        turn = horizontal(vector(values, "tilt_x", "tilt_y"), world.up)
        return replace(world, gravity=quat_rotate(quat_exp(turn), world.gravity))
