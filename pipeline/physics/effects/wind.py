"""Steady wind."""

from __future__ import annotations

from torch import Tensor

from .effect import BodyMotion, Effect, EffectParameter, Values, horizontal, vector


class Wind(Effect):
    """Air that flows at w; the drag of the model acts on u - w, and so does its lift."""

    name = "wind"
    summary = "A steady, horizontal flow of the air, felt through the drag in the model."
    formula = "u becomes u - w in the drag and the lift of the model; w = w_x e_x + w_y e_y"
    parameters = (
        EffectParameter(name="w_x", unit="m/s", scale=1.0, limit=20.0),
        EffectParameter(name="w_y", unit="m/s", scale=1.0, limit=20.0),
    )
    phase = "flight"
    needs = ("drag",)
    reveals = "long flights in opposite directions, of bodies with different drag"
    source = "Galilean invariance of the drag"

    def flow(self, values: Values, motion: BodyMotion) -> Tensor:
        """Return the velocity of the air (n or 1, 3) [m/s]."""
        return self.along(values, motion.up)

    @staticmethod
    def along(values: Values, up: Tensor) -> Tensor:
        """Return the velocity (n or 1, 3) [m/s] of the wind for an upward direction (n or 1, 3)."""
        return horizontal(vector(values, "w_x", "w_y"), up)
