"""A film around what was fitted: one turn about the bodies, or about where the cameras looked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets.progress import progress
from ..datasets.video import encoded_video
from .splats.render import render
from .splats.spheres import Spheres
from .splats.views import View, focus_of
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
    east = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    east /= np.linalg.norm(east)
    frames = []
    for angle in progress(np.arange(FRAMES) * 2 * np.pi / FRAMES, "turntable"):
        eye = focus + high * up + wide * (np.cos(angle) * east + np.sin(angle) * np.cross(up, east))
        viewmat = torch.as_tensor(_towards(eye, focus, up)).to(everything.means)
        seen = everything.seen_from(torch.as_tensor(eye).to(everything.means))
        K = torch.as_tensor(camera.K).to(everything.means)
        picture = render(
            seen.means, seen.scales, seen.opacities, seen.colors, viewmat[None], K[None], camera.width, camera.height
        )
        frames.append((picture.features[0].clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
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


def _towards(eye: Array, focus: Array, up: Array) -> NDArray[np.float64]:
    """Return T_cam_world of a camera at `eye` that looks at `focus`, OpenCV axes, (4, 4)."""
    forward = (focus - eye) / np.linalg.norm(focus - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, -rotation @ eye
    return T
