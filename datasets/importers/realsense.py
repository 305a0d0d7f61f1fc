"""Import of recordings of RealSense cameras: sharp frames of a walk, their intrinsics, and depth in their pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import CameraIntrinsics, InputDataError
from ...schemas.imports import ImportResult
from ..capture.images import write_depth, write_image
from ..io.atomic import new_directory
from ..io.outputs import reads
from ..io.progress import progress
from .photo_captures import write_photo_capture
from .realsense_file import RealSenseFile, StreamGeometry, opened
from .walk_video import measured, sharp_frames

Array = NDArray[np.float64]

DEPTH_WITHIN_NS = 40_000_000
"""Largest time between a photo and its depth map [ns]: a little more than a frame."""
_LENS_OF_OPENCV = ("none", "brown conrady", "modified brown conrady", "plumb_bob")
_MILLIMETRES = 1000.0


@reads("source")
def import_realsense(source: Path | str, out: Path | str, photos: int = 60, overwrite: bool = False) -> ImportResult:
    """Write frames of a recording of a walk around a resting scene as a capture, with intrinsics and depth.

    The camera does not know its poses: `cgwm calibrate` estimates them, with the recorded intrinsics and the scale of
    the depth.

    Args:
        source: A .bag or .db3 of the RealSense Viewer or of rs-record, with a colour stream.
        out: The capture directory to write.
        photos: Most photos.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the file is no such recording, its camera stands, or fewer than three frames are sharp.
        UsageError: If `out` exists, before anything is read; or if rosbags is not installed.
    """
    source = Path(source)
    with new_directory(out, "capture", overwrite) as directory, opened(source) as recording:
        color = recording.stream("Color")
        if color is None:
            raise InputDataError(f"{source}: no colour stream.", todo="record with colour (and depth) switched on.")
        chosen, blurred = sharp_frames(source, measured(recording.colors(color)), photos)
        (directory / "images").mkdir()
        for k, frame in zip(chosen, recording.colors(color, set(chosen)), strict=True):
            write_image(directory / "images" / f"{k:06d}.jpg", np.ascontiguousarray(frame[:, :, ::-1]), 97)
        geometry = recording.geometry(color)
        intrinsics, notes = _intrinsics(geometry, source)
        notes += [f"{blurred} of {photos} parts of the recording have no sharp frame"] if blurred else []
        notes += _write_depth(recording, color, geometry, chosen, directory)
        return write_photo_capture(directory, out, len(chosen), warnings=notes, intrinsics=intrinsics)


def _intrinsics(geometry: StreamGeometry, source: Path) -> tuple[tuple[CameraIntrinsics, ...], list[str]]:
    """Return the intrinsics where OpenCV's model has them, and what is to be said."""
    lens = geometry.distortion
    if lens.any() and (geometry.lens.lower() not in _LENS_OF_OPENCV or lens[4:].any()):
        note = f"the lens ('{geometry.lens}') is not OpenCV's k1, k2, p1, p2: calibrate estimates it from the photos"
        return (), [note]
    (width, height), K = geometry.size, geometry.K
    numbers = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    distortion = tuple(map(float, lens[:4])) if lens.any() else ()
    return (CameraIntrinsics.of_lens(str(source), width=width, height=height, **numbers, distortion=distortion),), []


def _write_depth(
    recording: RealSenseFile, color: str, geometry: StreamGeometry, chosen: list[int], directory: Path
) -> list[str]:
    """Write the depth map of each photo that has one at its time; return what is to be said."""
    stream = recording.stream("Depth")
    if stream is None:
        return ["no depth stream: the scale has to come from elsewhere (docs: Calibrate)"]
    pairs = _photos_by_map(recording.times(color)[chosen], recording.times(stream), chosen)
    unit, depth_geometry = recording.depth_unit_m(stream), recording.geometry(stream)
    if pairs:
        (directory / "depth").mkdir()
    maps = recording.depths(stream, set(pairs))
    for k, raw in progress(maps, "depth", total=len(pairs), unit="map"):
        aligned = in_color_pixels(raw * unit, depth_geometry, geometry)
        millimetres = np.minimum(np.round(aligned * _MILLIMETRES), 65535).astype(np.uint16)
        for photo in pairs[k]:
            write_depth(directory / "depth" / f"{photo:06d}.png", millimetres)
    without = len(chosen) - sum(map(len, pairs.values()))
    return [f"{without} of {len(chosen)} photos have no depth at their time"] if without else []


def _photos_by_map(at: NDArray[np.int64], there: NDArray[np.int64], photos: list[int]) -> dict[int, list[int]]:
    """Return the photos, taken at times `at`, whose nearest depth map is close enough, by the number of the map."""
    nearest = np.abs(there[None] - at[:, None]).argmin(axis=1) if len(there) else np.zeros(0, int)
    pairs: dict[int, list[int]] = {}
    for photo, time, k in zip(photos, at, nearest, strict=False):
        if abs(int(there[k]) - int(time)) <= DEPTH_WITHIN_NS:
            pairs.setdefault(int(k), []).append(photo)
    return pairs


def in_color_pixels(depth_m: Array, depth: StreamGeometry, color: StreamGeometry) -> Array:
    """Return a depth map as the colour camera sees it [m], 0 where nothing is known, shape (H, W) of the colour.

    Each pixel is divided so finely that it covers those of the colour image; of several the nearest counts. Distortion
    is left out: that of the depth stream, which is computed from rectified images, is zero, and in the colour stream it
    moves depth by a few pixels at most.
    """
    split = int(np.ceil(color.K[0, 0] / depth.K[0, 0])) + 1
    fine = np.repeat(np.repeat(depth_m, split, 0), split, 1)
    rows, columns = np.nonzero(fine > 0)
    z = fine[rows, columns]
    inside = np.stack([columns + 0.5, rows + 0.5]) / split - 0.5  # in pixels of the depth map, middles at integers
    slopes = (inside - depth.K[:2, 2:3]) / np.array([[depth.K[0, 0]], [depth.K[1, 1]]])
    points = np.stack([slopes[0] * z, slopes[1] * z, z], 1)
    reference = (points - depth.t_stream_reference) @ depth.R_stream_reference
    seen = reference @ color.R_stream_reference.T + color.t_stream_reference
    seen = seen[seen[:, 2] > 0]
    pixels = seen[:, :2] / seen[:, 2:] * [color.K[0, 0], color.K[1, 1]] + color.K[:2, 2]
    x, y = np.round(pixels).astype(int).T
    width, height = color.size
    within = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    found = np.full((height, width), np.inf)
    np.minimum.at(found, (y[within], x[within]), seen[within, 2])
    return np.where(np.isfinite(found), found, 0.0)
