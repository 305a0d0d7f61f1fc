"""Rigid bodies of a world, made of spheres."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .hull import Hull
from .kept import Kept
from .patch import Patch


@dataclass(frozen=True, kw_only=True)
class Body(Kept):
    """A rigid body made of spheres; every tensor has a batch dimension of 1 or B."""

    name: str
    """Name of the body, unique in the world."""
    motion: str
    """How the body moves: "free", "driven", "fixed", or "link" of a chain."""
    mass: Tensor
    """Mass [kg], shape (B,)."""
    inertia: Tensor
    """Inertia about the centre of mass, body axes [kg m2], shape (B, 3, 3)."""
    com: Tensor
    """Centre of mass in the body frame [m], shape (B, 3)."""
    centers: Tensor
    """Centres of the spheres in the body frame [m], shape (B, N, 3)."""
    radii: Tensor
    """Radii of the spheres [m], shape (B, N)."""
    place: Tensor | None = None
    """Position [m] and quat_wxyz of a fixed body, world frame, shape (1, 7)."""
    on_plane: Tensor | None = None
    """Indices of the spheres that the ground can touch, shape (K,); None for all."""
    material: str | None = None
    """Material, by which its pairs with others have their laws; None where it does not matter."""
    hull: Hull | None = None
    """Hull of the spheres, by which other bodies touch this one; None where they touch its spheres."""
    patch: Patch | None = None
    """Points of the hull's flat faces, by which the ground carries them as plates; None where its supports carry."""

    @property
    def plane_spheres(self) -> tuple[Tensor, Tensor]:
        """Centres (B, K, 3) and radii (B, K) [m] of what the ground can touch: spheres, then points of the patches."""
        centers, radii = self.centers, self.radii
        if self.on_plane is not None:
            centers, radii = centers[:, self.on_plane], radii[:, self.on_plane]
        if self.patch is None:
            return centers, radii
        points, sizes = self.patch.centers(self.centers), self.patch.radii(self.radii)
        return torch.cat((centers, points), 1), torch.cat((radii, sizes), 1)

    @property
    def plane_areas(self) -> Tensor | None:
        """Areas (K,) of what the ground can touch, in the order of `plane_spheres`; None where all count alike."""
        if self.patch is None:
            return None
        return self.patch.weights(self.radii.shape[-1] if self.on_plane is None else len(self.on_plane))

    @property
    def free(self) -> bool:
        """Whether the body moves by physics, on its own."""
        return self.motion == "free"
