"""Crops of video frames around the moving bodies, all of the same size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from .video_frames import Video

_TILE = 8
"""Crops begin on multiples of the renderer's tile [px], so that tiles and blocks of pixels stay in place."""


@dataclass(frozen=True, eq=False)
class Window:
    """Rectangles of one size in frames of a video."""

    frames: Tensor
    """Index of the frame of each rectangle, shape (S,)."""
    corners: Tensor
    """Upper left corners [px], shape (S, 2)."""
    size: tuple[int, int]
    """Width and height [px]."""

    def cut(self, pictures: Tensor, which: Tensor | None = None) -> Tensor:
        """Return the rectangles (S, h, w, F) of images (T, H, W, F); `which`: images instead of the window's frames."""
        frames = self.frames if which is None else which
        return pictures[frames[:, None, None], *self._pixels]

    @cached_property
    def _pixels(self) -> tuple[Tensor, Tensor]:
        """Rows (S, h, 1) and columns (S, 1, w)."""
        columns = self.corners[:, :1] + torch.arange(self.size[0], device=self.corners.device)
        rows = self.corners[:, 1:] + torch.arange(self.size[1], device=self.corners.device)
        return rows[:, :, None], columns[:, None, :]

    def repeat(self, times: int) -> Window:
        """Return the windows repeated the given number of times."""
        return Window(self.frames.repeat(times), self.corners.repeat(times, 1), self.size)


def window_of(video: Video, frames: Tensor, means: Tensor, reach: Tensor, margin: int = 0) -> Window:
    """Return windows that contain the visible parts of spheres.

    Args:
        video: The video.
        frames: A frame of it for each window, shape (S,).
        means: Centres of the spheres at that frame [m], world, shape (S, N, 3).
        reach: Distance from a sphere's centre at which it is too faint to be drawn [m], shape (N,).
        margin: Additional pixels on each side.
    """
    with torch.no_grad():
        viewmats = video.viewmats[frames]
        local = means @ viewmats[:, :3, :3].transpose(1, 2) + viewmats[:, None, :3, 3]
        depth = local[..., 2]
        seen = (depth > reach)[..., None]
        # off the optical axis a sphere appears as an ellipse, longer than the disc on the axis by this factor
        away = depth.clamp_min(1e-3)[..., None]
        middle = local[..., :2] / away
        radius = reach[:, None] / away * (1 + middle.square().sum(-1, keepdim=True))
        low = torch.where(seen, middle - radius, torch.inf).amin(1) * video.K.diagonal()[:2] + video.K[:2, 2]
        high = torch.where(seen, middle + radius, -torch.inf).amax(1) * video.K.diagonal()[:2] + video.K[:2, 2]
        extent = torch.tensor(video.size).to(low)
        low = (low - margin).clamp_min(0).minimum(extent)
        high = (high + margin).clamp_min(0).minimum(extent)
        low = (low / _TILE).floor() * _TILE
        span = (high - low).clamp_min(1).amax(0).tolist()  # one wait for the device
        size = [min(video.size[k], math.ceil(span[k] / _TILE) * _TILE) for k in (0, 1)]
        corners = low.minimum(extent - extent.new_tensor(size)).clamp_min(0).to(torch.int64)
        return Window(frames, corners, (size[0], size[1]))
