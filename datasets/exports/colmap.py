"""A model's photos and spheres as a COLMAP model: cameras, images, points3D, rigs and frames (.bin).

Source of the layout: COLMAP documentation, "Output format"; rigs and frames as COLMAP 4 writes them (one frame for each
image, one rig for each camera).
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...schemas import CameraIntrinsics, CamerasFile
from ..capture.cameras import camera_of
from ..io.atomic import new_directory
from ..shapes.ply import Splats

_PINHOLE, _OPENCV, _FULL_OPENCV = 1, 4, 6
_CAMERA_SENSOR = 0


def write_colmap(
    path: Path, cameras: CamerasFile, points: Splats, photos: Path | None = None, overwrite: bool = False
) -> dict[str, int]:
    """Write `sparse/0/*.bin`, and `images/` if the photos are available.

    The COLMAP model has the axes, pixel origin and unit of the cameras. Its points are the centres of the spheres;
    images have no 2D points, so that tracks are empty and the error is -1, COLMAP's value for unknown.

    Args:
        path: The directory to write.
        cameras: Photos with poses.
        points: Spheres in the world frame, of which centres and colours are written.
        photos: Folder of the photos; existing ones are copied.
        overwrite: Replace what exists.

    Returns:
        Numbers of cameras, images, points, and copied photos.
    """
    camera_ids = {name: number for number, name in enumerate(cameras.cameras, 1)}
    sensors = [camera_ids[image.camera] for image in cameras.images.values()]
    with new_directory(path, "COLMAP model", overwrite) as folder:
        sparse = folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        files = {
            "cameras": _counted([_camera(camera_ids[name], entry) for name, entry in cameras.cameras.items()]),
            "images": _images(cameras, sensors),
            "points3D": _points(points),
            "rigs": _counted(
                [struct.pack("<IIiI", number, 1, _CAMERA_SENSOR, number) for number in camera_ids.values()]
            ),
            "frames": _frames(cameras, sensors),
        }
        for name, data in files.items():
            (sparse / f"{name}.bin").write_bytes(data)
        copied = 0 if photos is None else _copy_photos(photos, cameras.images, folder / "images")
    counts = {"cameras": len(cameras.cameras), "images": len(cameras.images)}
    return {**counts, "points": len(points), "photos_copied": copied}


def _counted(records: list[bytes]) -> bytes:
    return struct.pack("<Q", len(records)) + b"".join(records)


def _camera(number: int, entry: CameraIntrinsics) -> bytes:
    focal = (entry.fx, entry.fy, entry.cx, entry.cy)
    distortion = entry.distortion
    if not any(distortion):
        model, params = _PINHOLE, focal
    elif len(distortion) == 4:
        model, params = _OPENCV, (*focal, *distortion)
    else:  # k1, k2, p1, p2, k3, and k4 to k6 of OpenCV's rational model
        model, params = _FULL_OPENCV, (*focal, *distortion, 0.0, 0.0, 0.0)
    return struct.pack(f"<iiQQ{len(params)}d", number, model, entry.width, entry.height, *params)


def _poses(cameras: CamerasFile) -> list[bytes]:
    """Return each image's pose, world to camera: quaternion w x y z, translation."""
    packed = []
    for name in cameras.images:
        T_cam_world = camera_of(cameras, name).T_cam_world
        quat_wxyz = Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(canonical=True, scalar_first=True)
        packed.append(struct.pack("<7d", *quat_wxyz, *T_cam_world[:3, 3]))
    return packed


def _images(cameras: CamerasFile, sensors: list[int]) -> bytes:
    records = []
    entries = zip(cameras.images, _poses(cameras), sensors, strict=True)
    for number, (name, pose, sensor) in enumerate(entries, 1):
        tail = struct.pack("<I", sensor) + name.encode("utf-8") + b"\0" + struct.pack("<Q", 0)
        records.append(struct.pack("<I", number) + pose + tail)
    return _counted(records)


def _frames(cameras: CamerasFile, sensors: list[int]) -> bytes:
    records = []
    for number, (pose, sensor) in enumerate(zip(_poses(cameras), sensors, strict=True), 1):
        data = struct.pack("<IiIQ", 1, _CAMERA_SENSOR, sensor, number)
        records.append(struct.pack("<II", number, sensor) + pose + data)
    return _counted(records)


def _points(points: Splats) -> bytes:
    colors = np.round(np.clip(points.colors, 0, 1) * 255).astype(np.uint8)
    layout = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
    table = np.zeros(len(points), layout)
    table["id"], table["xyz"], table["rgb"], table["error"] = np.arange(1, len(points) + 1), points.means, colors, -1.0
    return struct.pack("<Q", len(points)) + table.tobytes()


def _copy_photos(photos: Path, names: Iterable[str], images: Path) -> int:
    """Copy the photos that there are; return their number."""
    there = [name for name in names if (photos / name).is_file()]
    for name in there:
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(photos / name, images / name)
    return len(there)
