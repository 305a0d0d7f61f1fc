"""What `cgwm compare --json` prints: where and when each model fails, side by side."""

from __future__ import annotations

from typing import Literal, get_args

from .base import FileModel
from .results import OpenLoopErrors

Phase = Literal["flight", "impact", "sliding", "rolling", "sticking", "rest"]
PHASES: tuple[Phase, ...] = get_args(Phase)


class PhaseFigures(FileModel):
    """Short predictions of a model within one phase of the motion."""

    frames: int
    """Measured frames of this phase, over all free bodies."""
    reduced_chi2: float | None
    """Mean square residual in units of the noise, for each degree of freedom left by the fitted states; about 1 where
    the model explains the data. Null where too few frames are left."""
    position_rms_m: float | None = None
    """Root mean square distance between short prediction and measurement [m]."""
    rotation_rms_deg: float | None = None
    sigmas: dict[str, float] = {}
    """Root mean square residual by degree of freedom in units of the noise: x, y, z in the world frame, and rx, ry, rz,
    the rotation vector in the body frame."""


class WorstMoment(FileModel):
    """A short segment of a motion that a model cannot follow."""

    episode: str
    t0_s: float
    t1_s: float
    """From the episode's first measured frame [s], as t0_s."""
    phase: Phase
    quantity: str
    """Body and degree of freedom with the largest residual: `cube z`, `cube rx`."""
    z: float
    """That residual in units of the noise."""


class CovariateShare(FileModel):
    """A coordinate of the motion that orders what a model misses."""

    coordinate: str
    """time, x, y, height, heading, speed, spin, episode; constant where it is the same everywhere."""
    share: float
    """Of the excess of the residual wrench over its noise, the part that bins along the coordinate take away."""


class ModelComparison(OpenLoopErrors):
    """One model: open-loop errors as `cgwm eval` prints them, and short predictions in units of the noise."""

    model: str
    effects: tuple[str, ...] = ()
    reduced_chi2: float | None = None
    """Of all short predictions."""
    by_phase: dict[Phase, PhaseFigures | None]
    """Null where no frame is in that phase."""
    worst: tuple[WorstMoment, ...] = ()
    """The worst first, one a segment."""
    wrench: tuple[CovariateShare, ...] = ()
    """What orders the residual wrench, the most telling coordinate first; empty where nothing is above the noise."""


class ShortDifference(FileModel):
    """Short predictions of two models on the same pieces of motion."""

    frames: int
    """Frames that both predict."""
    pieces: int
    """Pieces of motion, each predicted from the start that fits it best."""
    reduced_chi2: float
    than_reduced_chi2: float
    """Mean square residuals in units of the noise, of the two models."""
    interval_95: tuple[float, float] | None = None
    """Of their difference, by resampling the pieces; null where they are too few for it."""


class PairedDifference(FileModel):
    """Two models on the same episodes."""

    model: str
    than: str
    episodes: int
    better: int
    """Episodes in which `model` has the smaller translation error."""
    median_difference_m: float
    """Median over episodes of the translation error of `model` less that of `than` [m]."""
    interval_95_m: tuple[float, float] | None = None
    """Of that median, by resampling the episodes; null where they are too few for it."""
    short: ShortDifference | None = None
    """The same two in short predictions; null where none can be judged."""


class CompareResult(FileModel):
    """`cgwm compare --json`."""

    capture: str
    split: str
    episodes: int
    verdict: str
    models: tuple[ModelComparison, ...]
    best: str
    """The model with the smallest median translation error; `pairs` tells whether that means anything."""
    pairs: tuple[PairedDifference, ...] = ()
    """Each model against the one before it, and against the first."""
    measurement_std: dict[str, float]
    """position_m and rotation_rad: the noise that short predictions are measured in, the same for all models."""
    report: str | None = None
    """The page that was written."""
    warnings: tuple[str, ...] = ()
