"""Reading of cameras from nerfstudio's (and instant-ngp's) `transforms.json`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, PosedImage, Scale, parse
from ...schemas.cameras import Matrix4
from ...schemas.documents import parse_json
from ...schemas.regular_files import read_text_file
from .files import optional_file
from .images import IMAGE_SUFFIXES, image_size

_INTRINSICS = (
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
    "h",
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "camera_angle_x",
    "camera_angle_y",
)
_EXPORT = "correct it there, or write it again with the tool that made it."
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def read_transforms(path: Path, metric: bool = False) -> CamerasFile:
    """Read `transforms.json`: intrinsics common or by frame, poses camera to world with OpenGL axes.

    The axes are converted to OpenCV's (y and z reversed). Principal points need no shift: nerfstudio casts the ray of
    pixel column i at i + 0.5, so it shares the corner origin used here. `applied_transform` records an earlier
    transformation of the world and is not undone.

    Args:
        path: The file.
        metric: Whether its unit is the metre, which the file does not contain.

    Raises:
        InputDataError: For a field that is missing or wrong, or a camera model that is not a pinhole.
    """
    return cameras_of(parse_json(read_text_file(path), path), path, metric)


def _file_path(where: str, frame: Any) -> str:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise InputDataError(f"{where}: no 'file_path'.", "the path of its photo, a text.", _EXPORT)
    return frame["file_path"]


def cameras_of(data: Any, path: Path, metric: bool = False) -> CamerasFile:
    """Return the cameras of a `transforms.json` whose content is parsed; see :func:`read_transforms`."""
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputDataError(f"{path}: no list 'frames' with at least one frame.", todo=_EXPORT)
    cameras: dict[str, CameraIntrinsics] = {}
    images: dict[str, PosedImage] = {}
    for k, frame in enumerate(data["frames"]):
        where = f"{path}: frames[{k}]"
        file = _image_file(path.parent, _file_path(where, frame))
        intrinsics = _intrinsics(where, {**data, **frame}, path.parent / file)
        camera = next((name for name, known in cameras.items() if known == intrinsics), f"camera{len(cameras)}")
        cameras[camera] = intrinsics
        name = file.removeprefix("images/")
        if name in images:
            raise InputDataError(
                f"{where}: '{frame['file_path']}' stands twice.", "one frame for each photo.", "remove one."
            )
        images[name] = parse({"camera": camera, "T_world_cam": _pose(where, frame)}, PosedImage, where)
    scale = Scale(kind="metric" if metric else "unscaled", source="transforms.json")
    return CamerasFile(scale=scale, cameras=cameras, images=images)


def opencv_from_opengl(T_world_cam: np.ndarray) -> np.ndarray:
    """Convert a camera pose (4, 4) from OpenGL axes (y up, z backward) to OpenCV axes."""
    return np.asarray(T_world_cam, np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])


def matrix4(pose: np.ndarray) -> Matrix4:
    """Return a 4x4 matrix in the format of `cameras.json`."""
    if pose.shape != (4, 4):
        raise ValueError(f"a pose has the shape (4, 4); found {pose.shape}")
    a, b, c, d = ((float(x), float(y), float(z), float(w)) for x, y, z, w in pose)
    return a, b, c, d


def _image_file(folder: Path, file_path: str) -> str:
    name = file_path.removeprefix("./")
    if Path(name).suffix.lower() in IMAGE_SUFFIXES or optional_file(folder / name) is not None:
        return name
    # Blender's synthetic scenes leave the suffix out.
    return next((name + suffix for suffix in (".png", ".jpg") if optional_file(folder / (name + suffix))), name)


def _pose(where: str, frame: dict[str, Any]) -> Matrix4:
    try:
        matrix = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        allowed = "four rows of four numbers, the pose camera to world."
        raise InputDataError(f"{where}: 'transform_matrix' is no 4x4 matrix of finite numbers.", allowed, _EXPORT)
    return matrix4(opencv_from_opengl(matrix))


def _intrinsics(where: str, fields: dict[str, Any], image: Path) -> CameraIntrinsics:
    values = {name: _number(where, fields, name) for name in _INTRINSICS if name in fields}
    _require_pinhole(where, fields, values.get("k4", 0.0))
    if "w" in values and "h" in values:
        width, height = round(values["w"]), round(values["h"])
    else:
        places = (image, image.parent / "images" / image.name)
        width, height = image_size(next((place for place in places if place.exists()), image))
    fx, fy = _focal_lengths(where, values, width, height)
    distortion = tuple(values.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
    return CameraIntrinsics.of_lens(
        where,
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=values.get("cx", width / 2),
        cy=values.get("cy", height / 2),
        distortion=distortion if distortion[4] else distortion[:4],
    )


def _require_pinhole(where: str, fields: dict[str, Any], k4: float) -> None:
    """Refuse a camera that is no pinhole, or whose distortion has a term too many."""
    model = str(fields.get("camera_model", "OPENCV"))
    if model not in _MODELS or fields.get("is_fisheye"):
        raise InputDataError(
            f"{where}: the camera model is {model if model not in _MODELS else 'a fisheye'}.",
            ", ".join(_MODELS) + ".",
            "undistort the photos to a pinhole camera first.",
        )
    if k4:
        raise InputDataError(
            f"{where}: k4 = {k4:g}.",
            "distortion by k1, k2, p1, p2, k3.",
            "undistort the pictures, or fit their camera without k4.",
        )


def _focal_lengths(where: str, values: dict[str, float], width: int, height: int) -> tuple[float, float]:
    """Return fx and fy [px], from focal lengths or angles of view; fy is fx where neither is given for it."""
    fx = values.get("fl_x") or _focal(where, values, "camera_angle_x", width)
    fy = values.get("fl_y") or (_focal(where, values, "camera_angle_y", height) if "camera_angle_y" in values else fx)
    return fx, fy


def _focal(where: str, values: dict[str, float], name: str, size_px: int) -> float:
    if not 0 < values.get(name, 0.0) < math.pi:
        found = (
            f"'{name}' is {values[name]:g}"
            if name in values
            else f"neither a focal length 'fl_x' nor an angle '{name}'"
        )
        raise InputDataError(
            f"{where}: {found}.",
            "fl_x [px] above 0, or an angle of view between 0 and pi [rad].",
            _EXPORT,
        )
    return size_px / (2 * math.tan(values[name] / 2))


def _number(where: str, fields: dict[str, Any], name: str) -> float:
    value = fields[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputDataError(f"{where}: '{name}' is {value!r:.40}, no finite number.", "a number.", _EXPORT)
    return float(value)
