"""Map of the ground's friction."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..contact_law import Touch
from ..impulse_solver import tangent_axes
from .effect import Effect, EffectConstant, EffectParameter, Values

SIDE = 3
"""Number of B-splines along each side of the grid, centred at the projection of the world's origin onto the ground."""


class FrictionPatch(Effect):
    """mu + sum over i, j of c_ij B(x / p - i + 2) B(y / p - j + 2), on the ground.

    B is the quadratic B-spline of width 3: once differentiable, zero beyond 1.5; for equal c the sum is constant within
    the grid.
    """

    name = "friction_patch"
    summary = "Spots of the ground with more or less friction."
    formula = (
        "mu(x, y) = mu + sum of c_ij B(x / p - i + 2) B(y / p - j + 2), i, j = 1 .. 3, at least 0; "
        "B the quadratic B-spline, (x, y) from the world's origin in the ground's axes"
    )
    parameters = tuple(
        EffectParameter(name=f"c_{i}{j}", unit="1", scale=0.1, limit=1.0)
        for i in range(1, SIDE + 1)
        for j in range(1, SIDE + 1)
    )
    constants = (EffectConstant("p", "m", (0.05, 0.1, 0.2)),)
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "the same slide across different places of the ground"
    source = "a tensor product of quadratic B-splines (de Boor 1978)"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the friction at its position."""
        if not touch.ground:
            return touch
        axes = tangent_axes(touch.normal)[..., 1:, :]
        place = (axes @ touch.position[..., None]).squeeze(-1) / values["p"][:, None, None]
        steps = torch.arange(SIDE).to(place) - (SIDE - 1) / 2
        along, across = _spline(place[..., None] - steps).unbind(-2)
        grid = torch.stack([values[p.name] for p in self.parameters], -1).unflatten(-1, (SIDE, SIDE))
        bumps = ((along @ grid) * across).sum(-1)
        return replace(touch, friction=touch.friction + bumps)


def _spline(x: Tensor) -> Tensor:
    """Return the quadratic B-spline of width 3 at x, same shape."""
    far = (1.5 - x.abs()).clamp_min(0.0)
    return torch.where(x.abs() < 0.5, 0.75 - x.square(), 0.5 * far.square())
