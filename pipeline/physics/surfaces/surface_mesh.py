"""Triangle mesh as a fixed surface: its features, the contacts of spheres with it, and its grid for the kernels.

A sphere touches a mesh where the distance from its centre to the mesh has a local minimum (derived): inside a
triangle; on an edge or a corner only where no way into an adjacent triangle, or along an adjacent edge, leads closer.
So a ball in a groove has two contacts, one on a convex edge has one, and edges between coplanar triangles have none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .mesh_neighbourhood import Neighbourhood
from .mesh_topology import Topology

FEATURES = 7
"""Features of a triangle: its inside, its edges ab, bc and ca, and its corners a, b and c."""
MESH_CONTACTS = 4
"""Maximum number of contacts of a sphere with a mesh: those with the smallest gap."""
FLAT = 1e-6
"""Sine of the angle up to which a way along the mesh counts as leading no closer."""
ORDER = (0.2672612419124244, 0.5345224838248488, 0.8017837257372732)
"""Direction along which the contacts of a sphere are sorted by their normals, so that each keeps its slot."""
MANY = 200
"""Number of spheres from which on it is worth while to find what spheres may touch by cells."""
_CHUNK = 2_000_000
"""Number of cells that are looked up at once."""
_CELLS = (64, 1 << 18)
"""Least and largest number of cells of a grid."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """A triangle mesh in the frame of its surface."""

    topology: Topology
    """Its triangles and how they hang together, and whether they bound a solid."""

    @property
    def solid(self) -> bool:
        """Whether the mesh has an inside; otherwise it is a sheet that is touched from both sides."""
        return self.topology.solid

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest corner of its box [m], shape (2, 3)."""
        corners = self.topology.corners.reshape(-1, 3)
        return np.stack((corners.min(0), corners.max(0)))

    @cached_property
    def cell_m(self) -> float:
        """Side of the cells of its grid [m]: about the triangles' size, within bounds on the number of cells."""
        corners = self.topology.corners
        size = float(np.median(np.ptp(corners, axis=1).max(1)))
        extent = np.ptp(self.bounds, axis=0)
        least = float(np.cbrt(np.maximum(extent, 0.02 * extent.max()).prod() / _CELLS[1]))
        return max(size, least, 1e-6)

    @cached_property
    def _cells(self) -> NDArray[np.int64]:
        """Numbers of cells along the axes (3,)."""
        return np.floor(np.ptp(self.bounds, axis=0) / self.cell_m).astype(np.int64) + 1

    @cached_property
    def _first_cells(self) -> NDArray[np.int64]:
        """The cell (F, 3) of the lowest corner of the box of each triangle."""
        return self._cell_of(self.topology.corners.min(1))

    def _cell_of(self, places: Array) -> NDArray[np.int64]:
        """Return the cells (..., 3) of places (..., 3)."""
        numbers = np.floor((places - self.bounds[0]) / self.cell_m).astype(np.int64)
        return np.clip(numbers, 0, self._cells - 1)

    @cached_property
    def grid(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of cells along the axes (3,), first entry of each cell (cells + 1,), and triangles by cell."""
        count, corners = self._cells, self.topology.corners
        first, last = self._first_cells, self._cell_of(corners.max(1))
        spans = last - first + 1
        sizes = spans.prod(1)
        triangle = np.repeat(np.arange(len(corners)), sizes)
        within = np.arange(len(triangle)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        span, begin = spans[triangle], first[triangle]
        cell = begin + np.stack(
            (within // (span[:, 1] * span[:, 2]), within // span[:, 2] % span[:, 1], within % span[:, 2]), 1
        )
        flat = (cell[:, 0] * count[1] + cell[:, 1]) * count[2] + cell[:, 2]
        order = np.argsort(flat, kind="stable")
        starts = np.concatenate(([0], np.cumsum(np.bincount(flat, minlength=int(count.prod())))))
        return count, starts, triangle[order]

    def neighbourhood(self, reach_m: float) -> Neighbourhood:
        """Return the triangles that spheres may touch within a reach [m], by the places of their centres."""
        if reach_m not in self._neighbourhoods:
            self._neighbourhoods[reach_m] = Neighbourhood.of(self.topology, reach_m)
        return self._neighbourhoods[reach_m]

    @cached_property
    def _neighbourhoods(self) -> dict[float, Neighbourhood]:
        return {}

    def numbers(self, near: Neighbourhood) -> Array:
        """Return the numbers that the kernel reads: box, cell, grid, corners, pseudonormals, prisms and ways."""
        t = self.topology
        head = np.concatenate((self.bounds.ravel(), [self.cell_m], near.numbers()))
        return np.concatenate((head, t.corners.ravel(), t.pseudonormals.ravel(), t.prisms.ravel(), t.ways.ravel()))

    def indices(self, near: Neighbourhood) -> NDArray[np.int64]:
        """Return the integers that the kernel reads: sizes, starts and counts of ways, first cells, and the grids."""
        t = self.topology
        count, starts, triangles = self.grid
        head = [*count, len(t.corners), int(t.solid), len(starts), *near.cells, len(triangles), len(near.starts)]
        ways = np.concatenate((t.way_start.ravel(), t.way_count.ravel()))
        return np.concatenate((head, ways, self._first_cells.ravel(), starts, triangles, near.starts, near.triangles))

    @torch.no_grad()
    def features(self, centers: Tensor, radii: Tensor, margin: Tensor) -> tuple[Tensor, Tensor]:
        """Return the contacts of spheres: signed distances to their centres and numbers of features.

        Args:
            centers: Centres in the frame of the surface [m], shape (Q, 3).
            radii: Radii [m], shape (Q,).
            margin: Gap up to which a contact matters [m], shape (Q,).

        Returns:
            Distances (Q, MESH_CONTACTS) [m], infinite where there is no contact, and features (Q, MESH_CONTACTS),
            triangle * FEATURES + feature, in both sorted along `ORDER`.
        """
        # from inside a solid, the way out may be longer than the radius
        reach = (radii.clamp_min(self.cell_m) if self.solid else radii) + margin
        distance = centers.new_full((len(centers), MESH_CONTACTS), torch.inf)
        feature = torch.zeros_like(distance, dtype=torch.int64)
        low, high = (torch.as_tensor(x).to(centers) for x in self.bounds)
        outside = (torch.maximum(low - centers, centers - high)).clamp_min(0.0)
        near = (outside.square().sum(-1) < reach.square()).nonzero().squeeze(1)
        if not len(near):
            return distance, feature
        known = self._known_for(float(reach[near].max()), len(near), float(radii.max()))
        for part in near.split(self._together(reach[near])):
            pairs = self._pairs(centers[part], reach[part]) if known is None else _looked_up(known, centers[part])
            distance[part], feature[part] = self._query(centers[part], reach[part], *pairs)
        return distance, feature

    def _known_for(self, reach_m: float, spheres: int, radius_m: float) -> Neighbourhood | None:
        """Return a neighbourhood for spheres of a reach and a radius [m]; None where it is not worth while."""
        known = [one for wide, one in self._neighbourhoods.items() if reach_m <= wide < 2 * reach_m]
        if known:
            return min(known, key=lambda one: one.reach_m)
        return self.neighbourhood(rounded_reach(reach_m)) if spheres > MANY and reach_m < 2 * radius_m else None

    def _together(self, reach: Tensor) -> int:
        """Return of how many spheres, with what they reach (Q,), the triangles nearby are looked up at once."""
        cells = float((2 * reach.max() / self.cell_m + 2) ** 3)
        return max(1, int(_CHUNK / max(1.0, min(cells, float(len(self.grid[1]))))))

    def _pairs(self, centers: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        """Return which spheres (N,) and triangles (N,) share a cell of the grid, in the order of both, each pair once.

        Args:
            centers: Centres of the spheres (Q, 3) [m].
            reach: How far each reaches (Q,) [m].
        """
        number, starts, entries = (torch.as_tensor(x, device=centers.device) for x in self.grid)
        low, most = torch.as_tensor(self.bounds[0]).to(centers), number - 1
        first, last = (
            torch.minimum(((centers + side * reach[:, None] - low) / self.cell_m).floor().long().clamp_min(0), most)
            for side in (-1, 1)
        )
        spans = (last - first + 1).clamp_min(0)
        query, within = _counted(spans.prod(-1))
        _, wide, high = spans[query].unbind(-1)
        place = torch.stack((within // (wide * high), within // high % wide, within % high), -1) + first[query]
        cell = (place[:, 0] * number[1] + place[:, 1]) * number[2] + place[:, 2]
        row, within = _counted(starts[cell + 1] - starts[cell])
        triangle = entries[starts[cell[row]] + within]
        # a triangle in several cells counts in the first one of those that are looked at
        begins = torch.as_tensor(self._first_cells, device=centers.device)[triangle]
        query, place = query[row], place[row]
        once = (torch.maximum(begins, first[query]) == place).all(-1)
        query, triangle = query[once], triangle[once]
        order = (query * len(self.topology.corners) + triangle).argsort()
        return query[order], triangle[order]

    def _query(self, centers: Tensor, reach: Tensor, query: Tensor, triangle: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances and features (Q, MESH_CONTACTS) of spheres; their numbers and triangles (N,) to look at."""
        away, region = _closest(centers[query], self._corners(centers)[triangle])
        far = away.square().sum(-1).sqrt()
        close = far < reach[query]
        query, away, far, number = (x[close] for x in (query, away, far, triangle * FEATURES + region))
        minimal = self._is_minimal(number, away, far)
        sign = torch.ones_like(far)
        if self.solid:
            along = (away * self._pseudonormals(centers)[number]).sum(-1)
            least = centers.new_full((len(centers),), torch.inf).scatter_reduce(0, query, far, "amin")
            behind = (far <= least[query]) & (along < 0)
            none = len(self.topology.corners) * FEATURES
            way_out = torch.full_like(least, none, dtype=torch.int64)
            way_out = way_out.scatter_reduce(0, query[behind], number[behind], "amin")[query]
            # from inside, the only way out is the shortest one; from outside, the far sides of walls are no contacts
            minimal = torch.where(way_out < none, number == way_out, minimal & (along >= 0))
            sign = torch.where(way_out < none, -sign, sign)
        query, number, far, away = (x[minimal] for x in (query, number, sign * far, sign[:, None] * away))
        return _slotted(len(centers), query, number, far, away)

    def _is_minimal(self, number: Tensor, away: Tensor, far: Tensor) -> Tensor:
        """Return whether the distance has a local minimum at the features; of shared ones, one triangle's counts."""
        start, count, ways = self._ways(away)
        first, many = start[number], count[number]
        good = many >= 0
        for k in range(int(many.max()) if len(many) else 0):
            way = ways[(first + k).clamp_max(len(ways) - 1)]
            good &= (many <= k) | ((away * way).sum(-1) <= FLAT * far)
        return good

    def distances(self, points: Tensor, feature: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Return the signed distances (...) [m] of points (..., 3) to given features (...), and the normals (..., 3).

        Args:
            points: Points in the frame of the surface [m].
            feature: Numbers of features as :meth:`features` returns them.
            inside: Whether the point is inside a solid.
        """
        place, direction, on_face = self._places(feature, points)
        arm = points - place
        along = _dot(arm, direction)
        rest = arm - along[..., None] * direction
        size2 = _dot(rest, rest)
        apart = size2 > 0
        size = torch.where(apart, size2, torch.ones_like(size2)).sqrt()
        up = torch.zeros_like(rest)
        up[..., 2] = 1.0
        outward = torch.where(apart[..., None], rest / size[..., None], up)
        side = torch.where(inside, -torch.ones_like(size), torch.ones_like(size))
        if self.solid:
            faced = torch.ones_like(side)
        else:
            faced = torch.where(along.detach() < 0, -torch.ones_like(side), torch.ones_like(side))
        distance = torch.where(on_face, faced * along, side * size * apart)
        normal = torch.where(on_face[..., None], faced[..., None] * direction, side[..., None] * outward)
        return distance, normal

    def _places(self, feature: Tensor, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return of features (...) a point (..., 3), a direction (..., 3), and whether they are insides of triangles.

        The direction is the normal of a triangle or that of an edge, zero for corners.
        """
        triangle, region = feature // FEATURES, feature % FEATURES
        corners = self._corners(like)[triangle]
        sides = corners.roll(-1, -2) - corners
        normal = torch.linalg.cross(sides[..., 0, :], sides[..., 1, :])
        directions = torch.cat((normal[..., None, :], sides, torch.zeros_like(sides)), -2)
        points = torch.cat((corners[..., :1, :], corners, corners), -2)
        index = region[..., None, None].expand(*region.shape, 1, 3)
        direction = directions.gather(-2, index).squeeze(-2)
        length = direction.square().sum(-1, keepdim=True)
        direction = direction / torch.where(length > 0, length, torch.ones_like(length)).sqrt()
        return points.gather(-2, index).squeeze(-2), direction, region == 0

    def _corners(self, like: Tensor) -> Tensor:
        return torch.as_tensor(self.topology.corners).to(like)

    def _pseudonormals(self, like: Tensor) -> Tensor:
        return torch.as_tensor(self.topology.pseudonormals).to(like).flatten(0, 1)

    def _ways(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        t = self.topology
        start, count = (torch.as_tensor(x, device=like.device).flatten() for x in (t.way_start, t.way_count))
        return start, count, torch.as_tensor(t.ways).to(like)


def _slotted(spheres: int, query: Tensor, number: Tensor, far: Tensor, away: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances and features (Q, MESH_CONTACTS): of each sphere the nearest contacts, sorted by normal."""
    order = far.argsort(stable=True)
    order = order[query[order].argsort(stable=True)]
    query, number, far, away = query[order], number[order], far[order], away[order]
    rank = torch.arange(len(query), device=query.device) - torch.searchsorted(query, query)
    kept = rank < MESH_CONTACTS
    query, number, far, away, rank = query[kept], number[kept], far[kept], away[kept], rank[kept]
    key = far.new_full((spheres, MESH_CONTACTS), torch.inf)
    key[query, rank] = (away @ away.new_tensor(ORDER)) / away.square().sum(-1).clamp_min(1e-30).sqrt()
    place = key.argsort(dim=-1, stable=True)
    distance = far.new_full(key.shape, torch.inf)
    feature = torch.zeros_like(key, dtype=torch.int64)
    distance[query, rank], feature[query, rank] = far, number
    return distance.gather(1, place), feature.gather(1, place)


def _closest(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Return the offsets (N, 3) [m] from triangles (N, 3, 3) to points (N, 3), and the nearest features (N,).

    Source: the regions of a triangle in Ericson, "Real-Time Collision Detection", 2005, section 5.1.5.
    """
    a, b, c = corners.unbind(1)
    ab, ac, bc, pa, pb, pc = b - a, c - a, c - b, points - a, points - b, points - c
    d1, d2, d3, d4, d5, d6 = _dot(ab, pa), _dot(ac, pa), _dot(ab, pb), _dot(ac, pb), _dot(ab, pc), _dot(ac, pc)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    conditions = (
        (4, (d1 <= 0) & (d2 <= 0)),
        (5, (d3 >= 0) & (d4 <= d3)),
        (6, (d6 >= 0) & (d5 <= d6)),
        (1, (vc <= 0) & (d1 >= 0) & (d3 <= 0)),
        (3, (vb <= 0) & (d2 >= 0) & (d6 <= 0)),
        (2, (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)),
    )
    region = torch.zeros_like(d1, dtype=torch.int64)
    for number, holds in reversed(conditions):
        region = region.masked_fill(holds, number)
    normal = torch.linalg.cross(ab, ac)
    unit = normal / normal.square().sum(-1, keepdim=True).sqrt()
    offset = _dot(unit, pa)[:, None] * unit
    for number, (arm, side) in {1: (pa, ab), 2: (pb, bc), 3: (pa, ac)}.items():
        offset = torch.where((region == number)[:, None], _off(arm, side), offset)
    for number, arm in {4: pa, 5: pb, 6: pc}.items():
        offset = torch.where((region == number)[:, None], arm, offset)
    return offset, region


def rounded_reach(reach_m: float) -> float:
    """Return a reach [m] that is as large or up to a fifth larger, one for all that differ little."""
    return 1.2 ** math.ceil(math.log(reach_m, 1.2))


def _looked_up(known: Neighbourhood, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Return which spheres (N,) may touch which triangles (N,), in the order of both."""
    low, cells, starts, entries = (
        torch.as_tensor(x, device=centers.device) for x in (known.low, known.cells, known.starts, known.triangles)
    )
    place = ((centers - low.to(centers)) / known.cell_m).floor().long()
    within = ((place >= 0) & (place < cells)).all(-1).nonzero().squeeze(1)
    flat = (place[within, 0] * cells[1] + place[within, 1]) * cells[2] + place[within, 2]
    row, number = _counted(starts[flat + 1] - starts[flat])
    return within[row], entries[starts[flat[row]] + number]


def _counted(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return for each of the things that rows (R,) count its row and its number within that, shapes (N,)."""
    row = torch.repeat_interleave(counts)
    return row, torch.arange(len(row), device=row.device) - (counts.cumsum(0) - counts)[row]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _off(arm: Tensor, side: Tensor) -> Tensor:
    """Return the part of arms across the direction of a side."""
    return arm - (_dot(arm, side) / _dot(side, side))[..., None] * side
