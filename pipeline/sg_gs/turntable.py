"""A film around what was fitted: one turn about the bodies, or about where the cameras looked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ..datasets.progress import progress
from ..datasets.video import encoded_video
from .sampling import look_at
from .splats.directions import upright_axes
from .splats.render import render
from .splats.spheres import Spheres
from .splats.views import View, as_bytes, focus_of
from .splats.volume import Array

FRAMES, FRAME_RATE_HZ = 60, 20.0
_WIDTH = 320
_LEAST_HEIGHT = 0.25  # of the distance: the film looks down a little even if all cameras stood level


@torch.no_grad()
def turntable(views: Sequence[View], bodies: Sequence[Spheres], scene: Spheres | None, up: Array) -> bytes:
    """Return an MP4 of one turn, seen from as far and as high as the photos.

    Args:
        views: The photos; the first one's camera makes the film.
        bodies: Visual spheres of the bodies, world frame.
        scene: The background, or None.
        up: The axis of the turn, a unit vector, world frame, shape (3,).
    """
    everything = Spheres.joined([*bodies, *([] if scene is None else [scene])])
    focus = _focus(views, bodies)
    away = np.stack([view.camera.center for view in views]) - focus
    high = float(np.median(away @ up))
    wide = float(np.median(np.linalg.norm(away - np.outer(away @ up, up), axis=1)))
    high = max(high, _LEAST_HEIGHT * float(np.hypot(high, wide)))
    first = views[0].camera
    camera = first.resized(_WIDTH, 2 * round(_WIDTH * first.height / first.width / 2))
    east, north, _ = upright_axes(up)
    frames = []
    for angle in progress(np.arange(FRAMES) * 2 * np.pi / FRAMES, "turntable"):
        eye = focus + high * up + wide * (np.cos(angle) * east + np.sin(angle) * north)
        camera = replace(camera, T_world_cam=look_at(eye, focus, up))
        viewmat = torch.as_tensor(camera.T_cam_world).to(everything.means)
        seen = everything.seen_from(torch.as_tensor(eye).to(everything.means))
        K = torch.as_tensor(camera.K).to(everything.means)
        picture = render(
            seen.means, seen.scales, seen.opacities, seen.colors, viewmat[None], K[None], camera.width, camera.height
        )
        frames.append(as_bytes(picture.features[0]))
    return encoded_video(frames, FRAME_RATE_HZ)


def upward(views: Sequence[View], normal: Sequence[float] | None) -> Array:
    """Return the axis that points up, world frame: the ground's normal, or the mean of the cameras' own up."""
    up = np.mean([-view.camera.T_world_cam[:3, 1] for view in views], axis=0) if normal is None else np.array(normal)
    return up / np.linalg.norm(up)


def _focus(views: Sequence[View], bodies: Sequence[Spheres]) -> Array:
    """Return the bodies' middle, or the point that the cameras' axes pass nearest to [m], (3,)."""
    if bodies:
        return torch.cat([body.means for body in bodies]).double().mean(0).cpu().numpy()
    return focus_of(views)
