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
from torch.autograd import forward_ad

from ..geometry.rotation import cross
from .fixed_surface import HALF_SPACE
from .smooth_distance import blended, log_sum_exp_distance, smooth_min
from .world import Body, World

PAIR_SMOOTHING_M = 1e-3
"""Width of the smooth minimum in the distance between two bodies [m]."""
ROUNDING_M = 1e-9
"""Margin of the broad phase [m], for rounding: distances are computed again afterwards, in another order."""
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

    def point_velocity(self, position: Tensor) -> Tensor:
        """Return the velocity (n, C, 3) [m/s] of its material points at `position` (n, C, 3)."""
        return self.velocity[:, None] + cross(self.omega[:, None], position - self.reference[:, None])

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
    if plane and first.on_plane is not None:
        return len(first.on_plane)
    if surface is not None:
        return first.radii.shape[-1] * surface.contacts_per_sphere
    if plane:
        return first.radii.shape[-1]
    return first.radii.shape[-1] + world.bodies[pair[1]].radii.shape[-1]


def near_ground(world: World, placed: Placed, step_s: Tensor) -> Tensor:
    """Return the smaller gap (n, S) [m] of each sphere to the ground, now or at the end of the step; negative inside.

    Heights and their rates are products in the body frame: n . (R r) = (R^T n) . r and
    n . (omega x R r) = (R^T (n x omega)) . r.
    """
    (normal, offset), body = world.ground, placed.body
    with torch.no_grad():
        still = placed.plain()
        centers, radii = plain(body.centers), plain(body.radii)
        if body.on_plane is not None:
            centers, radii = centers[:, body.on_plane], radii[:, body.on_plane]
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
    (normal, offset), body = world.ground, placed.body
    chosen = slot if body.on_plane is None else body.on_plane[slot]
    centers, radii = placed.centers(chosen), placed.radii(chosen)
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
    on_a, on_b = (_against_union(*order, step_s, sharpness_per_m) for order in ((a, b), (b, a)))
    count = b.body.radii.shape[-1]
    parts = []
    if on_a is not None:
        parts.append(replace(on_a, normal=-on_a.normal))
    if on_b is not None:
        parts.append(replace(on_b, slot=on_b.slot + count))
    return _joined(parts) if parts else None


def all_body_points(a: Placed, b: Placed) -> Points:
    """Return the points of all spheres of two bodies against the other body, touching or not, in slot order."""
    on_a, on_b = _all_against_union(a, b), _all_against_union(b, a)
    return _joined([replace(on_a, normal=-on_a.normal), replace(on_b, slot=on_b.slot + b.body.radii.shape[-1])])


def _joined(parts: Sequence[Points]) -> Points:
    return Points(*(torch.cat([getattr(part, name) for part in parts], 1) for name in Points.__dataclass_fields__))


def _against_union(union: Placed, spheres: Placed, step_s: Tensor, sharpness_per_m: float | None) -> Points | None:
    """Return the points of `spheres` that may touch `union` within a step; normals point out of the union."""
    softness = _softness(union, sharpness_per_m)
    with torch.no_grad():
        surface, queries = union.plain(), spheres.plain()
        slot = _within(queries, surface, step_s, softness)
        if not slot.shape[1]:
            return None
        distance = _sphere_distances(queries, surface, slot)
        reached = plain(step_s)[:, None] * _speed_bound(union, spheres)[:, None]
        depth = distance.amin(-1) - queries.radii(slot) - reached
        kept = _lowest(depth, ROUNDING_M + softness)
        if kept is None:
            return None
        near = depth.gather(1, kept) < ROUNDING_M + softness
        distance = distance.gather(1, kept[..., None].expand(-1, -1, distance.shape[-1]))
    return _points_at(union, spheres, slot.gather(1, kept), near, distance, sharpness_per_m)


def _all_against_union(union: Placed, spheres: Placed) -> Points:
    """Return the points of all `spheres` at the surface of `union`; normals point out of the union."""
    with torch.no_grad():
        distance = _sphere_distances(spheres.plain(), union.plain(), None)
    slot = torch.arange(spheres.body.radii.shape[-1], device=distance.device).expand(distance.shape[0], -1)
    return _points_at(union, spheres, slot, torch.ones_like(slot, dtype=torch.bool), distance, None)


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
    gap = value - radii
    return Points(
        slot=slot, near=near, gap=gap, normal=normal, position=points - (radii + 0.5 * gap)[..., None] * normal
    )


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
    return forward_ad.unpack_dual(value).primal.detach()


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
