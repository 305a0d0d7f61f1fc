"""Errors of one episode: means over its frames after the warm-up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...schemas import EpisodeErrors, FilmedErrors
from .filmed_poses import PoseUncertainty
from .image_errors import VideoComparison
from .mask_centroids import CentroidDistance, Sighting, centroid_distance
from .prediction import MODEL, EpisodePrediction

Array = NDArray[np.float64]


def episode_errors(
    prediction: EpisodePrediction, videos: Sequence[VideoComparison], uncertainty: PoseUncertainty | None = None
) -> EpisodeErrors:
    """Return the errors of a prediction and of its videos after the warm-up.

    Args:
        prediction: The prediction.
        videos: Its comparisons with the videos.
        uncertainty: Of the measured poses, where they were found in the videos.

    Raises:
        ValueError: If no measured frame follows the warm-up.
    """
    moved, moved_last = within(prediction, prediction.translation_error_m())
    turned, turned_last = within(prediction, prediction.rotation_error_deg())
    if moved is None or moved_last is None:
        raise ValueError(f"episode '{prediction.episode}': no measured frame follows the warm-up.")
    after = prediction.seen.any(1) & ~prediction.warmup
    intervals = (None, None) if uncertainty is None else uncertainty.intervals(prediction, moved, turned or 0.0)
    apart = _centroids_apart(videos)
    return EpisodeErrors(
        episode=prediction.episode,
        frames=int(after.sum()),
        duration_s=float(prediction.time_s[-1] - prediction.time_s[0]),
        translation_error_m=moved,
        translation_final_m=moved_last,
        translation_interval_95_m=intervals[0],
        rotation_error_deg=turned,
        rotation_final_deg=turned_last,
        rotation_interval_95_deg=None if turned is None else intervals[1],
        psnr_db=video_mean(videos, "psnr_db", MODEL),
        psnr_object_db=video_mean(videos, "psnr_object_db", MODEL),
        ssim=video_mean(videos, "ssim", MODEL),
        mask_iou=silhouette_mean(videos, "iou", MODEL),
        centroid_error_px=silhouette_mean(videos, "centroid_px", MODEL),
        outline_error_px=silhouette_mean(videos, "outline_px", MODEL),
        centroid_error_m=None if apart is None else apart.mean_m,
        centroid_final_m=None if apart is None else apart.final_m,
        centroid_interval_95_m=None if apart is None else apart.interval_95_m,
        filmed=tuple(_over_time(video, float(prediction.time_s[0])) for video in videos if video.silhouettes),
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


def silhouette_mean(videos: Sequence[VideoComparison], figure: str, method: str) -> float | None:
    """Return the mean error of silhouettes over all bodies, frames and cameras where it is known; None without any."""
    known = [getattr(video.silhouettes[method], figure).ravel() for video in videos if method in video.silhouettes]
    values = np.concatenate(known) if known else np.zeros(0)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def _centroids_apart(videos: Sequence[VideoComparison]) -> CentroidDistance | None:
    """Return the distance of the centroids of masks and of predicted silhouettes, triangulated."""
    return centroid_distance(
        [
            Sighting(
                time_s=video.time_s,
                cameras=video.cameras,
                real=video.silhouettes[MODEL].real_centroids,
                predicted=video.silhouettes[MODEL].predicted_centroids,
            )
            for video in videos
            if MODEL in video.silhouettes
        ]
    )


def _over_time(video: VideoComparison, start_s: float) -> FilmedErrors:
    """Return the errors of one camera's frames over time: means over the free bodies."""
    shown = video.silhouettes[MODEL]
    return FilmedErrors(
        camera=video.camera,
        time_s=_figures(video.time_s - start_s, 4),
        mask_iou=_figures(_over_bodies(shown.iou), 4),
        centroid_error_px=_figures(_over_bodies(shown.centroid_px), 2),
        outline_error_px=_figures(_over_bodies(shown.outline_px), 2),
        psnr_object_db=_figures(video.psnr_object_db[MODEL], 2),
    )


def _over_bodies(values: Array) -> Array:
    known = np.isfinite(values)
    count = known.sum(1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(1) / np.maximum(count, 1), np.nan)


def _figures(values: Array, digits: int) -> tuple[float | None, ...]:
    return tuple(round(float(value), digits) if np.isfinite(value) else None for value in values)
