"""Offset of the centre of mass."""

from __future__ import annotations

from dataclasses import replace

from ..world import World
from .effect import Effect, EffectParameter, Values, vector


class ComOffset(Effect):
    """Centre of mass of every free body moved by d in its frame; the inertia about it does not change."""

    name = "com_offset"
    summary = "A centre of mass that differs from that of the shape."
    formula = "com becomes com + (d_x, d_y, d_z), body frame; the inertia about it stays"
    parameters = tuple(EffectParameter(name=f"d_{axis}", unit="m", scale=0.003, limit=0.05) for axis in "xyz")
    phase = "flight"
    needs = ("orientation",)
    reveals = "free flight with fast spin about different axes, then impacts (against marker_offset)"
    source = "definition"

    def world(self, values: Values, world: World) -> World:
        """Return the world with the centres of mass moved."""
        offset = vector(values, "d_x", "d_y", "d_z")
        bodies = (replace(body, com=body.com + offset) if body.free else body for body in world.bodies)
        return replace(world, bodies=tuple(bodies))
