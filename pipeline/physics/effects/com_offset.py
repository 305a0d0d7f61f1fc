"""A centre of mass that is not where it was thought to be."""

from __future__ import annotations

from dataclasses import replace

from ..world import World
from .effect import Effect, EffectParameter, Values, vector


class ComOffset(Effect):
    """The centre of mass of every free body moved by d in its frame; the inertia about it stays."""

    name = "com_offset"
    summary = "A centre of mass beside the one that the shape says."
    formula = "com becomes com + (d_x, d_y, d_z), body frame; the inertia about it stays"
    parameters = tuple(EffectParameter(f"d_{axis}", "m", scale=0.003, limit=0.05) for axis in "xyz")
    phase = "flight"
    needs = ("spin",)
    reveals = "free flight with fast spin about different axes, then impacts (against marker_offset)"
    source = "definition"

    def world(self, values: Values, world: World) -> World:
        """Return the world with the centres of mass moved."""
        offset = vector(values, "d_x", "d_y", "d_z")
        bodies = (replace(body, com=body.com + offset) if body.free else body for body in world.bodies)
        return replace(world, bodies=tuple(bodies))
