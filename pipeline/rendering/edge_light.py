"""Light on spheres at the edges of a body.

A sphere at an edge is seen from both sides of it, but belongs to one, whose normal it has. Seen from where that side is
hidden, it shows the other side's surface, and is as bright as that.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .relighting import Relighting

_NEIGHBOURS = 16
_REACH = 3.0
"""Distance of a neighbour on the other side of an edge, in scales of the sphere."""
_SHARP = 0.6
"""Greatest cosine between the normals of the two sides of an edge."""
_HIDDEN = 0.05
"""Cosine between a normal and the direction to the camera below which a side is hidden."""


@dataclass(frozen=True)
class Edges:
    """Spheres of a body that are close to a sphere of another side."""

    rows: Tensor
    """Their indices, shape (E,)."""
    normals: Tensor
    """Their unit normals, body frame, shape (E, 3)."""
    others: Tensor
    """Unit normals of the nearest sphere of another side, shape (E, 3)."""

    @staticmethod
    def of(means: Tensor, scales: Tensor, normals: Tensor) -> Edges:
        """Find them among spheres with centres (N, 3) [m], scales (N,) [m] and unit normals (N, 3), body frame."""
        from scipy.spatial import KDTree  # dear to import, and needed with a light alone

        centers = means.cpu().numpy().astype(float)
        count = min(_NEIGHBOURS + 1, len(centers))
        found = KDTree(centers).query(centers, k=count)
        away, index = (torch.as_tensor(values).reshape(-1, count) for values in found)
        cosine = torch.einsum("nkc,nc->nk", normals.cpu()[index], normals.cpu())
        across = (cosine < _SHARP) & (away <= _REACH * scales.cpu()[:, None])
        rows = across.any(1).nonzero()[:, 0]
        nearest = index[rows, across[rows].int().argmax(1)]  # neighbours come nearest first
        rows, nearest = rows.to(means.device), nearest.to(means.device)
        return Edges(rows, normals[rows], normals[nearest])

    def placed(self, relighting: Relighting, rotations: Tensor) -> EdgeLight:
        """Return the light of a body's relighting on them at orientations (n, 3, 3)."""
        normals, others = (values @ rotations.mT for values in (self.normals, self.others))
        factors = relighting.brightness(others) / relighting.brightness(normals)
        return EdgeLight(self.rows, normals, factors[..., None])


@dataclass(frozen=True)
class EdgeLight:
    """Light on the edges of a body in n views, or in one, without the first axis."""

    rows: Tensor
    """Indices of the spheres, shape (E,)."""
    normals: Tensor
    """Their unit normals, world frame, shape (n, E, 3)."""
    factors: Tensor
    """Brightness of the other side over that of their own, shape (n, E, 1)."""

    def view(self, number: int) -> EdgeLight:
        """Return the light in one view."""
        return EdgeLight(self.rows, self.normals[number], self.factors[number])

    def seen(self, colors: Tensor, means: Tensor, eye: Tensor) -> Tensor:
        """Return colours (..., N, 3) as a camera at `eye` (3,) [m] sees them, given the centres (..., N, 3)."""
        ways = torch.nn.functional.normalize(eye - means[..., self.rows, :], dim=-1)
        hidden = (ways * self.normals).sum(-1, keepdim=True) < _HIDDEN
        found = colors.clone()
        found[..., self.rows, :] = torch.where(hidden, self.factors, 1.0) * found[..., self.rows, :]
        return found.clamp(0, 1)
