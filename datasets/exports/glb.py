"""A model as binary glTF with KHR_gaussian_splatting: one node for the scene and one for each body.

Source: KHR_gaussian_splatting (Khronos, kernel "ellipse"): linear scales, opacities in [0, 1], quaternions x y z w,
harmonics with 3DGS's signs. glTF's up axis is +y: all nodes have one root, which rotates the world's +z to it.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..io.atomic import new_file
from ..models.model import Model
from ..shapes.ply import SH_C0, Splats

EXTENSION = "KHR_gaussian_splatting"
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
_Z_TO_Y_UP_XYZW = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


class _Buffer:
    """The single buffer of the file, and the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: NDArray[np.floating], bounds: bool = False) -> int:
        """Append an array, shape (N, 1, 3 or 4), as float32; return the number of its accessor."""
        table = np.ascontiguousarray(values, "<f4")
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": table.nbytes, "target": _ARRAY_BUFFER}
        self.views.append(view)
        self.data += table.tobytes()
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": _FLOAT}
        accessor |= {"count": len(table), "type": _TYPES[table.shape[1]]}
        if bounds:
            accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(path: Path | str, model: Model, overwrite: bool = False) -> dict[str, int]:
    """Write the visual spheres of a model, with bodies in their photo poses; return the number of spheres by node.

    Args:
        path: The file, .glb.
        model: A model with visual spheres.
        overwrite: Replace an existing file.
    """
    buffer, meshes = _Buffer(), []
    nodes: list[dict[str, Any]] = [{"name": "world", "rotation": list(_Z_TO_Y_UP_XYZW), "children": []}]
    parts: dict[str, Splats] = {"scene": model.scene} if model.scene is not None else {}
    for name, splats in [*parts.items(), *model.body_splats.items()]:
        if len(splats) == 0:
            continue
        meshes.append({"name": name, "primitives": [_primitive(buffer, splats)]})
        node: dict[str, Any] = {"name": name, "mesh": len(meshes) - 1}
        if splats is not model.scene:
            pose = model.body(name).photo_pose
            w, *xyz = pose.quat_wxyz
            node |= {"translation": list(pose.position_m), "rotation": [*xyz, w], "extras": {"cgwm_body": name}}
        nodes[0]["children"].append(len(nodes))
        nodes.append(node)
    document = {
        "asset": {"version": "2.0", "generator": "cgwm", "extras": {"unit": "metre", "root": "cgwm's world, z up"}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(buffer.data)
    with new_file(path, "glTF file", overwrite) as temporary, temporary.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, size))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", len(buffer.data), b"BIN\0") + buffer.data)
    return {mesh["name"]: buffer.accessors[mesh["primitives"][0]["attributes"]["POSITION"]]["count"] for mesh in meshes}


def _primitive(buffer: _Buffer, splats: Splats) -> dict[str, Any]:
    count = len(splats)
    colors = np.asarray(splats.colors, np.float64)
    opacities = np.asarray(splats.opacities, np.float64)[:, None]
    attributes = {
        "POSITION": buffer.add(splats.means, bounds=True),
        # for viewers without the extension: points with linear colours
        "COLOR_0": buffer.add(np.concatenate([_linear(colors), opacities], 1)),
        f"{EXTENSION}:ROTATION": buffer.add(np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
        f"{EXTENSION}:SCALE": buffer.add(np.repeat(np.asarray(splats.scales, np.float64)[:, None], 3, axis=1)),
        f"{EXTENSION}:OPACITY": buffer.add(opacities),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": buffer.add((colors - 0.5) / SH_C0),
    }
    if splats.harmonics is not None:
        terms = iter(np.moveaxis(splats.harmonics, 1, 0))
        for degree in range(1, round(math.sqrt(splats.harmonics.shape[1] + 1))):
            for order in range(2 * degree + 1):
                attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = buffer.add(next(terms))
    appearance = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    return {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: appearance}}


def _linear(srgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Convert sRGB values to linear ones, clamped to [0, 1] (IEC 61966-2-1)."""
    clamped = np.clip(srgb, 0.0, 1.0)
    return np.where(clamped <= 0.04045, clamped / 12.92, ((clamped + 0.055) / 1.055) ** 2.4)
