"""What the commands print with `--json`."""

from __future__ import annotations

from typing import Any, Literal

from .base import FileModel

Reference = Literal["auto", "tracks", "images"]
"""With what an evaluation compares: measured tracks, or poses found in the videos; auto takes tracks where any are."""


class KeptOutput(FileModel):
    """What a command prints whose output is there already: nothing was done."""

    output: str
    """The output, unchanged since the same command wrote it from the same inputs."""
    kept: bool = True


class ErrorSummary(FileModel):
    """Statistics over episodes of an error that was averaged within each episode."""

    mean: float
    median: float
    final: float | None = None
    """Median over episodes of the error at the last frame."""


class FilmedErrors(FileModel):
    """The errors of the frames of one camera after the warm-up; null where the body is not in sight."""

    camera: str
    time_s: tuple[float | None, ...]
    """Times of the frames from the beginning of the episode."""
    mask_iou: tuple[float | None, ...]
    """Overlap of the predicted silhouettes with the masks: intersection over union, mean over the free bodies."""
    centroid_error_px: tuple[float | None, ...]
    """Distance of the centroids of silhouette and mask."""
    outline_error_px: tuple[float | None, ...]
    """Mean distance of the points of either outline from the other."""
    psnr_object_db: tuple[float | None, ...]


class EpisodeErrors(FileModel):
    """The errors of one episode."""

    episode: str
    frames: int
    """Number of frames after the warm-up."""
    duration_s: float
    translation_error_m: float
    translation_final_m: float
    translation_interval_95_m: tuple[float, float] | None = None
    """Of the mean error, from the uncertainty of poses that were found in videos; null for tracks."""
    rotation_error_deg: float | None = None
    rotation_final_deg: float | None = None
    rotation_interval_95_deg: tuple[float, float] | None = None
    psnr_db: float | None = None
    psnr_object_db: float | None = None
    ssim: float | None = None
    """Structural similarity of the whole frame."""
    mask_iou: float | None = None
    """Mean over frames and cameras; so are the next two."""
    centroid_error_px: float | None = None
    outline_error_px: float | None = None
    centroid_error_m: float | None = None
    """Distance of the centroids of masks and of predicted silhouettes, triangulated: masks and cameras alone."""
    centroid_final_m: float | None = None
    centroid_interval_95_m: tuple[float, float] | None = None
    filmed: tuple[FilmedErrors, ...] = ()
    """The same over time by camera, where the videos have masks."""
    state_fitted_residual_m: float | None = None
    state_noise_floor_m: float | None = None


class OpenLoopErrors(FileModel):
    """The open-loop errors of a model over episodes; null what was not measured."""

    translation_error_m: ErrorSummary
    rotation_error_deg: ErrorSummary | None = None
    psnr_db: ErrorSummary | None = None
    psnr_object_db: ErrorSummary | None = None
    ssim: ErrorSummary | None = None
    mask_iou: ErrorSummary | None = None
    centroid_error_px: ErrorSummary | None = None
    outline_error_px: ErrorSummary | None = None
    centroid_error_m: ErrorSummary | None = None
    state_fitted_residual_m: ErrorSummary | None = None
    state_noise_floor_m: ErrorSummary | None = None
    baselines: dict[str, dict[str, Any]] = {}
    """The same figures for a frozen object and a ballistic one."""
    per_episode: tuple[EpisodeErrors, ...] = ()
    warnings: tuple[str, ...] = ()


class EvalResult(OpenLoopErrors):
    """`cgwm eval --json`."""

    episodes: int
    reference: Literal["tracks", "images"] = "tracks"
    """What the errors of position and rotation are against, and where predictions begin: measured tracks, or poses
    found in the videos."""
    report: str | None = None
    """The page that was written."""
