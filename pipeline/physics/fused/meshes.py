"""Layout of the meshes of fixed surfaces as the input arrays of a fused kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ..surfaces.fixed_surface import FixedSurface
from ..surfaces.surface_mesh import SurfaceMesh

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


def packed_meshes(surfaces: Sequence[FixedSurface]) -> PackedMeshes:
    """Return the meshes of surfaces; those that are no meshes take no room."""
    return _packed(tuple(surface.mesh for surface in surfaces))


@lru_cache(_KEPT)
def _packed(meshes: tuple[SurfaceMesh | None, ...]) -> PackedMeshes:
    numbers, indices, starts = [np.zeros(0)], [np.zeros(0, np.int64)], []
    for mesh in meshes:
        starts.append((sum(map(len, numbers)), sum(map(len, indices))))
        if mesh is not None:
            numbers.append(mesh.numbers())
            indices.append(mesh.indices())
    flat = torch.from_numpy(np.concatenate(indices).astype(np.int32))
    return PackedMeshes(torch.from_numpy(np.concatenate(numbers)), flat, tuple(starts))
