"""The focal length of a camera from what its photos say in their EXIF data and from their matches, together."""

from __future__ import annotations

from collections.abc import Mapping as Map
from dataclasses import dataclass

import numpy as np

EXIF_STD = 0.03
"""Relative standard deviation of a focal length from EXIF data: lenses are marked with round numbers (ISO 517 admits
5 %), a lens that focuses near has another one, and the 35 mm equivalent is a whole number of millimetres."""
_CONTRADICTION = 4.0
"""Standard deviations of the difference above which the EXIF data are taken for wrong: those of cut-out photos are."""


@dataclass(frozen=True, kw_only=True)
class FocalLength:
    """The focal length of a camera [px]."""

    exif_px: float
    """That of the EXIF data."""
    matches_px: float
    """That of the bundle adjustment, which the matches of all its photos determine."""
    matches_std: float
    """Relative standard deviation of the latter; infinite where they do not determine it."""

    @property
    def agree(self) -> bool:
        """Whether the two differ by no more than their errors admit."""
        return abs(np.log(self.matches_px / self.exif_px)) <= _CONTRADICTION * float(
            np.hypot(EXIF_STD, self.matches_std)
        )

    @property
    def combined_px(self) -> float:
        """The mean of both weighted by their information; that of the matches where they contradict each other."""
        if not self.agree:
            return self.matches_px
        weight = EXIF_STD**2 / (EXIF_STD**2 + self.matches_std**2) if np.isfinite(self.matches_std) else 0.0
        return float(np.exp(weight * np.log(self.matches_px) + (1 - weight) * np.log(self.exif_px)))


def focal_lengths(
    exif_px: Map[str, float], matches_px: Map[str, float], stds: Map[str, float]
) -> dict[str, FocalLength]:
    """Return the focal lengths of the cameras with EXIF data whose intrinsics were estimated."""
    return {
        camera: FocalLength(exif_px=exif_px[camera], matches_px=matches_px[camera], matches_std=stds[camera])
        for camera in matches_px
        if camera in exif_px and camera in stds
    }
