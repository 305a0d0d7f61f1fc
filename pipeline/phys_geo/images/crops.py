"""Windows: equal rectangles of video frames around the moving bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .footage import Video

_TILE = 8
"""Windows begin on multiples of the renderer's tile [px]: tiles, and squares of pixels, stay in place."""


@dataclass(frozen=True, eq=False)
class Window:
    """Equal rectangles in some frames of a video: frames (S,), corners (S, 2) [px], size (width, height)."""

    frames: Tensor
    corners: Tensor
    size: tuple[int, int]

    def cut(self, pictures: Tensor, which: Tensor | None = None) -> Tensor:
        """Return the rectangles of pictures (T, H, W, F), those of `which` or the window's frames: (S, h, w, F)."""
        columns = self.corners[:, :1] + torch.arange(self.size[0], device=self.corners.device)
        rows = self.corners[:, 1:] + torch.arange(self.size[1], device=self.corners.device)
        frames = self.frames if which is None else which
        return pictures[frames[:, None, None], rows[:, :, None], columns[:, None, :]]

    def repeat(self, times: int) -> Window:
        """Return the windows one after the other, as often as told."""
        return Window(self.frames.repeat(times), self.corners.repeat(times, 1), self.size)


def window_of(video: Video, frames: Tensor, means: Tensor, reach: Tensor, margin: int = 0) -> Window:
    """Return windows that hold spheres as far as they are in the picture.

    Args:
        video: The video.
        frames: A frame of it for each window, shape (S,).
        means: Centres of the spheres at that frame [m], world, shape (S, N, 3).
        reach: Distance from its centre [m] at which a sphere is too faint to be drawn, shape (N,).
        margin: Further pixels on each side.
    """
    with torch.no_grad():
        viewmats = video.viewmats[frames]
        local = means @ viewmats[:, :3, :3].transpose(1, 2) + viewmats[:, None, :3, 3]
        depth = local[..., 2]
        seen = (depth > reach)[..., None]
        # a sphere seen off the axis is an ellipse that is longer than the disc of one on it: hence the factor
        away = depth.clamp_min(1e-3)[..., None]
        middle = local[..., :2] / away
        radius = reach[:, None] / away * (1 + middle.square().sum(-1, keepdim=True))
        low = torch.where(seen, middle - radius, torch.inf).amin(1) * video.K.diagonal()[:2] + video.K[:2, 2]
        high = torch.where(seen, middle + radius, -torch.inf).amax(1) * video.K.diagonal()[:2] + video.K[:2, 2]
        extent = torch.tensor(video.size).to(low)
        low = (low - margin).clamp_min(0).minimum(extent)
        high = (high + margin).clamp_min(0).minimum(extent)
        low = (low / _TILE).floor() * _TILE
        span = (high - low).clamp_min(1).amax(0)
        size = [min(int(extent[k]), math.ceil(float(span[k]) / _TILE) * _TILE) for k in (0, 1)]
        corners = low.minimum(extent - extent.new_tensor(size)).clamp_min(0).to(torch.int64)
        return Window(frames, corners, (size[0], size[1]))
