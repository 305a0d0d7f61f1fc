"""Patches: points spread over the flat faces of a convex body, by which a plane carries it as a plate.

The supports of a hull touch a plane at the corners of a face alone. A plate that lies on a plane presses on it with its
whole face, and how much friction resists its turning depends on where: four corners resist twice as much as the square
between them. So each flat face gets points with equal parts of its area, by the rule of three points that is exact for
polynomials of degree 2 on each triangle of its hull (Hammer and Stroud, 1956), and a contact's share of the load is
proportional to its area: the pressure is that of an even elastic layer (Winkler), linear in the place.

A real face may press more at its rim than in its middle, as a stiff plate on a soft ground does. An exponent g makes
the layer stiffer with the distance from the middle of the face, by its g-th power: 0 is the even layer, 2 raises the
second moment of the pressure of a disc by a third, and a large one leaves the farthest corners alone. What resists
turning is above all the mean distance of the load from the middle, which this one number sets.

Planes and the ground touch patches; other bodies and surfaces touch the hull.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .hull import SAME_NORMAL, SAME_PLANE_M, Hull

CORNER_SHARE = 1e-3
"""Area of a support of the hull, in units of the smallest area of a point: it counts only where no face lies flat."""
LEAST_CARRIED = 1e-3
"""Least that a point carries for its area, in units of what the farthest point from the middle does."""
LEAST_FACE = 0.02
"""Smallest area of a face that gets points, in units of the hull's whole surface: facets of curved sides have less."""
_RULE = torch.tensor([[4.0, 1, 1], [1, 4, 1], [1, 1, 4]], dtype=torch.float64) / 6


@dataclass(frozen=True)
class Patch:
    """Points of the flat faces of a body's hull; P points."""

    corners: Tensor
    """Indices of the three spheres between which each point lies, shape (P, 3)."""
    shares: Tensor
    """Barycentric coordinates, shape (P, 3)."""
    areas: Tensor
    """Area of each point, 1 for the largest face in all, shape (P,); with an exponent what it carries of that."""

    @staticmethod
    def of(hull: Hull, centers: Tensor, radii: Tensor, least: int, exponent: float = 0.0) -> Patch | None:
        """Spread at least `least` points over each flat face of a hull; None where no face is large.

        Args:
            hull: The hull.
            centers: Centres of all spheres of the body [m], shape (N, 3).
            radii: Their radii [m], shape (N,).
            least: Least number of points of a face.
            exponent: Power of the distance from the middle of its face by which a point carries more [1].
        """
        triangles = _triangles(hull, centers, radii)
        areas, faces = _areas(hull, centers, radii, triangles), _coplanar(hull)
        whole = torch.zeros_like(areas).index_add(0, faces, areas)
        parts = []
        for face in torch.nonzero(whole > LEAST_FACE * areas.sum()).flatten():
            members = torch.nonzero(faces == face).flatten()
            rule = _refined(math.ceil(math.sqrt(least / (3 * len(members))))).to(centers)
            size = (areas[members] / len(rule)).repeat_interleave(len(rule))
            corners, shares = triangles[members].repeat_interleave(len(rule), 0), rule.repeat(len(members), 1)
            places = (centers[corners] * shares[..., None]).sum(1)
            parts.append((corners, shares, _carried(places, size, exponent)))
        if not parts:
            return None
        corners, shares, sizes = (torch.cat(each) for each in zip(*parts, strict=True))
        return Patch(corners, shares, sizes / whole.max())

    def centers(self, spheres: Tensor) -> Tensor:
        """Return the centres (n, P, 3) [m] of the points, given those of the body's spheres (n, N, 3)."""
        return (spheres[:, self.corners] * self.shares[..., None]).sum(2)

    def radii(self, spheres: Tensor) -> Tensor:
        """Return the radii (n, P) [m] of the points, given those of the body's spheres (n, N)."""
        return (spheres[:, self.corners] * self.shares).sum(2)

    def weights(self, supports: int) -> Tensor:
        """Return the areas (K + P,) of a hull's K supports and of the points."""
        return torch.cat((CORNER_SHARE * self.areas.min().expand(supports), self.areas))


def _triangles(hull: Hull, centers: Tensor, radii: Tensor) -> Tensor:
    """Return the three spheres (F, 3) that each plane of the hull touches, from the barycentric coordinates there."""
    places = centers[hull.supports]
    height = (hull.faces[:, None, :3] * places).sum(-1) + radii[hull.supports] - hull.faces[:, None, 3]
    second, third = ((hull.faces[:, None, k : k + 3] * places).sum(-1) + hull.faces[:, None, k + 3] for k in (4, 8))
    wanted = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    far = [(second - a).abs() + (third - b).abs() + height.abs() / SAME_PLANE_M for a, b in wanted]
    nearest = torch.stack([each.argmin(1) for each in far], 1)
    return hull.supports[nearest]


def _areas(hull: Hull, centers: Tensor, radii: Tensor, triangles: Tensor) -> Tensor:
    """Return the areas (F,) [m2] of the triangles between the points at which the planes touch their spheres."""
    touched = centers[triangles] + radii[triangles][..., None] * hull.faces[:, None, :3]
    sides = touched[:, 1:] - touched[:, :1]
    return 0.5 * torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=-1)


def _carried(places: Tensor, areas: Tensor, exponent: float) -> Tensor:
    """Return what points (P, 3) of a face with areas (P,) carry of its area: more far from its middle."""
    if exponent == 0:
        return areas
    away = (places - (areas[:, None] * places).sum(0) / areas.sum()).norm(dim=-1)
    carried = areas * ((away / away.max()) ** exponent).clamp_min(LEAST_CARRIED)
    return carried * (areas.sum() / carried.sum())


def _coplanar(hull: Hull) -> Tensor:
    """Return for each face (F,) the first face in the same plane."""
    apart = hull.faces[:, None] - hull.faces
    same = (apart[..., :3].norm(dim=-1) < SAME_NORMAL) & (apart[..., 3].abs() < SAME_PLANE_M)
    return same.to(torch.int8).argmax(1)


def _refined(parts: int) -> Tensor:
    """Return the barycentric coordinates (3 parts^2, 3) of the rule on each of parts^2 equal triangles."""
    found = []
    for i in range(parts):
        for j in range(parts - i):
            for up in (True, False) if i + j < parts - 1 else (True,):
                base = ((i, j), (i + 1, j), (i, j + 1)) if up else ((i + 1, j + 1), (i, j + 1), (i + 1, j))
                corners = torch.tensor([[parts - a - b, a, b] for a, b in base], dtype=torch.float64) / parts
                found.append(_RULE @ corners)
    return torch.cat(found)
