"""What `cgwm calibrate` reports: `calibration.json`, beside `cameras.json`."""

from __future__ import annotations

from typing import Literal

from .base import FileModel
from .cameras import Scale
from .config import CalibrateConfig


class ImageVerdict(FileModel):
    """Whether an image was registered, and on what evidence."""

    registered: bool
    reason: str = ""
    """Why not; empty for a registered image."""
    features: int = 0
    matched_images: int = 0
    """Images that share verified matches with this one."""
    matches: int = 0
    """Verified matches with all of them together."""
    inliers: int = 0
    """Features that see a sparse point of the model."""
    center_std_percent: float | None = None
    """Standard deviation of the optical centre [% of the diagonal of the box around all centres], at most 100; none for
    an image that is not registered."""
    rotation_std_deg: float | None = None
    """Standard deviation of the camera's rotation [deg]; none for an image that is not registered."""


class PairFigures(FileModel):
    """A pair of images in the self-check."""

    images: tuple[str, str]
    inliers: int
    """Matches that two-view verification kept."""
    consistent: float
    """Fraction of them that agrees with the model's relative pose (Sampson error below 4 px)."""


class SelfCheckFigures(FileModel):
    """The self-check: do the verified matches agree with the cameras?"""

    passed: bool
    pairs: int
    """Pairs with at least 50 verified inliers."""
    strong_pairs: int
    """Pairs with at least 200: one of them that is less than half consistent rejects the model."""
    worst: PairFigures | None = None
    """The least consistent strong pair (of all pairs where none is strong)."""
    images_without_strong_pair: tuple[str, ...] = ()
    """Registered images for which the check has no strong evidence."""


class CalibrationAttempt(FileModel):
    """One attempt at a model."""

    seed: int
    max_features: int
    max_image_size: int
    peak_threshold: float
    guided_matching: bool
    max_ratio: float
    camera_model: str = ""
    """COLMAP's camera model: the simplest that no richer one beats; empty where nothing was estimated."""
    models: int
    """Connected models; the largest is taken."""
    registered: int
    points: int
    reprojection_error_px: float | None = None
    self_check: SelfCheckFigures | None = None
    outcome: Literal["taken", "passed", "self_check_failed", "no_model"]


class FocalFigures(FileModel):
    """The focal length of a camera whose photos have one in their EXIF data."""

    px: float
    """That of cameras.json: the mean of the two below, weighted by their information [px]."""
    exif_px: float
    """From the EXIF data, taken to be right within 3 % (one standard deviation)."""
    matches_px: float
    """From the matches of all photos."""
    matches_std_percent: float
    """Standard deviation of the latter [%], at most 100."""
    exif_used: bool
    """False where the two contradict each other: the matches alone count."""


class CalibrationReport(FileModel):
    """`calibration.json`."""

    format: Literal["cgwm-calibration/1"] = "cgwm-calibration/1"
    photos: int
    photos_registered: int
    images: dict[str, ImageVerdict]
    """By photo, relative to images/."""
    videos: dict[str, ImageVerdict] = {}
    """By video camera: its first frame."""
    points: int
    """Sparse points, in sparse_points.ply."""
    reprojection_error_px: float
    """Mean over the points. A wrong model can have a low one: the self-check decides."""
    self_check: SelfCheckFigures
    attempts: tuple[CalibrationAttempt, ...]
    center_std_percent: float | None = None
    """Median over the registered images of the standard deviation of the optical centre [% of the centres' extent]."""
    turntable_rings: tuple[int, ...] = ()
    """Number of photos of each ring, where the camera stood before a turntable: poses are then those of its motion."""
    focal_lengths: dict[str, FocalFigures] = {}
    """By camera, where the EXIF data name a focal length and the intrinsics were estimated."""
    scale: Scale
    world_frame: str
    """Where the axes and the origin come from, in words."""
    marker_residual_m: float | None = None
    """Root mean square distance of the triangulated marker corners from their places [m]."""
    ground_tilt_deg: float | None = None
    """Angle between the manifest's ground and the dominant plane of the sparse points [deg], where both exist."""
    ground_height_m: float | None = None
    """Height of that plane over the manifest's ground at the origin [m]; metric scale only."""
    warnings: tuple[str, ...] = ()
    config: CalibrateConfig
    versions: dict[str, str] = {}
    input_sha256: str = ""
    """Of the manifest, the photos and the videos; empty where an earlier version wrote the report."""
    wall_time_s: float

    def __str__(self) -> str:
        """Return the summary that the command prints."""
        lines = [
            f"{self.photos_registered} of {self.photos} photos registered, "
            f"{self.points} points, reprojection {self.reprojection_error_px:.2f} px, {self.wall_time_s:.0f} s",
            f"self-check: {_passed(self.self_check)}",
            *(f"camera model: {one.camera_model}" for one in self.attempts if one.outcome == "taken"),
            *([f"turntable: {_counted(self.turntable_rings)}"] if self.turntable_rings else []),
            *(
                f"focal length of '{camera}': {one.px:.0f} px (matches {one.matches_px:.0f} +- "
                f"{one.matches_std_percent:.2g} %, EXIF {one.exif_px:.0f} +- 3 %)"
                for camera, one in self.focal_lengths.items()
                if one.exif_used
            ),
            *self._centers(),
        ]
        if self.videos:
            seen = sum(verdict.registered for verdict in self.videos.values())
            lines.append(f"{seen} of {len(self.videos)} video cameras registered")
        lines += [self._scale(), f"world frame: {self.world_frame}"]
        for name, verdict in {**self.images, **{f"video {k}": v for k, v in self.videos.items()}}.items():
            if not verdict.registered:
                lines.append(f"not registered: {name}: {verdict.reason}")
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])

    def _scale(self) -> str:
        """Return the line on the scale of lengths."""
        if self.scale.kind != "metric":
            return "scale: unscaled; physics needs a metric scale (capture.toml, [calibration])"
        error = "" if self.scale.relative_std is None else f" +- {100 * self.scale.relative_std:.2f} %"
        return f"scale: metric{error}, {self.scale.source}"

    def _centers(self) -> list[str]:
        """Return the line on how certain the optical centres are."""
        seen = {name: verdict.center_std_percent for name, verdict in {**self.images, **self.videos}.items()}
        known = {name: value for name, value in seen.items() if value is not None}
        if not known or self.center_std_percent is None:
            return []
        worst = max(known, key=lambda name: known[name])
        return [
            f"optical centres: +- {self.center_std_percent:.2g} % of their extent (median), "
            f"+- {known[worst]:.2g} % at {worst}"
        ]


def _counted(rings: tuple[int, ...]) -> str:
    """Return the words for the numbers of photos of rings."""
    places = "one place" if len(rings) == 1 else f"{len(rings)} places"
    return f"the camera stood at {places} ({', '.join(map(str, rings))} photos), what it shows turned about one axis"


def _passed(check: SelfCheckFigures) -> str:
    if check.worst is None:
        return "passed, but no pair has the 50 matches that it needs"
    a, b = check.worst.images
    return (
        f"passed, {check.strong_pairs} strong pairs; the worst, {a} and {b}, is {100 * check.worst.consistent:.0f} % "
        f"consistent ({check.worst.inliers} matches)"
    )
