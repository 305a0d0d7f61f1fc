"""Exposure of video cameras: gain and offset from the model's colours to theirs.

Only the static background is compared: the scene's spheres without moving bodies, with the first and last frame of a
few episodes.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ....datasets.capture.capture import Capture
from ....datasets.models.model import Model
from ....datasets.shapes.ply import Splats
from ....schemas import Exposure
from ...geometry.rotation import quat_to_matrix
from ...geometry.spheres import Spheres
from ...rendering.render import render
from ...rendering.video_view import usable_cameras, video_view

Array = NDArray[np.floating]
Blocks = tuple[Array, Array]
"""Mean colours of blocks of pixels, in the model and in the frame, each of shape (n, 3)."""

EPISODES = 2
"""Maximum number of episodes of a camera that are compared."""
BLOCK_PX = 4
"""Side of the blocks whose mean colours are compared [px]; noise, blur and errors of cameras mostly cancel in them."""
MARGIN_PX = 12
"""Minimum distance of compared pixels from a mask [px], because of the body's blur and contact shadow."""
MIN_ALPHA = 0.95
"""Minimum opacity of the rendered scene in compared pixels."""
SATURATED = (0.02, 0.98)
"""Range of colours that the sensor does not clip."""
MIN_BLOCKS = 64
"""Minimum number of blocks for estimating a camera's exposure."""
OFFSET_GAIN = 0.8
"""Maximum ratio of the robust cost with an offset to that without for the offset to be used."""
MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
IRLS_STEPS = 20
"""Number of iterations of re-weighted least squares."""


def estimate_exposures(
    model: Model, capture: Capture, split: str = "train", device: str = "auto"
) -> dict[str, Exposure]:
    """Estimate the exposure of each calibrated video camera against the model's scene.

    Args:
        model: Model with a scene.
        capture: Capture with calibrated cameras and videos.
        split: Name of the episodes.
        device: Device of the renderer: auto, cpu or cuda.

    Returns:
        Exposure by video camera, image = gain * model + offset; cameras that see too little of the scene are left out.
    """
    if model.scene is None:
        return {}
    from ...runtime.device import resolve_device

    background = _background(model, model.scene, resolve_device(device))
    episodes: dict[str, list[str]] = {}
    for episode in capture.episodes(split):
        for camera in usable_cameras(capture, episode)[0]:
            episodes.setdefault(camera, []).append(episode)
    found = {}
    for camera, names in sorted(episodes.items()):
        parts = [pair for name in names[:EPISODES] for pair in _pairs(capture, background, camera, name)]
        seen, real = (np.concatenate([pair[k] for pair in parts]) for k in (0, 1))
        if len(seen) >= MIN_BLOCKS:
            found[camera] = fit_exposure(seen, real)
    return found


def fit_exposure(model_rgb: Array, image_rgb: Array) -> Exposure:
    """Fit image = gain * model + offset robustly to each channel.

    Cauchy weights with the residuals' median absolute deviation as their scale reduce the influence of shadows and of
    objects that are not in the model. The offset stays 0 unless it explains the image clearly better.

    Args:
        model_rgb: Colours of the model in [0, 1], shape (n, 3).
        image_rgb: Colours of the image at the same places, shape (n, 3).
    """
    gains = [_line(model_rgb[:, k : k + 1], image_rgb[:, k]) for k in range(3)]
    designs = [np.stack((model_rgb[:, k], np.ones(len(model_rgb))), 1) for k in range(3)]
    lines = [_line(design, image_rgb[:, k]) for k, design in enumerate(designs)]
    without = sum(_cost(image_rgb[:, k] - model_rgb[:, k] * fit[0], scale) for k, (fit, scale) in enumerate(gains))
    with_offset = sum(_cost(image_rgb[:, k] - designs[k] @ lines[k][0], gains[k][1]) for k in range(3))
    if with_offset < OFFSET_GAIN * without:
        return Exposure(gain_rgb=_three([fit[0] for fit, _ in lines]), offset_rgb=_three([fit[1] for fit, _ in lines]))
    return Exposure(gain_rgb=_three([fit[0] for fit, _ in gains]))


def _line(design: Array, values: Array) -> tuple[Array, float]:
    """Return coefficients of a robust linear fit, and the scale of its residuals."""
    fit, *_ = np.linalg.lstsq(design, values, rcond=None)
    scale = 1e-4
    for _ in range(IRLS_STEPS):
        residual = values - design @ fit
        scale = max(MAD_TO_STD * float(np.median(np.abs(residual))), 1e-4)
        weight = np.sqrt(1 / (1 + np.square(residual / scale)))
        fit, *_ = np.linalg.lstsq(design * weight[:, None], values * weight, rcond=None)
    return fit, scale


def _cost(residual: Array, scale: float) -> float:
    """Return the sum of the Cauchy loss of residuals (n,)."""
    return float(np.log1p(np.square(residual / scale)).sum())


def _background(model: Model, scene: Splats, device: torch.device) -> Spheres:
    """Return the spheres of the scene and of the fixed bodies."""
    parts = [Spheres.from_numpy(scene, device=device)]
    for body in model.file.bodies:
        splats: Splats | None = model.body_splats.get(body.name)
        if body.motion == "fixed" and splats is not None:
            T_world_body = torch.eye(4, device=device)
            T_world_body[:3, :3] = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz, device=device))
            T_world_body[:3, 3] = torch.tensor(body.photo_pose.position_m, device=device)
            parts.append(Spheres.from_numpy(splats, device=device).moved(T_world_body))
    return Spheres.joined(parts)


def _pairs(capture: Capture, background: Spheres, camera: str, episode: str) -> list[Blocks]:
    """Return colours of model and image for the first and the last frame of a video."""
    frames, numbers = capture.video_frames(camera, episode), capture.frame_numbers(camera, episode)
    masks = capture.video_masks(camera, episode)
    found = []
    for k in sorted({0, len(frames) - 1}):
        view = video_view(capture, camera, episode, int(numbers[k]), frames.shape[2:0:-1])
        real, plain = view.undistorted(frames[k])
        usable = view.undistorted(np.full(real.shape[:2], 255, np.uint8))[0] == 255
        if masks is not None:
            labels = view.undistorted(masks[k], labels=True)[0]
            usable &= cv2.dilate((labels > 0).astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)) == 0
        with torch.no_grad():
            viewmat, K = (torch.as_tensor(a).to(background.means)[None] for a in (plain.T_cam_world, plain.K))
            size = (plain.width, plain.height)
            seen = background.seen_from(torch.as_tensor(plain.center))
            picture = render(seen.means, seen.scales, seen.opacities, seen.colors, viewmat, K, *size)
        usable &= picture.alpha[0].cpu().numpy() > MIN_ALPHA
        found.append(_blocks(picture.features[0].cpu().numpy(), real.astype(np.float32) / 255, usable))
    return found


def _blocks(model: NDArray, image: NDArray, usable: NDArray[np.bool_]) -> Blocks:
    """Return the mean colours of the blocks whose pixels are all usable and not saturated."""
    height, width = (size // BLOCK_PX for size in usable.shape)
    if min(height, width) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    low, high = SATURATED
    usable = usable & (image > low).all(-1) & (image < high).all(-1) & (model > low).all(-1) & (model < high).all(-1)

    def cut(values: NDArray) -> NDArray:
        whole = values[: height * BLOCK_PX, : width * BLOCK_PX].astype(np.float64)
        return whole.reshape(height, BLOCK_PX, width, BLOCK_PX, *values.shape[2:]).mean((1, 3))

    chosen = cut(usable) == 1
    return cut(model)[chosen], cut(image)[chosen]


def _three(values: list[float]) -> tuple[float, float, float]:
    """Return three channels as a tuple."""
    red, green, blue = (float(value) for value in values)
    return red, green, blue
