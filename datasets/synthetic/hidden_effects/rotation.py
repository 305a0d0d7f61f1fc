"""Rotations and cross products without the overhead of general library functions."""

from __future__ import annotations

import numpy as np

from .things import Array


def rotations(quat_wxyz: Array) -> Array:
    """Return the rotation matrices (T, 3, 3) of unit quaternions (T, 4)."""
    w, x, y, z = quat_wxyz.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2).astype(np.float64)


def rotation_of(quat_wxyz: Array) -> Array:
    """Return the rotation matrix (3, 3) of one unit quaternion (4,)."""
    w, x, y, z = quat_wxyz.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turn(vector: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle else np.zeros(3)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors, ten times as fast as `np.cross`."""
    (x, y, z), (u, v, w) = a, b
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def cross_rows(a: Array, rows: Array) -> Array:
    """Return a x each row, for a vector a and rows (n, 3)."""
    return rows @ np.array([[0.0, a[2], -a[1]], [-a[2], 0.0, a[0]], [a[1], -a[0], 0.0]])
