"""Structure-from-motion model as plain arrays, independent of COLMAP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_UNDISTORT_STEPS = 20


@dataclass(frozen=True, kw_only=True)
class SfmCamera:
    """Intrinsics in pixels; the centre of the top-left pixel is (0.5, 0.5)."""

    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Column of the principal point [px]."""
    cy: float
    """Row of the principal point [px]."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Lens parameters k1, k2, p1, p2 of OpenCV."""

    @property
    def focal_px(self) -> float:
        """Mean focal length [px]."""
        return 0.5 * (self.fx + self.fy)

    @property
    def K(self) -> Array:
        """Camera matrix [px], shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rays(self, xy_px: Array) -> Array:
        """Undistort pixels into rays (x/z, y/z) in the camera frame.

        Args:
            xy_px: Pixels [px], shape (point, 2).

        Returns:
            Ray slopes [1], shape (point, 2).
        """
        target = (np.asarray(xy_px, float).reshape(-1, 2) - [self.cx, self.cy]) / [self.fx, self.fy]
        rays = target.copy()
        for _ in range(_UNDISTORT_STEPS):  # Newton; the lens maps of real photos are close to the identity
            value, jacobian = distort(rays, self.distortion)
            step = np.linalg.solve(jacobian, (value - target)[:, :, None])[:, :, 0]
            rays -= step
            if np.max(np.abs(step), initial=0.0) < 1e-14:
                break
        return rays

    def project(self, points_cam: Array) -> Array:
        """Project points of the camera frame.

        Args:
            points_cam: Points in the camera frame, shape (point, 3), z > 0.

        Returns:
            Pixels [px], shape (point, 2).
        """
        rays = points_cam[:, :2] / points_cam[:, 2:]
        return distort(rays, self.distortion)[0] * [self.fx, self.fy] + [self.cx, self.cy]


@dataclass(frozen=True)
class Similarity:
    """A similarity transform: p_world = scale * rotation @ p + translation."""

    scale: float
    """Scale [1]."""
    rotation: Array
    """Rotation matrix, shape (3, 3)."""
    translation: Array
    """Translation [world unit], shape (3,)."""

    def points(self, points: Array) -> Array:
        """Map points, shape (..., 3)."""
        return self.scale * points @ self.rotation.T + self.translation

    def pose(self, T_cam_world: Array) -> Array:
        """Map a camera pose (4, 4), so that images of the mapped world are those of the original one."""
        rotation = T_cam_world[:3, :3] @ self.rotation.T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = self.scale * T_cam_world[:3, 3] - rotation @ self.translation
        return pose

    def then(self, motion: Similarity) -> Similarity:
        """Return this transform followed by another one."""
        scale, rotation = motion.scale * self.scale, motion.rotation @ self.rotation
        return Similarity(scale, rotation, motion.scale * motion.rotation @ self.translation + motion.translation)

    @staticmethod
    def identity() -> Similarity:
        """Return the identity transform."""
        return Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True, kw_only=True)
class SfmModel:
    """Registered cameras and sparse points of one connected model."""

    cameras: dict[str, SfmCamera]
    """Intrinsics by camera name."""
    image_camera: dict[str, str]
    """Name of the camera of each registered image."""
    T_cam_world: dict[str, Array]
    """Pose (4, 4) of each registered image: world to camera, camera axes OpenCV."""
    points: Array
    """Sparse points, world frame, shape (point, 3)."""
    colors: NDArray[np.uint8]
    """Colours of the points, sRGB, shape (point, 3)."""
    observations: dict[str, tuple[Array, NDArray[np.int64]]]
    """Pixels (observation, 2) and point indices (observation,) of the observations in each image."""
    reprojection_error_px: float
    """Mean reprojection error of the points [px]; a wrong model may have a low one."""

    def camera(self, image: str) -> SfmCamera:
        """Return the intrinsics of an image."""
        return self.cameras[self.image_camera[image]]

    def center(self, image: str) -> Array:
        """Return the optical centre of an image, world frame, shape (3,)."""
        pose = self.T_cam_world[image]
        return -pose[:3, :3].T @ pose[:3, 3]

    def centers(self) -> Array:
        """Return all optical centres in the order of `T_cam_world`, shape (image, 3)."""
        return np.array([self.center(image) for image in self.T_cam_world])

    def errors_px(self, image: str) -> Array:
        """Return the reprojection errors of an image's observations [px], shape (observation,)."""
        (pixels, seen), pose = self.observations[image], self.T_cam_world[image]
        drawn = self.camera(image).project(self.points[seen] @ pose[:3, :3].T + pose[:3, 3])
        return np.linalg.norm(drawn - pixels, axis=1)

    def renamed(self, names: Mapping[str, str]) -> SfmModel:
        """Return the model with other names of the images."""
        return replace(
            self,
            image_camera={names[image]: camera for image, camera in self.image_camera.items()},
            T_cam_world={names[image]: pose for image, pose in self.T_cam_world.items()},
            observations={names[image]: seen for image, seen in self.observations.items()},
        )

    def with_points(self, kept: NDArray[np.bool_]) -> SfmModel:
        """Return the model with some of its points (point,), and their observations."""
        index, observations = np.cumsum(kept) - 1, {}
        for image, (pixels, seen) in self.observations.items():
            own = kept[seen]
            observations[image] = (pixels[own], index[seen[own]])
        return replace(self, points=self.points[kept], colors=self.colors[kept], observations=observations)

    def transformed(self, similarity: Similarity) -> SfmModel:
        """Return the model in another world frame and unit."""
        return replace(
            self,
            points=similarity.points(self.points),
            T_cam_world={image: similarity.pose(pose) for image, pose in self.T_cam_world.items()},
        )


@dataclass(frozen=True)
class VerifiedPair:
    """Two images and their matches that passed COLMAP's two-view verification."""

    image_a: str
    """Name of the first image."""
    image_b: str
    """Name of the second image."""
    xy_a: Array
    """Pixels in the first image [px], shape (inlier, 2)."""
    xy_b: Array
    """Pixels in the second image [px], shape (inlier, 2)."""


def world_from_cam(T_cam_world: Array) -> Array:
    """Invert a rigid pose exactly (transpose of the rotation), shape (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = T_cam_world[:3, :3].T
    inverse[:3, 3] = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
    return inverse


def distort(rays: Array, distortion: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Apply OpenCV's lens model to ray slopes (ray, 2); return them and the Jacobians (ray, 2, 2).

    Source: OpenCV, "Camera Calibration and 3D Reconstruction", k1 k2 p1 p2.
    """
    k1, k2, p1, p2 = distortion
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + r2 * k2), 2.0 * (k1 + 2.0 * k2 * r2)
    value = np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
        axis=-1,
    )
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    dx_dx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    dy_dy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    jacobian = np.stack([dx_dx, cross, cross, dy_dy], axis=-1)
    return value, jacobian.reshape(-1, 2, 2)
