"""How long video cameras expose a frame, from the blur of bodies whose motion is known.

Frames in which bodies move fast are compared with pictures of the model over exposures of several durations. The one
that repeats them best is taken if it does so beyond the scatter of the frames; otherwise frames stay instants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ....datasets.capture.cameras import Camera
from ....datasets.capture.capture import Capture
from ....datasets.capture.tracks import Track
from ....datasets.models.model import Model
from ....schemas import Exposure
from ...rendering.label_renderer import LabelRenderer
from ...rendering.motion_blur import exposed_for, poses_at
from ...rendering.video_view import expose, renderable, usable_cameras, video_view
from ...runtime.device import resolve_device

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

EPISODES, FRAMES = 4, 8
"""Maximum number of episodes, and of frames of each camera, those with the fastest motion."""
FEWEST = 4
"""Fewest frames from which a duration is told."""
LEAST_PX = 2.0
"""Least motion of a body's origin from frame to frame [px]: less blurs by less than its edges are uncertain."""
DURATIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Durations that are compared, in intervals between frames; between them the squares of errors are a parabola."""
BEYOND_CHANCE = 2.0
"""Least fall of the mean square error, in standard errors over the frames, for a duration to be taken."""
SOFTER_PX = 1.5
"""Standard deviation of a blur to all sides that is told from that along the motion [px]."""
MARGIN_PX = 3
"""How far beyond the body's silhouettes pixels are compared [px]."""


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """A frame of a video, and how bodies move about its time."""

    image: Image
    """Undistorted frame, shape (H, W, 3)."""
    valid: NDArray[np.bool_]
    """Pixels that the original frame covers, shape (H, W)."""
    camera: Camera
    """Undistorted camera."""
    time_s: float
    """Time of the frame [s]."""
    tracks: tuple[Track, ...]
    """Motions of the bodies."""

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """Return positions (n, B, 3) and orientations (n, B, 4) of the bodies at times (n,) [s]."""
        found = [_poses(track, times_s) for track in self.tracks]
        return np.concatenate([one[0] for one in found], 1), np.concatenate([one[1] for one in found], 1)


def with_durations(
    model: Model,
    capture: Capture,
    split: str = "train",
    found: Mapping[str, dict[str, Track]] | None = None,
    device: str = "auto",
) -> Model:
    """Add to a model how long its video cameras expose a frame.

    Args:
        model: Model with exposures, and spheres of the bodies.
        capture: Capture with calibrated cameras, videos and measured tracks.
        split: Name of the episodes.
        found: Tracks found in the videos, by episode and body, instead of measured ones; None for measured ones.
        device: Device of the renderer: auto, cpu or cuda.
    """
    exposures = dict(model.file.exposures)
    if not renderable(model) or any(body.motion == "link" for body in model.file.bodies):
        return model
    interval_s = 1 / capture.manifest.video.frame_rate_hz
    for name, exposure in exposures.items():
        frames = _fastest(model, capture, split, name, interval_s, found)
        if len(frames) >= FEWEST:
            drawn = _Drawn(model, str(resolve_device(device)))
            errors = np.array([_errors(drawn.of(frame.camera), frame, exposure, interval_s) for frame in frames])
            exposures[name] = exposure.model_copy(update={"duration_s": interval_s * best_duration(errors)})
    return replace(model, file=model.file.model_copy(update={"exposures": exposures}))


def best_duration(errors: Array) -> float:
    """Return the duration with the least errors, in intervals between frames; 0 if it is no better beyond chance.

    Args:
        errors: Mean square errors of frames at the `DURATIONS`, shape (frame, duration).
    """
    mean = errors.mean(0)
    best = int(mean.argmin())
    fall = errors[:, 0] - errors[:, best]
    if best == 0 or fall.mean() < BEYOND_CHANCE * fall.std(ddof=1) / np.sqrt(len(fall)):
        return 0.0
    if best == len(mean) - 1:
        return DURATIONS[best]
    before, least, after = mean[best - 1 : best + 2]
    step = DURATIONS[best] - DURATIONS[best - 1]
    return float(DURATIONS[best] + 0.5 * step * (before - after) / (before - 2 * least + after))


def _fastest(
    model: Model,
    capture: Capture,
    split: str,
    name: str,
    interval_s: float,
    known: Mapping[str, dict[str, Track]] | None,
) -> list[_Frame]:
    """Return the frames of a camera in which a body moves fastest, those first."""
    found: list[tuple[float, Camera, Image, float, tuple[Track, ...]]] = []
    for episode in capture.episodes(split)[:EPISODES]:
        tracks = capture.tracks(episode) if known is None else known.get(episode, {})
        moved = [_track(model, body, tracks) for body in range(len(model.file.bodies))]
        if name not in usable_cameras(capture, episode)[0] or any(track is None for track in moved):
            continue
        motions = tuple(track for track in moved if track is not None)
        times, numbers = capture.frame_times(name, episode), capture.frame_numbers(name, episode)
        frames = capture.video_frames(name, episode)
        first, last = (max(t.time_s[0] for t in motions), min(t.time_s[-1] for t in motions))
        for k in np.flatnonzero((times >= first + interval_s / 2) & (times <= last - interval_s / 2)):
            view = video_view(capture, name, episode, int(numbers[k]), frames.shape[2:0:-1])
            ends = [_poses(track, times[k] + interval_s * np.array([-0.5, 0.5]))[0][:, 0] for track in motions]
            moved_px = max(float(np.linalg.norm(np.diff(view.project(end)[0], axis=0))) for end in ends)
            if moved_px >= LEAST_PX:
                found.append((moved_px, view, frames[k].copy(), float(times[k]), motions))
    return [_undistorted(*one[1:]) for one in sorted(found, key=lambda one: -one[0])[:FRAMES]]


def _undistorted(view: Camera, picture: Image, time_s: float, tracks: tuple[Track, ...]) -> _Frame:
    """Return a frame of a video without the distortion of its lens."""
    image, plain = view.undistorted(picture)
    valid = view.undistorted(np.full(image.shape[:2], 255, np.uint8))[0] == 255
    return _Frame(image=image, valid=valid, camera=plain, time_s=time_s, tracks=tracks)


def _track(model: Model, index: int, tracks: Mapping[str, Track]) -> Track | None:
    """Return the motion of a body; None if it moves and its orientation is not known."""
    body = model.file.bodies[index]
    if body.motion == "fixed":
        pose = body.photo_pose
        return Track(
            time_s=np.array([-np.inf, np.inf]),
            position_m=np.array([pose.position_m] * 2),
            quat_wxyz=np.array([pose.quat_wxyz] * 2),
            velocity_m_s=None,
            omega_body_rad_s=None,
        )
    track = tracks.get(body.name)
    return None if track is None or track.quat_wxyz is None else track


def _poses(track: Track, times_s: Array) -> tuple[Array, Array]:
    """Return positions (n, 1, 3) and orientations (n, 1, 4) of a track at times (n,) [s]."""
    assert track.quat_wxyz is not None
    if not np.isfinite(track.time_s).all():
        return np.repeat(track.position_m[:1, None], len(times_s), 0), np.repeat(
            track.quat_wxyz[:1, None], len(times_s), 0
        )
    return poses_at(track.time_s, track.position_m[:, None], track.quat_wxyz[:, None], times_s)


@dataclass
class _Drawn:
    """A model in one camera after the other; a camera that stands is prepared once."""

    model: Model
    device: str
    _camera: Camera | None = None
    _renderer: LabelRenderer | None = None

    def of(self, camera: Camera) -> LabelRenderer:
        """Return the renderer of a camera."""
        known = self._camera
        if self._renderer is None or known is None or not np.array_equal(known.T_world_cam, camera.T_world_cam):
            self._camera, self._renderer = camera, LabelRenderer(self.model, {"": camera}, self.device)
        return self._renderer


def _errors(renderer: LabelRenderer, frame: _Frame, exposure: Exposure, interval_s: float) -> Array:
    """Return the mean square errors (duration,) of pictures of a frame over exposures of the `DURATIONS`."""
    touched = ~frame.valid

    def draw(_: NDArray[np.intp], position_m: Array, quat_wxyz: Array) -> Image:
        blocks = list(renderer.blocks(position_m, quat_wxyz))
        for block in blocks:
            touched[:] |= (block.mask > 0).any(0)
        return np.concatenate([block.image for block in blocks])

    now = np.array([frame.time_s])
    shown = draw(np.zeros(1, np.intp), *frame.poses(now)).repeat(len(DURATIONS), 0)
    times = now.repeat(len(DURATIONS))
    pictures = exposed_for(interval_s * np.array(DURATIONS), draw, shown, frame.poses, times)
    near = cv2.dilate(touched.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)) > 0
    real = frame.image.astype(np.float32) / np.float32(255)
    return np.array([unexplained(expose(picture, exposure), real, near & frame.valid) for picture in pictures])


def unexplained(picture: NDArray[np.float32], real: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    """Return the mean square error of a picture (H, W, 3), but for what small shifts, turns and scales of it explain.

    A pose that is off by a pixel makes errors at edges, which a longer blur would make smaller, too.

    Args:
        picture: The model's.
        real: The camera's.
        where: Pixels that are compared, (H, W).
    """
    along_y, along_x = (np.gradient(picture, axis=axis)[where] for axis in (0, 1))
    y, x = (values[:, None] - values.mean() for values in np.nonzero(where))
    softer = (cv2.GaussianBlur(picture, (0, 0), SOFTER_PX) - picture)[where]
    columns = [along_x, along_y, x * along_x + y * along_y, x * along_y - y * along_x, softer]
    columns = np.stack([one.ravel() for one in columns], 1).astype(float)
    error = (picture - real)[where].ravel().astype(float)
    moment = columns.T @ columns
    explained = columns.T @ error
    solved = np.linalg.solve(moment + 1e-9 * np.trace(moment) * np.eye(len(moment)), explained)
    return float((error @ error - explained @ solved) / max(len(error), 1))
