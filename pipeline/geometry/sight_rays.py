"""Rays from cameras to a point: where they meet, and how far its images are from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nearest_points(centers: Array, directions: Array) -> Array:
    """Return the points (..., 3) of least squared distances from lines that are not all parallel.

    Args:
        centers: A point on each line, shape (..., view, 3).
        directions: Unit directions, shape (..., view, 3).
    """
    projectors = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    right = np.einsum("...vij,...vj->...i", projectors, centers)
    return np.linalg.solve(projectors.sum(axis=-3), right[..., None])[..., 0]


def least_squares_point(point: Array, poses: Array, rays: Array, focal: Array) -> Array:
    """Return the point of least squared reprojection errors from a nearby point, by one linear system.

    An error is linear in the point but for its division by the depth (Hartley and Sturm, "Triangulation", 1997,
    section 4.2). With the depths of the nearby point, the result differs from the minimum by the product of an error
    and the relative change of depth.

    Args:
        point: The nearby point, shape (3,).
        poses: T_cam_world of each view, shape (view, 4, 4) or (view, 3, 4).
        rays: Its image (x/z, y/z) in each view, shape (view, 2).
        focal: Focal length of each view [px], shape (view,), or of its axes (view, 2).
    """
    rotation, shift = poses[:, :3, :3], poses[:, :3, 3]
    weight = focal.reshape(len(poses), -1) / (rotation[:, 2] @ point + shift[:, 2])[:, None]
    matrix = (rotation[:, :2] - rays[:, :, None] * rotation[:, 2:]) * weight[..., None]
    right = (rays * shift[:, 2:] - shift[:, :2]) * weight
    return np.asarray(np.linalg.lstsq(matrix.reshape(-1, 3), right.ravel(), rcond=None)[0], np.float64)


def reprojection(point: Array, poses: Array, rays: Array, focal: Array) -> tuple[Array, Array]:
    """Return the reprojection errors (2 view,) of a point [px] and their derivatives (2 view, 3), see above."""
    local = poses[:, :3, :3] @ point + poses[:, :3, 3]
    scale = focal.reshape(len(poses), -1)
    residual = (local[:, :2] / local[:, 2:] - rays) * scale
    jacobian = projection_jacobian(local) @ poses[:, :3, :3] * scale[..., None]
    return residual.ravel(), jacobian.reshape(-1, 3)


def projection_jacobian(local: Array) -> Array:
    """Return d(x/z, y/z)/d(x, y, z), shape (point, 2, 3)."""
    x, y, z = local.T
    zero = np.zeros_like(z)
    return np.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], axis=1).reshape(-1, 2, 3)
