"""Inertia that differs from that of the shape."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..inertia import stretched_inertia
from ..world import World
from .effect import Effect, EffectParameter, Values, vector

_AXES = ("xx", "yy", "zz", "xy", "xz", "yz")


class InertiaShape(Effect):
    """The mass of every free body stretched by exp(S / 2), S symmetric: C becomes exp(S/2) C exp(S/2).

    C is the second moment of the mass about the centre of mass, C = tr(I) / 2 - I. The inertia I = tr(C) - C thus stays
    symmetric and positive definite, and keeps the triangle inequality, which exp(S) on I itself would violate.
    S = s 1 multiplies the inertia by exp(s).
    """

    name = "inertia_shape"
    summary = "Mass that is not distributed uniformly in the shape."
    formula = "C becomes exp(S/2) C exp(S/2), C = tr(I)/2 - I the second moment of the mass, S symmetric, body axes"
    parameters = tuple(EffectParameter(name=f"s_{axes}", unit="1", scale=0.1, limit=1.0) for axes in _AXES)
    phase = "flight"
    needs = ("orientation",)
    reveals = "free flight with fast spin about axes that are not principal axes, and off-centre impacts"
    source = "second moments as in Wensing, Kim and Slotine 2018; the exponential map of symmetric matrices"

    def world(self, values: Values, world: World) -> World:
        """Return the world with the inertias of the stretched masses."""
        stretch = torch.linalg.matrix_exp(0.5 * _symmetric(vector(values, *(f"s_{axes}" for axes in _AXES))))
        bodies = (
            replace(body, inertia=stretched_inertia(body.inertia, stretch)) if body.free else body
            for body in world.bodies
        )
        return replace(world, bodies=tuple(bodies))


def _symmetric(six: Tensor) -> Tensor:
    """Return symmetric matrices (n, 3, 3) of (xx, yy, zz, xy, xz, yz), shape (n, 6)."""
    xx, yy, zz, xy, xz, yz = six.unbind(-1)
    return torch.stack((xx, xy, xz, xy, yy, yz, xz, yz, zz), -1).unflatten(-1, (3, 3))
