"""One rollout as a recording of the viewer Rerun (.rrd): bodies, cameras, pictures, depth, labels, contacts.

The world is that of the dataset: metres, z up; cameras have the axes of OpenCV (RDF). Timelines: `time` [s] and
`frame`. Depth has steps of 1 mm. Source: rerun.io/docs, archetypes Transform3D, Pinhole, EncodedImage,
EncodedDepthImage, SegmentationImage, Points3D and Arrows3D.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import UsageError
from ..capture.images import encoded_image
from ..io.atomic import new_file
from ..io.progress import progress
from ..models.model import Model, read_model
from ..shapes.ply import Splats
from .nerfstudio import DEPTH_UNIT_M, MAX_DEPTH, place_of
from .selection import Picture, Selection

APPLICATION = "cgwm"
LONGEST_ARROW_M = 0.2
"""Length of the arrow of the largest impulse [m]."""
_JPEG_QUALITY = 95


def require_rerun() -> Any:
    """Return the package rerun.

    Raises:
        UsageError: If it is not installed.
    """
    try:
        import rerun  # pyright: ignore[reportMissingImports]
    except ImportError:
        todo = "pip install 'cgwm[rerun]'."
        raise UsageError("--to rerun needs rerun-sdk, which is not installed.", todo=todo) from None
    return rerun


def write_rerun(
    path: Path, chosen: Selection, rollout: int = 0, overwrite: bool = False
) -> dict[str, int | float | str]:
    """Write one rollout as a recording.

    Args:
        path: The file, `.rrd`.
        chosen: The dataset, its cameras and frames.
        rollout: Global index of the rollout.
        overwrite: Replace what exists.

    Raises:
        UsageError: If rerun-sdk is not installed, or there is no such rollout.
    """
    rerun = require_rerun()
    number = place_of(chosen, rollout)
    time_s = chosen.reader.read(number, "time")
    frames = range(0, len(time_s), chosen.every)
    with new_file(path, "Rerun recording", overwrite) as temporary:
        log = rerun.RecordingStream(APPLICATION, recording_id=f"{chosen.path.resolve().name}-{rollout}")
        log.save(temporary)
        _add_shapes(rerun, log, read_model(chosen.path / chosen.manifest.model), chosen.bodies(number))
        _add_motion(rerun, log, chosen, number, time_s, frames)
        for camera in progress(chosen.cameras, "cameras", len(chosen.cameras), "camera"):
            for picture in chosen.pictures(number, camera):
                _at(log, picture.frame, time_s)
                _add_picture(rerun, log, chosen, number, camera, picture)
        log.flush()
        log.disconnect()
    counts = {"rollout": rollout, "frames": len(frames), "cameras": len(chosen.cameras)}
    return {**counts, "images": len(frames) * len(chosen.cameras), "duration_s": float(time_s[-1])}


def _at(log: Any, frame: int, time_s: NDArray[np.float64]) -> None:
    log.set_time("time", duration=float(time_s[frame]))
    log.set_time("frame", sequence=frame)


def _add_shapes(rerun: Any, log: Any, model: Model, bodies: list[str]) -> None:
    """Log what does not change: axes, names of labels, and spheres."""
    log.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    labels = [rerun.AnnotationInfo(id=k + 1, label=name) for k, name in enumerate(bodies)]
    log.log("world", rerun.AnnotationContext([rerun.AnnotationInfo(id=0, label="background"), *labels]), static=True)
    if model.scene is not None:
        log.log("world/scene", _points(rerun, model.scene), static=True)
    for name in bodies:
        splats = model.body_splats.get(name)
        if splats is not None:
            log.log(f"world/{name}/splats", _points(rerun, splats), static=True)


def _points(rerun: Any, splats: Splats) -> Any:
    colors = np.round(np.clip(splats.colors, 0, 1) * 255).astype(np.uint8)
    return rerun.Points3D(np.asarray(splats.means, np.float32), colors=colors, radii=np.asarray(splats.scales))


def _add_motion(
    rerun: Any, log: Any, chosen: Selection, number: int, time_s: NDArray[np.float64], frames: range
) -> None:
    """Log poses of bodies, and contacts: an arrow from each point along the impulse on the first body."""
    position, quat = (chosen.reader.read(number, f"bodies/{name}") for name in ("pos", "quat_wxyz"))
    contacts = {frame: chosen.reader.contacts(number, frame) for frame in frames}
    sizes = [np.linalg.norm(rows["impulse_world"], axis=-1).max(initial=0.0) for rows in contacts.values()]
    scale = LONGEST_ARROW_M / largest if (largest := max(sizes, default=0.0)) > 0 else 0.0
    for frame in frames:
        _at(log, frame, time_s)
        for k, name in enumerate(chosen.bodies(number)):
            turn = rerun.Quaternion(xyzw=quat[frame, k][[1, 2, 3, 0]])
            log.log(f"world/{name}", rerun.Transform3D(translation=position[frame, k], quaternion=turn))
        rows = contacts[frame]
        arrows = rerun.Arrows3D(origins=rows["pos_world"], vectors=scale * rows["impulse_world"])
        log.log("world/contacts", arrows)


def _add_picture(rerun: Any, log: Any, chosen: Selection, number: int, name: str, picture: Picture) -> None:
    camera, place = chosen.camera(number, name, picture.frame), f"world/cameras/{name}"
    pose = camera.T_world_cam
    log.log(place, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    lens = {"image_from_camera": camera.K, "width": camera.width, "height": camera.height}
    log.log(place, rerun.Pinhole(**lens, camera_xyz=rerun.ViewCoordinates.RDF))
    bgr = cv2.cvtColor(picture.image, cv2.COLOR_RGB2BGR)
    jpeg = encoded_image(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]).tobytes()
    log.log(f"{place}/image", rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
    depth = np.round(picture.depth_m / DEPTH_UNIT_M)
    png = encoded_image(".png", np.where(depth > MAX_DEPTH, 0, depth).astype(np.uint16), []).tobytes()
    log.log(f"{place}/depth", rerun.EncodedDepthImage(blob=png, media_type="image/png", meter=1 / DEPTH_UNIT_M))
    log.log(f"{place}/labels", rerun.SegmentationImage(picture.mask))
