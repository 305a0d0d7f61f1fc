"""Rotations in numpy: quaternions, w first, and matrices; for files, where torch would be too much.

scipy has them, too, but its import takes 60 ms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrix_of(quat_wxyz: Array) -> Array:
    """Return the rotations (..., 3, 3) of quaternions (..., 4) of any norm above 0."""
    quat = np.asarray(quat_wxyz, float)
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quat_of_matrix(matrix: Array) -> Array:
    """Return the quaternion (4,), w first, of a rotation (3, 3): the largest eigenvector of its quadratic form."""
    m = matrix
    form = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(form)[1][:, -1]


def quat_product(a: Array, b: Array) -> Array:
    """Return the product (4,) of two quaternions: the turn b, then the turn a."""
    w, v, s, u = a[0], a[1:], b[0], b[1:]
    return np.concatenate(([w * s - v @ u], w * u + s * v + np.cross(v, u)))


def turn_between(from_wxyz: Array, to_wxyz: Array) -> Array:
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


def quat_of_normal(normal: Array) -> Array:
    """Return the quaternion (4,) of the shortest turn that takes z to a unit vector."""
    x, y, z = normal
    if z < -1 + 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quat = np.array([1 + z, -y, x, 0.0])
    return quat / np.linalg.norm(quat)
