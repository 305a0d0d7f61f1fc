"""Rotations of unit quaternions (w, x, y, z) in numpy, for files that need no more: importing scipy's takes 60 ms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrices(quat_wxyz: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any norm above 0."""
    quat = np.asarray(quat_wxyz, float)
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def turns(from_wxyz: Array, to_wxyz: Array) -> Array:
    """Return the shortest rotation vectors (..., 3) [rad] from orientations (..., 4) to others, axes of the former."""
    aw, ax, ay, az = np.moveaxis(np.asarray(from_wxyz, float), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(to_wxyz, float), -1, 0)
    cosine = aw * bw + ax * bx + ay * by + az * bz
    vector = np.stack(
        (
            aw * bx - ax * bw - ay * bz + az * by,
            aw * by + ax * bz - ay * bw - az * bx,
            aw * bz - ax * by + ay * bx - az * bw,
        ),
        -1,
    )
    sine = np.linalg.norm(vector, axis=-1)
    angle = 2 * np.arctan2(sine, np.abs(cosine)) * np.where(cosine < 0, -1.0, 1.0)
    return vector * (angle / np.maximum(sine, 1e-300))[..., None]
