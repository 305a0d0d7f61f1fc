"""Screen-space bounds of spheres: boxes of pixels outside of which they contribute nothing."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from .posed_scene import Labelled
from .render import MIN_ALPHA

TILE = 8
"""Side of a tile [px]; crops begin and end on its multiples, so that their tiles are those of the full image."""


class Box(NamedTuple):
    """Box of pixels; right and bottom are exclusive."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.bottom - self.top

    @property
    def place(self) -> tuple[slice, slice]:
        """Slices of rows and columns."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def camera_matrix(self, K: Tensor) -> Tensor:
        """Return the camera matrix (3, 3) [px] of a camera that sees only the box."""
        shifted = K.clone()
        shifted[0, 2] -= self.left
        shifted[1, 2] -= self.top
        return shifted


def spans(spheres: Labelled, viewmat: Tensor, K: Tensor) -> Tensor:
    """Return bounds (N, 4) [px] left, top, right, bottom of where each sphere reaches MIN_ALPHA; inf to -inf for none.

    Derived: the rays that pass a centre (x, z) within r lie, in the plane of x and z, within asin(r / |(x, z)|) of
    its direction; likewise for y. A sphere around the camera reaches all pixels.
    """
    local = spheres.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    reach = spheres.scales * (2 * (spheres.opacities / MIN_ALPHA).clamp_min(1.0).log()).sqrt()
    depth = local[:, 2]
    drawn = (spheres.opacities > MIN_ALPHA) & (depth > -reach)
    around = depth <= reach
    columns: list[Tensor] = []
    for axis in (0, 1):
        middle = torch.atan2(local[:, axis], depth)
        half = torch.asin((reach / torch.hypot(local[:, axis], depth)).clamp_max(1.0))
        for sign in (-1.0, 1.0):
            # one pixel of margin for rounding
            end = torch.tan(middle + sign * half) * K[axis, axis] + K[axis, 2] + sign
            end = torch.where(around, sign * torch.inf, end)
            columns.append(torch.where(drawn, end, -sign * torch.inf))
    return torch.stack([columns[0], columns[2], columns[1], columns[3]], 1)


def reach(each: Tensor, width: int, height: int) -> Box | None:
    """Return the box, on tile borders, around `spans` (N, 4) of spheres; None for an empty box."""
    if len(each) == 0:
        return None
    low, high = each[:, :2].amin(0).tolist(), each[:, 2:].amax(0).tolist()
    limits = []
    for first, last, size in zip(low, high, (width, height), strict=True):
        if last <= 0 or first >= size:
            return None
        start = max(0, math.floor(max(first, 0) / TILE) * TILE)
        limits.append((start, min(size, math.ceil(min(last, size) / TILE) * TILE)))
    (left, right), (top, bottom) = limits
    return Box(left, top, right, bottom)


def inside(each: Tensor, box: Box) -> Tensor:
    """Return which spheres (N,) with spans (N, 4) reach into a box."""
    low, high = each.new_tensor([box.left, box.top]), each.new_tensor([box.right, box.bottom])
    return ((each[:, :2] <= high) & (each[:, 2:] >= low)).all(1)
