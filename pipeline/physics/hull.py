"""Convex hull of a body's spheres: the flat faces that its spheres stand for, and the distance to them.

Source of the distance (derived): the hull of spheres is bounded by planes that touch three spheres, cones that touch
two, and spheres. The nearest point lies on one of these; the foot of a point on a touching plane is an affine
function of the point, and the distance to a cone or sphere is that to a segment with a radius linear along it. Outside
of the hull the distance is continuously differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]
Corners = NDArray[np.int64]

_ROUNDING = 1e-9
"""Largest protrusion of a sphere over a plane of the hull, in units of the body's size."""

SAME_PLANE_M = 1e-9
"""Largest distance between the planes of faces that count as one flat face [m]."""

SAME_NORMAL = 1e-6
"""Largest difference of the unit normals of such faces."""
OVERHANG_M = 1e-3
"""How far beyond the border of a flat face, which another body's face lies on, a sphere still touches its plane [m].
Spheres at the rim of two equal faces would else be pushed off the rounded edges of the other body.
"""
LEAST_SHARP = 0.996
"""Largest cosine between the normals of two faces with an edge between them: 5 degrees."""
LEVEL = 0.01
"""Largest difference of the radii at both ends of such an edge, in units of its length: elsewhere it is no edge but a
cone, of a large sphere that lies inside of a corner.
"""
PARALLEL = 0.98
"""Least cosine between the normals of faces that lie on each other."""
MOST_PLANES = 4096
"""Most products of faces and supports, or of edges, of two hulls that are compared; curved bodies have more."""


@dataclass(frozen=True)
class Hull:
    """Hull of spheres, in the body frame; F faces, E edges."""

    faces: Tensor
    """Unit normal n and offset h [m] of each face, n . x = h; then two affine functions of a point that are the
    barycentric coordinates of its foot at the second and third sphere, each as gradient [1/m] and constant; shape
    (F, 12).
    """
    edges: Tensor
    """Indices of the two spheres of each edge, shape (E, 2)."""
    supports: Tensor
    """Indices of the spheres that support the hull, shape (K,)."""
    ridges: Tensor
    """Indices of the two spheres of each edge between faces in different planes, shape (R, 2)."""
    inward: Tensor
    """Unit vectors in both faces of each such edge, orthogonal to it and away from it, shape (R, 2, 3)."""

    def planes_against(self, other: Hull) -> int:
        """Return how many planes and spheres of two hulls are compared where one lies on the other."""
        return len(self.faces) * len(other.supports) + len(other.faces) * len(self.supports)

    @staticmethod
    def of(centers: Tensor, radii: Tensor, chosen: Tensor) -> Hull | None:
        """Build the hull of some spheres; None where they enclose no volume.

        Args:
            centers: Centres of all spheres of a body [m], shape (N, 3).
            radii: Their radii [m], shape (N,).
            chosen: Indices of the spheres that support the hull, shape (K,), as from `plane_contacts`.
        """
        c, r = (x.detach().cpu().double().numpy() for x in (centers[chosen], radii[chosen]))
        found = _touching_planes(c, r)
        if found is None:
            return None
        triangles, planes = found
        edges = _edges(c, triangles)
        faces = np.concatenate([planes, _feet(c, triangles, planes)], 1)
        ridges, inward = _ridges_between(c, r, triangles, planes)
        return Hull(
            faces=torch.as_tensor(faces).to(centers),
            edges=chosen[torch.as_tensor(edges).to(chosen)],
            supports=chosen,
            ridges=chosen[torch.as_tensor(ridges).to(chosen)],
            inward=torch.as_tensor(inward).to(centers),
        )


def hull_distance(
    points: Tensor, hull: Hull, centers: Tensor, radii: Tensor, flat: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the signed distance to a hull, and its outward unit normal.

    Args:
        points: Points in the body frame [m], shape (n, K, 3).
        hull: The hull.
        centers: Centres of the body's spheres [m], shape (1 or n, N, 3).
        radii: Their radii [m], shape (1 or n, N).
        flat: Face (n,) over whose flat side the distance is that to its plane; -1 or None for none.

    Returns:
        Distance [m], shape (n, K), negative inside; normal, shape (n, K, 3).
    """
    with torch.no_grad():
        face, on_face = _nearest_face(points, hull)
        if flat is not None:
            over = _over_flat(points, hull, flat)
            face, on_face = torch.where(over, flat[:, None], face), on_face | over
    height, normal = _height(points, hull, face), hull.faces[face, :3]
    if bool(on_face.all()):
        return height, normal
    with torch.no_grad():
        edge = _edge_distances(points[:, :, None], *_ends(hull.edges, centers, radii))[0].argmin(-1)
    distance, away = _edge_distances(points, *_ends(hull.edges[edge], centers, radii))
    return torch.where(on_face, height, distance), torch.where(on_face[..., None], normal, away)


def parting(hull: Hull, points: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Return the plane of a hull over which spheres are highest: their least height (n,) [m], and its normal (n, 3).

    Args:
        hull: The hull.
        points: Centres of the spheres in the frame of the hull's body [m], shape (n, K, 3).
        radii: Their radii [m], shape (1 or n, K).
    """
    least = (points @ hull.faces[:, :3].T - hull.faces[:, 3] - radii[..., None]).amin(1)
    most, face = least.max(-1)
    return most, hull.faces[face, :3]


def parallel_face(hull: Hull, axis: Tensor) -> Tensor:
    """Return the face (n,) whose normal is nearest to an axis (n, 3) in the body frame, -1 where none is parallel."""
    along, face = (axis @ hull.faces[:, :3].T).max(-1)
    return torch.where(along > PARALLEL, face, torch.full_like(face, -1))


def _over_flat(points: Tensor, hull: Hull, flat: Tensor) -> Tensor:
    """Return whether (n, K) the foot of a point lies on the flat side of a face (n,), or at most OVERHANG_M beyond."""
    plane, second, third = hull.faces.split(4, -1)
    chosen = plane[flat.clamp_min(0)]
    apart = chosen[:, None] - plane
    same = (apart[..., :3].square().sum(-1) < SAME_NORMAL**2) & (apart[..., 3].square() < SAME_PLANE_M**2)
    a, b = (points @ part[:, :3].T + part[:, 3] for part in (second, third))
    margin = [OVERHANG_M * part[:, :3].norm(dim=-1) for part in (second, third, second + third)]
    within = (a >= -margin[0]) & (b >= -margin[1]) & (a + b <= 1 + margin[2])
    return (within & same[:, None]).any(-1) & (flat >= 0)[:, None]


def _nearest_face(points: Tensor, hull: Hull) -> tuple[Tensor, Tensor]:
    """Return the face (n, K) nearest to each point among those that have its foot, and whether no edge is nearer.

    Outside, a face that has the foot is the nearest part of the hull; inside, that is so if no plane is nearer.
    """
    height, second, third = (points @ part[:, :3].T + sign * part[:, 3]
                             for part, sign in zip(hull.faces.split(4, -1), (-1, 1, 1), strict=True))  # fmt: skip
    within = (second >= 0) & (third >= 0) & (second + third <= 1)
    best, chosen = torch.where(within, height, torch.full_like(height, -torch.inf)).max(-1)
    return chosen, (best > 0) | (best >= height.amax(-1) - SAME_PLANE_M)


def _height(points: Tensor, hull: Hull, face: Tensor) -> Tensor:
    chosen = hull.faces[face]
    return (points * chosen[..., :3]).sum(-1) - chosen[..., 3]


def _ends(edges: Tensor, centers: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return centres and radii of both spheres of edges (E, 2), the same for all items, or (n, K, 2)."""
    if edges.ndim == 2:
        return tuple(x[:, None, edges[:, k]] for x in (centers, radii) for k in (0, 1))  # type: ignore[return-value]
    row = torch.arange(edges.shape[0], device=edges.device)[:, None] % centers.shape[0]
    other = torch.arange(edges.shape[0], device=edges.device)[:, None] % radii.shape[0]
    return (
        centers[row, edges[..., 0]],
        centers[row, edges[..., 1]],
        radii[other, edges[..., 0]],
        radii[other, edges[..., 1]],
    )


def _edge_distances(points: Tensor, start: Tensor, end: Tensor, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances (...) to hulls of two spheres, and the outward normals (..., 3); the shapes broadcast."""
    edge, away = end - start, points - start
    length = edge.square().sum(-1).sqrt()
    axis = edge / length[..., None]
    x = (away * axis).sum(-1)
    y = (away - x[..., None] * axis).square().sum(-1).clamp_min(1e-30).sqrt()
    slope = (first - second) / length
    steep = (1 - slope.square()).clamp_min(1e-12).sqrt()
    place = torch.minimum((x - y * slope / steep).clamp_min(0.0), length)
    arm = away - place[..., None] * axis
    size = arm.square().sum(-1).clamp_min(1e-30).sqrt()
    return size - first + slope * place, arm / size[..., None]


def _touching_planes(centers: Array, radii: Array) -> tuple[Corners, Array] | None:
    """Return the triples of spheres (F, 3) that a supporting plane touches, and the planes (F, 4) as (n, h).

    The triples are among the ridges of the convex hull of the points (c, r): the support function max n . c + r is that
    of these points in the direction (n, 1).
    """
    size = float(np.ptp(centers, axis=0).max())
    if len(radii) < 4 or size == 0.0 or _thickness(centers) < 1e-6 * size:
        return None
    middle = centers.mean(0)
    triangles = _ridges(np.c_[(centers - middle) / size, radii / size])
    normal = _normals(centers[triangles], radii[triangles])
    triangles = np.concatenate([triangles, triangles])
    height = (normal * centers[triangles[:, 0]]).sum(1) + radii[triangles[:, 0]]
    beyond = (normal @ centers.T + radii).max(1) - height
    kept = np.isfinite(beyond) & (beyond <= _ROUNDING * size)
    if kept.sum() < 4:
        return None
    return triangles[kept], np.c_[normal, height][kept]


def _edges(centers: Array, triangles: Corners) -> Corners:
    """Return the edges (E, 2) of the faces, and one more for each sphere without a face, to the nearest sphere."""
    edges = np.concatenate([triangles[:, list(chosen)] for chosen in combinations(range(3), 2)])
    bare = np.setdiff1d(np.arange(len(centers)), edges)
    apart = np.linalg.norm(centers[bare, None] - centers, axis=2)
    apart[np.arange(len(bare)), bare] = np.inf
    return np.unique(np.concatenate([edges, np.sort(np.stack([bare, apart.argmin(1)], 1), axis=1)]), axis=0)


def _ridges_between(centers: Array, radii: Array, triangles: Corners, planes: Array) -> tuple[Corners, Array]:
    """Return the edges (R, 2) between two faces in different planes, and the vectors (R, 2, 3) away from them."""
    sides: dict[tuple[int, int], list[int]] = {}
    for face, corners in enumerate(triangles):
        for pair in combinations(sorted(int(corner) for corner in corners), 2):
            sides.setdefault(pair, []).append(face)
    kept = [
        (pair, faces)
        for pair, faces in sides.items()
        if len(faces) == 2
        and planes[faces[0], :3] @ planes[faces[1], :3] < LEAST_SHARP
        and abs(radii[pair[1]] - radii[pair[0]]) <= LEVEL * np.linalg.norm(centers[pair[1]] - centers[pair[0]])
    ]
    found = np.array([pair for pair, _ in kept], dtype=np.int64).reshape(-1, 2)
    inward = np.array([[_away(centers, radii, pair, triangles[f], planes[f]) for f in faces] for pair, faces in kept])
    return found, inward.reshape(-1, 2, 3)


def _away(centers: Array, radii: Array, pair: tuple[int, int], corners: Corners, plane: Array) -> Array:
    """Return the unit vector in a face that is orthogonal to one of its edges and leads away from it."""
    third = next(int(corner) for corner in corners if corner not in pair)
    start, end, other = (centers[k] + radii[k] * plane[:3] for k in (*pair, third))
    edge, away = end - start, other - start
    away = away - edge * (away @ edge) / (edge @ edge)
    return away / np.linalg.norm(away)


def _thickness(centers: Array) -> float:
    return float(np.linalg.svd(centers - centers.mean(0), compute_uv=False)[-1])


def _ridges(points: Array) -> Corners:
    """Return the triples of points (n, 4) that may be ridges of their hull; of equal radii those of the hull in 3D."""
    from scipy.spatial import ConvexHull, QhullError  # dear to import, and seldom needed

    level = np.ptp(points[:, 3]) < 1e-9
    used = points[:, :3] if level else points
    try:
        simplices = ConvexHull(used, qhull_options="Qt").simplices
    except QhullError:
        simplices = ConvexHull(used, qhull_options="QJ").simplices
    if level:
        return np.sort(simplices, axis=1).astype(np.int64)
    rows = [simplices[:, list(chosen)] for chosen in combinations(range(4), 3)]
    return np.unique(np.sort(np.concatenate(rows), axis=1), axis=0).astype(np.int64)


def _normals(centers: Array, radii: Array) -> Array:
    """Return the normals (2 F, 3) of the two planes that touch triples of spheres; not finite where none does."""
    e, f = centers[:, 1] - centers[:, 0], centers[:, 2] - centers[:, 0]
    ee, ef, ff = (e * e).sum(1), (e * f).sum(1), (f * f).sum(1)
    across = np.cross(e, f)
    area2 = ee * ff - ef**2
    with np.errstate(divide="ignore", invalid="ignore"):
        de, df = radii[:, 0] - radii[:, 1], radii[:, 0] - radii[:, 2]
        u, v = (ff * de - ef * df) / area2, (ee * df - ef * de) / area2
        flat = u[:, None] * e + v[:, None] * f
        rise = np.sqrt(1 - (u * de + v * df))[:, None] * across / np.linalg.norm(across, axis=1, keepdims=True)
    flat[area2 <= 1e-14 * np.maximum(ee, ff) ** 2] = np.nan
    return np.concatenate([flat + rise, flat - rise])


def _feet(centers: Array, triangles: Corners, planes: Array) -> Array:
    """Return the affine functions (F, 8) that give the second and third barycentric coordinate of a point's foot.

    The foot goes along the plane's normal n to the plane of the centres: p = c0 + a e + b f + t n, solved for a and b.
    """
    first = centers[triangles[:, 0]]
    frame = np.stack([centers[triangles[:, 1]] - first, centers[triangles[:, 2]] - first, planes[:, :3]], -1)
    rows = np.linalg.inv(frame)[:, :2]
    constant = -(rows @ first[..., None])
    return np.concatenate([rows, constant], 2).reshape(len(triangles), 8)
