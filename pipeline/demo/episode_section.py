"""From an evaluation to what a report shows of each episode: errors over time, and frames real and predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture import Capture
from ...datasets.scenes import TruthFile
from ...schemas import EpisodeCurves, ErrorCurve
from ..eval import EpisodeEvaluation
from ..image_errors import VideoComparison, video_view
from ..prediction import BALLISTIC, FROZEN, MODEL, EpisodePrediction
from .pictures import FrameStrip, Image

_MICROMETRES, _MILLIDEGREES = 6, 3


def curves_of(predictions: Sequence[EpisodePrediction], truth: TruthFile) -> tuple[EpisodeCurves, ...]:
    """Return the errors over time, averaged over the free bodies, on the times since each episode's start.

    The baselines begin where the warm-up ends: before that they predict nothing.
    """
    return tuple(
        EpisodeCurves(
            episode=one.episode,
            time_s=_rounded(one.time_s - one.time_s[0], _MICROMETRES),
            warmup_end_s=round(one.warmup_end_s - float(one.time_s[0]), _MICROMETRES),
            first_contact_s=truth.episodes[one.episode].first_contact_s,
            model=_curve(one, MODEL, one.time_s > -np.inf),
            frozen=_curve(one, FROZEN, one.time_s >= one.warmup_end_s),
            ballistic=_curve(one, BALLISTIC, one.time_s >= one.warmup_end_s),
        )
        for one in predictions
    )


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
                    one.prediction.episode, video.camera, video.time_s - start, video.real, video.predicted, masks
                )
            )
    return strips


def _true_masks(prediction: EpisodePrediction, video: VideoComparison, capture: Capture) -> Image | None:
    """Return the masks (F, H, W) of the frames that were compared, without distortion: 1 where a free body is."""
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


def _curve(one: EpisodePrediction, method: str, shown: NDArray[np.bool_]) -> ErrorCurve:
    return ErrorCurve(
        translation_error_m=_mean(one.translation_error_m(method), shown, _MICROMETRES),
        rotation_error_deg=_mean(one.rotation_error_deg(method), shown, _MILLIDEGREES) if one.turned.any() else (),
    )


def _mean(error: NDArray[np.float64], shown: NDArray[np.bool_], decimals: int) -> tuple[float | None, ...]:
    """Return the mean over bodies of an error (T, bodies) at the frames that are shown; None where it is unknown."""
    known = np.isfinite(error)
    count = known.sum(1)
    total = np.where(known, error, 0.0).sum(1)
    return tuple(
        round(float(value / n), decimals) if n and keep else None
        for value, n, keep in zip(total, count, shown, strict=True)
    )


def _rounded(values: NDArray[np.float64], decimals: int) -> tuple[float, ...]:
    return tuple(round(float(value), decimals) for value in values)
