"""Search for the pose of bodies at one instant of a video, from silhouettes, over all orientations."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from ...geometry.rotation import quat_exp, quat_multiply, quat_to_matrix
from .image_loss import ImageLoss
from .pose_descent import Poses, descended
from .video_frames import Video

ROTATIONS = 72
"""Number of orientations that a search scores: about 35 degrees apart, within the range of the descent."""
NEARBY_DEG = (20.0, 40.0)
"""Angles from an expected orientation that a search also scores, each around fourteen axes [deg]."""
KEPT = 6
"""Number of the best orientations of a search that are refined."""
DESCENT_ITERATIONS = 6
"""Maximum number of steps from each of them."""
SAME_POSE = (0.15, math.radians(8.0))
"""Maximum distance and angle of equal poses (radii of the body, radians)."""
MIN_SILHOUETTE_PX = 6.0
"""Minimum area of a silhouette that locates a body [px]."""
DIFFERENCE_FLOOR = 0.08
"""Minimum difference from the background of a pixel that shows a body, without masks; it must also exceed 4 times the
median difference."""


def search(loss: ImageLoss, instant: int, position_m: Tensor, quat_wxyz: Tensor, blur: int) -> Poses:
    """Try many orientations of each free body in turn, at its silhouettes or at the expected position.

    Args:
        loss: Image loss on small images.
        instant: Instant of its footage.
        position_m: Expected positions of all bodies [m], world, shape (nb, 3).
        quat_wxyz: Expected orientations, shape (nb, 4).
        blur: As in `ImageLoss.expand`.

    Returns:
        The best few poses, refined; with several free bodies all but the last have the best pose.
    """
    position, quat = position_m.clone(), quat_wxyz.clone()
    found: Poses | None = None
    globe = rotation_grid(ROTATIONS).to(quat)
    for index in loss.free:
        place = located(loss, instant, index)
        turns = torch.cat([_nearby(quat[index]), globe])
        center = loss.centers[index]
        middle = place if place is not None else position[index] + quat_to_matrix(quat[index]) @ center
        positions, quats = position.repeat(len(turns), 1, 1), quat.repeat(len(turns), 1, 1)
        quats[:, index] = turns
        positions[:, index] = middle - quat_to_matrix(turns) @ center
        values = loss.values(torch.full((len(turns),), instant), positions, quats)
        order = values.argsort(stable=True)[:KEPT]
        at = torch.full((len(order),), instant)
        poses = descended(loss, at, positions[order], quats[order], DESCENT_ITERATIONS, blur)
        found = distinct(loss, poses, KEPT)
        position, quat = found.position_m[0].clone(), found.quat_wxyz[0].clone()
    assert found is not None  # a model without a free body has no pose to find
    return found


def distinct(loss: ImageLoss, poses: Poses, most: int) -> Poses:
    """Return the best poses, at most `most`, without those that nearly equal a better one."""
    kept: list[int] = []
    for row in poses.value.argsort(stable=True).tolist():
        if len(kept) < most and not any(_same(loss, poses, row, other) for other in kept):
            kept.append(row)
    return poses.at(torch.tensor(kept))


def _same(loss: ImageLoss, poses: Poses, a: int, b: int) -> bool:
    """Return whether two poses of all free bodies are nearly equal."""
    for index in loss.free:
        shift = float((poses.position_m[a, index] - poses.position_m[b, index]).norm())
        cosine = float((poses.quat_wxyz[a, index] * poses.quat_wxyz[b, index]).sum().abs().clamp_max(1.0))
        if shift > SAME_POSE[0] * loss.radii[index] or 2 * math.acos(cosine) > SAME_POSE[1]:
            return False
    return True


def located(loss: ImageLoss, instant: int, index: int) -> Tensor | None:
    """Return the centroid of a body (3,), world, from its silhouettes; None if too little of it is visible."""
    rays, distances = [], []
    for number, video in enumerate(loss.footage.videos):
        frame = int(loss.footage.frame_at[number, instant])
        if frame < 0:
            continue
        cover = _silhouette(loss, number, frame, index)
        area = float(cover.sum())
        if area < MIN_SILHOUETTE_PX:
            continue
        rays.append(_ray(video, frame, cover))
        # a disc of the body's mean radius would cover as many pixels at this distance
        distances.append(loss.radii[index] * float(video.K[0, 0]) * math.sqrt(math.pi / area))
    if not rays:
        return None
    origins, directions = (torch.stack(column) for column in zip(*rays, strict=True))
    if len(rays) == 1:
        return origins[0] + distances[0] * directions[0]
    across = torch.eye(3).to(directions) - directions[:, :, None] * directions[:, None]
    return torch.linalg.solve(across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0])


def small_silhouette_px(loss: ImageLoss) -> float | None:
    """Return the 10 % quantile of the areas of the free bodies' silhouettes [px]; None if none is visible."""
    areas = []
    for number, frames in enumerate(loss.footage.frame_at.tolist()):
        for frame in set(frames) - {-1}:
            areas += [float(_silhouette(loss, number, frame, index).sum()) for index in loss.free]
    seen = [area for area in areas if area >= MIN_SILHOUETTE_PX]
    return float(np.quantile(seen, 0.1)) if seen else None


def _silhouette(loss: ImageLoss, number: int, frame: int, index: int) -> Tensor:
    """Return a body's silhouette (H, W): its mask, or the largest region that differs from the background."""
    video = loss.footage.videos[number]
    if video.covers is not None:
        return video.covers[frame, index]
    difference = cv2.blur(loss.difference(number, frame).cpu().numpy(), (3, 3))
    threshold = max(DIFFERENCE_FLOOR, 4 * float(np.median(difference)))
    _, regions, table, _ = cv2.connectedComponentsWithStats((difference > threshold).astype(np.uint8))
    if len(table) < 2:
        return torch.zeros_like(video.frames[frame, ..., 0])
    largest = 1 + int(table[1:, cv2.CC_STAT_AREA].argmax())
    return torch.as_tensor((regions == largest).astype(np.float32)).to(video.frames)


def rotation_grid(count: int) -> Tensor:
    """Return evenly spread rotations as quaternions wxyz, shape (count, 4).

    Source: super-Fibonacci spirals (M. Alexa, CVPR 2022).
    """
    phi, psi = math.sqrt(2.0), 1.533751168755204288118041
    s = torch.arange(count, dtype=torch.float64) + 0.5
    near, far = (s / count).sqrt(), (1 - s / count).sqrt()
    alpha, beta = 2 * math.pi * s / phi, 2 * math.pi * s / psi
    return torch.stack([near * alpha.sin(), near * alpha.cos(), far * beta.sin(), far * beta.cos()], -1)


def _nearby(quat_wxyz: Tensor) -> Tensor:
    """Return a rotation and its neighbours, shape (1 + 14 * angles, 4)."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) / math.sqrt(3)
    axes = torch.cat([torch.eye(3), -torch.eye(3), corners]).to(quat_wxyz)
    turns = torch.cat([math.radians(angle) * axes for angle in NEARBY_DEG])
    return quat_multiply(quat_wxyz[None], quat_exp(torch.cat([torch.zeros(1, 3).to(turns), turns])))


def _ray(video: Video, frame: int, cover: Tensor) -> tuple[Tensor, Tensor]:
    """Return origin and unit direction (world) of the ray through the centroid of a silhouette (H, W)."""
    rows = torch.arange(cover.shape[0]).to(cover) + 0.5
    columns = torch.arange(cover.shape[1]).to(cover) + 0.5
    area = cover.sum()
    pixel = torch.stack(
        [(cover.sum(0) * columns).sum() / area, (cover.sum(1) * rows).sum() / area, torch.ones(()).to(cover)]
    )
    viewmat = video.viewmats[frame]
    rotation = viewmat[:3, :3]
    direction = rotation.T @ torch.linalg.solve(video.K, pixel)
    return -rotation.T @ viewmat[:3, 3], direction / direction.norm()
