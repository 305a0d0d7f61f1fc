"""The folder of a capture: manifest, photos, videos, tracks and cameras, read from disk on demand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, CamerasFile, CaptureManifest, InputDataError, Shape, UsageError, did_you_mean
from ...schemas.documents import shortened
from ...schemas.printable import typed_path
from ...schemas.regular_files import real_path, require_regular_file
from ..shapes.meshes import Mesh, read_mesh
from ..shapes.surfaces import surface_meshes
from .cameras import Camera, camera_of
from .files import entries_of, files_under, has_folder, optional_file
from .geometry_maps import GeometryMaps, read_maps
from .images import IMAGE_SUFFIXES, read_label, read_rgb
from .spin import require_told_spin
from .tracks import Track, read_tracks
from .video import VIDEO_SUFFIXES, VideoInfo, read_video, read_video_labels, video_info


class CheckedTracks(NamedTuple):
    """The tracks of an episode, and what was found in their file."""

    tracks: dict[str, Track]
    """Tracks by body, between the episode's `start_s` and `end_s`; empty without any."""
    normalised: int
    """Number of quaternions that were normalised (see :func:`read_tracks`)."""
    unturned: tuple[str, ...]
    """Free bodies whose orientation is the same in all rows."""


MOST_KEPT = 1_000_000
"""Samples of the track files that a capture keeps in memory, at 64 bytes each with orientations."""


@dataclass(frozen=True, eq=False)
class CaptureFolder:
    """A capture directory. Everything except the manifest and the cameras is read from disk on demand."""

    root: Path
    """The directory."""
    manifest: CaptureManifest
    """`capture.toml`."""
    cameras: CamerasFile | None = None
    """The calibrated cameras, or None if there are none yet."""
    only_splits: tuple[str, ...] | None = None
    """The splits that may be read; None for everything."""
    inconsistencies: tuple[str, ...] = ()
    """What gravity, ground, shapes and motion disagree about, without a fault."""
    read: dict[object, tuple[dict[str, Track], int]] = field(default_factory=dict, repr=False)
    """What track files hold that were read, by name, bodies, and time and size of the file."""

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of the manifest; label k of a mask is number k - 1."""
        return [body.name for body in self.manifest.bodies]

    def body(self, name: str) -> Body:
        """Return a body's entry in the manifest."""
        for body in self.manifest.bodies:
            if body.name == name:
                return body
        legal = ", ".join(self.body_names) or "none, [[bodies]] is empty"
        raise UsageError(
            f"{self.root / 'capture.toml'}: no body '{name}'.",
            legal + "." + did_you_mean(name, self.body_names),
            "correct the name, or add the body to capture.toml.",
        )

    def surface_meshes(self) -> Mapping[str, Mesh]:
        """Return the triangles of the fixed surfaces that are meshes or height fields, by name.

        Raises:
            InputDataError: As `read_surface`, or if a file lies outside the capture.
        """
        manifest = self.root / "capture.toml"
        for surface in self.manifest.surfaces:
            shape = surface.mesh or surface.height_field
            if shape is not None and not real_path(self.root / shape.path).is_relative_to(real_path(self.root)):
                raise InputDataError(
                    f"{manifest}: [[surfaces]] '{surface.name}': path '{shape.path}' lies outside the capture.",
                    "a file of the capture directory.",
                    "copy the file into it.",
                )
        return surface_meshes(self.manifest.surfaces, self.root, self._largest_body_m())

    def _largest_body_m(self) -> float | None:
        """Return the diameter of the largest body whose shape the manifest or a mesh gives [m]; None without one."""
        sizes = (self._diameter_m(body.shape) for body in self.manifest.bodies if body.shape is not None)
        return max(sizes, default=0.0) or None

    def _diameter_m(self, shape: Shape) -> float:
        """Return the diameter of a body's shape [m], 0 where splats are all that is known of it."""
        if shape.box is not None:
            return 2 * math.hypot(*shape.box.half_extents_m)
        if shape.sphere is not None:
            return 2 * shape.sphere.radius_m
        if shape.mesh is None:
            return 0.0
        return float(np.linalg.norm(np.ptp(read_mesh(self.root / shape.mesh.path).vertices, axis=0)))

    def shape_file(self, body: Body) -> Path | None:
        """Return the file of a body's mesh or splats, which must lie inside the capture; None without one."""
        shape = body.shape and (body.shape.mesh or body.shape.splats)
        if not shape:
            return None
        path = self.root / shape.path
        where = f"{self.root / 'capture.toml'}: [[bodies]] '{body.name}': shape path '{shape.path}'"
        if not real_path(path).is_relative_to(real_path(self.root)):
            raise InputDataError(
                f"{where} lies outside the capture.", "a file of the capture directory.", "copy the file into it."
            )
        if optional_file(path) is None:
            raise InputDataError(
                f"{where}: no such file.",
                "a path relative to the capture directory.",
                "add the file, or correct its name in capture.toml.",
            )
        _require_suffix(path, where, (".obj", ".stl") if body.shape and body.shape.mesh else (".ply",))
        return path

    # Photos

    def photos(self) -> list[str]:
        """Return the photos' names relative to `images/`, sorted."""
        return _images_under(self.root / "images")

    def masks(self) -> list[str]:
        """Return the masks' names relative to `masks/`, sorted."""
        return _images_under(self.root / "masks")

    def photo(self, name: str) -> NDArray[np.uint8]:
        """Return a photo, RGB, uint8, shape (height, width, 3)."""
        return read_rgb(self.root / "images" / name)

    def photo_mask(self, name: str) -> NDArray[np.uint8] | None:
        """Return a photo's labels (k: the k-th body), uint8, shape (height, width), or None without a mask."""
        path = optional_file(self.root / "masks" / Path(name).with_suffix(".png"))
        return None if path is None else read_label(path)

    def photo_maps(self, name: str) -> GeometryMaps:
        """Return the geometry maps of a photo: depth, normals, features."""
        return read_maps(self.root, name)

    def photo_camera(self, name: str) -> Camera:
        """Return the camera of a photo, at the photo's size."""
        return camera_of(self._calibrated(), name)

    # Episodes

    def episodes(self, split: str | None = None) -> list[str]:
        """Return the episodes of a split in the manifest's order, or all episodes on disk, sorted.

        Raises:
            UsageError: If there is no such split.
            InputDataError: If a directory of episodes cannot be listed, or holds what is neither a file nor a
                directory.
        """
        if split is not None:
            _require_split(self.root / "capture.toml", self.manifest, split)
            return list(self.manifest.splits[split])
        found = {path.stem for path in entries_of(self.root / "tracks") if path.suffix == ".csv"}
        for camera in _cameras(self.root / "videos"):
            found |= set(_videos_in(camera))
        if self.only_splits is not None:
            found &= {name for split in self.only_splits for name in self.episodes(split)}
        return sorted(found)

    @property
    def groups(self) -> dict[str, str]:
        """Group of each episode that belongs to one."""
        return {name: entry.group for name, entry in self.manifest.episodes.items() if entry.group is not None}

    def tracks(self, episode: str) -> dict[str, Track]:
        """Return the tracks of an episode by body, between its `start_s` and `end_s`; empty without any."""
        return self.checked_tracks(episode).tracks

    def checked_tracks(self, episode: str) -> CheckedTracks:
        """Return the tracks of an episode with the findings about them.

        A ball whose orientation is the same in all samples was tracked without one, whatever fills the columns: taken
        as measured, it would mean that the ball slides without friction. Such tracks are returned as centroids.
        """
        path = optional_file(self.root / "tracks" / f"{episode}.csv")
        if path is None:
            return CheckedTracks({}, 0, ())
        tracks, normalised = self._read_once(path)
        for name, track in tracks.items():
            _require_exerted(path, self.body(name), track)
        unturned = [name for name, track in tracks.items() if self._is_unturned(name, track)]
        for name in filter(self._is_ball, unturned):
            tracks[name] = replace(tracks[name], quat_wxyz=None)
        start_s, end_s = self._window(episode)
        windowed = {name: track.window(start_s, end_s) for name, track in tracks.items()}
        for name, track in windowed.items():
            _require_samples(path, name, episode, track, tracks[name])
            require_told_spin(path, name, track)
        return CheckedTracks(windowed, normalised, tuple(unturned))

    def _read_once(self, path: Path) -> tuple[dict[str, Track], int]:
        """Return the tracks in a file, as :func:`read_tracks` does, from memory if it is as it was when it was read."""
        state = path.stat()
        key = path, *self.body_names, state.st_mtime_ns, state.st_size
        if key not in self.read:
            found = read_tracks(path, self.body_names)
            kept = sum(len(track) for tracks, _ in (found, *self.read.values()) for track in tracks.values())
            if kept > MOST_KEPT:
                return found
            self.read[key] = found
        tracks, normalised = self.read[key]
        return dict(tracks), normalised

    def window_warning(self, episode: str, tracks: Mapping[str, Track]) -> str:
        """Return a warning about a `start_s` or `end_s` outside of an episode's tracks, or an empty text.

        Args:
            episode: Its name.
            tracks: Tracks by body within the window; a limit outside of them left all their samples.
        """
        start_s, end_s = self._window(episode)
        first = min(float(track.time_s[0]) for track in tracks.values())
        last = max(float(track.time_s[-1]) for track in tracks.values())
        sample = max(float(np.median(np.diff(track.time_s))) for track in tracks.values())
        if end_s is not None and end_s > last + 2 * sample:
            limit, value = "end_s", end_s
        elif start_s is not None and start_s < first - 2 * sample:
            limit, value = "start_s", start_s
        else:
            return ""
        return (
            f"episode '{episode}': its {limit} = {value:g} lies outside of its tracks, which last from {first:g} s to "
            f"{last:g} s, so that it cuts nothing off; correct [episodes] '{episode}' in capture.toml."
        )

    def unturned_warning(self, episodes: Mapping[str, Sequence[str]]) -> str:
        """Return a warning about tracks whose orientation never changes, or an empty text.

        Args:
            episodes: The `unturned` bodies of each episode.
        """
        bodies = sorted(set().union(*episodes.values()))
        if not bodies:
            return ""
        places = [name for name, names in episodes.items() if names]
        shown = ", ".join(places[:5]) + (", ..." if len(places) > 5 else "")
        balls = [name for name in bodies if self._is_ball(name)]
        text = f"the orientation of {', '.join(bodies)} is the same in all rows of {len(places)} episodes ({shown}). "
        if balls:
            text += f"A ball that never turns was tracked without orientation: that of {', '.join(balls)} is not used. "
        if len(balls) < len(bodies):
            text += "If it was not measured, leave the columns qw, qx, qy, qz out."
        return text.strip()

    def _is_unturned(self, name: str, track: Track) -> bool:
        """Return whether a body that is free to turn has the same orientation in all samples."""
        return track.quat_wxyz is not None and not track.turns and self.body(name).motion == "free"

    def _is_ball(self, name: str) -> bool:
        shape = self.body(name).shape
        return shape is not None and shape.sphere is not None

    # Videos

    def video_cameras(self) -> list[str]:
        """Return the names of the video cameras, sorted."""
        return [folder.name for folder in _cameras(self.root / "videos")]

    def videos(self, episode: str) -> list[str]:
        """Return the video cameras that saw an episode, sorted."""
        return [folder.name for folder in _cameras(self.root / "videos") if episode in _videos_in(folder)]

    def video_path(self, camera: str, episode: str) -> Path:
        """Return the directory of frames or the file of a video.

        Raises:
            InputDataError: If there is none.
        """
        folder = self.root / "videos" / camera
        videos = _videos_in(folder) if camera in self.video_cameras() else {}
        if episode not in videos:
            raise InputDataError(
                f"{folder}: no video of episode '{episode}'.",
                f"{shortened(', '.join(videos)) or 'none: the folder has no video'}.{did_you_mean(episode, videos)}",
                "name a camera and an episode of which there is a video.",
            )
        return videos[episode]

    def video_info(self, camera: str, episode: str) -> VideoInfo:
        """Return the properties of a whole video, without the limits `start_s` and `end_s`."""
        return video_info(self.video_path(camera, episode))

    def video_frames(self, camera: str, episode: str) -> NDArray[np.uint8]:
        """Return the frames between the episode's start and end, RGB, uint8, shape (frames, height, width, 3)."""
        frames = read_video(self.video_path(camera, episode))
        return frames[self._in_window(camera, episode, len(frames))]

    def video_masks(self, camera: str, episode: str) -> NDArray[np.uint8] | None:
        """Return the labels that belong to :meth:`video_frames`, uint8, shape (frames, height, width), or None."""
        folder = self.root / "video_masks" / camera / episode
        if not has_folder(folder):
            return None
        labels = read_video_labels(folder)
        return labels[self._in_window(camera, episode, len(labels))]

    def frame_times(self, camera: str, episode: str) -> NDArray[np.float64]:
        """Return the times [s] of the frames of :meth:`video_frames` on the tracks' clock, shape (frames,)."""
        count = video_info(self.video_path(camera, episode), decode=True).frames
        return self._all_times(camera, count)[self._in_window(camera, episode, count)]

    def frame_numbers(self, camera: str, episode: str) -> NDArray[np.int64]:
        """Return the numbers, from 0 in the video, of the frames that :meth:`video_frames` returns."""
        count = video_info(self.video_path(camera, episode), decode=True).frames
        return np.flatnonzero(self._in_window(camera, episode, count))

    def frames_kept(self, camera: str, episode: str, count: int) -> int:
        """Return how many of the first `count` frames of a video lie between the episode's start and end."""
        return int(self._in_window(camera, episode, count).sum())

    def video_camera(self, camera: str, episode: str, frame: int | None = None) -> Camera:
        """Return the camera of a video; `frame` (from 0) is needed for a moving camera."""
        return camera_of(self._calibrated(), camera, frame, "videos", episode)

    def _all_times(self, camera: str, count: int) -> NDArray[np.float64]:
        video = self.manifest.video
        return np.arange(count) / video.frame_rate_hz + video.camera_time_offset_s.get(camera, 0.0)

    def _in_window(self, camera: str, episode: str, count: int) -> NDArray[np.bool_]:
        start_s, end_s = self._window(episode)
        times = self._all_times(camera, count)
        after = times >= (-np.inf if start_s is None else start_s)
        return after & (times <= (np.inf if end_s is None else end_s))

    def _window(self, episode: str) -> tuple[float | None, float | None]:
        entry = self.manifest.episodes.get(episode)
        return (None, None) if entry is None else (entry.start_s, entry.end_s)

    def _calibrated(self) -> CamerasFile:
        if self.cameras is None:
            raise InputDataError(
                f"{self.root}: no calibrated cameras.",
                "cameras.json, transforms.json or a COLMAP model in sparse/0.",
                f"run 'cgwm calibrate {typed_path(self.root)}'.",
            )
        return self.cameras


def _images_under(folder: Path) -> list[str]:
    return [name for name in files_under(folder, IMAGE_SUFFIXES) if Path(name).suffix.lower() in IMAGE_SUFFIXES]


def _cameras(videos: Path) -> list[Path]:
    """Return the directories of the video cameras; a video beside them belongs to no camera and is refused."""
    found = entries_of(videos)
    for path in found:
        if not path.is_dir() and require_regular_file(path).suffix.lower() in VIDEO_SUFFIXES:
            raise InputDataError(
                f"{path}: a video without a camera.",
                "videos/<camera>/<episode>.mp4.",
                f"move it into the directory of its camera, such as {videos / 'cam' / path.name}.",
            )
    return [path for path in found if path.is_dir()]


def _videos_in(camera: Path) -> dict[str, Path]:
    """Return the videos of a camera by episode; duplicates, and what is neither file nor directory, are refused."""
    found: dict[str, Path] = {}
    for path in entries_of(camera):
        if not path.is_dir() and require_regular_file(path).suffix.lower() not in VIDEO_SUFFIXES:
            continue
        episode = path.name if path.is_dir() else path.stem
        if episode in found:
            raise InputDataError(
                f"{camera}: episode '{episode}' is there twice, as {found[episode].name} and {path.name}.",
                todo="remove one.",
            )
        found[episode] = path
    return found


def _require_exerted(path: Path, body: Body, track: Track) -> None:
    """Refuse measured forces of a body that is not driven, and torques without forces."""
    if track.force_n is None and track.torque_n_m is None:
        return
    if body.motion != "driven":
        raise InputDataError(
            f"{path}: body '{body.name}' has columns of force or torque, but its motion is '{body.motion}'.",
            "the force that a driven body exerts on what it touches; other bodies leave these columns empty.",
            f"empty them in the rows of '{body.name}', or make it driven in capture.toml.",
        )
    if track.force_n is None:
        raise InputDataError(
            f"{path}: body '{body.name}' has a torque but no force.",
            "force_x_n, force_y_n and force_z_n with it.",
            "add the columns force_x_n, force_y_n and force_z_n, or remove the torque.",
        )


def _require_suffix(path: Path, where: str, legal: tuple[str, ...]) -> None:
    if path.suffix.lower() not in legal:
        raise InputDataError(
            f"{where}: the suffix is '{path.suffix}'.",
            " or ".join(legal) + ".",
            "convert the file to one of these formats.",
        )


def _require_split(path: Path, manifest: CaptureManifest, split: str) -> None:
    """Refuse a split that the manifest at `path` does not name."""
    if split in manifest.splits:
        return
    legal = sorted(manifest.splits)
    allowed = ", ".join(legal) + "." + did_you_mean(split, legal) if legal else "none: [splits] is empty."
    todo = "name it in [splits]." if legal else (
        "list its episodes in [splits], which are the names of tracks/<episode>.csv or of "
        "videos/<camera>/<episode>.mp4."
    )  # fmt: skip
    raise UsageError(f"{path}: no split '{split}'.", allowed, todo)


def _require_samples(path: Path, body: str, episode: str, windowed: Track, whole: Track) -> None:
    """Refuse a window of an episode in which a track has a single sample or none."""
    if len(windowed) < 2:
        raise InputDataError(
            f"{path}: body '{body}' has {len(windowed)} of {len(whole)} samples between the "
            f"episode's start_s and end_s.",
            "at least 2.",
            f"correct [episodes] '{episode}' in capture.toml; the track lasts from "
            f"{whole.time_s[0]:g} s to {whole.time_s[-1]:g} s.",
        )
