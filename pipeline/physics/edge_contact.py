"""Contacts of the edges of two convex bodies, where no sphere of one lies within the other: two crossed edges.

The points of spheres see a corner that enters a face, not an edge that crosses an edge. Source of the test (derived;
the axes are those of the separating axis theorem for polyhedra): the common normal n of two edges supports both bodies
where it leads out of both faces of the one edge and against it out of both faces of the other one; then the gap of the
bodies along n is that of the edges. Of all normals of faces and of such edges, the one with the largest gap parts the
bodies best. Edges touch where the feet of their common normal lie within them and that normal is nearly the best one:
for convex bodies this bounds the depth of each such point by that along the best normal, over the cosine between the
two, so that no point appears deep inside. Two planks that lie across each other so touch at four points.

Each edge of body a has two slots: where it comes over body b and where it leaves it, so that contacts keep their slot.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry.rotation import cross
from .hull import PARALLEL, Hull

LEAST_CROSSING = 1e-4
"""Least squared sine between two edges that touch in a point; the corners of parallel ones carry them."""
OUT_OF_FACE = 0.1
"""By how much the normal of a contact may lean towards one of the faces of an edge [1]: for faces on each other, which
inner spheres tilt by some hundredths."""

FACE_SLACK_M = 2e-4
"""By how much worse than edges the faces may part two bodies that still lie flat on each other [m]: a tilt."""


@dataclass(frozen=True)
class Edges:
    """Edges of a hull in one frame; R edges, n items of the batch."""

    start: Tensor
    """First ends [m], shape (n, R, 3)."""
    along: Tensor
    """Vectors to the second ends [m], shape (n, R, 3)."""
    inward: Tensor
    """Unit vectors in the two faces, away from the edge, shape (n, R, 2, 3)."""
    radius: Tensor
    """Radii at the first end [m], shape (1 or n, R)."""
    widening: Tensor
    """Radii at the second end less those at the first [m], shape (1 or n, R)."""

    @staticmethod
    def of(hull: Hull, centers: Tensor, radii: Tensor, rotation: Tensor) -> Edges:
        """Return the edges of a hull, given the centres (n, N, 3) and radii (1 or n, N) of its body's spheres [m].

        Args:
            hull: The hull.
            centers: Centres in the frame of the edges.
            radii: Radii.
            rotation: Rotation of the body frame into that of the edges, shape (n, 3, 3).
        """
        first, second = hull.ridges.unbind(1)
        inward = (hull.inward.flatten(0, 1) @ rotation.transpose(-1, -2)).unflatten(1, (-1, 2))
        return Edges(
            start=centers[:, first],
            along=centers[:, second] - centers[:, first],
            inward=inward,
            radius=radii[:, first],
            widening=radii[:, second] - radii[:, first],
        )

    def chosen(self, index: Tensor) -> Edges:
        """Return the edges of each item with indices (n, S)."""
        vector = index[..., None].expand(-1, -1, 3)
        radius, widening = (x.expand(len(index), -1).gather(1, index) for x in (self.radius, self.widening))
        pair = index[..., None, None].expand(-1, -1, 2, 3)
        start, along = self.start.gather(1, vector), self.along.gather(1, vector)
        return Edges(start, along, self.inward.gather(1, pair), radius, widening)

    def across(self, dim: int) -> Edges:
        """Return the edges with another dimension, in which they are compared with those of another hull."""
        return Edges(*(x.unsqueeze(dim) for x in (self.start, self.along, self.inward, self.radius, self.widening)))


@dataclass(frozen=True)
class Crossings:
    """Common normals of edges of two bodies; shapes (..., 3) and (...)."""

    normal: Tensor
    """Unit normal out of the first body."""
    gap: Tensor
    """Gap along the normal [m]."""
    place: Tensor
    """Foot on the edge of the first body, 0 at its first end, 1 at its second."""
    other_place: Tensor
    """Foot on the other edge."""
    parallel: Tensor
    """Whether the edges are nearly parallel."""
    leaves: Tensor
    """Whether the first edge, from its first to its second end, leaves the other body."""
    lean: Tensor
    """By how much the normal leans towards a face of either edge, below 0 where it supports both bodies [1]."""

    @staticmethod
    def of(first: Edges, second: Edges) -> Crossings:
        """Return the common normals of edges whose shapes broadcast."""
        over = cross(*torch.broadcast_tensors(first.along, second.along))
        size2 = over.square().sum(-1)
        lengths = first.along.square().sum(-1) * second.along.square().sum(-1)
        unit = over / size2.clamp_min(1e-30).sqrt()[..., None]
        out = (first.inward.sum(-2) * unit).sum(-1)
        normal = torch.where((out > 0)[..., None], -unit, unit)
        apart = second.start - first.start
        safe = size2.clamp_min(1e-30)
        place, other = (
            (cross(*torch.broadcast_tensors(apart, x.along)) * over).sum(-1) / safe for x in (second, first)
        )
        width = first.radius + place * first.widening + second.radius + other * second.widening
        lean = (normal[..., None, :] * first.inward).sum(-1).amax(-1)
        other_lean = (-normal[..., None, :] * second.inward).sum(-1).amax(-1)
        return Crossings(
            normal=normal,
            gap=(normal * apart).sum(-1) - width,
            place=place,
            other_place=other,
            parallel=size2 <= LEAST_CROSSING * lengths,
            leaves=(second.inward.sum(-2) * first.along).sum(-1) < 0,
            lean=torch.maximum(lean, other_lean),
        )

    @property
    def within(self) -> Tensor:
        """Whether both feet lie within their edges."""
        ends = [(x >= 0) & (x <= 1) for x in (self.place, self.other_place)]
        return ends[0] & ends[1] & ~self.parallel


@torch.no_grad()
def best_normal(found: Crossings, height: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest gap (n,) of two hulls along a normal of a face or of two edges, and that normal (n, 3).

    Args:
        found: Common normals of all edges (n, A, B).
        height: Largest gap along the normals of faces [m].
        axis: That normal.
    """
    gap = torch.where(~found.parallel & (found.lean <= 0), found.gap, torch.full_like(found.gap, -torch.inf))
    most, place = gap.flatten(1).max(1)
    normal = found.normal.flatten(1, 2).gather(1, place[:, None, None].expand(-1, 1, 3))[:, 0]
    edge = most > height
    return torch.where(edge, most, height), torch.where(edge[:, None], normal, axis)


@torch.no_grad()
def slots_of(found: Crossings, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Return the edge of the second body (n, 2 A) in each slot, and the gap there [m], infinite where none crosses.

    Args:
        found: Common normals of all edges (n, A, B).
        axis: The normal that parts the bodies best, shape (n, 3).
    """
    touches = found.within & (found.lean <= OUT_OF_FACE) & ((found.normal * axis[:, None, None]).sum(-1) > PARALLEL)
    gaps = [torch.where(touches & (found.leaves == leaves), found.gap, torch.inf) for leaves in (False, True)]
    gap, other = torch.stack(gaps, 2).min(-1)
    return other.flatten(1), gap.flatten(1)
