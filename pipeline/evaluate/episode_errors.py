"""Errors of one episode: means over its frames after the warm-up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...schemas import EpisodeErrors
from .image_errors import VideoComparison
from .prediction import MODEL, EpisodePrediction

Array = NDArray[np.float64]


def episode_errors(prediction: EpisodePrediction, videos: Sequence[VideoComparison]) -> EpisodeErrors:
    """Return the errors of a prediction and of its videos after the warm-up.

    Raises:
        ValueError: If no measured frame follows the warm-up.
    """
    moved, moved_last = within(prediction, prediction.translation_error_m())
    turned, turned_last = within(prediction, prediction.rotation_error_deg())
    if moved is None or moved_last is None:
        raise ValueError(f"episode '{prediction.episode}': no measured frame follows the warm-up.")
    after = prediction.seen.any(1) & ~prediction.warmup
    return EpisodeErrors(
        episode=prediction.episode,
        frames=int(after.sum()),
        duration_s=float(prediction.time_s[-1] - prediction.time_s[0]),
        translation_error_m=moved,
        translation_final_m=moved_last,
        rotation_error_deg=turned,
        rotation_final_deg=turned_last,
        psnr_db=video_mean(videos, "psnr_db", MODEL),
        psnr_object_db=video_mean(videos, "psnr_object_db", MODEL),
        ssim=video_mean(videos, "ssim", MODEL),
        state_fitted_residual_m=prediction.state_fitted_m,
        state_noise_floor_m=prediction.noise_floor_m,
    )


def within(prediction: EpisodePrediction, error: Array) -> tuple[float | None, float | None]:
    """Return mean and last value of an error (T, nf) after the warm-up; None without measurements there."""
    after = error[~prediction.warmup]
    measured = np.flatnonzero(np.isfinite(after).any(1))
    if len(measured) == 0:
        return None, None
    return float(np.nanmean(after)), float(np.nanmean(after[measured[-1]]))


def video_mean(videos: Sequence[VideoComparison], figure: str, method: str) -> float | None:
    """Return the mean over all frames of all cameras; None without frames."""
    values = np.concatenate([getattr(video, figure)[method] for video in videos]) if videos else np.zeros(0)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None
