"""Calibrated cameras: projection, and reading of the files that contain them.

The centre of the top-left pixel is at (0.5, 0.5), as in COLMAP and nerfstudio. OpenCV's functions put it at (0, 0):
subtract 0.5 from the principal point before passing `K` to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, PosedImage, PosedVideo, did_you_mean, read_json
from .camera_faults import ROTATION_TOLERANCE, pose_fault
from .colmap_model import find_colmap_model, read_colmap_model
from .files import optional_file
from .transforms import read_transforms

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with its pose; camera axes OpenCV (x right, y down, z forward)."""

    width: int
    """Width of the image [px]."""
    height: int
    """Image height [px]."""
    K: Array
    """Intrinsic matrix [px], shape (3, 3); the top-left pixel's centre is (0.5, 0.5)."""
    distortion: Array
    """OpenCV's k1, k2, p1, p2 [, k3] [1], shape (4,) or (5,); shape (0,) without distortion."""
    T_world_cam: Array
    """Pose, camera to world [m where the scale is metric], shape (4, 4)."""

    @property
    def T_cam_world(self) -> Array:
        """World to camera, shape (4, 4)."""
        rotation, translation = self.T_world_cam[:3, :3], self.T_world_cam[:3, 3]
        inverse = np.eye(4)
        inverse[:3, :3] = rotation.T
        inverse[:3, 3] = -rotation.T @ translation
        return inverse

    @property
    def center(self) -> Array:
        """Optical centre, world frame [m where the scale is metric], shape (3,)."""
        return self.T_world_cam[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same view at another image size [px]."""
        # With the corner of the image at (0, 0), a change of size is a pure scaling of pixel coordinates.
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, K=scale @ self.K)

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """Project points into the image.

        Source of the distortion: OpenCV, calib3d, "Detailed description" (radial k1, k2, k3, tangential p1, p2).

        Args:
            points_world: Points, world frame, shape (N, 3).

        Returns:
            Pixel coordinates (x, y) [px], shape (N, 2), NaN for points at or behind the optical centre, and
            depths along the optical axis, in the unit of the points, shape (N,).
        """
        T_cam_world = self.T_cam_world
        points_cam = np.asarray(points_world, np.float64) @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        depth = points_cam[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            normalised = np.where(depth[:, None] > 0, points_cam[:, :2] / depth[:, None], np.nan)
        distorted = distort(normalised, self.distortion)
        return distorted @ self.K[:2, :2].T + self.K[:2, 2], depth

    def pixels_of(self, points_world: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
        """Return which points (N, 3), world frame, are in the image, and the columns and rows of their pixels.

        Each has shape (N,); column and row are 0 for a point outside the image.
        """
        pixel, depth = self.project(points_world)
        inside = (depth > 0) & (pixel >= 0).all(1) & (pixel < [self.width, self.height]).all(1)
        column, row = np.where(inside[:, None], pixel, 0).astype(np.int64).T
        return inside, column, row

    def undistorted(self, image: NDArray[Any], labels: bool = False) -> tuple[NDArray[Any], Camera]:
        """Return the undistorted image, and the camera without distortion and with the same K that takes it.

        Args:
            image: Shape (height, width) or (height, width, channels), uint8 or float32.
            labels: Take the nearest pixel instead of interpolating.
        """
        camera = replace(self, distortion=np.zeros(0))
        if not np.any(self.distortion):
            return image, camera
        import cv2

        K_opencv = self.K.copy()
        K_opencv[:2, 2] -= 0.5
        map_x, map_y = cv2.initUndistortRectifyMap(
            K_opencv, self.distortion, np.eye(3), K_opencv, (self.width, self.height), cv2.CV_32FC1
        )
        method = cv2.INTER_NEAREST if labels else cv2.INTER_LINEAR
        return np.asarray(cv2.remap(image, map_x, map_y, method), image.dtype), camera


def distort(normalised: Array, distortion: Array) -> Array:
    """Apply OpenCV's distortion to normalised image coordinates (x/z, y/z), shape (N, 2)."""
    if not np.any(distortion):
        return normalised
    k1, k2, p1, p2, k3 = [*distortion, 0.0][:5]
    x, y = normalised[:, 0], normalised[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def read_cameras(root: Path | str, metric: bool = False) -> CamerasFile | None:
    """Read the cameras of a capture directory, or None if there are none.

    The first of these files is used: `cameras.json`; nerfstudio's `transforms.json`; a COLMAP model, text or binary,
    in `sparse/0`, `sparse` or `colmap`. Poses keep their scale; names of photos are relative to `images/`.

    Args:
        root: The capture directory.
        metric: Whether `transforms.json` or the COLMAP model is in metres; `cameras.json` contains its unit.

    Raises:
        InputDataError: If the file is wrong, uses a camera model that cannot be represented, or contains a pose
            that is not a rotation and a translation.
    """
    path = find_cameras(Path(root))
    if path is None:
        return None
    if path.name == "cameras.json":
        return require_rigid(path, read_json(path, CamerasFile))
    return require_rigid(path, (read_transforms if path.name == "transforms.json" else read_colmap_model)(path, metric))


def find_cameras(root: Path) -> Path | None:
    """Return the file of a capture's cameras, or the directory of its COLMAP model; None if there are no cameras."""
    for name in ("cameras.json", "transforms.json"):
        if optional_file(root / name) is not None:
            return root / name
    return find_colmap_model(root)


def require_rigid(path: Path, cameras: CamerasFile) -> CamerasFile:
    """Return the cameras of a file.

    Raises:
        InputDataError: If a pose is not a rotation and a translation.
    """
    for name, image in cameras.images.items():
        _check_rigid(f"{path}: image '{name}'", np.array(image.T_world_cam))
    for name, video in cameras.videos.items():
        for pose in _poses(video):
            _check_rigid(f"{path}: video '{name}'", pose)
    return cameras


def camera_of(
    cameras: CamerasFile,
    name: str,
    frame: int | None = None,
    kind: Literal["images", "videos"] = "images",
    episode: str | None = None,
) -> Camera:
    """Return the camera of a photo or of a video frame.

    Args:
        cameras: The cameras that :func:`read_cameras` returned.
        name: The photo, relative to `images/`, or the video camera.
        frame: Frame number (from 0) for a moving video camera.
        kind: Whether `name` is a photo or a video camera.
        episode: The episode of a video; a pose under `<camera>/<episode>` takes precedence over that of the camera.

    Raises:
        InputDataError: If the photo or video camera has no pose, or has one per frame and none for `frame`.
    """
    if kind == "images":
        entry = cameras.images.get(name)
        pose = None if entry is None else np.array(entry.T_world_cam)
    else:
        entry = cameras.videos.get(f"{name}/{episode}") or cameras.videos.get(name)
        pose = None if entry is None else _pose_at(name, _poses(entry), frame)
    if entry is None or pose is None:
        legal = sorted(getattr(cameras, kind))
        noun = "photo" if kind == "images" else "video camera"
        raise InputDataError(
            f"no pose for the {noun} '{name}' ({len(legal)} {kind} have one).{did_you_mean(name, legal)}",
            todo="run 'cgwm calibrate', or add it to cameras.json.",
        )
    return from_intrinsics(cameras.cameras[entry.camera], pose)


def posed(cameras: CamerasFile, T_world_cam: Mapping[str, Array]) -> CamerasFile:
    """Return the cameras with new poses of some photos.

    Args:
        cameras: The cameras.
        T_world_cam: New poses by photo, camera to world, shape (4, 4).
    """
    images = dict(cameras.images)
    for name, pose in T_world_cam.items():
        rows = tuple(tuple(float(value) for value in row) for row in pose)
        images[name] = PosedImage.model_validate({"camera": images[name].camera, "T_world_cam": rows})
    return cameras.model_copy(update={"images": images})


def from_intrinsics(intrinsics: CameraIntrinsics, T_world_cam: Array) -> Camera:
    """Return the camera with these intrinsics at this pose, shape (4, 4)."""
    K = np.array(
        [[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]], np.float64
    )
    distortion = np.array(intrinsics.distortion if any(intrinsics.distortion) else (), np.float64)
    return Camera(
        width=intrinsics.width,
        height=intrinsics.height,
        K=K,
        distortion=distortion,
        T_world_cam=np.asarray(T_world_cam, np.float64),
    )


def to_intrinsics(camera: Camera) -> CameraIntrinsics:
    """Return the intrinsics of a camera in the format of `cameras.json`."""
    return CameraIntrinsics.of_lens(
        "camera",
        width=camera.width,
        height=camera.height,
        fx=float(camera.K[0, 0]),
        fy=float(camera.K[1, 1]),
        cx=float(camera.K[0, 2]),
        cy=float(camera.K[1, 2]),
        distortion=[float(value) for value in camera.distortion],
    )


def pose_count(video: PosedVideo) -> int:
    """Return the number of poses of a video camera; 1 for a static one."""
    return len(_poses(video))


def _poses(video: PosedVideo) -> Array:
    poses = np.array(video.T_world_cam, np.float64)
    return poses[None] if poses.ndim == 2 else poses


def _pose_at(name: str, poses: Array, frame: int | None) -> Array:
    if len(poses) == 1:
        return poses[0]
    if frame is None or not 0 <= frame < len(poses):
        raise InputDataError(
            f"the video camera '{name}' has {len(poses)} poses, one a frame; frame {frame} was asked for.",
            f"0 to {len(poses) - 1}.",
            "remove the frames without a pose, or add these.",
        )
    return poses[frame]


def _check_rigid(where: str, pose: Array) -> None:
    fault = pose_fault(pose)
    if fault is not None:
        allowed = f"a rotation within {ROTATION_TOLERANCE:g} and a translation, last row 0, 0, 0, 1."
        raise InputDataError(f"{where}: {fault}.", allowed, "write the pose camera to world, 4x4, without scaling.")


def require_metric(cameras: CamerasFile) -> None:
    """Refuse cameras without a metric scale, with which the fitted physics would have an arbitrary gravity.

    Raises:
        InputDataError: If they are unscaled; the message says how to give the scale.
    """
    if cameras.scale.kind != "metric":
        raise InputDataError(
            "The cameras are unscaled: one unit of their poses is not one metre, so no physics can be fitted.",
            "cameras with a metric scale: from an ArUco marker, a known distance or a known camera distance.",
            "add one of these to capture.toml, then run 'cgwm calibrate --overwrite':\n"
            "  [calibration]\n"
            "  markers = [{ id = 0, side_m = 0.05 }]                                      # printed size, measured\n"
            '  known_camera_distance = { distance_m = 0.40, images = ["a.jpg", "b.jpg"] }\n'
            '  known_distance = { distance_m = 0.1, a_px = { "a.jpg" = [310.5, 220.0], "b.jpg" = [295.0, 241.5] }, '
            'b_px = { "a.jpg" = [402.0, 219.0], "b.jpg" = [388.5, 243.0] } }',
        )
