"""What an evaluation finds: of one episode, and of all."""

from __future__ import annotations

from dataclasses import dataclass

from ...schemas import EpisodeErrors, EvalResult
from .image_errors import VideoComparison
from .prediction import EpisodePrediction


@dataclass(frozen=True, eq=False)
class EpisodeEvaluation:
    """Evaluation of one episode."""

    prediction: EpisodePrediction
    """Measurements and predictions."""
    videos: tuple[VideoComparison, ...]
    """Comparisons with the videos, one per camera."""
    errors: EpisodeErrors
    """Errors of the episode."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of `cgwm eval` with the underlying motions and frames."""

    result: EvalResult
    """Summary of the errors."""
    episodes: tuple[EpisodeEvaluation, ...]
    """Evaluations of the episodes."""
