"""A model as binary glTF with KHR_gaussian_splatting: one node for the scene and one for each body.

Source: KHR_gaussian_splatting (Khronos, kernel "ellipse"): linear scales, opacities in [0, 1], quaternions x y z w,
harmonics with 3DGS's signs. glTF's up axis is +y: all nodes have one root, which rotates the world's +z to it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..models.model import Model
from ..shapes.ply import SH_C0, Splats
from .glb_file import Buffer, linear, place_of, world_node, write_document

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0


def write_glb(path: Path | str, model: Model, overwrite: bool = False) -> dict[str, int]:
    """Write the visual spheres of a model, with bodies in their photo poses; return the number of spheres by node.

    Args:
        path: The file, .glb.
        model: A model with visual spheres.
        overwrite: Replace an existing file.
    """
    buffer, meshes = Buffer(), []
    nodes: list[dict[str, Any]] = [world_node()]
    parts: dict[str, Splats] = {"scene": model.scene} if model.scene is not None else {}
    for name, splats in [*parts.items(), *model.body_splats.items()]:
        if len(splats) == 0:
            continue
        meshes.append({"name": name, "primitives": [_primitive(buffer, splats)]})
        node: dict[str, Any] = {"name": name, "mesh": len(meshes) - 1}
        if splats is not model.scene:
            node |= place_of(model.body(name))
        nodes[0]["children"].append(len(nodes))
        nodes.append(node)
    write_document(path, nodes, meshes, buffer, [EXTENSION], overwrite)
    return {mesh["name"]: buffer.accessors[mesh["primitives"][0]["attributes"]["POSITION"]]["count"] for mesh in meshes}


def _primitive(buffer: Buffer, splats: Splats) -> dict[str, Any]:
    count = len(splats)
    colors = np.asarray(splats.colors, np.float64)
    opacities = np.asarray(splats.opacities, np.float64)[:, None]
    attributes = {
        "POSITION": buffer.add(splats.means, bounds=True),
        # for viewers without the extension: points with linear colours
        "COLOR_0": buffer.add(np.concatenate([linear(colors), opacities], 1)),
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
