"""What `cgwm demo` reports: `report.json`, the content of `report.html` in numbers."""

from __future__ import annotations

from typing import Literal

from .base import FileModel
from .dataset import DatasetSummary
from .model import FittedParameter, Provenance
from .results import EvalResult


class DemoTarget(FileModel):
    """A figure of the verdict and what it ought to be; medians over the test episodes."""

    name: str
    unit: str
    value: float | None
    target: float
    better: Literal["below", "above"]
    met: bool
    frozen: float | None = None
    """The same figure for an object that stays where it was at the end of the warm-up."""
    ballistic: float | None = None
    """The same figure for an object that flies on freely, without contact."""


class CalibrationCheck(FileModel):
    """The stage calibrate; errors against the true cameras, known because the scene is simulated."""

    photos: int
    photos_registered: int
    video_cameras: int
    video_cameras_registered: int
    reprojection_error_px: float
    center_error_median_m: float
    """Distance between estimated and true camera centre, over photos and video cameras [m]."""
    center_error_max_m: float
    scale_error: float
    """Estimated over true scale, minus 1."""
    scale_std: float | None = None
    """Relative standard error that the calibration states."""
    scale_source: str = ""
    self_check: bool
    """Whether the verified matches agree with the cameras."""


class BodyCheck(FileModel):
    """The spheres of the object; distances against its true surface."""

    body: str
    visual_spheres: int
    collision_spheres: int
    surface_error_mean_m: float
    """Mean distance between points of the true surface and the surface of the colliding spheres [m]."""
    surface_error_95_m: float
    """95th percentile of it [m]."""
    surface_bias_m: float
    """Mean signed distance: positive where the colliding spheres are too small [m]."""


class SplatCheck(FileModel):
    """The stage sg-gs; figures on photos that it did not see."""

    held_out_photos: int
    psnr_db: float | None = None
    psnr_object_db: float | None = None
    mask_iou: float | None = None
    scene_spheres: int
    bodies: tuple[BodyCheck, ...]


class ComparedParameter(FileModel):
    """A parameter of the model next to the truth."""

    parameter: FittedParameter
    true_value: float | None = None
    """Known only because the scene is simulated; the fit never sees it."""
    covered: bool | None = None
    """Whether the 95 % interval holds the true value; null where there is no interval or no true value."""


class ErrorCurve(FileModel):
    """Errors over the frames of an episode; null where nothing was measured."""

    translation_error_m: tuple[float | None, ...]
    rotation_error_deg: tuple[float | None, ...] = ()


class EpisodeCurves(FileModel):
    """One test episode, frame by frame."""

    episode: str
    time_s: tuple[float, ...]
    warmup_end_s: float
    first_contact_s: float | None = None
    """The true first contact."""
    model: ErrorCurve
    frozen: ErrorCurve
    ballistic: ErrorCurve


class ImagesOnlyFit(FileModel):
    """The fit that learns physics from the video frames alone, without a pose track; no target is set for it."""

    outcome: Literal["fitted", "not_converged"]
    message: str = ""
    """Why not."""
    evaluation: EvalResult | None = None
    parameters: tuple[ComparedParameter, ...] = ()


class DemoResult(FileModel):
    """`report.json`, and what `cgwm demo --json` prints."""

    format: Literal["cgwm-demo/1"] = "cgwm-demo/1"
    scene: str
    seed: int
    renderer: str
    device: str
    verdict: str
    targets: tuple[DemoTarget, ...]
    evaluation: EvalResult
    selection: str = ""
    """How the test episodes were chosen, where that bears on the errors."""
    parameters: tuple[ComparedParameter, ...]
    images_only: ImagesOnlyFit
    calibration: CalibrationCheck
    splats: SplatCheck
    dataset: DatasetSummary
    curves: tuple[EpisodeCurves, ...]
    seconds: dict[str, float]
    """Wall time by stage [s]; the report itself is not among them."""
    peak_memory_bytes: int
    """Largest resident memory of the process."""
    paths: dict[str, str]
    """What was written, by kind, relative to OUT."""
    warnings: tuple[str, ...] = ()
    provenance: Provenance
    """Of the model."""

    @property
    def target_met(self) -> bool:
        """Whether every figure of the verdict is as it ought to be."""
        return all(target.met for target in self.targets)
