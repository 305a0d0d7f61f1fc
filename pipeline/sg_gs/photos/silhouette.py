"""Silhouette of a body in a photo: its mask, the camera, and a depth map where there is one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...geometry.solid_grid import Array


@dataclass(frozen=True)
class Silhouette:
    """A mask and its camera."""

    mask: NDArray[np.bool_]
    """Whether each pixel shows the body, shape (H, W)."""
    K: Array
    """Camera matrix [px], shape (3, 3); the centre of the top-left pixel is (0.5, 0.5); no distortion."""
    T_cam_world: Array
    """World to camera, OpenCV axes, shape (4, 4)."""
    depth_m: NDArray[np.float32] | None = None
    """Depth along the optical axis [m], 0 where unknown, shape (H, W); None without a depth map."""

    @cached_property
    def surface(self) -> tuple[NDArray[np.float32], Array] | None:
        """Return depth [m] and cosine between each pixel's ray and the surface normal, (H, W); None without a map."""
        if self.depth_m is None:
            return None
        depth = np.where(self.depth_m > 0, self.depth_m, np.nan).astype(float)
        down, right = (slope / depth for slope in np.gradient(depth))
        cosine = np.nan_to_num(1 / np.sqrt(1 + (self.K[1, 1] * down) ** 2 + (self.K[0, 0] * right) ** 2))
        return self.depth_m, cosine

    def pixel_at(self, point: Array) -> float:
        """Return the width of a pixel [m] at the depth of a point, world frame, shape (3,)."""
        depth = self.T_cam_world[2, :3] @ point + self.T_cam_world[2, 3]
        return float(abs(depth) / self.K[0, 0])
