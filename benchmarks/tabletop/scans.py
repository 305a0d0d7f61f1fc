"""Scanned objects in the cache: one file each, from which captures are made without the scans and without coacd."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.schemas import InputDataError
from numpy.typing import NDArray

from .distance import Distance, sample_surface

Array = NDArray[np.float64]

CACHE_VARIABLE = "CGWM_TABLETOP_CACHE"
_CACHE = Path(__file__).resolve().parents[2] / "out" / "tabletop"


@dataclass(frozen=True)
class Scan:
    """A scanned object.

    Args:
        solid: Its convex parts, and as its surface their union. The body frame's origin is the middle of its box.
        down: Body direction that points down at rest, shape (3,).
        scanned: The scan's surface, body frame.
        uv: Texture coordinates of its triangles' corners, v up, shape (face, 3, 2).
        jpeg: The texture, an encoded JPEG, uint8 (byte,).
        scan_to_solid: How far the scan's points lie from the solid's surface.
        solid_to_scan: How far the points of the solid's surface lie from the scan.
    """

    solid: SolidObject
    down: Array
    scanned: Mesh
    uv: Array
    jpeg: NDArray[np.uint8]
    scan_to_solid: Distance
    solid_to_scan: Distance

    def colours(self, count: int) -> tuple[Array, NDArray[np.float32]]:
        """Return points on the scan (count, 3) [m] and their colours in [0, 1] (count, 3).

        Raises:
            InputDataError: If the texture is broken.
        """
        image = cv2.imdecode(self.jpeg, cv2.IMREAD_COLOR_RGB)
        if image is None:
            raise InputDataError(f"the texture of {self.solid.family} is no image.", "a cache that `prepare` wrote.")
        points, face, weights = sample_surface(self.scanned, count, np.random.default_rng(0))
        uv = np.einsum("nk,nkx->nx", weights, self.uv[face])
        rows, columns = image.shape[:2]
        column = (uv[:, 0] * columns).astype(np.int64).clip(0, columns - 1)
        row = ((1 - uv[:, 1]) * rows).astype(np.int64).clip(0, rows - 1)
        return points, image[row, column].astype(np.float32) / np.float32(255)


def cache_folder() -> Path:
    """Return the folder of the cache: $CGWM_TABLETOP_CACHE, by default out/tabletop/ of the checkout."""
    return Path(os.environ.get(CACHE_VARIABLE, _CACHE))


def cache_path(name: str) -> Path:
    """Return the file of an object in the cache."""
    return cache_folder() / f"{name}.npz"


def write_scan(path: Path, scan: Scan) -> None:
    """Write a scanned object as one file, compact."""
    solid, distances = scan.solid, (scan.scan_to_solid, scan.solid_to_scan)
    np.savez_compressed(
        path, family=solid.family, vertices=solid.vertices.astype(np.float32), faces=solid.faces.astype(np.uint32),
        parts=np.concatenate(solid.parts).astype(np.float32), part_ends=np.cumsum([len(one) for one in solid.parts]),
        mass_kg=solid.mass, com_m=solid.com, inertia_kg_m2=solid.inertia, down=scan.down,
        scan_vertices=scan.scanned.vertices.astype(np.float32), scan_faces=scan.scanned.faces.astype(np.uint32),
        scan_uv=np.round(scan.uv.clip(0, 1) * 65535).astype(np.uint16), texture_jpeg=scan.jpeg,
        distances_m=[[one.mean_m, one.p99_m, one.max_m] for one in distances],
    )  # fmt: skip


def read_scan(name: str) -> Scan:
    """Read a scanned object from the cache.

    Raises:
        InputDataError: If it is not there.
    """
    path = cache_path(name)
    if not path.exists():
        raise InputDataError(
            f"{path}: missing.", f"one file an object, in the folder that {CACHE_VARIABLE} names.",
            "python -m tabletop.prepare, in benchmarks/.",
        )  # fmt: skip
    with np.load(path) as file:
        parts = np.split(file["parts"].astype(np.float64), file["part_ends"][:-1])
        solid = SolidObject(
            family=str(file["family"]),
            vertices=file["vertices"].astype(np.float64),
            faces=file["faces"].astype(np.int64),
            parts=tuple(parts),
            mass=float(file["mass_kg"]),
            com=file["com_m"],
            inertia=file["inertia_kg_m2"],
        )
        scanned = Mesh(file["scan_vertices"].astype(np.float64), file["scan_faces"].astype(np.int64))
        out, back = (Distance(*map(float, row)) for row in file["distances_m"])
        uv = file["scan_uv"].astype(np.float64) / 65535
        return Scan(solid, file["down"], scanned, uv, file["texture_jpeg"], out, back)
