"""Cameras on disk, `cameras.json`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import FileModel, parse

CAMERAS_FORMAT = "cgwm-cameras/1"

Entry = Annotated[float, Field(ge=-1e8, le=1e8)]
Row4 = tuple[Entry, Entry, Entry, Entry]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


Focal = Annotated[float, Field(ge=1e-3, le=1e9)]
FARTHEST_CENTRE = 20.0
"""Largest distance of the principal point from the middle of a picture, in sides: cut-outs have it outside."""


class CameraIntrinsics(FileModel):
    """A pinhole camera, with OpenCV distortion where there is any. Pixel centres: top-left is (0.5, 0.5)."""

    model: Literal["PINHOLE", "OPENCV"] = "PINHOLE"
    width: Annotated[int, Field(ge=1, le=100_000)]
    height: Annotated[int, Field(ge=1, le=100_000)]
    fx: Focal
    fy: Focal
    cx: float
    cy: float
    distortion: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] = ()
    """k1, k2, p1, p2 [, k3] for OPENCV; empty for PINHOLE."""

    @model_validator(mode="after")
    def _centred(self) -> CameraIntrinsics:
        for name, value, side in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if abs(value - 0.5 * side) > FARTHEST_CENTRE * side:
                raise ValueError(f"{name} of {value:g} px is far beyond a picture of {side} px")
        return self

    @model_validator(mode="after")
    def _distortion(self) -> CameraIntrinsics:
        if self.model == "PINHOLE" and any(self.distortion):
            raise ValueError("a PINHOLE camera has no distortion; use the model OPENCV")
        if self.model == "OPENCV" and len(self.distortion) not in (4, 5):
            raise ValueError(f"OPENCV takes 4 or 5 distortion values; found {len(self.distortion)}")
        return self

    @classmethod
    def of_lens(
        cls,
        where: str,
        *,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        distortion: Sequence[float],
    ) -> CameraIntrinsics:
        """Return a camera, with the model OPENCV where a value of the distortion is not zero, else PINHOLE.

        Args:
            where: What holds the numbers, for a message: a file and a place in it.
            width: Width of its images [px].
            height: Height of its images [px].
            fx: Focal length along rows [px].
            fy: Focal length along columns [px].
            cx: Column of the principal point [px].
            cy: Row of the principal point [px].
            distortion: OpenCV's k1, k2, p1, p2 [, k3], or nothing.

        Raises:
            InputDataError: If a number is out of bounds, or there are neither 0, 4 nor 5 distortion values.
        """
        bends = any(distortion)
        fields = {
            "model": "OPENCV" if bends else "PINHOLE",
            "width": width,
            "height": height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "distortion": tuple(distortion) if bends else (),
        }
        return parse(fields, cls, where)


class Scale(FileModel):
    """Whether one unit of the camera poses is one metre."""

    kind: Literal["metric", "unscaled"]
    source: str = ""
    relative_std: Annotated[float, Field(ge=0, le=1e6)] | None = None
    """Standard error of the scale, as a fraction."""


class PosedImage(FileModel):
    """A photo: which camera took it, and from where."""

    camera: str
    T_world_cam: Matrix4
    """Camera to world; camera axes OpenCV (x right, y down, z forward)."""


class PosedVideo(FileModel):
    """A video camera: one pose when it stands still, one for each frame when it moves."""

    camera: str
    T_world_cam: Matrix4 | Annotated[tuple[Matrix4, ...], Field(min_length=1)]


class CamerasFile(FileModel):
    """`cameras.json`."""

    format: Literal["cgwm-cameras/1"] = CAMERAS_FORMAT
    scale: Scale
    cameras: dict[str, CameraIntrinsics]
    images: dict[str, PosedImage] = {}
    videos: dict[str, PosedVideo] = {}

    @model_validator(mode="after")
    def _known_cameras(self) -> CamerasFile:
        for kind, entries in (("image", self.images), ("video", self.videos)):
            for name, entry in entries.items():
                if entry.camera not in self.cameras:
                    raise ValueError(f"{kind} '{name}' names the camera '{entry.camera}', which is not in 'cameras'")
        return self
