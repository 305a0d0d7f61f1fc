"""Import of scans of phones that know their pose: Polycam's raw data and Record3D's recordings.

Both store what ARKit measured: poses camera to world [m], OpenGL camera axes (x right, y up, z backward), in a world
whose y axis points up, which is turned to z up here. Sources: Polycam, "How to extract raw data and what is included"
and github.com/PolyCam/polyform; Record3D, record3d.app and the readers of nerfstudio (`process_data`). Tests
write files by these descriptions; Record3D was tried on one published recording, Polycam on none.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, PosedImage, Scale, read_json
from ...schemas.base import FileModel
from ...schemas.imports import ImportResult
from ..capture.camera_faults import pose_fault
from ..capture.files import entries_of, has_folder, optional_file
from ..capture.images import decoded, image_size, write_depth
from ..capture.transforms import matrix4, opencv_from_opengl
from ..io.atomic import new_directory
from ..io.outputs import reads
from ..io.progress import progress
from .photo_captures import Photo, copy_photos, photos_in, require_size, require_unpacked, write_photo_capture

Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""Turns a world whose y axis points up about x, so that z points up."""
_UNSURE = 1
"""Least confidence of a depth of ARKit, 0 to 2 (Polycam: 0 to 255), that is kept."""


class _Keyframe(FileModel, extra="ignore"):
    """`keyframes/cameras/<time>.json` of Polycam."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float

    def pose(self) -> np.ndarray:
        """Return camera to world as it is in the file, shape (4, 4)."""
        rows = [[getattr(self, f"t_{row}{column}") for column in range(4)] for row in range(3)]
        return np.array([*rows, [0.0, 0.0, 0.0, 1.0]])


class _Recording(FileModel, extra="ignore"):
    """`metadata` of Record3D."""

    w: Annotated[int, Field(ge=1)]
    h: Annotated[int, Field(ge=1)]
    K: Annotated[tuple[float, ...], Field(min_length=9, max_length=9)]
    """Camera matrix, column by column [px]."""
    poses: tuple[tuple[float, float, float, float, float, float, float], ...]
    """Quaternion (x, y, z, w) and position [m] of each frame."""


@reads("source")
def import_polycam(source: Path | str, out: Path | str, overwrite: bool = False) -> ImportResult:
    """Write the keyframes of a raw export of Polycam as a capture, with metric cameras and depth.

    Corrected cameras and images (`corrected_cameras/`, `corrected_images/`) are preferred. Depth is enlarged to the
    size of the photos, each pixel from its nearest; pixels without confidence are left out.

    Args:
        source: The folder that holds `keyframes/`.
        out: The capture directory to write.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the folder is no such export, or a file of it is wrong.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        root = require_unpacked(Path(source))
        root = root / "keyframes" if has_folder(root / "keyframes") else root
        folder = next((root / name for name in ("corrected_images", "images") if has_folder(root / name)), None)
        if folder is None:
            raise InputDataError(
                f"{root / 'images'}: no such folder: {source} is no raw export of Polycam.",
                "keyframes/ with images/ and cameras/.",
                "export the raw data in the app (its developer mode), and name the folder.",
            )
        poses = root / ("corrected_cameras" if has_folder(root / "corrected_cameras") else "cameras")
        photos = photos_in(folder)
        cameras, images = {}, {}
        for photo in photos:
            path = poses / f"{Path(photo.name).stem}.json"
            frame = read_json(path, _Keyframe)
            size = (frame.width, frame.height)
            require_size(photo, size)
            intrinsics = {"fx": frame.fx, "fy": frame.fy, "cx": frame.cx, "cy": frame.cy}
            camera = CameraIntrinsics.of_lens(str(path), width=size[0], height=size[1], **intrinsics, distortion=())
            images[photo.name] = _posed(cameras, camera, frame.pose(), str(path))
        copy_photos(directory, photos)
        _copy_depth(root, directory, photos)
        posed = CamerasFile(scale=_scale("Polycam (ARKit)"), cameras=cameras, images=images)
        return write_photo_capture(directory, out, len(photos), posed)


@reads("source")
def import_record3d(source: Path | str, out: Path | str, photos: int = 60, overwrite: bool = False) -> ImportResult:
    """Write frames of a recording of Record3D as a capture, with metric cameras.

    An .r3d file is an archive: unpack it first. Frames are taken at equal distances in time. Depth in .r3d files is
    compressed with Apple's LZFSE and is not read.

    Args:
        source: The folder with `metadata` (or `metadata.json`), and photos in `rgbd/` or `rgb/`, named by number.
        out: The capture directory to write.
        photos: Most photos.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the folder is no such recording.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        root = require_unpacked(Path(source))
        path = root / ("metadata" if (root / "metadata").is_file() else "metadata.json")
        if optional_file(path) is None:
            raise InputDataError(
                f"{path}: no such file: {source} is no recording of Record3D.",
                "metadata (or metadata.json) beside rgbd/ or rgb/.",
                "export an .r3d file, unpack it, and name the folder.",
            )
        recording = read_json(path, _Recording)
        folder = root / ("rgbd" if has_folder(root / "rgbd") else "rgb")
        frames = _numbered(photos_in(folder), len(recording.poses), path)
        chosen = [
            frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(photos, len(frames))).round().astype(int))
        ]
        cameras, images = {}, {}
        K = np.array(recording.K).reshape(3, 3).T
        for number, photo in chosen:
            require_size(photo, (recording.w, recording.h))
            lens = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
            camera = CameraIntrinsics.of_lens(str(path), width=recording.w, height=recording.h, **lens, distortion=())
            pose = _pose_of(recording.poses[number], f"{path}: pose {number}")
            images[photo.name] = _posed(cameras, camera, pose, f"{path}: pose {number}")
        copy_photos(directory, [photo for _, photo in chosen])
        posed = CamerasFile(scale=_scale("Record3D (ARKit)"), cameras=cameras, images=images)
        left = [f"{len(frames) - len(chosen)} of {len(frames)} frames are left out (--photos)"]
        return write_photo_capture(directory, out, len(chosen), posed, left if len(frames) > len(chosen) else [])


def _scale(source: str) -> Scale:
    return Scale(kind="metric", source=source)


def _posed(cameras: dict[str, CameraIntrinsics], camera: CameraIntrinsics, pose: np.ndarray, where: str) -> PosedImage:
    """Return a photo of a camera, which is added if it is new, from its pose in ARKit's world."""
    T_world_cam = opencv_from_opengl(Z_UP_FROM_Y_UP @ pose)
    fault = pose_fault(T_world_cam)
    if fault is not None:
        raise InputDataError(f"{where}: {fault}.", "a rotation and a position in metres.", "export it again.")
    name = next((name for name, known in cameras.items() if known == camera), None)
    if name is None:
        name = f"camera{len(cameras)}"
        cameras[name] = camera
    return PosedImage(camera=name, T_world_cam=matrix4(T_world_cam))


def _pose_of(numbers: Sequence[float], where: str) -> np.ndarray:
    if not np.isfinite(numbers).all() or not any(numbers[:4]):
        raise InputDataError(f"{where}: not finite, or no rotation.", "qx qy qz qw px py pz.", "export it again.")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(numbers[:4]).as_matrix()
    pose[:3, 3] = numbers[4:]
    return pose


def _numbered(photos: list[Photo], count: int, path: Path) -> list[tuple[int, Photo]]:
    """Return photos with their numbers, in their order; each has a pose."""
    found = []
    for photo in photos:
        stem = photo.source.stem
        if not (stem.isascii() and stem.isdecimal()) or int(stem) >= count:
            raise InputDataError(
                f"{photo.source}: no number of one of the {count} poses of {path.name}.",
                "0.jpg, 1.jpg, ...",
                "take photos and poses of one recording.",
            )
        found.append((int(stem), photo))
    return sorted(found, key=lambda one: one[0])


def _maps(folder: Path) -> dict[str, Path]:
    """Return the maps in a folder by their names without suffix."""
    return {path.stem: path for path in entries_of(folder) if path.suffix.lower() == ".png"}


def _copy_depth(root: Path, directory: Path, photos: list[Photo]) -> None:
    """Write the depth maps of photos [mm] in their size, without pixels that have no confidence."""
    there, sure = _maps(root / "depth"), _maps(root / "confidence")
    known = [photo for photo in photos if Path(photo.name).stem in there]
    if known:
        (directory / "depth").mkdir()
    for photo in progress(known, "depth", unit="map"):
        stem = Path(photo.name).stem
        depth = sure_depth(there[stem], sure.get(stem))
        write_enlarged_depth(directory / "depth" / f"{stem}.png", depth, image_size(photo.source))


def sure_depth(path: Path, confidence: Path | None) -> NDArray[np.uint16]:
    """Return a depth map (H, W) [mm], 0 where its map of confidence, if there is one, has 0."""
    depth = _grey(path, np.uint16)
    if confidence is None:
        return np.asarray(depth, np.uint16)
    sure = _grey(confidence, np.uint8)
    if sure.shape != depth.shape:
        raise InputDataError(
            f"{confidence}: {sure.shape[1]}x{sure.shape[0]} px, but the depth has "
            f"{depth.shape[1]}x{depth.shape[0]} px.",
            "maps of one size.",
            "take both of one recording.",
        )
    return np.where(sure >= _UNSURE, depth, 0).astype(np.uint16)


def write_enlarged_depth(path: Path, depth_mm: NDArray[np.uint16], size: tuple[int, int]) -> None:
    """Write a depth map (H, W) [mm] in another size (width, height), each pixel from its nearest."""
    large = cv2.resize(depth_mm, size, interpolation=cv2.INTER_NEAREST)
    write_depth(path, np.asarray(large, np.uint16))


def _grey(path: Path, kind: Any) -> np.ndarray:
    values = decoded(path, cv2.IMREAD_UNCHANGED)
    if values.ndim != 2 or values.dtype != kind:
        raise InputDataError(
            f"{path}: {1 if values.ndim == 2 else values.shape[2]} channel(s) of {8 * values.dtype.itemsize} bits.",
            f"one channel of {8 * np.dtype(kind).itemsize} bits.",
            "take the file of the original recording.",
        )
    return values
