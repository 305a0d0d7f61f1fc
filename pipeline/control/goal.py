"""The goal of a push: a position along the ground and a turn about its normal, and the errors of poses against them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry.rotation import quat_conjugate, quat_multiply


@dataclass(frozen=True, kw_only=True)
class PlanarGoal:
    """A pose along the ground."""

    position_m: Tensor
    """x and y of the origin of the object's frame [m], shape (2,)."""
    turn_rad: float
    """Turn about z from the reference orientation [rad]."""
    reference_wxyz: Tensor
    """Orientation that is no turn, body to world, shape (4,)."""

    @property
    def quat_wxyz(self) -> Tensor:
        """Orientation of the object at the goal, body to world, shape (4,)."""
        return quat_multiply(turned(self.turn_rad, self.reference_wxyz), self.reference_wxyz)

    def errors(self, position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
        """Return the errors x [m], y [m] and turn [rad], shape (..., 3), of poses (..., 3) and (..., 4).

        The turn is the angle of the twist about z (Dobrowolski, "Swing-twist decomposition in Clifford algebra", 2015,
        eq. 3.12), between -pi and pi; a tilt of the object is no part of it.
        """
        between = quat_multiply(quat_wxyz, quat_conjugate(self.quat_wxyz).expand_as(quat_wxyz))
        w, z = between[..., 0], between[..., 3]
        side = torch.where(w < 0, -torch.ones_like(w), torch.ones_like(w))
        turn = 2 * torch.atan2(z * side, w * side)
        return torch.cat((position_m[..., :2] - self.position_m, turn[..., None]), -1)


def turned(angle_rad: float, like: Tensor) -> Tensor:
    """Return the quaternion (4,) of a turn about z [rad]."""
    return like.new_tensor([math.cos(angle_rad / 2), 0.0, 0.0, math.sin(angle_rad / 2)])
