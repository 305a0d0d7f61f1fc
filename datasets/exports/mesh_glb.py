"""A model as triangle meshes with colours of their corners, in binary glTF: a node for each body.

For tools that show no splats: game engines, renderers, robot simulators. Source: Khronos, glTF 2.0; colours of corners
are linear there.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..models.model import Model
from .bop_models import ObjectModel
from .glb_file import Buffer, linear, place_of, world_node, write_document

_MATTE = {"name": "matte", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}


def write_mesh_glb(
    path: Path | str, model: Model, surfaces: Mapping[str, ObjectModel], overwrite: bool = False
) -> dict[str, int]:
    """Write the surfaces of bodies at their poses in the photos; return the number of triangles of each.

    Args:
        path: The file, .glb.
        model: The model.
        surfaces: Surface of each body in its frame [m], by name.
        overwrite: Replace an existing file.
    """
    buffer, meshes = Buffer(), []
    nodes: list[dict[str, Any]] = [world_node()]
    for name, surface in surfaces.items():
        attributes = {
            "POSITION": buffer.add(surface.vertices, bounds=True),
            "NORMAL": buffer.add(surface.normals()),
            "COLOR_0": buffer.add(linear(surface.colors / 255.0)),
        }
        indices = buffer.add_indices(np.asarray(surface.faces).ravel())
        meshes.append({"name": name, "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]})
        nodes[0]["children"].append(len(nodes))
        nodes.append({"name": name, "mesh": len(meshes) - 1, **place_of(model.body(name))})
    write_document(path, nodes, meshes, buffer, [], overwrite, [_MATTE])
    return {name: len(surface.faces) for name, surface in surfaces.items()}
