"""Optional geometry maps of the photos: depth, normals and features.

    depth/<photo>.npy      float, (H, W): depth along the optical axis [m]; 0 or not finite where unknown
    depth/<photo>.png      16 bits, one channel: the same in millimetres
    normals/<photo>.npy    float, (H, W, 3): outward unit normals in camera axes (OpenCV); zero where unknown
    normals/<photo>.png    8 bits, RGB: 127.5 (n + 1)
    features/<photo>.npy   float, (h, w, F), any size and number of channels: features of a network

Names are those of the photos without their suffix. Maps belong to the photo as taken, with its camera's distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ..io.arrays import read_npy
from .files import files_under, optional_file
from .images import decoded

KINDS = {"depth": (".npy", ".png"), "normals": (".npy", ".png"), "features": (".npy",)}
"""Readable suffixes of each kind of map, by its folder."""
_MILLIMETRE_M = 1e-3
_LEAST_NORMAL = 0.5
Map = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class GeometryMaps:
    """Geometry maps of a photo; None for a map that does not exist."""

    depth_m: Map | None = None
    """Depth along the optical axis [m], 0 where unknown, shape (H, W)."""
    normals_cam: Map | None = None
    """Outward unit normals, camera axes (OpenCV), zero where unknown, shape (H, W, 3)."""
    features: Map | None = None
    """Features, shape (h, w, F)."""


def map_names(root: Path, kind: str) -> list[str]:
    """Return the maps of a kind in a capture, relative to their folder, sorted."""
    return [name for name in files_under(root / kind, KINDS[kind]) if Path(name).suffix.lower() in KINDS[kind]]


def read_maps(root: Path, photo: str) -> GeometryMaps:
    """Return the maps of a photo.

    Raises:
        InputDataError: If a file cannot be read, or its shape or type is wrong.
    """
    depth, normals, features = (_read(root, kind, photo) for kind in KINDS)
    return GeometryMaps(depth, normals, features)


def _read(root: Path, kind: str, photo: str) -> Map | None:
    for suffix in KINDS[kind]:
        path = optional_file(root / kind / Path(photo).with_suffix(suffix))
        if path is not None:
            return read_map(path, kind)
    return None


def read_map(path: Path, kind: str) -> Map:
    """Read one map as float32, in the convention of `GeometryMaps`.

    Raises:
        InputDataError: If it cannot be read, or its shape or type is wrong.
    """
    return {"depth": _depth, "normals": _normals, "features": _features}[kind](path)


def _depth(path: Path) -> Map:
    if path.suffix.lower() == ".png":
        values = decoded(path, cv2.IMREAD_UNCHANGED)
        if values.ndim != 2 or values.dtype != np.uint16:
            raise InputDataError(
                f"{path}: no image of one channel with 16 bits.",
                "16-bit PNG, millimetres; or .npy.",
                "save the depth as a PNG of 16 bits, in millimetres.",
            )
        depth = values.astype(np.float32) * _MILLIMETRE_M
    else:
        depth = _array(path, (2,), "(H, W) [m]")
    if (depth[np.isfinite(depth)] < 0).any():
        raise InputDataError(
            f"{path}: a depth below 0.",
            "metres along the optical axis; 0 where unknown.",
            "write 0 where the depth is unknown.",
        )
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def _normals(path: Path) -> Map:
    if path.suffix.lower() == ".png":
        values = decoded(path, cv2.IMREAD_UNCHANGED)
        if values.ndim != 3 or values.shape[2] != 3 or values.dtype != np.uint8:
            raise InputDataError(
                f"{path}: no RGB image with 8 bits.",
                "8-bit PNG, 127.5 (n + 1); or .npy.",
                "save the normals as an RGB PNG of 8 bits.",
            )
        normals = values[..., ::-1].astype(np.float32) / 127.5 - 1
    else:
        normals = _array(path, (3,), "(H, W, 3)")
        if normals.shape[2] != 3:
            raise InputDataError(
                f"{path}: the shape is {normals.shape}.",
                "(H, W, 3).",
                "save one normal of three numbers for each pixel.",
            )
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    known = np.isfinite(length) & (length > _LEAST_NORMAL)
    return np.where(known, normals / np.where(known, length, 1), 0).astype(np.float32)


def _features(path: Path) -> Map:
    features = _array(path, (3,), "(h, w, F)")
    if not np.isfinite(features).all():
        raise InputDataError(
            f"{path}: values that are not finite.", "finite numbers.", "write 0 where a value is unknown."
        )
    return features


def _array(path: Path, dimensions: tuple[int, ...], wanted: str) -> Map:
    array = read_npy(path)
    if array.ndim not in dimensions or array.dtype.kind != "f" or not array.size:
        raise InputDataError(
            f"{path}: {array.dtype} {array.shape}.",
            f"floating-point numbers, {wanted}.",
            "save the map in one of these forms.",
        )
    return array.astype(np.float32)
