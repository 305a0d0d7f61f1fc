"""Layout of the meshes of fixed surfaces as the input arrays of a fused kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ..surfaces.fixed_surface import FixedSurface
from ..surfaces.surface_mesh import SurfaceMesh, rounded_reach

STEP_M = 0.004
"""How far a sphere moves in most steps [m]."""
_KEPT = 8
"""Number of sets of meshes whose arrays are kept: rollouts of one world follow each other."""


@dataclass(frozen=True, eq=False)
class PackedMeshes:
    """The meshes of a world, one after another."""

    numbers: Tensor
    """As `SurfaceMesh.numbers`, float64, shape (N,)."""
    indices: Tensor
    """As `SurfaceMesh.indices`, int32, shape (I,)."""
    starts: tuple[tuple[int, int], ...]
    """First number and first index of each surface's mesh."""


def packed_meshes(surfaces: Sequence[FixedSurface], radius_m: float) -> PackedMeshes:
    """Return the meshes of surfaces, for spheres of a radius [m] at most; those that are no meshes take no room."""
    return _packed(tuple(surface.mesh for surface in surfaces), radius_m)


def _reach(radius_m: float) -> float:
    """Return how far triangles are told from the centres of spheres [m]: one reach for radii that differ little."""
    return rounded_reach(max(radius_m + max(0.5 * radius_m, STEP_M), STEP_M))


@lru_cache(_KEPT)
def _packed(meshes: tuple[SurfaceMesh | None, ...], radius_m: float) -> PackedMeshes:
    numbers, indices, starts = [np.zeros(0)], [np.zeros(0, np.int64)], []
    for mesh in meshes:
        starts.append((sum(map(len, numbers)), sum(map(len, indices))))
        if mesh is not None:
            near = mesh.neighbourhood(_reach(max(radius_m, mesh.cell_m) if mesh.solid else radius_m))
            numbers.append(mesh.numbers(near))
            indices.append(mesh.indices(near))
    flat = torch.from_numpy(np.concatenate(indices).astype(np.int32))
    return PackedMeshes(torch.from_numpy(np.concatenate(numbers)), flat, tuple(starts))
