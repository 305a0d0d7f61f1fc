"""Contact detection: spheres that touch within a step, by a broad phase and a smooth distance.

A sphere that stays apart gets no impulse and takes no share of the mass, so leaving it out changes nothing. The broad
phase runs without derivatives; the contact points of the remaining spheres are computed with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from ..geometry.rotation import cross
from ..optimization.forward_mode import parts_of
from .body import Body
from .edge_contact import FACE_SLACK_M, Crossings, Edges, best_normal, slots_of
from .hull import MOST_PLANES, Hull, hull_distance, parallel_face, parting
from .smooth_distance import blended, log_sum_exp_distance, smooth_min
from .surfaces.fixed_surface import HALF_SPACE
from .world import World

PAIR_SMOOTHING_M = 1e-3
"""Width of the smooth minimum in the distance between two bodies [m]."""
ROUNDING_M = 1e-9
"""Margin of the broad phase [m], for rounding: distances are computed again afterwards, in another order."""
FAR_M = 1e3
"""Gap of a slot in which nothing meets [m]; its normal is z, its position the origin."""
GROUND = -1
"""Index of the ground as the second body of a pair; fixed surfaces follow, -2 being the first."""


@dataclass(frozen=True)
class Placed:
    """A body at its pose in a step, world frame."""

    body: Body
    """The body."""
    reference: Tensor
    """Centre of mass of a free body, origin of the frame of another [m], shape (n, 3)."""
    rotation: Tensor
    """Rotation, body to world, shape (n, 3, 3)."""
    velocity: Tensor
    """Velocity of the reference point [m/s], shape (n, 3)."""
    omega: Tensor
    """Angular velocity [rad/s], shape (n, 3)."""

    @staticmethod
    def still(body: Body, origin: Tensor, rotation: Tensor) -> Placed:
        """Return a body at rest with its frame at origins (n, 3) [m] and rotations (n, 3, 3)."""
        reference = origin + (rotation @ body.com[..., None]).squeeze(-1) if body.free else origin
        zero = torch.zeros_like(origin)
        return Placed(body=body, reference=reference, rotation=rotation, velocity=zero, omega=zero)

    @property
    def origin(self) -> Tensor:
        """The reference point in the body frame [m], shape (1 or n, 3)."""
        return self.body.com if self.body.free else torch.zeros_like(self.body.com)

    def arms(self, chosen: Tensor | None = None) -> Tensor:
        """Return the spheres (n, N or K, 3) [m] relative to the reference point, world axes."""
        return pick(self.body.centers - self.origin[:, None], chosen) @ self.rotation.transpose(-1, -2)

    def centers(self, chosen: Tensor | None = None) -> Tensor:
        """Return the centres (n, N or K, 3) [m] of its spheres, or of the chosen ones (n, K)."""
        return self.reference[:, None] + self.arms(chosen)

    def radii(self, chosen: Tensor | None = None) -> Tensor:
        """Return the radii (1 or n, N or K) [m] of its spheres, or of the chosen ones (n, K)."""
        return pick(self.body.radii, chosen)

    def plane_spheres(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return centres (n, K, 3) and radii (1 or n, K) [m] in slots (n, K) of what the ground can touch."""
        centers, radii = self.body.plane_spheres
        arms = pick(centers - self.origin[:, None], chosen) @ self.rotation.transpose(-1, -2)
        return self.reference[:, None] + arms, pick(radii, chosen)

    def in_frame(self, position: Tensor) -> Tensor:
        """Return positions (n, C, 3) [m] of the world in the body frame."""
        origin = self.body.com if self.body.free else torch.zeros_like(self.body.com)
        return (position - self.reference[:, None]) @ self.rotation + origin[:, None]

    def point_velocity(self, position: Tensor) -> Tensor:
        """Return the velocity (n, C, 3) [m/s] of its material points at `position` (n, C, 3)."""
        return self.velocity[:, None] + cross(self.omega[:, None], position - self.reference[:, None])

    def at(self, items: Tensor) -> Placed:
        """Return some items (m,)."""
        return Placed(self.body, *(x[items] for x in (self.reference, self.rotation, self.velocity, self.omega)))

    def plain(self) -> Placed:
        """Return the body without derivatives."""
        names = ("com", "centers", "radii")
        body = replace(self.body, **{name: plain(getattr(self.body, name)) for name in names})
        return Placed(body, *(plain(x) for x in (self.reference, self.rotation, self.velocity, self.omega)))

    @cached_property
    def reach(self) -> Tensor:
        """The radius (n or 1,) [m] of a ball about the reference point that holds all spheres, without derivatives."""
        arms = plain(self.body.centers) - plain(self.origin)[:, None]
        return (arms.square().sum(-1).sqrt() + plain(self.body.radii)).amax(-1)


@dataclass(frozen=True)
class Points:
    """Contact points of two bodies, world frame: n items of the batch, C points each."""

    slot: Tensor
    """Number of each point in the pair's fixed list, shape (n, C)."""
    near: Tensor
    """Whether the item itself has the point, shape (n, C); others only fill the item up to the largest number."""
    gap: Tensor
    """Gap [m], negative where the bodies overlap, shape (n, C)."""
    normal: Tensor
    """Unit normal, from body b to body a, shape (n, C, 3)."""
    position: Tensor
    """Contact point [m], shape (n, C, 3)."""


def pairs_of(world: World) -> list[tuple[int, int]]:
    """List the pairs that can touch: each free body with the ground (-1), fixed surfaces (-2, ...) and other bodies."""
    return world.pairs


def slot_count(world: World, pair: tuple[int, int]) -> int:
    """Return the number of contacts that a pair can have: one per sphere that can touch, several with a mesh."""
    first, surface = world.bodies[pair[0]], world.surface(pair[1])
    plane = pair[1] == GROUND if surface is None else surface.kind == HALF_SPACE
    if pair[1] == GROUND:
        return first.plane_spheres[1].shape[-1]
    if plane and first.on_plane is not None:
        return len(first.on_plane)
    if surface is not None:
        return first.radii.shape[-1] * surface.contacts_per_sphere
    if plane:
        return first.radii.shape[-1]
    second = world.bodies[pair[1]]
    return first.radii.shape[-1] + second.radii.shape[-1] + edge_slots(first, second)


def edge_slots(a: Body, b: Body) -> int:
    """Return the number of contacts that the edges of two bodies can have: two for each edge of the first."""
    first, second = a.hull, b.hull
    if first is None or second is None or len(first.ridges) * len(second.ridges) > MOST_PLANES:
        return 0
    return 2 * len(first.ridges) if first.planes_against(second) <= MOST_PLANES else 0


def near_ground(world: World, placed: Placed, step_s: Tensor) -> Tensor:
    """Return the smaller gap (n, S) [m] of each sphere to the ground, now or at the end of the step; negative inside.

    Heights and their rates are products in the body frame: n . (R r) = (R^T n) . r and
    n . (omega x R r) = (R^T (n x omega)) . r.
    """
    (normal, offset), body = world.ground, placed.body
    with torch.no_grad():
        still = placed.plain()
        centers, radii = (plain(x) for x in body.plane_spheres)
        axes = torch.stack((normal.expand_as(still.omega), cross(normal.expand_as(still.omega), still.omega)), -1)
        height, rate = _along(centers - still.origin[:, None], still.rotation.transpose(-1, -2) @ axes).unbind(-1)
        gap = height + (still.reference @ normal - plain(offset))[:, None] - radii
        return torch.minimum(gap, gap + plain(step_s)[:, None] * (rate + (still.velocity @ normal)[:, None]))


def near_body(a: Placed, b: Placed, step_s: Tensor, sharpness_per_m: float | None = None) -> Tensor:
    """Return whether (n,) the bounding balls of two bodies meet within a step; see :func:`body_points`."""
    with torch.no_grad():
        soft = max(_softness(x, sharpness_per_m) for x in (a, b))
        apart = (plain(a.reference) - plain(b.reference)).square().sum(-1).sqrt()
        return apart < a.reach + b.reach + plain(step_s) * _speed_bound(a, b) + soft


def ground_points(world: World, placed: Placed, slot: Tensor, near: Tensor | None = None) -> Points:
    """Return the contact points with the ground of the spheres in the given slots (n, C); `near` as in `Points`."""
    normal, offset = world.ground
    centers, radii = placed.plane_spheres(slot)
    gap = centers @ normal - offset[:, None] - radii
    position = centers - radii[..., None] * normal
    near = torch.ones_like(gap, dtype=torch.bool) if near is None else near
    return Points(slot=slot, near=near, gap=gap, normal=normal.expand_as(position), position=position)


def body_points(a: Placed, b: Placed, step_s: Tensor, sharpness_per_m: float | None = None) -> Points | None:
    """Return the points where two bodies touch, or will by the end of the step; None where there are none.

    The spheres of b against the union of a come first, then those of a against the union of b.

    Args:
        a: The first body.
        b: The second body; normals point from it.
        step_s: Step [s], shape (n,).
        sharpness_per_m: beta [1/m] of the published log-sum-exp distance; None for the simplex smooth minimum.
    """
    parting = _parted(a, b)
    flat_a, flat_b = parting.flat if parting is not None else (None, None)
    on_a = _against_union(a, b, step_s, sharpness_per_m, flat_a)
    on_b = _against_union(b, a, step_s, sharpness_per_m, flat_b)
    count = b.body.radii.shape[-1]
    parts = []
    if on_a is not None:
        parts.append(replace(on_a, normal=-on_a.normal))
    if on_b is not None:
        parts.append(replace(on_b, slot=on_b.slot + count))
    if parting is not None and sharpness_per_m is None:
        reached = plain(step_s) * _speed_bound(a, b)
        kept = _lowest(parting.gap - reached[:, None], ROUNDING_M + PAIR_SMOOTHING_M)
        if kept is not None:
            parts.append(_points_of_edges(a, b, parting, kept, reached))
    return _joined(parts) if parts else None


def all_body_points(a: Placed, b: Placed) -> Points:
    """Return the points of all spheres of two bodies against the other body, touching or not, in slot order."""
    parting = _parted(a, b)
    flat_a, flat_b = parting.flat if parting is not None else (None, None)
    on_a, on_b = _all_against_union(a, b, flat_a), _all_against_union(b, a, flat_b)
    parts = [replace(on_a, normal=-on_a.normal), replace(on_b, slot=on_b.slot + b.body.radii.shape[-1])]
    if parting is not None and parting.gap.shape[1]:
        every = torch.arange(parting.gap.shape[1], device=parting.gap.device).expand_as(parting.other)
        parts.append(_points_of_edges(a, b, parting, every, None))
    return _joined(parts)


def _joined(parts: Sequence[Points]) -> Points:
    return Points(*(torch.cat([getattr(part, name) for part in parts], 1) for name in Points.__dataclass_fields__))


@dataclass(frozen=True)
class _Parting:
    """How two hulls part best, without derivatives."""

    flat: tuple[Tensor, Tensor]
    """Faces (n,) of both hulls that lie flat on each other, -1 for none: those parallel to the plane of a face that
    parts them best.
    """
    other: Tensor
    """Edge of the second hull in the slots of edges, shape (n, S)."""
    gap: Tensor
    """Gap there [m], infinite where no edges cross, shape (n, S)."""


@torch.no_grad()
def _parted(a: Placed, b: Placed) -> _Parting | None:
    """Return how two hulls part best; None where a body has no hull, or one too curved to be compared."""
    first, second = a.body.hull, b.body.hull
    if first is None or second is None or first.planes_against(second) > MOST_PLANES:
        return None
    a, b = a.plain(), b.plain()
    height_a, out_of_a = _parting(a, first, b, second)
    height_b, out_of_b = _parting(b, second, a, first)
    axis = torch.where((height_b > height_a)[:, None], -out_of_b, out_of_a)
    along_a, along_b = ((sign * axis[:, None] @ x.rotation)[:, 0] for sign, x in ((1.0, a), (-1.0, b)))
    flat = (parallel_face(first, along_a), parallel_face(second, along_b))
    if not edge_slots(a.body, b.body):
        none = torch.zeros((len(axis), 0), dtype=torch.int64, device=axis.device)
        return _Parting(flat, none, axis.new_zeros(none.shape))
    found = Crossings.of(_edges_of(a).across(2), _edges_of(b).across(1))
    height = torch.maximum(height_a, height_b)
    most, best = best_normal(found, height, axis)
    # where edges part the bodies, faces that part them worse are not what touches; spheres beside edges may protrude
    other = (most > height) & (_gap_along(a, b, best) > height + FACE_SLACK_M)
    flat = (torch.where(other, -1, flat[0]), torch.where(other, -1, flat[1]))
    return _Parting(flat, *slots_of(found, best))


def _gap_along(a: Placed, b: Placed, normal: Tensor) -> Tensor:
    """Return the gap (n,) [m] between the spheres of two bodies along normals (n, 3) out of the first."""
    ends = [(x.centers() @ (sign * normal)[..., None]).squeeze(-1) + x.radii() for x, sign in ((a, 1.0), (b, -1.0))]
    return -ends[0].amax(1) - ends[1].amax(1)


def _edges_of(body: Placed) -> Edges:
    if body.body.hull is None:
        raise ValueError(f"body '{body.body.name}' has no hull")
    return Edges.of(body.body.hull, body.centers(), body.radii(), body.rotation)


def _points_of_edges(a: Placed, b: Placed, parting: _Parting, slot: Tensor, reached: Tensor | None) -> Points:
    """Return the points of the slots (n, K) of edges; `reached` (n,) is how far points move within the step."""
    first, second = _edges_of(a).chosen(slot // 2), _edges_of(b).chosen(parting.other.gather(1, slot))
    found = Crossings.of(first, second)
    gap = parting.gap.gather(1, slot)
    near = gap - (0.0 if reached is None else reached[:, None]) < ROUNDING_M + PAIR_SMOOTHING_M
    middle = first.radius + found.place * first.widening + 0.5 * found.gap
    position = first.start + found.place[..., None] * first.along + middle[..., None] * found.normal
    count = a.body.radii.shape[-1] + b.body.radii.shape[-1]
    points = Points(slot=slot + count, near=near, gap=found.gap, normal=-found.normal, position=position)
    return emptied(points, torch.isfinite(gap))


def emptied(points: Points, there: Tensor) -> Points:
    """Return points with those slots far away that have no contact."""
    up = torch.zeros_like(points.normal)
    up[..., 2] = 1.0
    gap = torch.where(there, points.gap, torch.full_like(points.gap, FAR_M))
    normal = torch.where(there[..., None], points.normal, up)
    position = torch.where(there[..., None], points.position, torch.zeros_like(up))
    return replace(points, gap=gap, normal=normal, position=position)


def _parting(near: Placed, hull: Hull, far: Placed, other: Hull) -> tuple[Tensor, Tensor]:
    """Return how high (n,) [m] another hull lies over the plane that parts them best, and its normal (n, 3)."""
    points = near.in_frame(far.centers()[:, other.supports])
    height, normal = parting(hull, points, far.radii()[:, other.supports])
    return height, (near.rotation @ normal[..., None]).squeeze(-1)


def _against_union(
    union: Placed, spheres: Placed, step_s: Tensor, sharpness_per_m: float | None, face: Tensor | None
) -> Points | None:
    """Return the points of `spheres` that may touch `union` within a step; normals point out of the union."""
    softness = _softness(union, sharpness_per_m)
    flat = _is_flat(union, sharpness_per_m)
    with torch.no_grad():
        surface, queries = union.plain(), spheres.plain()
        slot = _within(queries, surface, step_s, softness)
        if not slot.shape[1]:
            return None
        if flat:
            distance = _to_hull(surface, queries.centers(slot), face)[0][..., None]
        else:
            distance = _sphere_distances(queries, surface, slot)
        reached = plain(step_s)[:, None] * _speed_bound(union, spheres)[:, None]
        depth = distance.amin(-1) - queries.radii(slot) - reached
        kept = _lowest(depth, ROUNDING_M + softness)
        if kept is None:
            return None
        near = depth.gather(1, kept) < ROUNDING_M + softness
        distance = distance.gather(1, kept[..., None].expand(-1, -1, distance.shape[-1]))
    slot = slot.gather(1, kept)
    if flat:
        return _points_at_hull(union, spheres, slot, near, face)
    return _points_at(union, spheres, slot, near, distance, sharpness_per_m)


def _all_against_union(union: Placed, spheres: Placed, face: Tensor | None) -> Points:
    """Return the points of all `spheres` at the surface of `union`; normals point out of the union."""
    slot = torch.arange(spheres.body.radii.shape[-1], device=union.reference.device)
    slot = slot.expand(union.reference.shape[0], -1)
    near = torch.ones_like(slot, dtype=torch.bool)
    if _is_flat(union, None):
        return _points_at_hull(union, spheres, slot, near, face)
    with torch.no_grad():
        distance = _sphere_distances(spheres.plain(), union.plain(), None)
    return _points_at(union, spheres, slot, near, distance, None)


def _is_flat(union: Placed, sharpness_per_m: float | None) -> bool:
    """Return whether a body is touched by its hull; the published distance is one to spheres."""
    return union.body.hull is not None and sharpness_per_m is None


def _to_hull(surface: Placed, points: Tensor, face: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the distances (n, K) [m] of points (n, K, 3) to the hull of a body, and its normals in the body frame."""
    body = surface.body
    if body.hull is None:
        raise ValueError(f"body '{body.name}' has no hull")
    return hull_distance(surface.in_frame(points), body.hull, body.centers, body.radii, face)


def _points_at_hull(surface: Placed, spheres: Placed, slot: Tensor, near: Tensor, face: Tensor | None) -> Points:
    """Return the points of the spheres in slots (n, K) at the hull of a body."""
    points, radii = spheres.centers(slot), spheres.radii(slot)
    distance, normal = _to_hull(surface, points, face)
    return _facing(slot, near, points, radii, distance, normal @ surface.rotation.transpose(-1, -2))


def _facing(slot: Tensor, near: Tensor, points: Tensor, radii: Tensor, distance: Tensor, normal: Tensor) -> Points:
    """Return the contact points of spheres, given the distances of their centres (n, K) and the outward normals."""
    gap = distance - radii
    position = points - (radii + 0.5 * gap)[..., None] * normal
    return Points(slot=slot, near=near, gap=gap, normal=normal, position=position)


def _sphere_distances(queries: Placed, surface: Placed, chosen: Tensor | None) -> Tensor:
    """Return the distances (n, K, N) [m] from centres of `queries` to each sphere of `surface`."""
    distance = torch.cdist(queries.centers(chosen), surface.centers(), compute_mode="donot_use_mm_for_euclid_dist")
    return distance - surface.radii()[:, None]


def _points_at(
    union: Placed, spheres: Placed, slot: Tensor, near: Tensor, distance: Tensor, sharpness_per_m: float | None
) -> Points:
    """Return the points of the spheres in slots (n, K), given their distances (n, K, N) to the union's spheres."""
    with torch.no_grad():
        most = distance.shape[-1]
        if sharpness_per_m is None:  # only spheres within the width of the nearest one have a weight in the minimum
            least = distance.amin(-1)
            most = int((distance < least[..., None] + PAIR_SMOOTHING_M + ROUNDING_M).sum(-1).max())
        members = distance.topk(most, dim=-1, largest=False, sorted=False).indices
    points = spheres.centers(slot)
    radii = spheres.radii(slot)
    gathered = union.centers(members.flatten(1)).unflatten(1, members.shape[1:])
    offset = points[:, :, None] - gathered
    member_radii = union.radii(members.flatten(1)).unflatten(1, members.shape[1:])
    if sharpness_per_m is None:
        minimum = partial(smooth_min, width=PAIR_SMOOTHING_M)
    else:
        minimum = partial(log_sum_exp_distance, per_m=sharpness_per_m)
    value, normal = blended(offset, member_radii, minimum)
    return _facing(slot, near, points, radii, value, normal)


def _softness(union: Placed, sharpness_per_m: float | None) -> float:
    """Return a bound [m] on how far the smooth distance lies below that of the nearest sphere."""
    if sharpness_per_m is None:
        return PAIR_SMOOTHING_M
    return math.log(union.body.radii.shape[-1]) / sharpness_per_m


def _within(queries: Placed, surface: Placed, step_s: Tensor, softness_m: float) -> Tensor:
    """Return the slots (n, K) of the spheres near the bounding ball of the other body."""
    centers = queries.centers()
    apart = (centers - surface.reference[:, None]).square().sum(-1).sqrt() - queries.radii()
    margin = surface.reach + plain(step_s) * _speed_bound(queries, surface) + softness_m
    kept = _lowest(apart - margin[:, None], 0.0)
    return apart.new_zeros((apart.shape[0], 0), dtype=torch.int64) if kept is None else kept


def _speed_bound(a: Placed, b: Placed) -> Tensor:
    """Return a bound (n,) [m/s] on the relative speed of any two points of two bodies."""
    spinning = [plain(x.omega).square().sum(-1).sqrt() * x.reach for x in (a, b)]
    return (plain(a.velocity) - plain(b.velocity)).square().sum(-1).sqrt() + spinning[0] + spinning[1]


def _lowest(depth: Tensor, limit: float) -> Tensor | None:
    """Return the slots (n, K) with values below the limit, K the largest number of any item; None where K is 0."""
    most = int((depth < limit).sum(1).max()) if depth.numel() else 0
    return depth.topk(most, dim=1, largest=False, sorted=False).indices if most else None


def plain(value: Tensor) -> Tensor:
    """Return a tensor without its derivatives, forward or backward."""
    return parts_of(value)[0].detach()


def pick(values: Tensor, chosen: Tensor | None) -> Tensor:
    """Return the chosen spheres (n, K, ...) of values (1 or n, N, ...); all for None."""
    if chosen is None:
        return values
    if values.ndim == 3:
        chosen = chosen[..., None].expand(-1, -1, values.shape[-1])
    return values.expand(chosen.shape[0], *values.shape[1:]).gather(1, chosen)


def _along(arms: Tensor, axes: Tensor) -> Tensor:
    """Return the components (n, N, 2) of arms (1 or n, N, 3) along axes (n, 3, 2)."""
    if arms.shape[0] > 1:
        return arms @ axes
    return (arms[0] @ axes.transpose(0, 1).flatten(1)).unflatten(1, (-1, 2)).transpose(0, 1)
