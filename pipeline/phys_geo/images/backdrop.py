"""Renders of the static scene of a video, over which the image loss draws the bodies."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...geometry.spheres import Spheres
from ...rendering.render import RenderOutput, render
from ...sg_gs.photos.views import camera_center
from .video_frames import Video


@dataclass(frozen=True, eq=False, kw_only=True)
class Backdrop:
    """Renders of the static scene of a video, and its camera's exposure."""

    plates: Tensor
    """Renders of the static scene, one for each camera pose, shape (P, H, W, 3)."""
    depths: Tensor
    """Median depth of the renders [m], infinite where nothing is seen, shape (P, H, W)."""
    plate_of: Tensor
    """Index of each frame's render, shape (T,)."""
    gain: Tensor
    """Exposure of the camera relative to the model's colours, by channel, shape (3,)."""
    unexplained: Tensor
    """Photometric error of each frame without bodies: sum of |gain plate - frame| / 3, shape (T,)."""


@torch.no_grad()
def backdrop_of(static: Spheres, video: Video, min_alpha: float) -> Backdrop:
    """Render the static scene from each camera pose of a video, and estimate the camera's exposure.

    Args:
        static: Spheres of everything that does not move.
        video: The video.
        min_alpha: As in :func:`render`.
    """
    poses, plate_of = torch.unique(video.viewmats.flatten(1), dim=0, return_inverse=True)
    views = []
    for pose in poses.view(-1, 1, 4, 4):
        seen = static.seen_from(camera_center(pose[0]))
        spheres = (seen.means, seen.scales, seen.opacities, seen.colors)
        views.append(render(*spheres, pose, video.K[None], *video.size, min_alpha=min_alpha, median=True))
    plates = torch.cat([view.features for view in views])
    depths = torch.cat([_median(view) for view in views])
    gain = _gain(video, plates, plate_of)
    unexplained = torch.stack(
        [
            ((gain * plates[plate]).clamp(0, 1) - frame).abs().sum() / 3
            for plate, frame in zip(plate_of, video.frames, strict=True)
        ]
    )
    return Backdrop(plates=plates, depths=depths, plate_of=plate_of, gain=gain, unexplained=unexplained)


def _median(view: RenderOutput) -> Tensor:
    """Return the median depth (1, H, W) [m], infinite where more than half of the light passes."""
    assert view.median_depth is not None
    return torch.where(view.median_depth > 0, view.median_depth, torch.inf)


def _gain(video: Video, plates: Tensor, plate_of: Tensor) -> Tensor:
    """Return the exposure (3,): the median ratio of frames to renders of the background where no body covers it."""
    behind = plates[plate_of]
    bright = behind > 0.1
    if video.covers is not None:
        bright = bright & (video.covers.sum(1) < 0.01)[..., None]
    gains = []
    for channel in range(3):
        rows = bright[..., channel]
        ratio = video.frames[..., channel][rows] / behind[..., channel][rows]
        gains.append(ratio.median() if ratio.numel() else ratio.new_tensor(1.0))
    return torch.stack(gains)
