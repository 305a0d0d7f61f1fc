"""Reading and writing of `sparse_points.ply`, the sparse points from which the stage sg-gs starts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.regular_files import read_binary_file

Array = NDArray[np.float64]

POINTS_NAME = "sparse_points.ply"
MOST_BYTES = 8 << 30
"""Largest size of the file [bytes]."""

_VERTEX = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])


_PROPERTIES = [f"property double {axis}" for axis in "xyz"] + [
    f"property uchar {name}" for name in ("red", "green", "blue")
]


def write_points(path: Path, points: Array, colors: NDArray[np.uint8], unit: str) -> None:
    """Write sparse points as binary PLY.

    Args:
        path: The file; it is not written atomically, so pass a temporary one.
        points: Positions, world frame, shape (point, 3).
        colors: sRGB, shape (point, 3).
        unit: "metre" or "arbitrary", for the header.
    """
    header = ["ply", "format binary_little_endian 1.0", f"comment unit {unit}", "comment frame world"]
    header += [f"element vertex {len(points)}", *_PROPERTIES, "end_header", ""]
    table = np.empty(len(points), _VERTEX)
    table["xyz"], table["rgb"] = points, colors
    path.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def read_points(path: Path) -> tuple[Array, NDArray[np.uint8]]:
    """Read the sparse points that :func:`write_points` wrote.

    Args:
        path: `sparse_points.ply` of a capture.

    Returns:
        Positions, world frame, float64 (point, 3), in the unit of `cameras.json`, and sRGB colours, uint8 (point, 3).

    Raises:
        InputDataError: If it is another kind of file, truncated, or contains a point that is not finite.
    """
    table = _table(path, read_binary_file(path, MOST_BYTES))
    bad = int(np.count_nonzero(~np.isfinite(table["xyz"]).all(1)))
    if bad:
        raise InputDataError(
            f"{path}: {bad} of {len(table)} points are not finite.", todo="run 'cgwm calibrate --overwrite'."
        )
    return table["xyz"].astype(np.float64), table["rgb"].astype(np.uint8)


def _table(path: Path, data: bytes) -> NDArray[Any]:
    """Return the points of a file, as they are stored."""
    header, found, body = data.partition(b"end_header\n")
    lines = header.decode("ascii", "replace").splitlines()
    counts = re.findall(r"^element vertex (\d+)$", "\n".join(lines), re.MULTILINE | re.ASCII)
    properties = [line for line in lines if line.startswith("property")]
    if not found or len(counts) != 1 or properties != _PROPERTIES:
        raise InputDataError(
            f"{path}: not the sparse points of a calibration.", todo="run 'cgwm calibrate --overwrite'."
        )
    if len(body) != int(counts[0]) * _VERTEX.itemsize:
        raise InputDataError(
            f"{path}: truncated: {counts[0]} points announced, {len(body) // _VERTEX.itemsize} found.",
            todo="run 'cgwm calibrate --overwrite'.",
        )
    return np.frombuffer(body, _VERTEX)
