"""Intrinsics of one camera, measured with photos of a calibration target: `intrinsics.json`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .base import FileModel
from .cameras import CameraIntrinsics

INTRINSICS_FORMAT = "cgwm-intrinsics/1"
Deviation = Annotated[float, Field(ge=0, le=1e9)]


class TargetPhoto(FileModel):
    """A photo of the target."""

    corners: Annotated[int, Field(ge=0, le=100_000)]
    """Corners of the board that were found in it."""
    rms_px: Deviation | None = None
    """Root mean square of their reprojection errors [px]; none where the photo was not used."""
    reason: str = ""
    """Why it was not used; empty where it was."""


class IntrinsicsFile(FileModel):
    """`intrinsics.json`."""

    format: Literal["cgwm-intrinsics/1"] = INTRINSICS_FORMAT
    camera: CameraIntrinsics
    fx_std_px: Deviation
    """Standard deviation of fx [px], from the corners' scatter; those below likewise."""
    fy_std_px: Deviation
    cx_std_px: Deviation
    cy_std_px: Deviation
    distortion_std: tuple[Deviation, Deviation, Deviation, Deviation]
    """Of k1, k2, p1 and p2 [1]."""
    rms_px: Deviation
    """Root mean square reprojection error of the corners in all photos that were used [px]."""
    held_out_rms_px: Deviation
    """The same of photos under intrinsics that were estimated from the others [px]: every photo is held out once."""
    covered: Annotated[float, Field(ge=0, le=1)]
    """Share of the picture that corners of the board reached in some photo."""
    lens: str = ""
    """Camera and focal length by the EXIF data of the photos; empty where they name none."""
    photos: dict[str, TargetPhoto]
    """By name."""
    warnings: tuple[str, ...] = ()
    versions: dict[str, str] = {}

    def __str__(self) -> str:
        """Return the summary that the command prints."""
        camera, used = self.camera, sum(not photo.reason for photo in self.photos.values())
        k1, k2, p1, p2 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
        s1, s2, s3, s4 = self.distortion_std
        lines = [
            f"{used} of {len(self.photos)} photos show the board; reprojection {self.rms_px:.2f} px, "
            f"{self.held_out_rms_px:.2f} px in photos that were held out",
            f"fx {camera.fx:.1f} +- {self.fx_std_px:.2g} px, fy {camera.fy:.1f} +- {self.fy_std_px:.2g} px "
            f"({camera.width} x {camera.height})",
            f"cx {camera.cx:.1f} +- {self.cx_std_px:.2g} px, cy {camera.cy:.1f} +- {self.cy_std_px:.2g} px",
            f"k1 {k1:.4f} +- {s1:.1g}, k2 {k2:.4f} +- {s2:.1g}, p1 {p1:.5f} +- {s3:.1g}, p2 {p2:.5f} +- {s4:.1g}",
            f"the corners reach {100 * self.covered:.0f} % of the picture",
            *(f"not used: {name}: {photo.reason}" for name, photo in self.photos.items() if photo.reason),
        ]
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])


class TargetSheet(FileModel):
    """What `cgwm calibrate BOARD.pdf --target charuco` reports."""

    path: str
    width_mm: float
    """Width of the board without its margin [mm]."""
    height_mm: float
    square_mm: float
    """Side of a square [mm]."""
