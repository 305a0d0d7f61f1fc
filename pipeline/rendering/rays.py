"""Rays through pixels, for pinhole cameras with and without OpenCV distortion."""

from __future__ import annotations

import torch
from torch import Tensor

UNDISTORT_STEPS = 10
"""Number of Newton steps; each doubles the number of digits."""
LEAST_DETERMINANT = 1e-3
"""Minimum determinant of the distortion's Jacobian, which bounds the steps where the distortion folds."""


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
        points = undistort(points, distortion)
    rays = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    return torch.nn.functional.normalize(rays, dim=-1).reshape(Ks.shape[0], *pixels.shape[:-1], 3)


def undistort(distorted: Tensor, distortion: Tensor) -> Tensor:
    """Invert OpenCV's distortion by Newton's method; points (C, n, 2) on the plane z = 1.

    From the distorted point the iteration converges to the nearer root, for barrel and for pincushion distortion
    (derived: along a radius the distortion is concave or convex, and the start lies where Newton's method is monotone).
    """
    k1, k2, p1, p2 = (distortion[:, None, index] for index in range(4))
    k3 = distortion[:, None, 4] if distortion.shape[1] > 4 else torch.zeros_like(k1)
    u, v = distorted.unbind(-1)
    x, y = u, v
    for _ in range(UNDISTORT_STEPS):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        off_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - u
        off_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - v
        xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
        yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        determinant = (xx * yy - xy * xy).clamp_min(LEAST_DETERMINANT)
        x = x - (yy * off_x - xy * off_y) / determinant
        y = y - (xx * off_y - xy * off_x) / determinant
    return torch.stack([x, y], -1)
