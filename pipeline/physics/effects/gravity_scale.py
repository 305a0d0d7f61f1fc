"""Scale error of gravity."""

from __future__ import annotations

from dataclasses import replace

from ..world import World
from .effect import Effect, EffectParameter, Values


class GravityScale(Effect):
    """g (1 + s)."""

    name = "gravity_scale"
    summary = "Gravity of another strength."
    formula = "g becomes (1 + s) g"
    # on the ground gravity is 9.76 to 9.83 m/s2: at most 0.5 % from 9.81; 10 m/s2 for 9.81 m/s2 is 2 %
    parameters = (EffectParameter(name="s", unit="1", scale=0.02, limit=0.9, plausible=0.005, possible=0.03),)
    phase = "flight"
    reveals = "drops from great heights, with a checked length and clock"
    source = "definition"

    def world(self, values: Values, world: World) -> World:
        """Return the world with gravity scaled."""
        return replace(world, gravity=world.gravity * (1 + values["s"])[:, None])
