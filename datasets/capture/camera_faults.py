"""What can be wrong with the numbers of a camera: its pose, its intrinsics, its distortion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROTATION_TOLERANCE = 1e-3
"""Largest difference of R R^T from 1."""
ROW_TOLERANCE = 1e-9
"""Largest difference of the last row of a pose, and of the fixed numbers of K, from what they are."""
NEAR_SIZES = 2.0
"""Largest distance of the principal point from the image [sizes of the image]; parts of photos have it outside."""


def pose_fault(T_world_cam: NDArray[np.float64]) -> str | None:
    """Return what keeps a 4x4 matrix from being a rotation and a translation, or None."""
    rotation = T_world_cam[:3, :3]
    if not np.isfinite(T_world_cam).all():
        return "the pose holds numbers that are not finite"
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE:
        return f"the pose is no rotation and translation: R R^T differs from 1 by {off:.2g}"
    if np.linalg.det(rotation) < 0:
        return "the pose is no rotation and translation: it mirrors (determinant -1)"
    if np.abs(T_world_cam[3] - [0, 0, 0, 1]).max() > ROW_TOLERANCE:
        return f"the pose's last row is {T_world_cam[3].tolist()}; it is 0, 0, 0, 1"
    return None


def intrinsics_fault(K: NDArray[np.float64], distortion: NDArray[np.float64], width: int, height: int) -> str | None:
    """Return what keeps K [px], shape (3, 3), and OpenCV's distortion from being those of an image, or None."""
    if not np.isfinite(K).all():
        return "K holds numbers that are not finite"
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        return f"the focal lengths in K are {K[0, 0]:g} and {K[1, 1]:g} px; they are positive"
    if np.abs(K[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max() > ROW_TOLERANCE:
        return "K is not of the form fx, s, cx; 0, fy, cy; 0, 0, 1"
    size = np.array([width, height], float)
    off = float((np.maximum(np.abs(K[:2, 2] - size / 2) - size / 2, 0) / size).max())
    if off > NEAR_SIZES:
        return (
            f"the principal point in K, ({K[0, 2]:g}, {K[1, 2]:g}) px, is {off:.1f} image sizes outside of the "
            f"{width} x {height} image; up to {NEAR_SIZES:g} are possible"
        )
    if len(distortion) not in (0, 4, 5):
        return f"the distortion has {len(distortion)} numbers; OpenCV's has 4 or 5, or none"
    return None if np.isfinite(distortion).all() else "the distortion holds numbers that are not finite"
