"""Contacts of the spheres of a body with a fixed surface, found without and computed with derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..contact_detection import Placed, Points, emptied, plain
from .fixed_surface import HALF_SPACE, FixedSurface

MOST_GAP_M = 0.1
"""Gap between a body and a surface up to which `surface_gap` tells it."""
NEAR_GAP_M = 0.004
"""Gap within which the triangles of a mesh are looked at first."""


@dataclass(frozen=True)
class Nearby:
    """Contacts of one body with one surface in a step, in fixed slots: n items, S slots."""

    depth: Tensor
    """The smaller gap, now or at the end of the step [m], infinite where there is no contact, shape (n, S)."""
    feature: Tensor | None
    """Feature of the mesh in each slot, shape (n, S); None for other surfaces."""
    inside: Tensor | None
    """Whether the centre is inside a mesh, shape (n, S); None for other surfaces."""

    def at(self, items: Tensor | None) -> Nearby:
        """Return some items; all for None."""
        if items is None:
            return self
        feature, inside = (None if x is None else x[items] for x in (self.feature, self.inside))
        return Nearby(self.depth[items], feature, inside)


@torch.no_grad()
def near_surface(placed: Placed, surface: FixedSurface, step_s: Tensor) -> Nearby | None:
    """Return the contacts of a body with a surface within a step; None where no item can have one.

    Args:
        placed: The body; n items.
        surface: The surface.
        step_s: Step [s], shape (n,).
    """
    still, fixed = placed.plain(), _plain(surface)
    speed = still.velocity.square().sum(-1).sqrt() + still.omega.square().sum(-1).sqrt() * still.reach
    margin = plain(step_s) * speed + 1e-6
    far = fixed.bound(still.reference[:, None]).squeeze(1) - still.reach - margin
    return _nearby(still, fixed, step_s) if bool((far < 0).any()) else None


def _nearby(still: Placed, fixed: FixedSurface, step_s: Tensor, within_m: Tensor | None = None) -> Nearby:
    """Return the contacts within a gap (n,) [m], or those that a step may close; of other surfaces all."""
    chosen = _chosen(still, fixed)
    centers, radii = _spheres(still, chosen)
    if fixed.mesh is None:
        points = _points(fixed, still, centers, radii, None, None)
        return Nearby(_least_gap(points, still, step_s), None, None)
    shape, count = centers.shape[:2], fixed.contacts_per_sphere
    if within_m is None:  # no gap of a sphere changes by more in a step, up to rounding
        margin = plain(step_s)[:, None] * still.point_velocity(centers).square().sum(-1).sqrt() + 1e-6
    else:
        margin = within_m[:, None].expand(shape)
    distance, feature = fixed.mesh.features(
        fixed.local(centers).flatten(0, 1), radii.expand(shape).flatten(), margin.flatten()
    )
    feature, there = (x.unflatten(0, shape).flatten(1) for x in (feature, torch.isfinite(distance)))
    inside = (distance < 0).unflatten(0, shape).flatten(1)
    centers, radii = centers.repeat_interleave(count, 1), radii.repeat_interleave(count, 1)
    points = _points(fixed, still, centers, radii, feature, inside)
    depth = torch.where(there, _least_gap(points, still, step_s), torch.inf)
    return Nearby(depth, feature, inside)


def surface_points(
    placed: Placed, surface: FixedSurface, nearby: Nearby, slot: Tensor, near: Tensor | None = None
) -> Points:
    """Return the contact points in the given slots (n, C) of a body with a surface; `near` as in `Points`."""
    chosen, sphere = _chosen(placed, surface), slot // surface.contacts_per_sphere
    if chosen is not None:
        sphere = chosen[sphere]
    feature, inside = (None if x is None else x.gather(1, slot) for x in (nearby.feature, nearby.inside))
    points = _points(surface, placed, placed.centers(sphere), placed.radii(sphere), feature, inside)
    near = torch.ones_like(points.gap, dtype=torch.bool) if near is None else near
    points = replace(points, slot=slot, near=near)
    if feature is None:
        return points
    return emptied(points, torch.isfinite(nearby.depth.gather(1, slot)))


@torch.no_grad()
def all_surface_points(placed: Placed, surface: FixedSurface) -> Points:
    """Return the points in all slots of a body with a surface, touching or not."""
    still, fixed = placed.plain(), _plain(surface)
    zero = torch.zeros_like(still.reference[:, 0])
    nearby = _nearby(still, fixed, zero, zero)
    slot = torch.arange(nearby.depth.shape[1], device=zero.device).expand(len(zero), -1)
    return surface_points(still, fixed, nearby, slot)


def surface_depth(placed: Placed, surface: FixedSurface) -> Tensor:
    """Return the penetration depth (n,) [m] of a body into a surface; 0 where they are apart."""
    zero = torch.zeros_like(plain(placed.reference)[:, 0])
    nearby = near_surface(placed, surface, zero)
    return zero if nearby is None else -nearby.depth.amin(-1).clamp_max(0.0)


@torch.no_grad()
def surface_gap(placed: Placed, surface: FixedSurface) -> Tensor:
    """Return the gap (n,) [m] of a body to a surface, negative where they overlap; infinite above `MOST_GAP_M`."""
    still, fixed = placed.plain(), _plain(surface)
    zero = torch.zeros_like(still.reference[:, 0])
    near = fixed.bound(still.reference[:, None]).squeeze(1) - still.reach < MOST_GAP_M
    gap = zero + torch.inf
    for within in (NEAR_GAP_M, MOST_GAP_M) if fixed.mesh is not None else (MOST_GAP_M,):
        asked = (near & ~(gap < MOST_GAP_M)).nonzero().squeeze(1)
        if len(asked):
            found = _nearby(still.at(asked), fixed, zero[asked], zero[asked] + within).depth.amin(-1)
            gap[asked] = torch.where(found < within, found, torch.inf)
    return gap


@torch.no_grad()
def points_within(placed: Placed, surface: FixedSurface, reach_m: float) -> Points:
    """Return the points in all slots of a body with a surface whose gap is at most a reach; others are far away."""
    still, fixed = placed.plain(), _plain(surface)
    zero = torch.zeros_like(still.reference[:, 0])
    nearby = _nearby(still, fixed, zero, zero + reach_m)
    slot = torch.arange(nearby.depth.shape[1], device=zero.device).expand(len(zero), -1)
    points = surface_points(still, fixed, nearby, slot)
    return emptied(points, points.gap <= reach_m)


def _chosen(placed: Placed, surface: FixedSurface) -> Tensor | None:
    """Return the indices of the spheres that a surface can touch; None for all."""
    return placed.body.on_plane if surface.kind == HALF_SPACE else None


def _spheres(placed: Placed, chosen: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return centres (n, S, 3) and radii (1 or n, S) [m] of the chosen spheres."""
    if chosen is None:
        return placed.centers(), placed.radii()
    index = chosen.expand(placed.reference.shape[0], -1)
    return placed.centers(index), placed.radii(index)


def _points(
    surface: FixedSurface,
    placed: Placed,
    centers: Tensor,
    radii: Tensor,
    feature: Tensor | None,
    inside: Tensor | None,
) -> Points:
    """Return the contact points of spheres (n, S): of each with its feature of a mesh, or with the whole surface."""
    local = surface.local(centers)
    if surface.mesh is None or feature is None or inside is None:
        distance, normal = surface.distances(local)
    else:
        distance, normal = surface.mesh.distances(local, feature, inside)
    normal = surface.to_world(normal).expand_as(centers)
    slot = torch.zeros_like(distance, dtype=torch.int64)
    return Points(slot, slot.bool(), distance - radii, normal, centers - radii[..., None] * normal)


def _least_gap(points: Points, placed: Placed, step_s: Tensor) -> Tensor:
    speed = (placed.point_velocity(points.position) * points.normal).sum(-1)
    return torch.minimum(points.gap, points.gap + plain(step_s)[:, None] * speed)


def _plain(surface: FixedSurface) -> FixedSurface:
    position, quat, size = (plain(x) for x in surface.tensors)
    return replace(surface, position=position, quat_wxyz=quat, size=size)
