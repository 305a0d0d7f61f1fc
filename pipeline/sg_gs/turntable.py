"""Turntable film: one turn around the bodies, or around the focus of the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ...datasets.capture.video import encoded_video
from ...datasets.io.progress import progress
from ..geometry.directions import upright_axes
from ..geometry.solid_grid import Array
from ..geometry.spheres import Spheres
from ..geometry.viewpoint import look_at
from ..rendering.render import render
from .photos.views import View, as_bytes, focus_of

FRAMES, FRAME_RATE_HZ = 60, 20.0
_WIDTH = 320
_LEAST_HEIGHT = 0.25  # of the distance: the film looks down a little even if all cameras were level


@torch.no_grad()
def turntable(views: Sequence[View], bodies: Sequence[Spheres], scene: Spheres | None, up: Array) -> bytes:
    """Return an MP4 of one turn, from the distance and height of the photos.

    Args:
        views: The photos; the film uses the intrinsics of the first.
        bodies: Visual spheres of the bodies, world frame.
        scene: The background, or None.
        up: Unit vector along the axis of the turn, world frame, shape (3,).
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
    """Return the axis that points up, world frame: the normal of the ground, or the mean of the cameras' up axes."""
    up = np.mean([-view.camera.T_world_cam[:3, 1] for view in views], axis=0) if normal is None else np.array(normal)
    return up / np.linalg.norm(up)


def _focus(views: Sequence[View], bodies: Sequence[Spheres]) -> Array:
    """Return the middle of the bodies, or the point nearest to the optical axes [m], world frame, shape (3,)."""
    if bodies:
        return torch.cat([body.means for body in bodies]).double().mean(0).cpu().numpy()
    return focus_of(views)
