"""A file of binary glTF: its one buffer, its nodes, and the document around them.

glTF's up axis is +y: all nodes have one root, which rotates the world's +z to it. Source: Khronos, glTF 2.0.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import BodyModel
from ..io.atomic import new_file

_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_FLOAT, _UNSIGNED_INT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_Z_TO_Y_UP_XYZW = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


class Buffer:
    """The single buffer of the file, and the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: NDArray[np.floating], bounds: bool = False) -> int:
        """Append an array, shape (N, 1, 3 or 4), as float32; return the number of its accessor."""
        table = np.ascontiguousarray(values, "<f4")
        return self._append(table, _FLOAT, _ARRAY_BUFFER, bounds)

    def add_indices(self, values: NDArray[np.integer]) -> int:
        """Append indices of corners, shape (N,), as uint32; return the number of their accessor."""
        return self._append(np.ascontiguousarray(values, "<u4")[:, None], _UNSIGNED_INT, _ELEMENT_ARRAY_BUFFER, False)

    def _append(self, table: NDArray, kind: int, target: int, bounds: bool) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": table.nbytes, "target": target}
        self.views.append(view)
        self.data += table.tobytes()
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": kind}
        accessor |= {"count": len(table), "type": _TYPES[table.shape[1]]}
        if bounds:
            accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def world_node() -> dict[str, Any]:
    """Return the root of all nodes, which turns z up to glTF's y up."""
    return {"name": "world", "rotation": list(_Z_TO_Y_UP_XYZW), "children": []}


def place_of(body: BodyModel) -> dict[str, Any]:
    """Return the entries of a node that put a body where it is in the photos, and name it."""
    w, *xyz = body.photo_pose.quat_wxyz
    return {
        "translation": list(body.photo_pose.position_m),
        "rotation": [*xyz, w],
        "extras": {"cgwm_body": body.name},
    }


def write_document(
    path: Path | str,
    nodes: list[dict[str, Any]],
    meshes: list[dict[str, Any]],
    buffer: Buffer,
    extensions: list[str],
    overwrite: bool,
    materials: list[dict[str, Any]] | None = None,
) -> None:
    """Write the file.

    Args:
        path: The file, .glb.
        nodes: The nodes; the first is the root.
        meshes: The meshes.
        buffer: What their accessors refer to.
        extensions: Names of the extensions in use.
        overwrite: Replace an existing file.
        materials: Materials of the meshes.
    """
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "cgwm", "extras": {"unit": "metre", "root": "cgwm's world, z up"}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    document |= {"extensionsUsed": extensions} if extensions else {}
    document |= {"materials": materials} if materials else {}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(buffer.data)
    with new_file(path, "glTF file", overwrite) as temporary, temporary.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, size))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", len(buffer.data), b"BIN\0") + buffer.data)


def linear(srgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Convert sRGB values to linear ones, clamped to [0, 1] (IEC 61966-2-1)."""
    clamped = np.clip(srgb, 0.0, 1.0)
    return np.where(clamped <= 0.04045, clamped / 12.92, ((clamped + 0.055) / 1.055) ** 2.4)
