"""What PIN-WM reads of a capture: pictures on white, cameras whose axis meets the middle, and its frame of a body."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.rendering.video_view import usable_cameras, video_view
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .source import module

Array = NDArray[np.float64]
FINGERTIP = "fingertip"


def seen(image: NDArray[np.uint8], mask: NDArray[np.bool_], camera: Camera, number: int) -> Any:
    """Return a picture as its camera, which holds the picture: the object on white, without distortion.

    Args:
        image: Picture, RGB, uint8, shape (H, W, 3).
        mask: Where the object is, bool, shape (H, W).
        camera: Of the picture; the new one has its pose and the mean of its focal lengths.
        number: Of the picture.
    """
    height, width = image.shape[:2]
    old = camera.K.copy()
    old[:2, 2] -= 0.5  # OpenCV's pixels have their centres at whole numbers
    focal = float((old[0, 0] + old[1, 1]) / 2)
    new = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    distortion = np.asarray(camera.distortion, float) if np.any(camera.distortion) else None
    maps = cv2.initUndistortRectifyMap(old, distortion, np.eye(3), new, (width, height), cv2.CV_32FC1)  # pyright: ignore[reportArgumentType, reportCallIssue]
    alpha = cv2.remap(mask.astype(np.float32), *maps, cv2.INTER_LINEAR)[..., None]
    picture = cv2.remap(image, *maps, cv2.INTER_LINEAR).astype(np.float32) / 255 * alpha + 1 - alpha
    channels = torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float()
    T_cam_world = camera.T_cam_world
    angles = [2 * np.arctan(size / (2 * focal)) for size in (width, height)]
    cameras = module("diff_rendering.gaussian_splatting_2d.scene.cameras")
    return cameras.Camera(
        number, T_cam_world[:3, :3].T, T_cam_world[:3, 3], *angles, channels, None, str(number), number
    )


def photos_of(capture: Capture) -> list[Any]:
    """Return the photos of a capture as its cameras."""
    names, label = capture.photos(), _label(capture)
    parts = [(capture.photo(name), capture.photo_mask(name) == label, capture.photo_camera(name)) for name in names]
    return [seen(*part, number) for number, part in enumerate(parts)]  # pyright: ignore[reportArgumentType]


def frames_of(capture: Capture, episode: str) -> tuple[Array, list[list[Any]]]:
    """Return the times of the first camera's frames [s], shape (F,), and each camera's frames as its cameras."""
    cameras, _ = usable_cameras(capture, episode)
    views = []
    for camera in cameras:
        images, masks = capture.video_frames(camera, episode), capture.video_masks(camera, episode)
        numbers, size = capture.frame_numbers(camera, episode), (images.shape[2], images.shape[1])
        sights = [video_view(capture, camera, episode, int(number), size) for number in numbers]
        views.append([seen(images[k], masks[k] == _label(capture), sight, k) for k, sight in enumerate(sights)])  # pyright: ignore[reportOptionalSubscript]
    return np.asarray(capture.frame_times(cameras[0], episode)), views


def _label(capture: Capture) -> int:
    """Return the object's number in the masks; the fingertip has another."""
    return 1 + [body.name for body in capture.manifest.bodies].index(OBJECT)


@dataclass(frozen=True, eq=False)
class Local:
    """The frame that its simulator wants: origin at the centre of mass, axes those of inertia.

    moments: of inertia, about its axes [kg m2], shape (3,); R_body_local (3, 3); com_m: in the body frame [m].
    """

    moments: Array
    R_body_local: Array
    com_m: Array

    @staticmethod
    def of(solid: SolidObject) -> Local:
        """Return the frame of a solid."""
        moments, axes = np.linalg.eigh(solid.inertia)
        return Local(moments, axes * np.linalg.det(axes), np.asarray(solid.com))

    def points(self, points_m: Array) -> Array:
        """Return points (N, 3) of the body frame in this one [m]."""
        return (points_m - self.com_m) @ self.R_body_local

    def pose(self, position_m: Array, quat_wxyz: Array) -> tuple[Array, Array]:
        """Return this frame's position and quat_wxyz in the world from the body frame's."""
        turn = _matrix(quat_wxyz)
        return position_m + turn @ self.com_m, _quat(turn @ self.R_body_local)

    def body_pose(self, position_m: Array, quat_wxyz: Array) -> tuple[Array, Array]:
        """Return the body frame's position and quat_wxyz in the world from this frame's."""
        turn = _matrix(quat_wxyz) @ self.R_body_local.T
        return position_m - turn @ self.com_m, _quat(turn)

    def state(self, position_m: Array, quat_wxyz: Array, velocity_m_s: Array, omega_body_rad_s: Array) -> list[Array]:
        """Return position, quat_wxyz, velocity and angular velocity (world axes) of this frame from the body's."""
        turn = _matrix(quat_wxyz)
        omega = turn @ omega_body_rad_s
        return [*self.pose(position_m, quat_wxyz), velocity_m_s + np.cross(omega, turn @ self.com_m), omega]


def fingertip_of(drives: Mapping[str, Track]) -> Callable[[float], Array] | None:
    """Return where the fingertip is at a time [s], or None where there is none."""
    track = drives.get(FINGERTIP)
    if track is None:
        return None
    times, places = np.asarray(track.time_s), np.asarray(track.position_m)
    return lambda time_s: np.array([np.interp(time_s, times, places[:, axis]) for axis in range(3)])


def _matrix(quat_wxyz: Array) -> Array:
    return Rotation.from_quat(np.asarray(quat_wxyz), scalar_first=True).as_matrix()


def _quat(turn: Array) -> Array:
    return Rotation.from_matrix(turn).as_quat(scalar_first=True)
