"""What the commands print with `--json`."""

from __future__ import annotations

from typing import Any

from .base import FileModel


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


class EpisodeErrors(FileModel):
    """The errors of one episode."""

    episode: str
    frames: int
    """Number of frames after the warm-up."""
    duration_s: float
    translation_error_m: float
    translation_final_m: float
    rotation_error_deg: float | None = None
    rotation_final_deg: float | None = None
    psnr_db: float | None = None
    psnr_object_db: float | None = None
    ssim: float | None = None
    """Structural similarity of the whole frame."""
    state_fitted_residual_m: float | None = None
    state_noise_floor_m: float | None = None


class OpenLoopErrors(FileModel):
    """The open-loop errors of a model over episodes; null what was not measured."""

    translation_error_m: ErrorSummary
    rotation_error_deg: ErrorSummary | None = None
    psnr_db: ErrorSummary | None = None
    psnr_object_db: ErrorSummary | None = None
    ssim: ErrorSummary | None = None
    state_fitted_residual_m: ErrorSummary | None = None
    state_noise_floor_m: ErrorSummary | None = None
    baselines: dict[str, dict[str, Any]] = {}
    """The same figures for a frozen object and a ballistic one."""
    per_episode: tuple[EpisodeErrors, ...] = ()
    warnings: tuple[str, ...] = ()


class EvalResult(OpenLoopErrors):
    """`cgwm eval --json`."""

    episodes: int
