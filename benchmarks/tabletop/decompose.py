"""Makes a scanned object ready for the benchmark: convex parts, their union as the visible surface, mass, rest.

What is seen is the union of the convex parts with the scan's colours, so that truth's collision shape is the visible
mesh, exactly. How far both lie from the scan is measured and kept. Needs the extra `benchmarks` (coacd, manifold3d).
"""

from __future__ import annotations

import importlib
import json
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cgwm.datasets.shapes.meshes import Mesh, mass_properties, read_mesh
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.schemas import InputDataError
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from store import shared_data

from .distance import surface_distance
from .scans import CACHE_VARIABLE, Scan

Array = NDArray[np.float64]

ARCHIVE = "ycb.tar.xz"
"""The scans, in the folder of measured data."""
_CONCAVITY_M = 0.003
"""What CoACD may leave of a concavity; the smaller, the more parts."""
_SIMPLER_M = 0.0002
"""How far corners of a part may stand out of its hull when they are left out."""
_OVERLAP_M = 0.0001
"""Parts are cut along planes; they grow by so much, so that they overlap and their union is one solid."""
_TEXTURE_PIXELS, _JPEG_QUALITY = 1024, 90


def prepare_scan(name: str, raw: Path) -> Scan:
    """Decompose one object of the archive, which is unpacked into `raw` if it is not there yet.

    Raises:
        InputDataError: If the archive, coacd or manifold3d is missing.
    """
    folder = raw / "ycb" / "ycb" / name
    if not folder.exists():
        with tarfile.open(_archive()) as archive:
            archive.extractall(raw, filter="data")
    mass = float(json.loads((raw / "ycb" / "ycb_mass.json").read_text(encoding="utf-8"))[name])
    scanned, uv = _read_textured(folder / "textured.obj")
    parts = [_grown(_simpler(part)) for part in _convex_parts(read_mesh(folder / "textured.obj"), _CONCAVITY_M)]
    corners = np.concatenate(parts)
    middle = (corners.max(axis=0) + corners.min(axis=0)) / 2
    # The cache holds single precision; all that follows is of what it holds.
    parts = [(part - middle).astype(np.float32).astype(np.float64) for part in parts]
    scanned = Mesh((scanned.vertices - middle).astype(np.float32).astype(np.float64), scanned.faces)
    visible = _union(parts)
    properties = mass_properties(visible, f"union of {name}")
    solid = SolidObject(
        family=name,
        vertices=visible.vertices,
        faces=visible.faces,
        parts=tuple(parts),
        mass=mass,
        com=properties.com_m,
        inertia=mass * properties.inertia_per_kg,
    )
    texture = cv2.imread(str(folder / "texture_map.png"))
    assert texture is not None
    if len(texture) > _TEXTURE_PIXELS:
        texture = cv2.resize(texture, (_TEXTURE_PIXELS, _TEXTURE_PIXELS), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", texture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    out, back = surface_distance(scanned, visible), surface_distance(visible, scanned)
    return Scan(solid, _rest(solid), scanned, uv, np.asarray(jpeg, np.uint8).ravel(), out, back)


def _archive() -> Path:
    data = shared_data()
    if data is None or not (data / ARCHIVE).is_file():
        raise InputDataError(
            "there is no folder of measured data." if data is None else f"{data / ARCHIVE}: missing.",
            f"the YCB scans as {ARCHIVE}, or a cache that was made from them.",
            f"set CGWM_SHARED_DATA to the folder that holds {ARCHIVE}, or {CACHE_VARIABLE} to that of the cache.",
        )
    return data / ARCHIVE


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputDataError(
            f"the package {name} is not installed.", "the extra 'benchmarks'.", "pip install 'cgwm[benchmarks]'."
        ) from None


def _convex_parts(mesh: Mesh, concavity_m: float) -> list[Array]:
    """Cut a closed mesh into convex parts with CoACD (Wei et al., SIGGRAPH 2022): the corners of each."""
    coacd = _module("coacd")
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=concavity_m, real_metric=True, preprocess_mode="off",
        mcts_iterations=60, mcts_nodes=20, mcts_max_depth=2, seed=1,
    )  # fmt: skip
    return [np.asarray(corners, np.float64) for corners, _ in found]


def _simpler(part: Array) -> Array:
    """Return those corners of a convex part whose hull all others stand out of by less than _SIMPLER_M."""
    part = part[ConvexHull(part).vertices]
    directions = np.random.default_rng(0).standard_normal((40, 3))
    chosen = np.unique((part @ directions.T).argmax(axis=0))
    while True:
        hull = ConvexHull(part[chosen])
        above = part @ hull.equations[:, :3].T + hull.equations[:, 3]
        more = above.argmax(axis=0)[above.max(axis=0) > _SIMPLER_M]
        if not len(more):
            return part[chosen]
        chosen = np.union1d(chosen, more)


def _grown(part: Array) -> Array:
    arms = part - part.mean(axis=0)
    return part + _OVERLAP_M * arms / np.linalg.norm(arms, axis=1, keepdims=True)


def _union(parts: list[Array]) -> Mesh:
    """Return the closed surface of the union of convex parts, without the pockets of air inside."""
    manifold = _module("manifold3d")
    whole = manifold.Manifold.batch_boolean(
        [manifold.Manifold.hull_points(part) for part in parts], manifold.OpType.Add
    )
    outer = max(whole.decompose(), key=lambda one: one.volume()).to_mesh()
    vertices = np.asarray(outer.vert_properties[:, :3], np.float64)
    return Mesh(vertices, np.asarray(outer.tri_verts, np.int64))


def _rest(solid: SolidObject) -> Array:
    """Return the body direction that points down in the most stable rest, shape (3,).

    It is the normal of that facet of the convex hull which is nearest to the centre of mass: where the height of the
    centre of mass over the ground is least of all orientations.
    """
    hull = ConvexHull(solid.vertices - solid.com)
    return np.asarray(hull.equations[hull.equations[:, 3].argmax(), :3], np.float64)


def _read_textured(path: Path) -> tuple[Mesh, Array]:
    """Return a mesh of triangles as it is written, and the texture coordinates of their corners, (face, 3, 2)."""
    vertices, texture, corners = [], [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "vt":
            texture.append([float(word) for word in words[:2]])
        elif kind == "f":
            corners.append([[int(number) - 1 for number in word.split("/")[:2]] for word in words])
    index = np.asarray(corners, np.int64)
    return Mesh(np.asarray(vertices, np.float64), index[:, :, 0]), np.asarray(texture, np.float64)[index[:, :, 1]]
