"""Frames of moving bodies as a camera takes them: the mean over the time of an exposure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Draw = Callable[[NDArray[np.intp], Array, Array], Image]
"""Draws some of the pictures, by their indices (n,): bodies at positions (n, B, 3) [m] and orientations (n, B, 4)."""

_POINTS, _WEIGHTS = (-0.5 * np.sqrt(0.6), 0.0, 0.5 * np.sqrt(0.6)), (5 / 18, 8 / 18, 5 / 18)
"""Instants, in durations of the exposure about its middle, and their weights (Gauss and Legendre)."""
_STILL_M, _STILL = 1e-4, 1e-3
"""Motion during an exposure, in position [m] and components of orientations, below which an instant is enough."""


def poses_at(grid_s: Array, position_m: Array, quat_wxyz: Array, times_s: Array) -> tuple[Array, Array]:
    """Return positions (F, B, 3) and orientations (F, B, 4) at times (F,), linear between those of a grid.

    Args:
        grid_s: Times [s], increasing, shape (G,).
        position_m: Positions [m], shape (G, B, 3).
        quat_wxyz: Orientations, shape (G, B, 4).
        times_s: Times [s]; before and behind the grid its ends count.
    """
    after = np.searchsorted(grid_s, times_s).clip(1, len(grid_s) - 1)
    share = ((times_s - grid_s[after - 1]) / (grid_s[after] - grid_s[after - 1])).clip(0, 1)[:, None, None]
    position = (1 - share) * position_m[after - 1] + share * position_m[after]
    first, second = quat_wxyz[after - 1], quat_wxyz[after]
    second = np.where((first * second).sum(-1, keepdims=True) < 0, -second, second)
    quat = (1 - share) * first + share * second
    return position, quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def exposed_for(
    duration_s: float | Array, draw: Draw, shown: Image, poses: Callable[[Array], tuple[Array, Array]], times_s: Array
) -> NDArray[np.float32]:
    """Return pictures (F, H, W, 3) that are means over an exposure about each time.

    Args:
        duration_s: How long a picture is exposed [s], or each of them (F,).
        draw: Draws pictures of bodies at instants.
        shown: The pictures at the instants `times_s`, shape (F, H, W, 3).
        poses: Returns poses at times (F,).
        times_s: Times of the pictures [s], shape (F,).
    """
    pictures = shown.astype(np.float32)
    if not np.any(duration_s):
        return pictures
    ends = [poses(times_s + point * duration_s) for point in (_POINTS[0], _POINTS[-1])]
    apart = [np.abs(one - other).reshape(len(times_s), -1).max(1) for one, other in zip(*ends, strict=True)]
    moving = np.flatnonzero((apart[0] > _STILL_M) | (apart[1] > _STILL))
    if len(moving):
        sides = [draw(moving, *(values[moving] for values in end)).astype(np.float32) for end in ends]
        side, middle = np.float32(_WEIGHTS[0]), np.float32(_WEIGHTS[1])
        pictures[moving] = middle * pictures[moving] + side * (sides[0] + sides[1])
    return pictures
