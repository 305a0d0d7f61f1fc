"""A custom effect: a box whose faces are not flat, so that it rocks on them (docs/real-data.md)."""

from __future__ import annotations

from dataclasses import replace

import torch
from cgwm.pipeline.physics.body import Body
from cgwm.pipeline.physics.effects import Effect, EffectParameter, Values
from cgwm.pipeline.physics.world import World
from torch import Tensor

FACES = tuple((axis, side) for axis in range(3) for side in ("plus", "minus"))
DIAGONALS = ("even", "odd")


class FaceWarp(Effect):
    """Two opposite corners of a face stand out of it: the box stands on them and on one of the other two."""

    name = "face_warp"
    summary = "Faces of a box whose corners do not lie in one plane: it rocks about a diagonal."
    formula = "the corners of face x+ with y z > 0 move out by x_plus_even, those with y z < 0 by x_plus_odd; and so on"
    parameters = tuple(
        EffectParameter(name=f"{'xyz'[axis]}_{side}_{diagonal}", unit="m", scale=0.0001, limit=0.01, nonnegative=True)
        for axis, side in FACES
        for diagonal in DIAGONALS
    )
    # of contact, but a fit shall find it where the box comes to rest: in impacts the contact law misses far more
    phase = "measurement"
    needs = ("ground", "spin")
    reveals = "sliding on every face until the box stops: there it rocks back, and its height and tilt at rest"
    source = "definition"

    def world(self, values: Values, world: World) -> World:
        """Return the world with the corners of all free bodies moved."""
        bodies = (
            replace(body, centers=body.centers + shift(values, body)) if body.free else body for body in world.bodies
        )
        return replace(world, bodies=tuple(bodies))


def shift(values: Values, body: Body) -> Tensor:
    """Return how far the spheres (1 or B, N, 3) [m] of a box move, in proportion to how near they are to a corner."""
    own = body.centers / body.centers.abs().amax(1, keepdim=True)  # -1 to 1, corners at the ends
    moved = torch.zeros_like(own)
    for axis, side in FACES:
        first, second = (k for k in range(3) if k != axis)
        sign = 1.0 if side == "plus" else -1.0
        out, turn = (sign * own[..., axis]).clamp_min(0.0), own[..., first] * own[..., second]
        even, odd = (values[f"{'xyz'[axis]}_{side}_{diagonal}"][:, None] for diagonal in DIAGONALS)
        amount = out * (even * turn.clamp_min(0.0) + odd * (-turn).clamp_min(0.0))
        moved = moved + sign * amount[..., None] * torch.eye(3).to(own)[axis]
    return moved
