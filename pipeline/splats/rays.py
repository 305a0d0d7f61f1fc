"""Rays through pixels, for pinhole cameras with and without OpenCV distortion."""

from __future__ import annotations

import torch
from torch import Tensor

_UNDISTORT_STEPS = 20


def pixel_rays(pixels: Tensor, Ks: Tensor, distortion: Tensor | None = None) -> Tensor:
    """Return unit ray directions through pixels.

    Args:
        pixels: Pixel positions (u, v) [px], shape (..., 2); the centre of the top-left pixel is (0.5, 0.5).
        Ks: Camera matrices [px], shape (C, 3, 3).
        distortion: OpenCV's k1, k2, p1, p2 [, k3], shape (C, k).

    Returns:
        Directions in the camera frame (OpenCV axes), shape (C, ..., 3).
    """
    flat = pixels.reshape(1, -1, 2)
    focal = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1]], 1)[:, None]
    points = (flat - Ks[:, None, :2, 2]) / focal
    if distortion is not None:
        points = _undistort(points, distortion)
    rays = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    return torch.nn.functional.normalize(rays, dim=-1).reshape(Ks.shape[0], *pixels.shape[:-1], 3)


def _undistort(distorted: Tensor, distortion: Tensor) -> Tensor:
    """Invert OpenCV's distortion by fixed-point iteration; points (C, n, 2) on the plane z = 1."""
    k1, k2, p1, p2 = (distortion[:, None, index] for index in range(4))
    k3 = distortion[:, None, 4] if distortion.shape[1] > 4 else torch.zeros_like(k1)
    points = distorted
    for _ in range(_UNDISTORT_STEPS):
        x, y = points.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        points = (distorted - torch.stack([dx, dy], -1)) / radial[..., None]
    return points
