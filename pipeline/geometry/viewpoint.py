"""Rotation matrices and camera poses in numpy."""

from __future__ import annotations

import numpy as np

from ...datasets.shapes.turns import matrix_of


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return T_world_cam (4, 4) of a camera at `eye` that looks at `target`; OpenCV axes."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def rotation_matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any norm; NaN where one has no direction.

    Validation reads quaternions that are zero or not finite from damaged datasets.
    """
    quat_wxyz = np.asarray(quat_wxyz, float)
    norm = np.linalg.norm(quat_wxyz, axis=-1)
    directed = np.isfinite(norm) & (norm > 0)
    matrices = np.full((*norm.shape, 3, 3), np.nan)
    if directed.any():
        matrices[directed] = matrix_of(quat_wxyz[directed])
    return matrices
