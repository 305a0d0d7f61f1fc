"""The light on moving bodies, estimated from videos of motions that were measured; `splats.relighting` applies it."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datasets.capture import Capture
from ..datasets.models import Model
from ..datasets.tracks import Track
from ..schemas import Exposure, Light
from .image_errors import usable_cameras, video_view
from .physics.driven import Drive
from .physics.rotation import quat_to_matrix
from .splats.relighting import light_basis
from .splats.render import render

Array = NDArray[np.float64]

EPISODES, FRAMES = 4, 12
"""Episodes to look at, and frames of each camera of an episode."""
BLOCK_PX = 4
"""Means over blocks of this side are compared: texture that is a little off cancels in them."""
MIN_BLOCKS = 200
MIN_ALPHA = 0.95
SATURATED = (0.03, 0.97)
PRIOR_STD = 0.3
"""Spread of a coefficient before any data; daylight from one side has about 0.4."""
BLOCK_STD = 0.08
"""Relative error of a block's brightness that the texture leaves; with the prior it says what few blocks may tell."""
IRLS_STEPS = 12


def estimate_light(
    model: Model, capture: Capture, exposures: dict[str, Exposure], split: str = "train", device: str = "cpu"
) -> Light | None:
    """Estimate the light from videos of bodies whose poses were measured.

    Args:
        model: With spheres of the bodies.
        capture: With calibrated cameras, videos and tracks.
        exposures: Of the video cameras; others are not looked at.
        split: The episodes to look at.
        device: Where to render.

    Returns:
        The light, or None where too little of a moving body is seen.
    """
    rows: list[tuple[Array, Array, Array]] = []
    for episode in capture.episodes(split)[:EPISODES]:
        tracks = capture.tracks(episode)
        for camera in usable_cameras(capture, episode)[0]:
            if camera not in exposures:
                continue
            for index, body in enumerate(model.file.bodies):
                track = tracks.get(body.name)
                splats = model.body_splats.get(body.name)
                shown = body.motion == "free" and splats is not None and splats.normals is not None
                if shown and track is not None and track.quat_wxyz is not None:
                    rows += _observed(model, capture, exposures[camera], camera, episode, index, track, device)
    if sum(len(ratio) for ratio, _, _ in rows) < MIN_BLOCKS:
        return None
    ratio, now, photo = (np.concatenate([row[k] for row in rows]) for k in range(3))
    return fit_light(ratio, now, photo)


def fit_light(ratio: Array, normals_now: Array, normals_photo: Array) -> Light:
    """Fit L to brightness ratios: ratio * L(n_photo) = L(n_now), linear in the coefficients, robustly.

    Args:
        ratio: Brightness in a frame over that of the photos' colours, shape (n,).
        normals_now: Normals in the frame, world, shape (n, 3).
        normals_photo: Of the same places in the photos, world, shape (n, 3).
    """
    now, photo = (light_basis(torch.as_tensor(n)).numpy() for n in (normals_now, normals_photo))
    design, wanted = now - ratio[:, None] * photo, ratio - 1
    prior = np.eye(8) * (BLOCK_STD / PRIOR_STD) ** 2
    weight = np.ones(len(ratio))
    for _ in range(IRLS_STEPS):
        fit = np.linalg.solve(design.T @ (design * weight[:, None]) + prior, design.T @ (wanted * weight))
        residual = wanted - design @ fit
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = 1 / (1 + np.square(residual / (2 * scale)))
    return Light(coefficients=tuple(float(value) for value in fit))


@torch.no_grad()
def _observed(
    model: Model,
    capture: Capture,
    exposure: Exposure,
    camera: str,
    episode: str,
    index: int,
    track: Track,
    device: str,
) -> list[tuple[Array, Array, Array]]:
    """Return brightness ratios (n,) and normals now and in the photos (n, 3) of blocks on a body, frame by frame."""
    body = model.file.bodies[index]
    splats = model.body_splats[body.name]
    times = capture.frame_times(camera, episode)
    inside = np.flatnonzero((times >= track.time_s[0] - 1e-6) & (times <= track.time_s[-1] + 1e-6))
    if not len(inside):
        return []
    chosen = np.unique(inside[np.linspace(0, len(inside) - 1, FRAMES).round().astype(int)])
    frames, numbers = capture.video_frames(camera, episode), capture.frame_numbers(camera, episode)
    masks = capture.video_masks(camera, episode)

    def tensor(values: object) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

    means, colors, normals = tensor(splats.means), tensor(splats.colors), tensor(splats.normals)
    drive = Drive.of([track], torch.zeros(0, dtype=torch.float64))
    photo_rotation = quat_to_matrix(tensor(body.photo_pose.quat_wxyz)).cpu().numpy().astype(np.float64)
    found = []
    for k in chosen:
        pose = drive.at(torch.tensor([times[k]], dtype=torch.float64))
        rotation = quat_to_matrix(pose.quat_wxyz[0])
        view = video_view(capture, camera, episode, int(numbers[k]), frames.shape[2:0:-1])
        real, plain = view.undistorted(frames[k])
        world = means @ rotation.to(means).T + pose.com[0].to(means)
        picture = render(
            world,
            tensor(splats.scales),
            tensor(splats.opacities),
            torch.cat([colors, normals], 1),
            tensor(plain.T_cam_world)[None],
            tensor(plain.K)[None],
            plain.width,
            plain.height,
        )
        features = picture.features[0].cpu().numpy().astype(np.float64)
        usable = picture.alpha[0].cpu().numpy() > MIN_ALPHA
        usable &= view.undistorted(np.full(real.shape[:2], 255, np.uint8))[0] == 255
        if masks is not None:
            usable &= view.undistorted(masks[k], labels=True)[0] == index + 1
        usable = cv2.erode(usable.astype(np.uint8), np.ones((3, 3))) > 0
        image = real.astype(np.float64) / 255
        usable &= (image > SATURATED[0]).all(-1) & (image < SATURATED[1]).all(-1)
        gain, offset = np.asarray(exposure.gain_rgb), np.asarray(exposure.offset_rgb)
        table = np.concatenate(
            (((image - offset) / gain).sum(-1)[..., None], features[..., :3].sum(-1)[..., None], features[..., 3:]), -1
        )
        blocks = _blocks(table, usable)
        if not len(blocks):
            continue
        direction = blocks[:, 2:]
        length = np.linalg.norm(direction, axis=1)
        flat = (length > 0.8) & (blocks[:, 1] > 0.05)  # not across an edge
        direction = direction[flat] / length[flat, None]
        found.append(
            (
                blocks[flat, 0] / blocks[flat, 1],
                direction @ rotation.numpy().T,
                direction @ photo_rotation.T,
            )
        )
    return found


def _blocks(table: Array, usable: NDArray[np.bool_]) -> Array:
    """Return the means (n, C) of the blocks of a table (H, W, C) all of whose pixels are usable."""
    height, width = (size // BLOCK_PX for size in usable.shape)
    whole = table[: height * BLOCK_PX, : width * BLOCK_PX].reshape(height, BLOCK_PX, width, BLOCK_PX, -1)
    full = usable[: height * BLOCK_PX, : width * BLOCK_PX].reshape(height, BLOCK_PX, width, BLOCK_PX).all((1, 3))
    return whole.mean((1, 3))[full]
