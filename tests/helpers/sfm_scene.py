"""Synthetic scenes for structure from motion: cameras around a textured volume, as plain arrays."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from cgwm.pipeline.calibrate.reconstruction import SfmCamera, SfmModel, VerifiedPair


def rotation_about(axis, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about an axis by an angle [rad] (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def look_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_cam_world (4, 4) of a camera (OpenCV axes) at `center` that looks at `target`, world z up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return pose


def make_scene(
    images: int, points: int, noise_px: float, outliers: float, seed: int, neighbours: int = 6
) -> tuple[SfmModel, list[VerifiedPair]]:
    """A ring of cameras (radius 1.5, alternating heights) around points in a box, and the pairs of neighbours.

    Every camera sees all points; a share of each pair's matches is false (uniform pixels).
    """
    rng = np.random.default_rng(seed)
    camera = SfmCamera(
        width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0, distortion=(0.05, -0.05, 0.0, 0.0)
    )
    cloud = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.5], (points, 3))
    names = [f"{index:02d}.jpg" for index in range(images)]
    poses, pixels = {}, {}
    for index, name in enumerate(names):
        angle = 2 * np.pi * index / images
        center = np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0.7 + 0.25 * (index % 2)])
        poses[name] = look_at(center, np.array([0.0, 0.0, 0.2]))
        local = cloud @ poses[name][:3, :3].T + poses[name][:3, 3]
        pixels[name] = camera.project(local) + rng.normal(0.0, noise_px, (points, 2))
    pairs = []
    for a, b in combinations(range(images), 2):
        gap = min(b - a, images - (b - a))
        if gap > neighbours:
            continue
        chosen = rng.choice(points, min(600 // gap, points), replace=False)
        xy_a, xy_b = pixels[names[a]][chosen], pixels[names[b]][chosen].copy()
        false = rng.random(len(chosen)) < outliers
        xy_b[false] = rng.uniform([0, 0], [640, 480], (int(false.sum()), 2))
        pairs.append(VerifiedPair(names[a], names[b], xy_a, xy_b))
    model = SfmModel(
        cameras={"photos": camera},
        image_camera=dict.fromkeys(names, "photos"),
        T_cam_world=poses,
        points=cloud,
        colors=np.full((points, 3), 128, np.uint8),
        observations={name: (pixels[name], np.arange(points)) for name in names},
        reprojection_error_px=noise_px,
    )
    return model, pairs
