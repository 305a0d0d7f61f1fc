"""Object models for BOP: triangle meshes with normals and colours, in millimetres, and `models_info.json`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A coloured triangle mesh."""

    vertices: Array
    """Corners [m], body frame, shape (V, 3)."""
    faces: NDArray[np.int64]
    """Indices of the corners, anticlockwise seen from outside, shape (F, 3)."""
    colors: NDArray[np.uint8]
    """uint8 RGB of the corners, shape (V, 3)."""
    origin: str
    """Description of the origin of the mesh."""

    def normals(self) -> Array:
        """Return the unit normals of the corners, the area-weighted mean of the adjacent faces; shape (V, 3)."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        by_face = np.cross(b - a, c - a)
        total = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(total, self.faces[:, k], by_face)
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def write_models(folder: Path, models: list[ObjectModel]) -> None:
    """Write `obj_000001.ply` etc. (ASCII, as BOP requires), and `models_info.json`, both in millimetres."""
    folder.mkdir()
    facts = {}
    for number, model in enumerate(models, 1):
        (folder / f"obj_{number:06d}.ply").write_text(_ply(model), encoding="ascii")
        facts[number] = _extent(1e3 * model.vertices)
    (folder / "models_info.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def _ply(model: ObjectModel) -> str:
    header = ["ply", "format ascii 1.0", "comment unit millimetre", f"element vertex {len(model.vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {len(model.faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = zip(1e3 * model.vertices, model.normals(), model.colors, strict=True)
    vertices = ["{:.4f} {:.4f} {:.4f} {:.5f} {:.5f} {:.5f} {} {} {}".format(*p, *n, *c) for p, n, c in rows]
    return "\n".join([*header, *vertices, *(f"3 {a} {b} {c}" for a, b, c in model.faces)]) + "\n"


def _extent(points_mm: Array) -> dict[str, float]:
    low, size = points_mm.min(0), np.ptp(points_mm, axis=0)
    try:
        outer = points_mm[ConvexHull(points_mm).vertices]
    except QhullError:  # flat
        outer = points_mm
    sides = {f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")}
    sides |= {f"size_{axis}": float(size[k]) for k, axis in enumerate("xyz")}
    return {"diameter": float(pdist(outer).max()), **sides}
