"""Videos of an episode for the image loss: undistorted and reduced, with cameras and a common time line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.cameras import Camera
from ....datasets.capture.capture import Capture
from ....schemas import InputDataError
from ....schemas.printable import typed_path

MIN_FRAMES = 3
"""Minimum number of frames of a video; two show only a velocity."""
MIN_SEEN = 0.5
"""Minimum share of the instants in which some camera sees the free bodies."""
SAME_INSTANT_S = 1e-6
"""Maximum difference of the times of frames at one instant [s]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Video:
    """One camera's frames of one episode."""

    camera: str
    """Name of the camera."""
    times_s: NDArray[np.float64]
    """Times of the frames [s], shape (T,)."""
    frames: Tensor
    """sRGB values in [0, 1], shape (T, H, W, 3)."""
    covers: Tensor | None
    """Share of each pixel that each body covers, shape (T, bodies, H, W); None without masks."""
    K: Tensor
    """Camera matrix at this size [px], shape (3, 3)."""
    viewmats: Tensor
    """T_cam_world of each frame, shape (T, 4, 4)."""
    unseen: NDArray[np.bool_] | None = None
    """Frames whose masks lack a free body, shape (T,); None if there are none. The body may be hidden, out of view or
    missed by the segmentation, so such a frame is ignored."""

    @property
    def shown(self) -> NDArray[np.int64]:
        """Return the indices of all frames but the unseen ones."""
        return np.arange(len(self.times_s)) if self.unseen is None else np.flatnonzero(~self.unseen)

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height [px]."""
        return self.frames.shape[2], self.frames.shape[1]


@dataclass(frozen=True, eq=False)
class Footage:
    """All videos of an episode on one time line."""

    episode: str
    """Name of the episode."""
    videos: tuple[Video, ...]
    """One video for each calibrated camera."""
    times_s: NDArray[np.float64]
    """Instants at which any camera has a frame that is not unseen [s], shape (I,)."""
    frame_at: NDArray[np.int64]
    """Frame of each video at each instant, -1 for none or an unseen one, shape (videos, I)."""

    @staticmethod
    def of(episode: str, videos: tuple[Video, ...]) -> Footage:
        """Put videos on one time line, on which frames of the same time share an instant."""
        times = _instants([video.times_s[video.shown] for video in videos])
        frame_at = np.full((len(videos), len(times)), -1)
        for row, video in enumerate(videos):
            nearest = np.abs(times[:, None] - video.times_s[video.shown]).argmin(0)
            frame_at[row, nearest] = video.shown
        return Footage(episode, videos, times, frame_at)


def load_footage(capture: Capture, episode: str, image_size: int, device: torch.device | str = "cpu") -> Footage:
    """Read the videos of an episode from all its calibrated cameras.

    Args:
        capture: The capture.
        episode: Name of the episode.
        image_size: Longer side [px] to which frames are reduced.
        device: Device of the tensors.

    Raises:
        InputDataError: If there are no cameras, no video, fewer than three frames, or the masks are empty in most.
    """
    names = capture.videos(episode)
    if not names:
        raise InputDataError(
            f"{capture.root}: episode '{episode}' has no video.",
            "videos/<camera>/<episode>.mp4, or a directory of frames.",
            "add the video, take the episode out of its split, or fit from tracks: --supervise tracks.",
        )
    if capture.cameras is None:
        raise InputDataError(
            f"{capture.root}: {len(names)} videos of episode '{episode}' and no calibrated cameras.",
            "cameras.json, transforms.json or a COLMAP model in sparse/0.",
            f"run 'cgwm calibrate {typed_path(capture.root)}'.",
        )
    posed = set(capture.cameras.videos)
    calibrated = [name for name in names if name in posed or f"{name}/{episode}" in posed]
    if not calibrated:
        raise InputDataError(
            f"{capture.root}: none of the {len(names)} video cameras of episode '{episode}' ({', '.join(names)}) "
            f"is calibrated.",
            f"a pose under 'videos' in the cameras' file; it has {', '.join(sorted(posed)) or 'none'}.",
            f"run 'cgwm calibrate {typed_path(capture.root)} --overwrite'.",
        )
    videos = tuple(_load(capture, name, episode, image_size, device) for name in calibrated)
    _require_seen(capture, episode, videos)
    return Footage.of(episode, videos)


def _instants(times_s: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the distinct times of several videos [s], sorted."""
    times = np.unique(np.concatenate(list(times_s)))
    return times[np.concatenate([[True], np.diff(times) > SAME_INSTANT_S])] if len(times) else times


def _require_seen(capture: Capture, episode: str, videos: Sequence[Video]) -> None:
    """Refuse an episode whose masks show the free bodies in too few instants."""
    every, seen = (_instants(rows) for rows in ([v.times_s for v in videos], [v.times_s[v.shown] for v in videos]))
    if len(seen) >= max(MIN_FRAMES, MIN_SEEN * len(every)):
        return
    labels = {k: body.name for k, body in enumerate(capture.manifest.bodies, 1) if body.motion == "free"}
    bodies = " and ".join(f"'{name}' (label {k})" for k, name in labels.items())
    where = f"{capture.root / 'video_masks'}: episode '{episode}'"
    if not len(seen):
        raise InputDataError(
            f"{where}: the masks of all {len(videos)} cameras are empty: none shows {bodies}.",
            "0 for the background, k for the k-th of [[bodies]].",
            "correct the masks, or remove them; without masks the whole image is compared.",
        )
    raise InputDataError(
        f"{where}: {bodies} can be seen in {len(seen)} of {len(every)} instants, last at {seen[-1]:.3f} s "
        f"({'; '.join(_last_seen(video) for video in videos)}); in all others every camera's mask is empty.",
        f"masks that show it in half of the instants, and in at least {MIN_FRAMES}.",
        f"end the episode where the body leaves the view ([episodes] '{episode}' = {{ start_s = {seen[0]:.3f}, "
        f"end_s = {seen[-1]:.3f} }} in capture.toml), or correct the masks if they missed it.",
    )


def _last_seen(video: Video) -> str:
    """Return the camera and its last frame that shows the free bodies, for a message."""
    shown = video.shown
    return f"{video.camera}: frame {shown[-1]} of {len(video.times_s)}" if len(shown) else f"{video.camera}: never"


def _load(capture: Capture, name: str, episode: str, image_size: int, device: torch.device | str) -> Video:
    """Read a camera's video of an episode, undistort and reduce it."""
    frames, labels = capture.video_frames(name, episode), capture.video_masks(name, episode)
    _require_enough_frames(capture, name, episode, len(frames))
    cameras = [capture.video_camera(name, episode, int(k)) for k in capture.frame_numbers(name, episode)]
    first = cameras[0]
    _require_size_of(first, capture, name, episode, frames)
    scale = min(1.0, image_size / max(first.width, first.height))
    width, height = round(scale * first.width), round(scale * first.height)
    images = [_reduced(first.undistorted(frame)[0].astype(np.float32) / 255, width, height) for frame in frames]
    covers = unseen = None
    if labels is not None:
        flat = [first.undistorted(label, labels=True)[0] for label in labels]
        covers = _covers(flat, len(capture.manifest.bodies), width, height)
        unseen = _lacking(capture, flat)

    def tensor(array: NDArray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)

    return Video(
        camera=name,
        times_s=capture.frame_times(name, episode),
        frames=tensor(np.stack(images)),
        covers=None if covers is None else tensor(covers),
        K=tensor(first.resized(width, height).K),
        viewmats=tensor(np.stack([camera.T_cam_world for camera in cameras])),
        unseen=unseen,
    )


def _require_enough_frames(capture: Capture, name: str, episode: str, count: int) -> None:
    """Refuse a video with too few frames."""
    if count < MIN_FRAMES:
        raise InputDataError(
            f"{capture.video_path(name, episode)}: {count} frames between the episode's start and end.",
            f"at least {MIN_FRAMES}, which show a change of velocity; about fifteen around an impact are good.",
            f"film longer or faster, or correct [episodes] '{episode}' (start_s, end_s) and [video] frame_rate_hz.",
        )


def _require_size_of(camera: Camera, capture: Capture, name: str, episode: str, frames: NDArray) -> None:
    """Refuse frames (T, H, W, 3) of another size than their camera's."""
    if frames.shape[1:3] != (camera.height, camera.width):
        raise InputDataError(
            f"{capture.video_path(name, episode)}: frames of {frames.shape[2]}x{frames.shape[1]} pixels.",
            f"{camera.width}x{camera.height}, the size of its camera.",
            f"film in the size that was calibrated, or run 'cgwm calibrate {typed_path(capture.root)} --overwrite'.",
        )


def _covers(labels: Sequence[NDArray], bodies: int, width: int, height: int) -> NDArray[np.float32]:
    """Return the share of each pixel that each body covers, shape (T, bodies, height, width)."""
    return np.stack(
        [[_reduced((label == k).astype(np.float32), width, height) for k in range(1, bodies + 1)] for label in labels]
    )


def _lacking(capture: Capture, labels: Sequence[NDArray]) -> NDArray[np.bool_] | None:
    """Return the frames whose labels lack a free body, shape (T,); None if there are none."""
    free = [k for k, body in enumerate(capture.manifest.bodies, 1) if body.motion == "free"]
    lacking = np.array([any(not (label == k).any() for k in free) for label in labels])
    return lacking if lacking.any() else None


def _reduced(image: NDArray, width: int, height: int) -> NDArray:
    """Return an image (H, W, ...) resized by averaging areas."""
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
