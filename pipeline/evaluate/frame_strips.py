"""Strips of real and predicted frames of evaluated episodes, one per camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...datasets.capture.capture import Capture
from ..rendering.contact_sheets import FrameStrip, Image
from ..rendering.video_view import video_view
from .evaluation import EpisodeEvaluation
from .image_errors import VideoComparison
from .prediction import EpisodePrediction


def strips_of(episodes: Sequence[EpisodeEvaluation], capture: Capture) -> list[FrameStrip]:
    """Return the kept frames of every episode and camera, with the true masks of the free bodies."""
    strips = []
    for one in episodes:
        for video in one.videos:
            if video.real is None or video.predicted is None:
                continue
            masks = _true_masks(one.prediction, video, capture) if video.true_masks else None
            start = float(one.prediction.time_s[0])
            strips.append(
                FrameStrip(
                    episode=one.prediction.episode,
                    camera=video.camera,
                    times_s=video.time_s - start,
                    real=video.real,
                    predicted=video.predicted,
                    masks=masks,
                )
            )
    return strips


def _true_masks(prediction: EpisodePrediction, video: VideoComparison, capture: Capture) -> Image | None:
    """Return the masks (F, H, W) of the compared frames, without distortion; 1 on the free bodies."""
    masks = capture.video_masks(video.camera, prediction.episode)
    if masks is None:
        return None
    times, numbers = (read(video.camera, prediction.episode) for read in (capture.frame_times, capture.frame_numbers))
    at = np.abs(times[:, None] - video.time_s).argmin(0)
    free = [k + 1 for k, name in enumerate(capture.body_names) if name in prediction.bodies]
    width, height = masks.shape[2], masks.shape[1]
    plain = [
        video_view(capture, video.camera, prediction.episode, int(numbers[k]), (width, height)).undistorted(
            masks[k], labels=True
        )[0]
        for k in at
    ]
    return np.isin(np.stack(plain), free).astype(np.uint8)
