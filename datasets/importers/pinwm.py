"""Import of the simulated pushes of PIN-WM (daihangpku/pin-wm): one camera, masks, poses, and a commanded pusher.

The files contain the poses of the block at 24 Hz, camera and masks of each frame, meshes, the mass, and start and goal
of the pusher in the plane. The following is assumed, because the files do not contain it:

- The pusher moves as in the dataset's `scripts/run.py`: from each frame to the next at `GAIN_HZ` times its distance
  from the goal, at the height `PUSHER_HEIGHT_M`, without rotation. It is in no picture.
- The simulator (Bullet) keeps a margin of `MARGIN_M` around every convex part, so two bodies touch at twice that
  distance. Here the ground and the pusher's sides are moved by that distance, because the block's shape is also used
  for its appearance.
- The pusher is the convex hull of its parts: its sides are nearly flat, and its hollows touch nothing.
- The inertia in the block's URDF (1 kg m2) is a placeholder; it is omitted and computed from the shape.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from ...schemas import (
    Body,
    CamerasFile,
    CaptureManifest,
    Ground,
    InputDataError,
    PosedVideo,
    Scale,
    Shape,
    World,
    read_json,
)
from ...schemas.base import FileModel
from ...schemas.capture import FileShape, Video
from ...schemas.imports import ImportResult
from ...schemas.regular_files import real_path, require_regular_file
from ..capture.camera_faults import intrinsics_fault, pose_fault
from ..capture.cameras import Camera, to_intrinsics
from ..capture.files import entries_of, optional_file
from ..capture.images import image_size, read_alpha, read_rgb, write_image
from ..capture.manifest import write_manifest
from ..capture.tracks import Track, tracks_csv
from ..io.atomic import new_directory
from ..io.cells import number_of
from ..io.outputs import reads
from ..io.progress import progress
from ..shapes.meshes import Mesh, read_mesh

Array = NDArray[np.float64]
Row = tuple[float, float, float, float]

RATE_HZ = 24.0
GAIN_HZ = 5.0
PUSHER_HEIGHT_M = 0.05
MARGIN_M = 0.001
BLOCK, PUSHER, CAMERA = "block", "pusher", "cam"
FIRST = "-first"
"""Suffix of the name of the episode that contains only the first frames of a push."""
_BLOCK_URDF = "envs/asset/cube_t/cube_t_mesh.urdf"
_PUSHER_URDF = "envs/asset/ee/ee.urdf"
_TODO = "get dataset/ and envs/ of github.com/daihangpku/pin-wm."


class _Frame(FileModel, extra="ignore"):
    """A picture of a push: its file, its time and its camera pose (OpenGL axes)."""

    file_path: str
    time: float | None = None
    """Time in the push [s]; the number in the file's name counts."""
    c2w: tuple[Row, Row, Row]
    intrinsic: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]

    @field_validator("c2w")
    @classmethod
    def _rigid(cls, rows: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
        fault = pose_fault(np.array([*rows, (0.0, 0.0, 0.0, 1.0)]))
        if fault is not None:
            raise ValueError(fault)
        return rows


class _Push(FileModel, extra="ignore"):
    """`dynamic_train0.json`."""

    ee_init_position: tuple[float, float]
    ee_goal_position: tuple[float, float]
    image_datas: tuple[_Frame, ...]
    pose_datas: Annotated[tuple[tuple[float, float, float, float, float, float, float], ...], Field(min_length=2)]
    """Position [m] and quaternion (x, y, z, w) of the block in each frame."""


@dataclass(frozen=True)
class _Recording:
    """A push and its pictures."""

    name: str
    """Name of the push."""
    push: _Push
    """Content of its file."""
    folder: Path
    """Folder of its file and pictures."""
    frames: tuple[_Frame, ...]
    """Frames with masks, by number; empty without pictures."""

    @property
    def tracks(self) -> dict[str, Track]:
        """Measured poses of the block and commanded ones of the pusher."""
        poses = np.array(self.push.pose_datas)
        times = np.arange(len(poses)) / RATE_HZ
        block = Track(times, poses[:, :3], poses[:, [6, 3, 4, 5]])
        return {BLOCK: block, PUSHER: pusher_track(self.push.ee_init_position, self.push.ee_goal_position, len(poses))}


@reads("source")
def import_pinwm(source: Path | str, out: Path | str, n_train: int = 12, overwrite: bool = False) -> ImportResult:
    """Write the pushes as a capture: block, pusher, camera, frames, masks and tracks.

    Every push is an episode of the split "test" with its track. A push with pictures has them as well, and its first
    frames make another episode, `<push>-first`, of the split "train".

    Args:
        source: The directory that contains `dataset/` and `envs/`.
        out: The capture directory to write.
        n_train: Number of frames in each episode of "train".
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the source is not such data, or no push has its pictures.
        UsageError: If `out` exists, before anything is read.
    """
    source = Path(source)
    with new_directory(out, "capture", overwrite) as directory:
        recordings = _recordings(source, n_train)
        filmed = [recording for recording in recordings if recording.frames]
        train = {f"{recording.name}{FIRST}": recording for recording in filmed}
        manifest = CaptureManifest(
            format="cgwm-capture/1",
            world=World(ground=Ground(offset_m=2 * MARGIN_M)),
            bodies=_bodies(source, directory),
            splits={"train": tuple(train), "test": tuple(recording.name for recording in recordings)},
            video=Video(frame_rate_hz=RATE_HZ),
        )
        write_manifest(directory / "capture.toml", manifest)
        (directory / "cameras.json").write_text(_cameras(filmed).model_dump_json(indent=1) + "\n", encoding="utf-8")
        (directory / "tracks").mkdir()
        samples = sum(_write_episode(directory, name, recording, n_train) for name, recording in train.items())
        for recording in recordings:
            samples += _write_episode(directory, recording.name, recording, len(recording.push.pose_datas))
    return ImportResult(
        capture=str(out),
        episodes=len(train) + len(recordings),
        samples=samples,
        splits={name: len(episodes) for name, episodes in manifest.splits.items()},
    )


def _write_episode(directory: Path, name: str, recording: _Recording, count: int) -> int:
    """Write tracks and pictures of the first frames of a recording; return the number of samples."""
    tracks = {body: track.window(0.0, (count - 0.5) / RATE_HZ) for body, track in recording.tracks.items()}
    (directory / "tracks" / f"{name}.csv").write_text(tracks_csv(tracks), encoding="utf-8")
    _write_frames(directory, name, recording, recording.frames[:count])
    return sum(map(len, tracks.values()))


def _bodies(source: Path, directory: Path) -> tuple[Body, Body]:
    """Write the shapes of block and pusher, and return their entries of the manifest."""
    shape, mass_kg, com_m = _link(source, _BLOCK_URDF)
    write_obj(directory / "block.obj", shape)
    write_obj(directory / "pusher.obj", widened(hull(_link(source, _PUSHER_URDF)[0]), 2 * MARGIN_M))
    return (
        Body(name=BLOCK, mass_kg=mass_kg, com_m=com_m, shape=Shape(mesh=FileShape(path="block.obj"))),
        Body(name=PUSHER, motion="driven", shape=Shape(mesh=FileShape(path="pusher.obj"))),
    )


def pusher_track(start_m: tuple[float, float], goal_m: tuple[float, float], count: int) -> Track:
    """Return the track of the pusher, which covers the same share of the remaining distance in each frame.

    Args:
        start_m: Start, x and y [m].
        goal_m: Goal, x and y [m].
        count: Number of frames.
    """
    left = (1 - GAIN_HZ / RATE_HZ) ** np.arange(count)[:, None]
    plane = np.array(goal_m) + left * (np.array(start_m) - np.array(goal_m))
    position = np.c_[plane, np.full(count, PUSHER_HEIGHT_M)]
    return Track(np.arange(count) / RATE_HZ, position, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))


def hull(mesh: Mesh) -> Mesh:
    """Return the convex hull of a mesh."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(mesh.vertices)
    vertices = mesh.vertices[found.vertices]
    place = np.full(len(mesh.vertices), -1)
    place[found.vertices] = np.arange(len(vertices))
    faces = place[found.simplices].astype(np.int64)
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    inwards = np.einsum("fi,fi->f", np.cross(a, b), c) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return Mesh(vertices, faces)


def widened(mesh: Mesh, by_m: float) -> Mesh:
    """Stretch a mesh about the middle of its bounding box so that its sides move outwards by `by_m` in x and y."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    factor = np.array([(half[0] + by_m) / half[0], (half[1] + by_m) / half[1], 1.0])
    return Mesh(middle + factor * (mesh.vertices - middle), mesh.faces)


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a mesh as a Wavefront file."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _push_files(source: Path) -> list[Path]:
    folders = [folder for folder in entries_of(source / "dataset") if folder.is_dir()]
    files = [path for folder in folders for path in entries_of(folder) if path.match("dynamic_*.json")]
    if not files:
        what = "no pushes of PIN-WM" if source.is_dir() else "no such directory"
        raise InputDataError(
            f"{source}: {what}.", "a directory with dataset/<push>/dynamic_train0.json, and envs/.", _TODO
        )
    return files


def _recordings(source: Path, n_train: int) -> list[_Recording]:
    files = _push_files(source)
    in_folder = Counter(file.parent for file in files)
    recordings = []
    for file in files:
        push = read_json(file, _Push)
        name = file.parent.name if in_folder[file.parent] == 1 else f"{file.parent.name}-{file.stem}"
        recordings.append(_Recording(name, push, file.parent, _frames(file, push)))
    _require_enough_frames(source, recordings, n_train)
    return recordings


def _frames(file: Path, push: _Push) -> tuple[_Frame, ...]:
    """Return the frames of a push with pictures, in the order of its poses: one for each pose, or none."""
    numbered = {_number(file, frame): frame for frame in push.image_datas}
    wanted = [numbered[k] for k in range(len(push.pose_datas)) if k in numbered]
    for frame in wanted:
        _require_inside(file.parent / frame.file_path, file.parent.parent, str(file))
    frames = tuple(frame for frame in wanted if optional_file(file.parent / frame.file_path))
    if frames and len(frames) < len(push.pose_datas):
        raise InputDataError(
            f"{file.parent}: {len(frames)} pictures for {len(push.pose_datas)} poses.",
            "one a pose, or none.",
            _TODO,
        )
    if frames:
        _require_lenses(file, push.image_datas, image_size(file.parent / frames[0].file_path))
    return frames


def _require_lenses(file: Path, listed: tuple[_Frame, ...], size: tuple[int, int]) -> None:
    """Refuse intrinsics that no camera of pictures of this size (width, height) has."""
    for frame in listed:
        fault = intrinsics_fault(np.array(frame.intrinsic), np.zeros(0), *size)
        if fault is not None:
            raise InputDataError(
                f"{file}: intrinsic of '{frame.file_path}': {fault}.", "fx, 0, cx; 0, fy, cy; 0, 0, 1 [px].", _TODO
            )


def _require_enough_frames(source: Path, recordings: list[_Recording], n_train: int) -> None:
    """Check that some push has pictures, and that each of these has more frames than are fitted."""
    filmed = [recording for recording in recordings if recording.frames]
    if not filmed:
        raise InputDataError(f"{source / 'dataset'}: no push has its pictures (r_0_<frame>.png).", todo=_TODO)
    shortest = min(len(recording.frames) for recording in filmed)
    if not 3 <= n_train < shortest:
        raise InputDataError(
            f"{source / 'dataset'}: {n_train} frames to fit on; the shortest push with pictures has {shortest}.",
            f"3 to {shortest - 1}.",
            "set --train.",
        )


def _number(file: Path, frame: _Frame) -> int:
    found = re.fullmatch(r"r_\d+_(-?\d+)", Path(frame.file_path).stem)
    if found is None:
        raise InputDataError(
            f"{file}: the picture '{frame.file_path}' has no frame number.",
            "r_<camera>_<frame>.png.",
            "take the original recording.",
        )
    return int(found[1])


def _require_inside(path: Path, folder: Path, where: str) -> None:
    """Refuse a file that another file names outside the data."""
    if not real_path(path).is_relative_to(real_path(folder)):
        raise InputDataError(f"{where}: names {path}, which lies outside the data.", f"files in {folder}.", _TODO)


def _link(source: Path, place: str) -> tuple[Mesh, float, tuple[float, float, float]]:
    """Return the collision mesh, the mass [kg] and the centre of mass [m] of the first link with a mesh."""
    urdf = source / place
    try:
        root = ElementTree.parse(require_regular_file(urdf)).getroot()
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise InputDataError(f"{urdf}: cannot be read: {error}.", todo=_TODO) from None
    for link in root.iter("link"):
        mesh, mass = link.find("collision/geometry/mesh"), link.find("inertial/mass")
        if mesh is None or mass is None:
            continue
        mass_kg, com_m = _inertial(urdf, mass, link.find("inertial/origin"))
        path = urdf.parent / mesh.get("filename", "")
        _require_inside(path, source, str(urdf))
        return read_mesh(path), mass_kg, com_m
    raise InputDataError(f"{urdf}: no link with a mesh and a mass.", todo=_TODO)


def _inertial(
    urdf: Path, mass: ElementTree.Element, origin: ElementTree.Element | None
) -> tuple[float, tuple[float, float, float]]:
    """Return the mass [kg] and the centre of mass [m] of a link."""
    try:
        x, y, z = map(number_of, ("0 0 0" if origin is None else origin.get("xyz", "0 0 0")).split())
        mass_kg = number_of(mass.get("value", ""))
        if not (0 < mass_kg < math.inf and math.isfinite(x + y + z)):
            raise ValueError("a mass that is not positive, or a place that is not finite")
    except ValueError as error:
        raise InputDataError(
            f"{urdf}: inertial: {error}.", "a mass [kg] and a centre of mass [m].", "take the original file."
        ) from None
    return mass_kg, (x, y, z)


def _cameras(filmed: list[_Recording]) -> CamerasFile:
    """Return the camera that took all frames of all pushes."""
    first = filmed[0].frames[0]
    for recording in filmed:
        for frame in recording.frames:
            if (frame.c2w, frame.intrinsic) != (first.c2w, first.intrinsic):
                raise InputDataError(
                    f"{recording.folder / frame.file_path}: its camera is another one.",
                    "one camera.",
                    "take the pictures of one camera.",
                )
    width, height = image_size(filmed[0].folder / first.file_path)
    pose = np.eye(4)
    pose[:3] = np.array(first.c2w) * [1.0, -1.0, -1.0, 1.0]  # OpenGL's y and z point the other way
    camera = Camera(width=width, height=height, K=np.array(first.intrinsic), distortion=np.zeros(0), T_world_cam=pose)
    rows = [tuple(float(value) for value in row) for row in pose]
    return CamerasFile(
        scale=Scale(kind="metric", source="simulated"),
        cameras={CAMERA: to_intrinsics(camera)},
        videos={CAMERA: PosedVideo(camera=CAMERA, T_world_cam=tuple(rows))},  # pyright: ignore[reportArgumentType]
    )


def _write_frames(directory: Path, episode: str, recording: _Recording, frames: tuple[_Frame, ...]) -> None:
    if not frames:
        return
    folders = [directory / kind / CAMERA / episode for kind in ("videos", "video_masks")]
    for folder in folders:
        folder.mkdir(parents=True)
    for k, frame in enumerate(progress(frames, episode, len(frames))):
        path = recording.folder / frame.file_path
        mask = path.with_name(f"m{path.name.removeprefix('r')}")
        write_image(folders[0] / f"{k:06d}.png", read_rgb(path))
        write_image(folders[1] / f"{k:06d}.png", (read_alpha(mask) > 127).astype(np.uint8))
