"""Cameras and poses from a COLMAP model on disk, text or binary, without COLMAP.

Source of the layout: COLMAP documentation, "Output format", and `scripts/python/read_write_model.py` there.
"""

# Why `pycolmap.Reconstruction` does not do this: it hung for minutes on damaged bytes, where a capture needs a message,
# and it requires points3D, which captures may lack.

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, PosedImage, Scale
from ...schemas.cameras import Matrix4
from ...schemas.regular_files import read_binary_file, read_text_file
from .files import optional_file
from .transforms import matrix4

MODEL_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap")
"""Folders of a capture that may contain a COLMAP model, in order of precedence."""

# COLMAP's number of a camera model, and its parameters; None: the parameter has no place in OpenCV's five.
_MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_READABLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


def find_colmap_model(root: Path) -> Path | None:
    """Return the directory of the capture's COLMAP model, or None."""
    for place in MODEL_PLACES:
        for suffix in (".bin", ".txt"):
            if all(optional_file(root / place / f"{name}{suffix}") for name in ("cameras", "images")):
                return root / place
    return None


def read_colmap_model(folder: Path, metric: bool = False) -> CamerasFile:
    """Read `cameras` and `images` (.bin before .txt) of a COLMAP model.

    COLMAP's axes and pixel origin are those used here; its poses, world to camera, are inverted.

    Args:
        folder: The directory with the files.
        metric: Whether its unit is the metre, which the files do not contain.

    Raises:
        InputDataError: If a file is truncated or a camera model is not a pinhole with OpenCV's distortion.
    """
    binary = all(optional_file(folder / f"{name}.bin") for name in ("cameras", "images"))
    suffix = ".bin" if binary else ".txt"
    camera_path, image_path = folder / f"cameras{suffix}", folder / f"images{suffix}"
    cameras: dict[str, CameraIntrinsics] = {}
    images: dict[str, PosedImage] = {}
    try:
        for number, model, width, height, params in (_cameras_bin if binary else _cameras_txt)(camera_path):
            if not all(map(math.isfinite, params)):
                raise InputDataError(f"{camera_path}: camera {number} has parameters that are not finite: {params}.")
            cameras[f"camera{number}"] = _intrinsics(camera_path, number, model, width, height, params)
        for name, camera, quat_wxyz, translation in (_images_bin if binary else _images_txt)(image_path):
            if not all(map(math.isfinite, (*quat_wxyz, *translation))) or not any(quat_wxyz):
                raise InputDataError(f"{image_path}: image '{name}' has a pose that is not finite, or no rotation.")
            pose = _world_from_camera(np.array(quat_wxyz), np.array(translation))
            images[name.removeprefix("images/")] = PosedImage(camera=f"camera{camera}", T_world_cam=pose)
        scale = Scale(kind="metric" if metric else "unscaled", source="COLMAP model")
        return CamerasFile(scale=scale, cameras=cameras, images=images)
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputDataError(f"{folder}: not a COLMAP model that can be read: {error}.") from None


def _world_from_camera(quat_wxyz: np.ndarray, translation: np.ndarray) -> Matrix4:
    # slow to import, and captures without a COLMAP model do not need it
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ translation
    return matrix4(pose)


def _intrinsics(
    path: Path, number: int, model: str, width: int, height: int, params: tuple[float, ...]
) -> CameraIntrinsics:
    if model not in _READABLE or any(params[9:]):
        raise InputDataError(
            f"{path}: camera {number} has the model {model}.",
            ", ".join(_READABLE[:-1]) + ".",
            "undistort the photos (colmap image_undistorter), or calibrate with --camera_model OPENCV.",
        )
    single_focal = model.startswith("SIMPLE") or model == "RADIAL"
    fx, fy, cx, cy, *rest = (params[0], *params) if single_focal else params
    # COLMAP's FULL_OPENCV continues k1, k2, p1, p2, k3; the radial models have no p1, p2.
    distortion = (*rest, 0.0, 0.0, 0.0, 0.0)[:4] if len(rest) < 5 or not rest[4] else tuple(rest[:5])
    return CameraIntrinsics.of_lens(
        f"{path}: camera {number}", width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion
    )


CameraRecord = tuple[int, str, int, int, tuple[float, ...]]
ImageRecord = tuple[str, int, tuple[float, ...], tuple[float, ...]]


def _lines(path: Path) -> list[str]:
    # A line of 2D points may be empty and counts, so that only comments are dropped.
    return [line for line in read_text_file(path).splitlines() if not line.startswith("#")]


def _cameras_txt(path: Path) -> Iterator[CameraRecord]:
    for line in _lines(path):
        if line.strip():
            number, model, width, height, *params = line.split()
            yield int(number), model, int(width), int(height), tuple(map(float, params))


def _images_txt(path: Path) -> Iterator[ImageRecord]:
    for line in _lines(path)[::2]:
        if line.strip():
            _, *pose, camera, name = line.split(maxsplit=9)
            values = tuple(map(float, pose))
            yield name.strip(), int(camera), values[:4], values[4:]


def _cameras_bin(path: Path) -> Iterator[CameraRecord]:
    data, offset = read_binary_file(path), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        offset += 24
        if model not in _MODELS:
            raise InputDataError(f"{path}: camera {number} has the unknown model number {model}.")
        name, count = _MODELS[model]
        yield number, name, width, height, struct.unpack_from(f"<{count}d", data, offset)
        offset += 8 * count


def _images_bin(path: Path) -> Iterator[ImageRecord]:
    data, offset = read_binary_file(path), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *pose, camera = struct.unpack_from("<i7di", data, offset)
        offset += 64
        end = data.index(b"\0", offset)
        name = data[offset:end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * points
        yield name, camera, tuple(pose[:4]), tuple(pose[4:])
