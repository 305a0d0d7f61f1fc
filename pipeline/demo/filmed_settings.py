"""Settings that the demos with photos and videos have in common."""

from __future__ import annotations

from dataclasses import dataclass, field

from ...schemas import CalibrateConfig, SplatConfig


@dataclass(frozen=True, kw_only=True)
class FilmedSettings:
    """Sizes of pictures, and settings of the stages up to the spheres; the demo fills in seed and device."""

    photos: int
    """Number of photos of the scene."""
    photo_size: tuple[int, int] = (640, 480)
    """Width and height of a photo [px]."""
    video_size: tuple[int, int] = (480, 360)
    """Width and height of a video frame [px]."""
    calibrate: CalibrateConfig = field(default_factory=lambda: CalibrateConfig(max_features=2048))
    """Settings of `calibrate`."""
    splats: SplatConfig = field(default_factory=SplatConfig)
    """Settings of the stage sg-gs."""
