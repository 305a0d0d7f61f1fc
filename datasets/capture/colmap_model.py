"""Cameras and poses from a COLMAP model on disk, text or binary, without COLMAP.

Source of the layout: COLMAP documentation, "Output format", and `scripts/python/read_write_model.py` there.
"""

# Why `pycolmap.Reconstruction` does not do this: it hung for minutes on damaged bytes, where a capture needs a message,
# and it requires points3D, which captures may lack.

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, PosedImage, Scale
from ...schemas.cameras import Matrix4
from ...schemas.documents import shortened
from ...schemas.regular_files import read_binary_file, read_text_file
from ..io.cells import number_of, shown
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
_PARAMETERS = dict(_MODELS.values())
_LAYOUT = {
    "cameras.txt": "lines of number, model, width, height and the model's parameters.",
    "images.txt": "pairs of lines: number, quaternion (w first), translation, camera and name; then its 2D points.",
    "cameras.bin": "COLMAP's binary cameras, complete.",
    "images.bin": "COLMAP's binary images, complete.",
}
_EXPORT = "export it again with COLMAP (colmap model_converter), or take the original."
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
    cameras = _read_cameras(camera_path, binary)
    images: dict[str, PosedImage] = {}
    with _faults(image_path) as place:
        for name, camera, quat_wxyz, translation in (_images_bin if binary else _images_txt)(place):
            if f"camera{camera}" not in cameras:
                raise ValueError(f"image '{name}' is of the camera {camera}, which {camera_path.name} does not have")
            pose = _pose(name, quat_wxyz, translation)
            images[name.removeprefix("images/")] = PosedImage(camera=f"camera{camera}", T_world_cam=pose)
    scale = Scale(kind="metric" if metric else "unscaled", source="COLMAP model")
    return CamerasFile(scale=scale, cameras=cameras, images=images)


def _read_cameras(path: Path, binary: bool) -> dict[str, CameraIntrinsics]:
    """Return the cameras of a file by name."""
    cameras: dict[str, CameraIntrinsics] = {}
    with _faults(path) as place:
        for number, model, width, height, params in (_cameras_bin if binary else _cameras_txt)(place):
            if not all(map(math.isfinite, params)):
                raise ValueError(f"camera {number} has parameters that are not finite: {params}")
            cameras[f"camera{number}"] = _intrinsics(f"{place}", number, model, width, height, params)
    return cameras


def _pose(name: str, quat_wxyz: Sequence[float], translation: Sequence[float]) -> Matrix4:
    """Return the pose camera to world of an image."""
    if not all(map(math.isfinite, (*quat_wxyz, *translation))) or not any(quat_wxyz):
        raise ValueError(f"image '{name}' has a pose that is not finite, or no rotation")
    return _world_from_camera(np.array(quat_wxyz), np.array(translation))


class _Place:
    """Where a reader of one file stands, for messages: a line, or the number of an entry."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, ""

    def __str__(self) -> str:
        return f"{self.path}, {self.at}" if self.at else f"{self.path}"


@contextmanager
def _faults(path: Path) -> Iterator[_Place]:
    """Turn what is raised in the block into one message with the file and the place in it."""
    place = _Place(path)
    try:
        yield place
    except (struct.error, IndexError, OverflowError):
        raise InputDataError(f"{place}: cut off, or damaged.", _LAYOUT[path.name], _EXPORT) from None
    except ValueError as error:
        found = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise InputDataError(f"{place}: {shortened(found)}.", _LAYOUT[path.name], _EXPORT) from None


def _world_from_camera(quat_wxyz: np.ndarray, translation: np.ndarray) -> Matrix4:
    # slow to import, and captures without a COLMAP model do not need it
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ translation
    return matrix4(pose)


def _intrinsics(
    where: str, number: int, model: str, width: int, height: int, params: tuple[float, ...]
) -> CameraIntrinsics:
    if model not in _READABLE or any(params[9:]):
        raise InputDataError(
            f"{where}: camera {number} has the model {model}.",
            ", ".join(_READABLE[:-1]) + ".",
            "undistort the photos (colmap image_undistorter), or calibrate with --camera_model OPENCV.",
        )
    if len(params) != _PARAMETERS[model]:
        raise ValueError(f"{len(params)} parameters for the model {model}, which has {_PARAMETERS[model]}")
    single_focal = model.startswith("SIMPLE") or model == "RADIAL"
    fx, fy, cx, cy, *rest = (params[0], *params) if single_focal else params
    # COLMAP's FULL_OPENCV continues k1, k2, p1, p2, k3; the radial models have no p1, p2.
    distortion = (*rest, 0.0, 0.0, 0.0, 0.0)[:4] if len(rest) < 5 or not rest[4] else tuple(rest[:5])
    return CameraIntrinsics.of_lens(
        f"{where}: camera {number}", width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion
    )


CameraRecord = tuple[int, str, int, int, tuple[float, ...]]
ImageRecord = tuple[str, int, tuple[float, ...], tuple[float, ...]]


def _lines(path: Path) -> list[tuple[int, str]]:
    # A line of 2D points may be empty and counts, so that only comments are dropped.
    lines = enumerate(read_text_file(path).splitlines(), 1)
    return [(number, line) for number, line in lines if not line.startswith("#")]


def _cameras_txt(place: _Place) -> Iterator[CameraRecord]:
    for number, line in _lines(place.path):
        if line.strip():
            place.at = f"line {number}"
            words = line.split()
            if len(words) < 5:
                raise ValueError(f"{len(words)} words for a camera")
            yield _whole(words[0]), words[1], _whole(words[2]), _whole(words[3]), tuple(map(number_of, words[4:]))


def _images_txt(place: _Place) -> Iterator[ImageRecord]:
    for number, line in _lines(place.path)[::2]:
        if line.strip():
            place.at = f"line {number}"
            words = line.split(maxsplit=9)
            if len(words) < 10:
                raise ValueError(f"{len(words)} words for an image")
            values = tuple(map(number_of, words[1:8]))
            yield words[9].strip(), _whole(words[8]), values[:4], values[4:]


def _whole(word: str) -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", word):
        raise ValueError(f"no whole number: {shown(word)}")
    return int(word)


def _cameras_bin(place: _Place) -> Iterator[CameraRecord]:
    data, offset = read_binary_file(place.path), 8
    for entry in range(struct.unpack_from("<Q", data)[0]):
        place.at = f"camera {entry}, counted from 0"
        number, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        offset += 24
        if model not in _MODELS:
            raise ValueError(f"camera {number} has the unknown model number {model}")
        name, count = _MODELS[model]
        yield number, name, width, height, struct.unpack_from(f"<{count}d", data, offset)
        offset += 8 * count


def _images_bin(place: _Place) -> Iterator[ImageRecord]:
    data, offset = read_binary_file(place.path), 8
    for entry in range(struct.unpack_from("<Q", data)[0]):
        place.at = f"image {entry}, counted from 0"
        _, *pose, camera = struct.unpack_from("<i7di", data, offset)
        offset += 64
        end = data.find(b"\0", offset)
        if end < 0:
            raise IndexError
        try:
            name = data[offset:end].decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError("its name is no text in UTF-8") from None
        (points,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * points
        yield name, camera, tuple(pose[:4]), tuple(pose[4:])
