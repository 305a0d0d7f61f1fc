"""Fixed surfaces of a world: exact distances and normals of spheres to half spaces, rectangles, boxes and cylinders.

A triangle mesh has its contacts from `surface_mesh.py`, several for a sphere where it has several; all other shapes are
convex, and a sphere has one contact with each. Half spaces, boxes, cylinders and closed meshes have an inside, from
which a sphere is pushed out the shortest way. A rectangle and an open mesh are sheets that are touched from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...geometry.rotation import quat_to_matrix
from .mesh_topology import Topology
from .surface_mesh import MESH_CONTACTS, SurfaceMesh

if TYPE_CHECKING:
    from ....datasets.shapes.meshes import Mesh
    from ....schemas.surfaces import Surface

KINDS = ("half_space", "box", "cylinder", "mesh")
"""Kinds by number, as the kernels know them; a rectangle is a box without thickness."""
HALF_SPACE, BOX, CYLINDER, MESH = range(4)


@dataclass(frozen=True, kw_only=True)
class FixedSurface:
    """A surface that does not move; every tensor has a batch dimension of 1 or B."""

    name: str
    """Name of the surface, unique among surfaces and bodies."""
    kind: int
    """Index in `KINDS`. A half space is z <= 0 of its frame; a cylinder has the axis z."""
    position: Tensor
    """Origin of its frame, world frame [m], shape (B, 3)."""
    quat_wxyz: Tensor
    """Orientation, surface to world, shape (B, 4)."""
    size: Tensor
    """Half the sides of a box; twice the radius, then half the length of a cylinder [m]; shape (B, 3)."""
    material: str | None = None
    """Material, by which its pairs with bodies have their laws; None where it does not matter."""
    mesh: SurfaceMesh | None = None
    """The triangles of a mesh, in the frame of the surface."""

    @property
    def contacts_per_sphere(self) -> int:
        """Maximum number of contacts of a sphere."""
        return MESH_CONTACTS if self.kind == MESH else 1

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """The tensors of the surface."""
        return self.position, self.quat_wxyz, self.size

    def local(self, points: Tensor) -> Tensor:
        """Return points (n, C, 3) of the world in the frame of the surface."""
        return (points - self.position[:, None]) @ quat_to_matrix(self.quat_wxyz)

    def to_world(self, directions: Tensor) -> Tensor:
        """Return directions (n, C, 3) of the surface's frame in the world."""
        return directions @ quat_to_matrix(self.quat_wxyz).transpose(-1, -2)

    def bound(self, points: Tensor) -> Tensor:
        """Return a lower bound (n, C) [m] of the distance of points (n, C, 3); exact but for meshes."""
        local = self.local(points)
        if self.mesh is None:
            return self.distances(local)[0]
        low, high = self.extent
        return torch.maximum(low - local, local - high).clamp_min(0.0).square().sum(-1).sqrt()

    @property
    def extent(self) -> tuple[Tensor, Tensor]:
        """Least and largest coordinates (3,) of the surface in its frame [m]."""
        if self.mesh is not None:
            low, high = (torch.as_tensor(x).to(self.size) for x in self.mesh.bounds)
            return low, high
        if self.kind == HALF_SPACE:
            far = torch.full_like(self.size[0], torch.inf)
            return -far, torch.cat((far[:2], torch.zeros_like(far[2:])))
        return -self.size[0], self.size[0]

    def apart(self, other: FixedSurface, distance_m: float) -> bool:
        """Return whether the boxes of two surfaces are seen to be farther apart than a distance, along their axes."""
        return self._beyond(other, distance_m) or other._beyond(self, distance_m)

    def _beyond(self, other: FixedSurface, distance_m: float) -> bool:
        ends = torch.stack(other.extent)
        if not bool(ends.isfinite().all()):
            return False
        corners = torch.cartesian_prod(*ends.unbind(1))
        world = other.to_world(corners[None])[0] + other.position[0]
        local, (low, high) = self.local(world[None])[0], self.extent
        return bool((local.amin(0) > high + distance_m).any() or (local.amax(0) < low - distance_m).any())

    def distances(self, local: Tensor) -> tuple[Tensor, Tensor]:
        """Return signed distances (n, C) [m] and outward normals (n, C, 3) of points in the frame of the surface."""
        if self.kind == HALF_SPACE:
            up = torch.zeros_like(local)
            up[..., 2] = 1.0
            return local[..., 2], up
        if self.kind == BOX:
            side = torch.where(local.detach() < 0, -1.0, 1.0).to(local)
            distance, outward = _corner_distance(side * local - self.size[:, None])
            return distance, side * outward
        radius2 = local[..., :2].square().sum(-1)
        off = radius2 > 0
        radius = torch.where(off, radius2, torch.ones_like(radius2)).sqrt() * off
        ahead = torch.where(local[..., 2].detach() < 0, -1.0, 1.0).to(local)
        past = torch.stack((radius, ahead * local[..., 2]), -1) - self.size[:, None, 1:]
        distance, outward = _corner_distance(past)
        axis = torch.zeros_like(local[..., :2])
        axis[..., 0] = 1.0
        around = torch.where(off[..., None], local[..., :2] / torch.where(off, radius, 1.0)[..., None], axis)
        return distance, torch.cat((outward[..., :1] * around, (ahead * outward[..., 1])[..., None]), -1)


def _corner_distance(past: Tensor) -> tuple[Tensor, Tensor]:
    """Return distance (...) and normal (..., d) of points to the corner past <= 0 of d half spaces."""
    outside = past.clamp_min(0.0)
    size2 = outside.square().sum(-1)
    apart = size2 > 0
    size = torch.where(apart, size2, torch.ones_like(size2)).sqrt()
    depth, nearest = past.max(-1)
    into = torch.nn.functional.one_hot(nearest, past.shape[-1]).to(past)
    return torch.where(apart, size, depth), torch.where(apart[..., None], outside / size[..., None], into)


def shape_of(entry: Surface) -> tuple[int, tuple[float, float, float]]:
    """Return kind and size [m] of a surface of a model, as `FixedSurface` has them."""
    if entry.rectangle is not None:
        return BOX, (*entry.rectangle.half_extents_m, 0.0)
    if entry.box is not None:
        return BOX, entry.box.half_extents_m
    if entry.cylinder is not None:
        return CYLINDER, (entry.cylinder.radius_m, entry.cylinder.radius_m, entry.cylinder.half_length_m)
    return (HALF_SPACE if entry.half_space is not None else MESH), (0.0, 0.0, 0.0)


def surface_mesh(mesh: Mesh, entry: Surface) -> SurfaceMesh:
    """Return the triangles of a surface of a model with their neighbours; those of one mesh are found once."""
    return _surface_mesh(mesh, entry.mesh is not None and entry.mesh.inside != "none", entry.name)


@lru_cache(16)
def _surface_mesh(mesh: Mesh, solid: bool, name: str) -> SurfaceMesh:
    return SurfaceMesh(Topology.of(mesh.vertices, mesh.faces, solid=solid, name=name))
