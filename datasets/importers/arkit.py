"""Import of recordings with ARKit's poses and LiDAR depth: of the app Stray Scanner, and scenes of ARKitScenes.

Stray Scanner: `rgb.mp4`, `odometry.csv` (a pose camera to world a frame, OpenCV camera axes, in ARKit's world, whose y
axis points up), `camera_matrix.csv`, `depth/` [mm] and `confidence/` (0 to 2), numbered as the frames. Source:
github.com/strayrobots/scanner, `docs/format.md` and `OdometryEncoder.swift`. ARKitScenes (Apple): `lowres_wide/`,
`lowres_wide_intrinsics/*.pincam`, `lowres_wide.traj` (world to camera, OpenCV axes, z up), `lowres_depth/` [mm],
`confidence/`. Source: github.com/apple/ARKitScenes, `DATA.md` and `tenFpsDataLoader.py`. No recording of either was at
hand: tests write files by these descriptions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, PosedImage, Scale
from ...schemas.imports import ImportResult
from ...schemas.regular_files import read_text_file, require_regular_file
from ..capture.camera_faults import pose_fault
from ..capture.files import entries_of, optional_file
from ..capture.images import image_size, write_image
from ..capture.transforms import matrix4
from ..capture.video import frames_of
from ..io.atomic import new_directory
from ..io.cells import LARGEST, csv_rows, number_of, shown
from ..io.outputs import reads
from ..io.progress import progress
from .phone_scans import Z_UP_FROM_Y_UP, sure_depth, write_enlarged_depth
from .photo_captures import Photo, copy_photos, write_photo_capture
from .walk_video import choose, measured

_ODOMETRY = ("x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
POSE_WITHIN_S = 0.005
"""Largest time between a photo of ARKitScenes and its pose [s], as in its own reader."""


@dataclass(frozen=True)
class _Taken:
    """A photo with its camera."""

    name: str
    camera: CameraIntrinsics
    T_world_cam: NDArray[np.float64]
    where: str


@reads("source")
def import_arkit(source: Path | str, out: Path | str, photos: int = 60, overwrite: bool = False) -> ImportResult:
    """Write frames of a recording with ARKit's poses as a capture, with metric cameras and depth.

    Of Stray Scanner's video, sharp, well-spaced frames are taken; of ARKitScenes, photos at equal distances in time.
    Depth is enlarged to the size of the photos; pixels of confidence 0 are left out.

    Args:
        source: The folder with `odometry.csv`, or that with `lowres_wide.traj`.
        out: The capture directory to write.
        photos: Most photos.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the folder is no such recording, or a file of it is wrong.
        UsageError: If `out` exists, before anything is read.
    """
    source = Path(source)
    with new_directory(out, "capture", overwrite) as directory:
        if optional_file(source / "odometry.csv") is not None:
            taken, notes = _stray(source, directory, photos)
        elif optional_file(source / "lowres_wide.traj") is not None:
            taken, notes = _scenes(source, directory, photos)
        else:
            raise InputDataError(
                f"{source}: neither odometry.csv (Stray Scanner) nor lowres_wide.traj (ARKitScenes).",
                todo="name the folder that holds it.",
            )
        return write_photo_capture(directory, out, len(taken), _posed(taken), notes)


def _posed(taken: Sequence[_Taken]) -> CamerasFile:
    """Return the cameras of photos; those with the same numbers are one."""
    cameras, images = {}, {}
    for one in taken:
        fault = pose_fault(one.T_world_cam)
        if fault is not None:
            raise InputDataError(
                f"{one.where}: {fault}.",
                "a rotation and a position in metres.",
                "take the file of the original recording.",
            )
        key = next((key for key, known in cameras.items() if known == one.camera), f"camera{len(cameras)}")
        cameras[key] = one.camera
        images[one.name] = PosedImage(camera=key, T_world_cam=matrix4(one.T_world_cam))
    return CamerasFile(scale=Scale(kind="metric", source="ARKit"), cameras=cameras, images=images)


def _stray(source: Path, directory: Path, most: int) -> tuple[list[_Taken], list[str]]:
    poses = _odometry(source / "odometry.csv")
    K = _matrix(source / "camera_matrix.csv")
    video = require_regular_file(source / "rgb.mp4")
    figures = measured(frames_of(video))
    chosen = [k for k in choose(figures, most)[0] if k in poses]
    if not chosen:
        raise InputDataError(
            f"{source}: no frame of rgb.mp4 has a pose in odometry.csv.", todo="export the recording again."
        )
    (directory / "images").mkdir()
    taken, wanted = [], set(chosen)
    for k, frame in enumerate(frames_of(video)):
        if k not in wanted:
            continue
        name = f"{k:06d}.jpg"
        where = f"{source / 'odometry.csv'}: frame {k}"
        camera = _lens_of_frame(video, where, frame, K | poses[k][1])
        write_image(directory / "images" / name, np.ascontiguousarray(frame[:, :, ::-1]), 97)
        taken.append(_Taken(name, camera, Z_UP_FROM_Y_UP @ poses[k][0], where))
    depths = {one.name: source / "depth" / f"{Path(one.name).stem}.png" for one in taken}
    _copy_depth(depths, source / "confidence", directory)
    left = len(figures.walked) - len(taken)
    return taken, [f"{left} of {len(figures.walked)} frames are left out (--photos)"] if left else []


def _lens_of_frame(video: Path, where: str, frame: NDArray[np.uint8], lens: dict[str, float]) -> CameraIntrinsics:
    """Return the camera of a frame of the video, whose principal point must lie near its middle."""
    height, width = frame.shape[:2]
    if not (0.2 < lens["cx"] / width < 0.8 and 0.2 < lens["cy"] / height < 0.8):
        raise InputDataError(
            f"{video}: {width}x{height} px, but the principal point is ({lens['cx']:.0f}, {lens['cy']:.0f}).",
            "a video of the size for which camera_matrix.csv was written.",
            "copy the original video; do not turn or resize it.",
        )
    return CameraIntrinsics.of_lens(where, width=width, height=height, **lens, distortion=())


def _odometry(path: Path) -> dict[int, tuple[NDArray[np.float64], dict[str, float]]]:
    """Return pose camera to world (4, 4) and own intrinsics of each frame, by its number."""
    (_, header), *rows = [(line, [cell.strip() for cell in cells]) for line, cells in csv_rows(path)] or [(0, [])]
    if not {"frame", *_ODOMETRY} <= set(header):
        raise InputDataError(
            f"{path}: the columns {', '.join(header[:12]) or 'none'}.",
            f"timestamp, frame, {', '.join(_ODOMETRY)}.",
            "export the trajectory again.",
        )
    found: dict[int, tuple[NDArray[np.float64], dict[str, float]]] = {}
    own = list(_INTRINSICS) if set(_INTRINSICS) <= set(header) else []
    for number, cells in rows:
        if not cells:
            continue
        frame, pose, lens = _frame(dict(zip(header, cells, strict=False)), own, f"{path}: line {number}")
        found[frame] = pose, lens
    return found


def _frame(row: dict[str, str], own: Sequence[str], where: str) -> tuple[int, NDArray[np.float64], dict[str, float]]:
    """Return the number of a frame, its pose and the intrinsics that it has of its `own`."""
    values = _numbers([row.get(name, "") for name in ("frame", *_ODOMETRY, *own)], where)
    return int(values[0]), _pose(values[4:8], values[1:4], where), dict(zip(own, values[8:], strict=True))


def _matrix(path: Path) -> dict[str, float]:
    rows = [line.split(",") for line in read_text_file(path).splitlines() if line.strip()]
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        raise InputDataError(
            f"{path}: not a matrix of 3 x 3 numbers.",
            "fx, 0, cx / 0, fy, cy / 0, 0, 1.",
            "take the file of the original recording.",
        )
    K = np.array([_numbers(row, str(path)) for row in rows])
    return {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def _scenes(source: Path, directory: Path, most: int) -> tuple[list[_Taken], list[str]]:
    times, poses = _trajectory(source / "lowres_wide.traj")
    files = [path for path in entries_of(source / "lowres_wide") if path.suffix.lower() == ".png"]
    pairs = _with_poses(files, times, poses)
    if not pairs:
        raise InputDataError(
            f"{source}: {len(files)} photos in lowres_wide/, none with a pose in lowres_wide.traj within 5 ms.",
            "photos <video>_<seconds>.png.",
            "take the photos and lowres_wide.traj of one recording.",
        )
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().astype(int))
    taken, sources = [], []
    for path, pose in (pairs[k] for k in chosen):
        camera = _pincam(source / "lowres_wide_intrinsics", path)
        _require_size(path, camera)
        taken.append(_Taken(path.name, camera, pose, f"{source / 'lowres_wide.traj'}: the pose of {path.name}"))
        sources.append(Photo(path, path.name))
    copy_photos(directory, sources)
    _copy_depth({one.name: source / "lowres_depth" / one.name for one in taken}, source / "confidence", directory)
    left = len(files) - len(taken)
    return taken, [f"{left} of {len(files)} photos are left out (--photos, or without a pose)"] if left else []


def _with_poses(
    files: Sequence[Path], times: NDArray[np.float64], poses: Sequence[NDArray[np.float64]]
) -> list[tuple[Path, NDArray[np.float64]]]:
    """Return the photos that have a pose of nearly their time, with it."""
    pairs = []
    for path in files:
        away = np.abs(times - _time(path))
        if len(away) and away.min() <= POSE_WITHIN_S:
            pairs.append((path, poses[int(away.argmin())]))
    return pairs


def _require_size(path: Path, camera: CameraIntrinsics) -> None:
    if (camera.width, camera.height) != image_size(path):
        raise InputDataError(
            f"{path}: not of the size of its .pincam.",
            f"{camera.width}x{camera.height} px.",
            "take photo and .pincam of one recording.",
        )


def _trajectory(path: Path) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """Return the times [s] and the poses camera to world (4, 4)."""
    times, poses = [], []
    for number, line in enumerate(read_text_file(path).splitlines(), start=1):
        if not line.strip():
            continue
        where = f"{path}: line {number}"
        values = _numbers(line.split(), where)
        if len(values) != 7:
            raise InputDataError(
                f"{where}: {len(values)} numbers.",
                "seconds, axis times angle, position: seven.",
                "take the file of the original recording.",
            )
        world_to_cam = np.eye(4)
        world_to_cam[:3, :3] = Rotation.from_rotvec(values[1:4]).as_matrix()
        world_to_cam[:3, 3] = values[4:]
        times.append(values[0])
        poses.append(np.linalg.inv(world_to_cam))
    return np.array(times), poses


def _pincam(folder: Path, photo: Path) -> CameraIntrinsics:
    """Return the camera of a photo, whose file may be named a millisecond off."""
    video, time = photo.stem.rsplit("_", 1)
    names = [f"{video}_{float(time) + off:.3f}.pincam" for off in (0.0, -0.001, 0.001)]
    path = next((found for name in names if (found := optional_file(folder / name)) is not None), None)
    if path is None:
        raise InputDataError(f"{folder}: no {names[0]} for {photo.name}.", todo="download the intrinsics, too.")
    values = _numbers(read_text_file(path).split(), str(path))
    if len(values) != 6 or min(values[:2]) < 1:
        raise InputDataError(
            f"{path}: not six numbers.", "width height fx fy cx cy.", "take the file of the original recording."
        )
    lens = dict(zip(_INTRINSICS, values[2:], strict=True))
    size = {"width": int(values[0]), "height": int(values[1])}
    return CameraIntrinsics.of_lens(str(path), **size, **lens, distortion=())


def _copy_depth(depths: dict[str, Path], confidence: Path, directory: Path) -> None:
    """Write the depth maps that exist, in the size of the photos."""
    there = {name: found for name, path in depths.items() if (found := optional_file(path)) is not None}
    if there:
        (directory / "depth").mkdir()
    for name, path in progress(there.items(), "depth", unit="map"):
        depth = sure_depth(path, optional_file(confidence / path.name))
        size = image_size(directory / "images" / name)
        write_enlarged_depth(directory / "depth" / f"{Path(name).stem}.png", depth, size)


def _time(path: Path) -> float:
    text = path.stem.rsplit("_", 1)[-1]
    return _numbers([text], str(path))[0]


def _numbers(cells: Sequence[str], where: str) -> list[float]:
    values = []
    for cell in cells:
        try:
            values.append(number_of(cell))
        except ValueError:
            raise InputDataError(f"{where}: {shown(cell)} is not a number.", todo="export it again.") from None
    if not all(math.isfinite(value) and abs(value) <= LARGEST for value in values):
        raise InputDataError(f"{where}: a number that is not finite, or too large.", todo="export it again.")
    return values


def _pose(quat_xyzw: Sequence[float], position: Sequence[float], where: str) -> NDArray[np.float64]:
    if not any(quat_xyzw):
        raise InputDataError(f"{where}: a quaternion of zeros.", "qx, qy, qz, qw.", "export it again.")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quat_xyzw).as_matrix()
    pose[:3, 3] = position
    return pose
