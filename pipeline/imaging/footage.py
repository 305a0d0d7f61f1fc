"""The videos of an episode as the image loss sees them: undistorted, reduced, with cameras and a common time line."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.capture import Capture
from ...schemas import InputDataError

MIN_FRAMES = 3
"""Two frames show a velocity and nothing of contact."""
SAME_INSTANT_S = 1e-6


@dataclass(frozen=True, eq=False)
class Video:
    """One camera's frames of one episode.

    Attributes:
        camera: Name of the camera.
        times_s: Times of the frames [s], shape (T,).
        frames: sRGB values in [0, 1], shape (T, H, W, 3).
        covers: Share of each pixel that each body covers, shape (T, bodies, H, W); None without masks.
        K: Camera matrix at this size [px], shape (3, 3).
        viewmats: T_cam_world of each frame, shape (T, 4, 4).
    """

    camera: str
    times_s: NDArray[np.float64]
    frames: Tensor
    covers: Tensor | None
    K: Tensor
    viewmats: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height [px]."""
        return self.frames.shape[2], self.frames.shape[1]


@dataclass(frozen=True, eq=False)
class Footage:
    """All videos of an episode on one time line.

    Attributes:
        episode: Its name.
        videos: One for each calibrated camera.
        times_s: The instants at which any camera took a frame [s], shape (I,).
        frame_at: Frame of each video at each instant, -1 for none, shape (videos, I).
    """

    episode: str
    videos: tuple[Video, ...]
    times_s: NDArray[np.float64]
    frame_at: NDArray[np.int64]

    @staticmethod
    def of(episode: str, videos: tuple[Video, ...]) -> Footage:
        """Put videos on one time line; frames of the same time share an instant."""
        times = np.unique(np.concatenate([video.times_s for video in videos]))
        times = times[np.concatenate([[True], np.diff(times) > SAME_INSTANT_S])]
        frame_at = np.full((len(videos), len(times)), -1)
        for row, video in enumerate(videos):
            nearest = np.abs(times[:, None] - video.times_s).argmin(0)
            frame_at[row, nearest] = np.arange(len(video.times_s))
        return Footage(episode, videos, times, frame_at)


def load_footage(capture: Capture, episode: str, image_size: int, device: torch.device | str = "cpu") -> Footage:
    """Read the videos of an episode from all its calibrated cameras.

    Args:
        capture: The capture.
        episode: Name of the episode.
        image_size: Longer side [px] to which frames are reduced.
        device: Where the tensors live.

    Raises:
        InputDataError: If there are no cameras, no video, or fewer than three frames.
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
            f"run 'cgwm calibrate {capture.root}'.",
        )
    posed = set(capture.cameras.videos)
    calibrated = [name for name in names if name in posed or f"{name}/{episode}" in posed]
    if not calibrated:
        raise InputDataError(
            f"{capture.root}: none of the {len(names)} video cameras of episode '{episode}' ({', '.join(names)}) "
            f"is calibrated.",
            f"a pose under 'videos' in the cameras' file; it has {', '.join(sorted(posed)) or 'none'}.",
            f"run 'cgwm calibrate {capture.root} --overwrite'.",
        )
    return Footage.of(episode, tuple(_load(capture, name, episode, image_size, device) for name in calibrated))


def _load(capture: Capture, name: str, episode: str, image_size: int, device: torch.device | str) -> Video:
    frames, labels = capture.video_frames(name, episode), capture.video_masks(name, episode)
    if len(frames) < MIN_FRAMES:
        raise InputDataError(
            f"{capture.video_path(name, episode)}: {len(frames)} frames between the episode's start and end.",
            f"at least {MIN_FRAMES}; they should hold an impact.",
        )
    cameras = [capture.video_camera(name, episode, int(k)) for k in capture.frame_numbers(name, episode)]
    first = cameras[0]
    if frames.shape[1:3] != (first.height, first.width):
        raise InputDataError(
            f"{capture.video_path(name, episode)}: frames of {frames.shape[2]}x{frames.shape[1]} pixels.",
            f"{first.width}x{first.height}, the size of its camera.",
            f"run 'cgwm calibrate {capture.root} --overwrite'.",
        )
    scale = min(1.0, image_size / max(first.width, first.height))
    width, height = round(scale * first.width), round(scale * first.height)
    images = [_reduced(first.undistorted(frame)[0].astype(np.float32) / 255, width, height) for frame in frames]
    covers = None
    if labels is not None:
        flat = [first.undistorted(label, labels=True)[0] for label in labels]
        bodies = range(1, len(capture.manifest.bodies) + 1)
        covers = np.stack(
            [[_reduced((label == k).astype(np.float32), width, height) for k in bodies] for label in flat]
        )

    def tensor(array: NDArray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)

    return Video(
        name,
        capture.frame_times(name, episode),
        tensor(np.stack(images)),
        None if covers is None else tensor(covers),
        tensor(first.resized(width, height).K),
        tensor(np.stack([camera.T_cam_world for camera in cameras])),
    )


def _reduced(image: NDArray, width: int, height: int) -> NDArray:
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
