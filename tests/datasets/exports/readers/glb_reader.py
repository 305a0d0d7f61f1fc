"""Read a .glb with pygltflib and with trimesh and print what they hold, as JSON. Run in an environment with both."""

# pyright: reportMissingImports=false

import json
import sys
from importlib.metadata import version

import numpy as np
import pygltflib
import trimesh

path = sys.argv[1]
document = pygltflib.GLTF2().load(path)
blob = document.binary_blob()
attributes = {}
for mesh in document.meshes:
    primitive = mesh.primitives[0]
    found = {}
    for name, index in vars(primitive.attributes).items():
        if index is None:
            continue
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        values = np.frombuffer(blob, "<f4", accessor.count * width, view.byteOffset + (accessor.byteOffset or 0))
        found[name] = [accessor.count, width, float(values.astype(float).sum())]
    attributes[mesh.name] = {"mode": primitive.mode, "extension": primitive.extensions, "attributes": found}
scene = trimesh.load(path)
clouds = {}
for name in scene.graph.nodes_geometry:
    pose, geometry = scene.graph[name]
    points = trimesh.transform_points(scene.geometry[geometry].vertices, pose)
    clouds[name] = {"points": len(points), "mean": points.mean(0).tolist()}
about = {
    "versions": {name: version(name) for name in ("pygltflib", "trimesh", "numpy")},
    "meshes": attributes,
    "nodes": [node.name for node in document.nodes],
    "clouds": clouds,
}
print(json.dumps(about))
