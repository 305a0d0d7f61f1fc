"""Light and colours of bodies from frames of a measured motion: the light on a body, and sides that no photo shows.

The spheres have the colours of the photos, in which the body is at rest and hides its underside. Frames of a motion
with known poses show its sides in other light. The ratios of brightness identify the light (`rendering.relighting`
applies it), and with the light the frames give the colours of the sides that the photos do not show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.cameras import Camera
from ....datasets.capture.capture import Capture
from ....datasets.capture.tracks import Track
from ....datasets.models.model import Model
from ....datasets.shapes.ply import Splats
from ....schemas import Exposure, Light
from ...geometry.rotation import quat_to_matrix
from ...geometry.spheres import Spheres
from ...physics.kinematic import Drive
from ...rendering.relighting import Relighting, light_terms
from ...rendering.render import RenderOutput, render
from ...rendering.video_view import usable_cameras, video_view
from ...runtime.device import resolve_device
from ...sg_gs.appearance.colors import sphere_weights
from ...sg_gs.photos.views import load_views
from .edge_colors import even_edges

Array = NDArray[np.float64]

EPISODES, FRAMES = 4, 12
"""Maximum number of episodes, and of frames of each camera of an episode."""
PHOTOS, PHOTO_SIZE = 16, 320
"""Maximum number of photos, evenly spread, from which seen spheres are determined, and their longer side [px]."""
SEEN_PX = 2.0
"""Minimum total weight of a seen sphere in all these photos, or in all frames [px]."""
BLOCK_PX = 4
"""Side of the blocks whose means are compared [px]; slightly displaced texture cancels in them."""
MIN_BLOCKS = 200
"""Minimum number of blocks for estimating the light."""
MIN_ALPHA = 0.95
"""Minimum opacity of the rendered body in compared pixels."""
SATURATED = (0.03, 0.97)
"""Range of colours that the sensor does not clip."""
PRIOR_MEAN, PRIOR_STD = np.array([0.0, 0.0, 0.6, 0.2]), np.array([0.5, 0.5, 0.5, 0.1])
"""Mean and standard deviation of the prior of lamp and sky: a lamp overhead about as bright as the room, and a floor
that reflects some light."""
SIDE_STD = 0.05
"""Relative error of a side's brightness in a frame, whose texture differs slightly from the photos'."""
SIDE_DEG, SIDE_BLOCKS = 20.0, 4
"""Largest angle between the normals of a side's blocks and that in their middle, and the fewest blocks of a side."""
IRLS_STEPS = 20
"""Number of iterations of re-weighted least squares."""
FACING = 0.15
"""Minimum cosine between a visible surface's normal and the direction to the camera; it excludes surfaces that shine
through the rim of a body or of the ground in front of it."""


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """A body in a frame of a video."""

    body: int
    """Index of the body in the model."""
    normals: NDArray[np.floating]
    """Normals of its spheres, body frame, shape (N, 3)."""
    image: Array
    """Colours of the frame, converted to the model's exposure, shape (H, W, 3)."""
    usable: NDArray[np.bool_]
    """Pixels that show the body and are not saturated, shape (H, W)."""
    camera: Camera
    """Undistorted camera of the frame."""
    rotation: Tensor
    """Rotation of the body, R_world_body, shape (3, 3)."""
    position: Tensor
    """Origin of the body's frame [m], world, shape (3,)."""


def learn_appearance(
    model: Model,
    capture: Capture,
    exposures: dict[str, Exposure],
    split: str = "train",
    found: Mapping[str, dict[str, Track]] | None = None,
    device: str = "auto",
) -> Model:
    """Add the light to a model, and the colours of spheres that only the motion shows.

    Args:
        model: Model with spheres of the bodies, and their normals.
        capture: Capture with calibrated cameras, photos, videos and measured tracks.
        exposures: Exposure by video camera; other cameras are not used.
        split: Name of the episodes.
        found: Tracks found in the videos, by episode and body, instead of measured ones; None for measured ones.
        device: Device of the renderer: auto, cpu or cuda.

    Returns:
        The model, unchanged if too little of a moving body is seen.
    """
    frames, drawn_on = _frames(model, capture, exposures, split, found), resolve_device(device)
    moving = {model.file.bodies[frame.body].name for frame in frames}
    seen = {name: _seen(model, capture, name, drawn_on) for name in moving}
    rows = [row for frame in frames if (row := _ratios(model, frame, seen, drawn_on)) is not None]
    sides = [side for row in rows for side in _sides(*row)]
    if sum(len(ratio) for ratio, _, _ in rows) < MIN_BLOCKS or not sides:
        return model
    ratio, now, photo = (np.stack([side[k] for side in sides]) for k in range(3))
    light = fit_light(ratio, now, photo, len(ratio))
    splats, collision = dict(model.body_splats), dict(model.collision)
    for index, body in enumerate(model.file.bodies):
        mine = [frame for frame in frames if frame.body == index]
        if mine:
            splats[body.name] = even_edges(_colored(model, index, mine, light, seen[body.name], drawn_on))
            # where the visual spheres collide, they stay one set
            if model.collision.get(body.name) is model.body_splats[body.name]:
                collision[body.name] = splats[body.name]
    file = model.file.model_copy(update={"light": light})
    return replace(model, file=file, body_splats=splats, collision=collision)


def fit_light(ratio: Array, normals_now: Array, normals_photo: Array, independent: float) -> Light:
    """Fit L to brightness ratios, ratio * L(n_photo) = L(n_now), robustly and from several directions of the lamp.

    Args:
        ratio: Brightness in a frame over that of the photos' colours, shape (n,).
        normals_now: Normals in the frame, world, shape (n, 3).
        normals_photo: Normals of the same places in the photos, world, shape (n, 3).
        independent: Number of independent ratios.
    """
    share = min(1.0, independent / len(ratio))
    starts = [0.5 * np.array([x, y, 1.0]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    found = [_light_from(start, ratio, normals_now, normals_photo, share) for start in starts]
    x, y, z, sky = (float(value) for value in min(found, key=lambda one: one[0])[1])
    return Light(lamp=(x, y, z), sky=min(max(sky, -1.0), 1.0))


def _light_from(lamp: Array, ratio: Array, now: Array, photo: Array, share: float) -> tuple[float, Array]:
    """Return the cost of a light and its parameters (4,), by least squares with Cauchy weights from a first lamp (3,).

    On each side of the terminator the residuals are linear, so that each step is a linear problem.
    """
    seen, pictured = torch.as_tensor(now), torch.as_tensor(photo)
    prior = np.diag(1 / np.square(PRIOR_STD))
    fit: Array = np.array([*lamp, PRIOR_MEAN[3]])
    best, light = math.inf, fit
    for _ in range(IRLS_STEPS):
        terms = [light_terms(normals, torch.as_tensor(fit[:3])).numpy() for normals in (seen, pictured)]
        design, wanted = terms[0] / ratio[:, None] - terms[1], 1 - 1 / ratio  # errors are relative to the brightness
        residual = wanted - design @ fit
        scale = max(1.4826 * float(np.median(np.abs(residual))), SIDE_STD / 2)
        weight = 1 / (1 + np.square(residual / (2 * scale)))
        away = fit - PRIOR_MEAN
        cost = share * float(np.log1p(np.square(residual / SIDE_STD)).sum()) + float(away @ prior @ away)
        if cost < best:
            best, light = cost, fit
        weighted = share / SIDE_STD**2 * design.T * weight
        fit = np.linalg.solve(weighted @ design + prior, weighted @ wanted + prior @ PRIOR_MEAN).astype(np.float64)
    return best, light


def _frames(
    model: Model,
    capture: Capture,
    exposures: dict[str, Exposure],
    split: str,
    known: Mapping[str, dict[str, Track]] | None,
) -> list[_Frame]:
    """Return the frames of moving bodies with known poses, in cameras with known exposure."""
    found = []
    for episode in capture.episodes(split)[:EPISODES]:
        tracks = capture.tracks(episode) if known is None else known.get(episode, {})
        for camera in usable_cameras(capture, episode)[0]:
            if camera not in exposures:
                continue
            for index, body in enumerate(model.file.bodies):
                track, splats = tracks.get(body.name), model.body_splats.get(body.name)
                if body.motion != "free" or splats is None or splats.normals is None:
                    continue
                if track is not None and track.quat_wxyz is not None:
                    found += _body_frames(capture, exposures[camera], camera, episode, index, splats.normals, track)
    return found


def _body_frames(
    capture: Capture,
    exposure: Exposure,
    camera: str,
    episode: str,
    index: int,
    normals: NDArray[np.floating],
    track: Track,
) -> list[_Frame]:
    """Return frames of one body in one video, evenly spread over its track."""
    times = capture.frame_times(camera, episode)
    inside = np.flatnonzero((times >= track.time_s[0] - 1e-6) & (times <= track.time_s[-1] + 1e-6))
    if not len(inside):
        return []
    chosen = np.unique(inside[np.linspace(0, len(inside) - 1, FRAMES).round().astype(int)])
    frames, numbers = capture.video_frames(camera, episode), capture.frame_numbers(camera, episode)
    masks = capture.video_masks(camera, episode)
    drive = Drive.of([track], torch.zeros(0, dtype=torch.float64))
    gain, offset = np.asarray(exposure.gain_rgb), np.asarray(exposure.offset_rgb)
    found = []
    for k in chosen:
        pose = drive.at(torch.tensor([times[k]], dtype=torch.float64))
        view = video_view(capture, camera, episode, int(numbers[k]), frames.shape[2:0:-1])
        real, plain = view.undistorted(frames[k])
        image = real.astype(np.float64) / 255
        usable = view.undistorted(np.full(real.shape[:2], 255, np.uint8))[0] == 255
        usable &= (image > SATURATED[0]).all(-1) & (image < SATURATED[1]).all(-1)
        if masks is not None:
            label = (view.undistorted(masks[k], labels=True)[0] == index + 1).astype(np.uint8)
            usable &= cv2.erode(label, np.ones((3, 3))) > 0
        rotation = quat_to_matrix(pose.quat_wxyz[0])
        found.append(
            _Frame(
                body=index,
                normals=normals,
                image=(image - offset) / gain,
                usable=usable,
                camera=plain,
                rotation=rotation,
                position=pose.com[0],
            )
        )
    return found


def _seen(model: Model, capture: Capture, name: str, device: torch.device) -> NDArray[np.bool_]:
    """Return which spheres (N,) of a body the photos show."""
    splats = model.body_splats[name]
    if capture.cameras is None:
        return np.ones(len(splats), bool)
    posed = [photo for photo in capture.photos() if photo in capture.cameras.images]
    picked = np.unique(np.linspace(0, len(posed) - 1, PHOTOS).round().astype(int)) if posed else []
    views = load_views(capture, [posed[k] for k in picked], PHOTO_SIZE, device)
    parts = []
    for body in [
        next(b for b in model.file.bodies if b.name == name),
        *(b for b in model.file.bodies if b.name != name),
    ]:
        if body.name in model.body_splats:
            T_world_body = torch.eye(4)
            T_world_body[:3, :3] = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz))
            T_world_body[:3, 3] = torch.tensor(body.photo_pose.position_m)
            spheres = Spheres.from_numpy(model.body_splats[body.name], device=device)
            parts.append(spheres.moved(T_world_body.to(device)))
    if model.scene is not None:
        parts.append(Spheres.from_numpy(model.scene, device=device))
    spheres, normals = Spheres.joined(parts), _resting_normals(model, name)
    weight = torch.zeros(len(splats), device=device)
    for view in views:
        facing = _facing(parts[0].means, normals, torch.as_tensor(view.camera.center))
        weight += sphere_weights(spheres, view)[: len(splats)] * facing
    return (weight >= SEEN_PX).cpu().numpy()


def _resting_normals(model: Model, name: str) -> Tensor:
    """Return the normals (N, 3) of a body's spheres at its pose in the photos, world frame."""
    body = next(body for body in model.file.bodies if body.name == name)
    rotation = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz, dtype=torch.float64))
    return torch.as_tensor(model.body_splats[name].normals, dtype=torch.float64) @ rotation.T


def _facing(means: Tensor, normals: Tensor, eye: Tensor) -> Tensor:
    """Return which surfaces face a camera at `eye` (3,), as 0 or 1 (N,); means and normals (N, 3), world frame."""
    way = eye.to(means) - means
    return ((way * normals.to(means)).sum(-1) > FACING * way.norm(dim=-1)).to(means)


@torch.no_grad()
def _ratios(
    model: Model, frame: _Frame, seen: dict[str, NDArray[np.bool_]], device: torch.device
) -> tuple[Array, Array, Array] | None:
    """Return brightness ratios (n,), and normals in frame and photos (n, 3), of blocks on a body that photos show."""
    body = model.file.bodies[frame.body]
    splats = model.body_splats[body.name]
    known = seen[body.name].astype(np.float64)[:, None]
    shown = np.concatenate([splats.colors, frame.normals, known], 1).astype(float)
    features, alpha = _pictured(splats, frame, shown, device)
    brightness = [frame.image.sum(-1)[..., None], features[..., :3].sum(-1)[..., None]]
    blocks = _blocks(np.concatenate([*brightness, features[..., 3:]], -1), frame.usable & (alpha > MIN_ALPHA))
    length = np.linalg.norm(blocks[:, 2:5], axis=1)
    kept = (length > 0.95) & (blocks[:, 1] > 0.05) & (blocks[:, 5] > 0.9)  # not across an edge
    if not kept.any():
        return None
    direction = blocks[kept, 2:5] / length[kept, None]
    resting = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz, dtype=torch.float64)).numpy()
    return blocks[kept, 0] / blocks[kept, 1], direction @ frame.rotation.numpy().T, direction @ resting.T


def _sides(ratio: Array, now: Array, photo: Array) -> list[tuple[Array, Array, Array]]:
    """Return the sides of a body in a frame: median ratio () and mean normals (3,) of blocks that face alike.

    The normals of single spheres are off by some degrees. A strong lamp makes much of that, so that a fit to single
    blocks would take it for weak (errors of a regressor attenuate its coefficient); in the mean of a side they cancel.
    """
    left, found = np.arange(len(ratio)), []
    while len(left):
        alike = photo[left] @ photo[left].T > math.cos(math.radians(SIDE_DEG))
        chosen = alike[alike.sum(1).argmax()]
        side, left = left[chosen], left[~chosen]
        if len(side) >= SIDE_BLOCKS:
            means = (normals[side].mean(0) for normals in (now, photo))
            found.append((np.median(ratio[side]), *(mean / np.linalg.norm(mean) for mean in means)))
    return found


def _pictured(splats: Splats, frame: _Frame, features: Array, device: torch.device) -> tuple[Array, Array]:
    """Return features (H, W, F) and alpha (H, W) of a body alone in a frame."""
    spheres = _in_frame(splats, frame, torch.as_tensor(features, dtype=torch.float32, device=device))
    picture = _rendered(spheres, frame.camera)
    return picture.features[0].double().cpu().numpy(), picture.alpha[0].cpu().numpy()


def _in_frame(splats: Splats, frame: _Frame, features: Tensor) -> Spheres:
    """Return a body's spheres at its pose in a frame, with features (N, F) as colours, on the device of these."""
    spheres = Spheres.from_numpy(splats, device=features.device)
    means = spheres.means @ frame.rotation.to(features).T + frame.position.to(features)
    return Spheres(means, spheres.scales, spheres.opacities, features)


def _rendered(spheres: Spheres, camera: Camera) -> RenderOutput:
    """Return the render of spheres in a camera."""
    viewmat, K = (torch.as_tensor(a).to(spheres.means)[None] for a in (camera.T_cam_world, camera.K))
    size = (camera.width, camera.height)
    return render(spheres.means, spheres.scales, spheres.opacities, spheres.colors, viewmat, K, *size)


def _colored(
    model: Model,
    index: int,
    frames: Sequence[_Frame],
    light: Light,
    seen: NDArray[np.bool_],
    device: torch.device,
) -> Splats:
    """Return a body's spheres with colours from the frames for those that no photo shows, in the light of the photos.

    Spheres that neither shows get the median colour of the seen ones, with the brightness of their side.
    """
    body = model.file.bodies[index]
    splats = model.body_splats[body.name]
    if seen.all() or not seen.any():
        return splats
    relighting = Relighting.of(light, body, torch.as_tensor(splats.normals, dtype=torch.float64))
    total = torch.zeros(len(splats), 4, dtype=torch.float64)
    for frame in frames:
        features = torch.zeros(len(splats), 4, device=device, requires_grad=True)
        spheres = _in_frame(splats, frame, features)
        picture = _rendered(spheres, frame.camera).features[0]
        usable = torch.as_tensor(frame.usable).to(picture)[..., None]
        real = torch.cat([torch.as_tensor(frame.image).to(picture), torch.ones_like(usable)], -1)
        sums = torch.autograd.grad((picture * real * usable).sum(), features)[0].double().cpu()
        eye = torch.as_tensor(frame.camera.center)
        sums *= _facing(spheres.means.cpu(), relighting.normals @ frame.rotation.T, eye)[:, None]
        turn = relighting.turned(frame.rotation)
        total += torch.cat([sums[:, :3] / turn[:, None], sums[:, 3:]], 1)
    in_photos = relighting.in_photos.numpy()
    colors = np.array(splats.colors, np.float64)
    plain = np.median(colors[seen] / in_photos[seen, None], axis=0)
    shown = ~seen & (total[:, 3].numpy() >= SEEN_PX)
    colors[~seen] = in_photos[~seen, None] * plain
    colors[shown] = (total[:, :3] / total[:, 3:].clamp_min(1e-9)).numpy()[shown]
    return replace(splats, colors=colors.clip(0, 1))


def _blocks(table: Array, usable: NDArray[np.bool_]) -> Array:
    """Return the means (n, C) of the blocks of a table (H, W, C) whose pixels are all usable."""
    height, width = (size // BLOCK_PX for size in usable.shape)
    whole = table[: height * BLOCK_PX, : width * BLOCK_PX].reshape(height, BLOCK_PX, width, BLOCK_PX, -1)
    full = usable[: height * BLOCK_PX, : width * BLOCK_PX].reshape(height, BLOCK_PX, width, BLOCK_PX).all((1, 3))
    return whole.mean((1, 3))[full]
