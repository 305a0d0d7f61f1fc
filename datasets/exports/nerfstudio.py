"""One rollout as nerfstudio's `transforms.json`, with the time of each frame.

Poses are camera to world with OpenGL axes, in metres, z of the world up; the pixel origin is that of nerfstudio. `time`
runs from 0 to 1 over the rollout, as readers of dynamic scenes expect; `time_s` is in seconds.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...schemas import UsageError
from ..capture.cameras import Camera
from ..capture.images import write_depth, write_image
from ..capture.transforms import opencv_from_opengl
from ..io.atomic import new_directory
from ..io.progress import progress
from ..models.model import read_model
from ..shapes.ply import Splats
from .selection import Picture, Selection
from .splat_files import in_world

MaskUse = Literal["none", "scene", "bodies"]
"""Pixels that `mask_path` keeps: all, the static scene, or the moving bodies."""
DEPTH_UNIT_M = 1e-3
MAX_DEPTH = 65535


def write_nerfstudio(
    path: Path, chosen: Selection, rollout: int = 0, mask: MaskUse = "none", overwrite: bool = False
) -> dict[str, int | float | str]:
    """Write images, depth (16 bits, mm, 0 = none), label images, masks, `transforms.json` and `points.ply`.

    Args:
        path: The directory to write.
        chosen: The dataset, its cameras and frames.
        rollout: Global index of the rollout.
        mask: Which pixels `mask_path` keeps (white); with ``none`` there is no `mask_path`. The label images are
            written in any case (`label_path`: 0 background, k the k-th body).
        overwrite: Replace what exists.

    Raises:
        UsageError: If there is no such rollout.
    """
    number = place_of(chosen, rollout)
    time_s = chosen.reader.read(number, "time")
    frames: list[dict[str, Any]] = []
    dropped = 0
    with new_directory(path, "nerfstudio capture", overwrite) as folder:
        for camera in progress(chosen.cameras, "cameras", len(chosen.cameras), "camera"):
            for picture in chosen.pictures(number, camera):
                entry, far = _frame(folder, camera, chosen.camera(number, camera, picture.frame), picture)
                if mask != "none":
                    kept = (picture.mask == 0) == (mask == "scene")
                    entry["mask_path"] = _write(folder, "masks", camera, picture.frame, kept.astype(np.uint8) * 255)
                entry["time"] = float(time_s[picture.frame] / time_s[-1])
                entry["time_s"] = float(time_s[picture.frame])
                frames.append(entry)
                dropped += far
        _write_points(folder / "points.ply", _first_points(chosen, number))
        document = {"camera_model": "OPENCV", "ply_file_path": "points.ply", "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    counts = {"rollout": rollout, "images": len(frames), "cameras": len(chosen.cameras)}
    return {**counts, "duration_s": float(time_s[-1]), "pixels_beyond_65_m": dropped, "mask_path": mask}


def place_of(chosen: Selection, rollout: int) -> int:
    """Return the place of a rollout, by its global index, in a selection.

    Raises:
        UsageError: If there is no such rollout.
    """
    indices = [info.index for info in chosen.reader.rollouts]
    if rollout not in indices:
        raise UsageError(
            f"{chosen.path} has no rollout {rollout}.",
            f"{len(indices)} rollouts, {min(indices)} to {max(indices)}.",
            "name one of these with --rollout.",
        )
    return indices.index(rollout)


def _frame(folder: Path, name: str, camera: Camera, picture: Picture) -> tuple[dict[str, Any], int]:
    depth = np.round(picture.depth_m / DEPTH_UNIT_M)
    far = depth > MAX_DEPTH
    depth = np.where(far, 0, depth).astype(np.uint16)
    distortion = [*np.asarray(camera.distortion, float), *[0.0] * 5][:5]
    entry: dict[str, Any] = {
        "file_path": _write(folder, "images", name, picture.frame, picture.image),
        "depth_file_path": _write(folder, "depth", name, picture.frame, depth),
        "label_path": _write(folder, "labels", name, picture.frame, picture.mask),
        "transform_matrix": opencv_from_opengl(camera.T_world_cam).tolist(),  # its own inverse
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.K[0, 0]),
        "fl_y": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
    }
    entry |= dict(zip(("k1", "k2", "p1", "p2", "k3"), map(float, distortion), strict=True))
    return entry, int(far.sum())


def _write(folder: Path, kind: str, camera: str, frame: int, pixels: NDArray[Any]) -> str:
    name = f"{kind}/{camera}/{frame:06d}.png"
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (write_depth if pixels.dtype == np.uint16 else write_image)(folder / name, pixels)
    return name


def _first_points(chosen: Selection, number: int) -> Splats:
    """Return the spheres of the model, posed as in the first frame of the rollout."""
    model = read_model(chosen.path / chosen.manifest.model)
    position = chosen.reader.read(number, "bodies/pos", 0, 1)[0]
    quat = chosen.reader.read(number, "bodies/quat_wxyz", 0, 1)[0]
    return in_world(model, dict(zip(chosen.bodies(number), zip(position, quat, strict=True), strict=True)))


def _write_points(path: Path, points: Splats) -> None:
    layout = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    table = np.zeros(len(points), layout)
    table["xyz"], table["rgb"] = points.means, np.round(np.clip(points.colors, 0, 1) * 255)
    header = ["ply", "format binary_little_endian 1.0", "comment unit metre", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode("ascii") + table.tobytes())
