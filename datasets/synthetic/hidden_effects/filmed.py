"""A case filmed by two cameras: a capture with videos and masks but no tracks; only the silhouettes carry information.

The images are deliberately plain: the known shape in one colour on a grey background. A fit uses only the masks, whose
edges are on average accurate to a fraction of a pixel, like those of a good segmentation.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ....schemas import CamerasFile, PosedVideo, Scale, Video
from ...capture.cameras import Camera, to_intrinsics
from ...capture.capture import Capture
from ...capture.images import write_image
from ...capture.manifest import write_manifest
from ...capture.tracks import Track
from ..rig import look_at
from .case import Case
from .record import make_capture
from .rotation import rotations
from .things import Array, Thing

AWAY_M, HEIGHT_M = 2.4, 1.0
"""Distance of the cameras from the world's origin, near which all paths lie [m]."""
SUPERSAMPLED = 4
"""Number of sample points along each side of a pixel, from which its coverage is computed."""
_BODY, _GROUND, _NOISE = (60, 130, 190), 150, 4.0


def film_capture(directory: Path, case: Case, truth: Path | None = None, overwrite: bool = False) -> Path:
    """Write the capture of a case as videos with masks, and the truth next to it; return the file of the truth.

    Args:
        directory: The capture to write.
        case: The case; its rate is the frame rate, and the noise of its tracks is not used.
        truth: File of the truth, see `make_capture`.
        overwrite: Replace both.
    """
    exact = replace(case, position_std_m=1e-9, rotation_std_rad=1e-9)
    path = make_capture(directory, exact, truth, overwrite)
    capture, cameras, thing = Capture.open(directory, check=False), video_cameras(case), case.drawn_thing()
    for names in capture.manifest.splits.values():
        for episode in names:
            track = capture.tracks(episode)[case.thing]
            for name, camera in cameras.items():
                _film(directory, name, camera, episode, track, thing)
    shutil.rmtree(directory / "tracks")
    filmed = capture.manifest.model_copy(update={"video": Video(frame_rate_hz=case.rate_hz)})
    write_manifest(directory / "capture.toml", filmed, overwrite=True)
    (directory / "cameras.json").write_text(_cameras_file(cameras).model_dump_json(indent=1) + "\n", encoding="utf-8")
    return path


def video_cameras(case: Case) -> dict[str, Camera]:
    """Return two cameras that look at the origin from directions about a right angle apart."""
    rng = case.rng("cameras")
    facing, focal_px, (width, height) = rng.uniform(-np.pi, np.pi), case.film_focal_px, case.film_px
    K = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    cameras = {}
    for name, azimuth in (("left", facing), ("right", facing + rng.uniform(1.2, 1.7))):
        eye = np.array([AWAY_M * np.cos(azimuth), AWAY_M * np.sin(azimuth), HEIGHT_M])
        cameras[name] = Camera(
            width=width,
            height=height,
            K=K,
            distortion=np.zeros(0),
            T_world_cam=look_at(eye, np.array([0.0, 0.0, 0.25])),
        )
    return cameras


def _film(directory: Path, name: str, camera: Camera, episode: str, track: Track, thing: Thing) -> None:
    images, masks = (directory / kind / name / episode for kind in ("videos", "video_masks"))
    images.mkdir(parents=True)
    masks.mkdir(parents=True)
    rng = np.random.default_rng([*episode.encode(), *name.encode()])
    assert track.quat_wxyz is not None
    for k, (place, turn) in enumerate(zip(track.position_m, rotations(track.quat_wxyz), strict=True)):
        mask = silhouette(camera, _surface(thing) @ turn.T + place)
        picture = np.full((*mask.shape, 3), _GROUND, np.float64)
        picture[mask > 0] = _BODY
        noisy = (picture + _NOISE * rng.standard_normal(picture.shape)).clip(0, 255).astype(np.uint8)
        write_image(images / f"{k:06d}.jpg", noisy)
        write_image(masks / f"{k:06d}.png", mask)


def silhouette(camera: Camera, points: Array) -> NDArray[np.uint8]:
    """Return the mask (height, width), 1 in the outline of convex points (n, 3) in the world; 0 elsewhere."""
    seen = (points - camera.T_world_cam[:3, 3]) @ camera.T_world_cam[:3, :3]
    pixels = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
    edges = ConvexHull(pixels).equations
    # the centre of pixel 0 is at 0.5; a pixel is set if most of its sample points lie inside
    offsets = (np.arange(SUPERSAMPLED) + 0.5) / SUPERSAMPLED
    low = np.floor(pixels.min(0)).astype(int).clip(0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int), (camera.width, camera.height))
    mask = np.zeros((camera.height, camera.width), np.uint8)
    if (high <= low).any():
        return mask
    x, y = ((np.arange(a, b)[:, None] + offsets).ravel() for a, b in zip(low, high, strict=True))
    inside = (edges[:, 0, None, None] * x + edges[:, 1, None, None] * y[:, None] + edges[:, 2, None, None] < 0).all(0)
    share = inside.reshape(high[1] - low[1], SUPERSAMPLED, high[0] - low[0], SUPERSAMPLED).mean((1, 3))
    mask[low[1] : high[1], low[0] : high[0]] = share > 0.5
    return mask


def _surface(thing: Thing) -> Array:
    if thing.kind == "cube":
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
        return signs * thing.half_extents_m
    count = 400
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * k / count), np.pi * (1 + np.sqrt(5)) * k
    on = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], 1)
    return on * thing.half_extents_m


def _cameras_file(cameras: dict[str, Camera]) -> CamerasFile:
    poses = {name: camera.T_world_cam.tolist() for name, camera in cameras.items()}
    return CamerasFile(
        scale=Scale(kind="metric"),
        cameras={name: to_intrinsics(camera) for name, camera in cameras.items()},
        videos={name: PosedVideo(camera=name, T_world_cam=pose) for name, pose in poses.items()},
    )
