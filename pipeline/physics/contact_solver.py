"""Contact solver of one step: detect the contacts of all pairs of bodies, prepare them, and solve their impulses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ...schemas import UsageError
from ..geometry.rotation import cross
from .body import Body
from .chains.stepping import ChainStepper, owners
from .contact_detection import (
    GROUND,
    ROUNDING_M,
    Placed,
    Points,
    body_points,
    ground_points,
    near_body,
    near_ground,
    pairs_of,
    slot_count,
)
from .contact_law import ContactLaw, Touch
from .friction_ellipse import Ellipse
from .impulse_solver import ContactGroup, Impulses, Rows, solve_with_joints, tangent_axes
from .paper_law import PaperLaw, paper_impulses
from .rigid_body import Inertia, Motion
from .surfaces.detection import Nearby, near_surface, surface_points
from .surfaces.fixed_surface import FixedSurface
from .world import World


@dataclass(frozen=True, kw_only=True)
class PairImpulses:
    """Impulses between one pair of bodies in a step; n items of the batch, C points."""

    pair: int
    """Number of the pair in the world's list of pairs."""
    a: int
    """Index of body a."""
    b: int
    """Index of body b, -1 for the ground, -2 and below for fixed surfaces."""
    free: tuple[bool, bool]
    """Whether a and b move freely."""
    items: Tensor | None
    """Items of the batch, shape (n,); None for all."""
    points: Points
    """The contact points."""
    impulse_n_s: Tensor
    """Impulses on a, world frame [N s], shape (n, C, 3)."""
    along_axes_n_s: Tensor
    """Impulses on a along the contacts' normals and tangents [N s], shape (n, C, 3)."""
    angular_n_m_s: Tensor | None
    """Angular impulse on a in addition to the moments of the impulses, world frame [N m s], shape (n, 3); None without
    resistance to turning.
    """
    friction: Tensor
    """Friction coefficient along the impulse [1], shape (n, 1 or C)."""

    def on_bodies(self, motions: Sequence[Motion]) -> dict[int, tuple[Tensor, Tensor]]:
        """Return for each free body the impulse (B, 3) [N s] and its moment (B, 3) [N m s] about the centre of mass."""
        found = {}
        for index, sign, free in ((self.a, 1.0, self.free[0]), (self.b, -1.0, self.free[1])):
            if free:
                com = take(motions[index].com, self.items)
                arms = self.points.position - com[:, None]
                impulse = sign * self.impulse_n_s
                moment = cross(arms, impulse).sum(1)
                if self.angular_n_m_s is not None:
                    moment = moment + sign * self.angular_n_m_s
                batch = motions[index].com.shape[0]
                found[index] = (put(impulse.sum(1), self.items, batch), put(moment, self.items, batch))
        return found

    def at(self, slot: Tensor, items: Tensor | None, slots: int, batch: int) -> Tensor:
        """Return the impulses along the axes (m, K, 3) [N s] at slots (m, K) of given items, 0 where none acted."""
        index = self.points.slot[..., None].expand_as(self.along_axes_n_s)
        wide = self.along_axes_n_s.new_zeros((index.shape[0], slots, 3)).scatter(1, index, self.along_axes_n_s)
        full = take(put(wide, self.items, batch), items)
        return full.gather(1, slot[..., None].expand(-1, -1, 3))


class Contacts:
    """Contact solver of a world.

    Args:
        world: The world.
        inertias: The inertias of its bodies, in the world's order.
        chains: Its chains in the rollout.
    """

    def __init__(self, world: World, inertias: Sequence[Inertia], chains: Sequence[ChainStepper] = ()) -> None:
        self.world = world
        self.chains = chains
        self.links = owners(chains)
        self.inertias = inertias
        self.pairs = pairs_of(world)
        self.effects = [active for active in world.effects if active.effect.has("contact")]
        law = world.contact
        self.sharpness_per_m = law.sharpness_per_m if isinstance(law, PaperLaw) else None

    @cached_property
    def _ground_axes(self) -> Tensor:
        """Normal and tangents of the ground as rows (3, 3)."""
        return tangent_axes(self.world.ground[0])

    def resolve(
        self, placed: Sequence[Placed], step_s: Tensor, before: Sequence[PairImpulses] = ()
    ) -> list[PairImpulses]:
        """Solve the contact impulses of a step.

        Args:
            placed: The bodies with their free velocities; B items each.
            step_s: Step [s], shape (B,).
            before: The impulses of the previous step, which warm-start the solver.
        """
        candidates = self._candidates(placed, step_s)
        if not candidates:
            return self._joints_alone()
        items = None if self.chains else _union([touching for touching, *_ in candidates.values()])
        some = [_select(body, items) for body in placed]
        h = take(step_s, items)
        found: list[tuple[int, Points, Touch, Tensor]] = []
        for number, (_, gaps, nearby) in candidates.items():
            points = self._points(number, gaps, nearby, some, items, h)
            if points is not None:
                a, b = self.pairs[number]
                law = self.world.law_of(a, b)
                touch, axes = self._touch(points, some[a], None if b < 0 else some[b], law, h, items, b == GROUND)
                found.append((number, points, touch, axes))
        if not found:
            return self._joints_alone()
        warm = self._warm(found, items, before, step_s.shape[0])
        impulses = self._impulses(found, some, items, warm)
        return [self._result(one, impulse, items) for one, impulse in zip(found, impulses, strict=True)]

    def _points(
        self,
        number: int,
        gaps: Tensor | None,
        nearby: Nearby | None,
        some: Sequence[Placed],
        items: Tensor | None,
        step_s: Tensor,
    ) -> Points | None:
        """Return where a pair touches; None where it does not.

        Args:
            number: The pair.
            gaps: Gap of each of its slots to the ground or a surface, shape (B, S) [m]; None for two bodies.
            nearby: What is near of a surface.
            some: The bodies of the items that may touch (b).
            items: Indices of these items; None for all.
            step_s: Step [s], shape (b,).
        """
        a, b = self.pairs[number]
        if gaps is None:
            return body_points(some[a], some[b], step_s, self.sharpness_per_m)
        near = take(gaps, items)
        most = int((near < ROUNDING_M).sum(1).max())
        slots = near.topk(most, dim=1, largest=False, sorted=False).indices
        reached = near.gather(1, slots) < ROUNDING_M
        surface = self.world.surface(b)
        if surface is None or nearby is None:
            return ground_points(_on(self.world, items), some[a], slots, reached)
        return surface_points(some[a], _selected(surface, items), nearby.at(items), slots, reached)

    def _result(
        self, found: tuple[int, Points, Touch, Tensor], impulse: Impulses, items: Tensor | None
    ) -> PairImpulses:
        """Return the impulses of a pair in the world, from those along its axes."""
        number, points, touch, axes = found
        a, b = self.pairs[number]
        angular = None if impulse.angular is None else (impulse.angular[..., None, :] @ axes).squeeze(-2).sum(1)
        friction = touch.friction
        if touch.anisotropy is not None:
            friction = Ellipse.of(friction, touch.anisotropy).along(impulse.linear[..., 1:])
        return PairImpulses(
            pair=number,
            a=a,
            b=b,
            free=(True, b >= 0 and self.world.moves(b)),
            items=items,
            points=points,
            impulse_n_s=(impulse.linear[..., None, :] @ axes).squeeze(-2),
            along_axes_n_s=impulse.linear,
            angular_n_m_s=angular,
            friction=friction,
        )

    def _joints_alone(self) -> list[PairImpulses]:
        """Solve the impulses of the joints of chains that nothing touches."""
        if self.chains:
            self._solve([], [])
        return []

    def _solve(self, groups: list[ContactGroup], warm: Sequence[Tensor | None]) -> list[Impulses]:
        rows = [chain.rows for chain in self.chains if chain.rows is not None and any(chain.rows.active)]
        rubbing = [chain for chain in self.chains if chain.rows is not None and any(chain.rows.active)]
        iterations = self.world.iterations
        old = [chain.impulses if iterations > 1 else None for chain in rubbing]
        found, rubbed = solve_with_joints(groups, iterations, warm, rows, old, not self.chains)
        for chain, impulses in zip(rubbing, rubbed, strict=True):
            chain.impulses = impulses
        return found

    def _candidates(
        self, placed: Sequence[Placed], step_s: Tensor
    ) -> dict[int, tuple[Tensor, Tensor | None, Nearby | None]]:
        """Return by pair which items (B,) may touch and, for ground and surfaces, the gap of each slot (B, S) [m]."""
        found: dict[int, tuple[Tensor, Tensor | None, Nearby | None]] = {}
        for number, (a, b) in enumerate(self.pairs):
            surface, nearby = self.world.surface(b), None
            if surface is not None:
                nearby = near_surface(placed[a], surface, step_s)
                if nearby is None:
                    continue
                depth, touching = nearby.depth, (nearby.depth < ROUNDING_M).any(1)
            elif b == GROUND:
                depth = near_ground(self.world, placed[a], step_s)
                touching = (depth < ROUNDING_M).any(1)
            else:
                depth, touching = None, near_body(placed[a], placed[b], step_s, self.sharpness_per_m)
            if bool(touching.any()):
                found[number] = (touching, depth, nearby)
        return found

    def _touch(
        self,
        points: Points,
        a: Placed,
        b: Placed | None,
        law: ContactLaw | PaperLaw,
        h: Tensor,
        items: Tensor | None,
        ground: bool,
    ) -> tuple[Touch, Tensor]:
        velocity, spin = a.point_velocity(points.position), a.omega
        if b is not None:
            velocity, spin = velocity - b.point_velocity(points.position), spin - b.omega
        if ground:
            axes = self._ground_axes.expand(*points.gap.shape, 3, 3)
        else:
            axes = tangent_axes(points.normal)
        friction = take(law.friction, items)[:, None]
        if isinstance(law, ContactLaw):
            time, ratio = (take(x, items)[:, None] for x in (law.contact_time_s, law.damping_ratio))
        else:
            time = ratio = torch.full_like(friction, torch.nan)  # the paper's law has other coefficients
        touch = Touch(
            ground=ground,
            position=points.position,
            normal=points.normal,
            gap=points.gap,
            velocity=velocity,
            spin_rad_s=spin,
            step_s=h[:, None],
            friction=friction,
            contact_time_s=time,
            damping_ratio=ratio,
            area=_areas(a.body, points) if ground else None,
        )
        for active in self.effects:
            changed = active.effect.contact(active.at(items), touch)
            if isinstance(law, PaperLaw) and not _only_friction(touch, changed):
                raise UsageError(
                    f"the effect '{active.effect.name}' changes what the published contact law does not have.",
                    "effects on the friction coefficient.",
                    "use the contact law closed_form with this effect.",
                )
            touch = changed
        if self.effects:
            touch = replace(
                touch, friction=touch.friction.clamp_min(0.0)
            )  # no sum of effects accelerates a sliding body
        return touch, axes

    def _impulses(
        self,
        found: list[tuple[int, Points, Touch, Tensor]],
        placed: Sequence[Placed],
        items: Tensor | None,
        warm: Sequence[Tensor | None],
    ) -> list[Impulses]:
        law = self.world.contact
        if isinstance(law, PaperLaw):
            law = replace(
                law, contact_time_s=take(law.contact_time_s, items), damping_ratio=take(law.damping_ratio, items)
            )
            return [Impulses(paper_impulses(law, touch, axes)) for _, _, touch, axes in found]
        groups = []
        for number, points, touch, axes in found:
            sides = []
            for index, sign in zip(self.pairs[number], (1.0, -1.0), strict=True):
                if index < 0 or not self.world.moves(index):
                    continue
                inertia, body = self.inertias[index], placed[index]
                arms = points.position - body.reference[:, None]
                if index in self.links:
                    chain, link = self.links[index]
                    sides.append(chain.contact_rows(link, sign, arms, axes))
                else:
                    root = body.rotation @ take(inertia.root, items)
                    sides.append(Rows.of(index, sign, arms, axes, take(inertia.mass, items).rsqrt(), root))
            groups.append(ContactGroup.of(touch, axes, tuple(sides)))
        return self._solve(groups, warm)

    def _warm(
        self,
        found: list[tuple[int, Points, Touch, Tensor]],
        items: Tensor | None,
        before: Sequence[PairImpulses],
        batch: int,
    ) -> list[Tensor | None]:
        """Return the impulses of the previous step along the axes (n, C, 3) [N s] for each pair; None for zero."""
        old = (
            {pair.pair: pair for pair in before} if self.world.iterations > 1 else {}
        )  # one iteration is the closed form
        warm: list[Tensor | None] = []
        for number, points, _, _ in found:
            if number in old:
                slots = slot_count(self.world, self.pairs[number])
                given = old[number].at(points.slot, items, slots, batch)
                warm.append(points.near[..., None] * given)
            else:
                warm.append(None)
        return warm


def _areas(body: Body, points: Points) -> Tensor | None:
    """Return the areas (n, C) of points on the ground; None where all count alike."""
    areas = body.plane_areas
    return None if areas is None else areas[points.slot]


def _only_friction(before: Touch, after: Touch) -> bool:
    """Return whether an effect changed only the friction of a contact."""
    names = set(Touch.__dataclass_fields__) - {"friction"}
    return all(getattr(before, name) is getattr(after, name) for name in names)


def take(x: Tensor, items: Tensor | None) -> Tensor:
    """Return some items (n, ...) of a tensor (B, ...); the whole tensor for None or for a batch of 1."""
    return x if items is None or x.shape[0] == 1 else x.index_select(0, items)


def put(x: Tensor, items: Tensor | None, batch: int) -> Tensor:
    """Return a tensor (B, ...) with x (n, ...) at the items, zero elsewhere."""
    if items is None:
        return x
    return torch.zeros(batch, *x.shape[1:], dtype=x.dtype, device=x.device).index_copy(0, items, x)


def _union(touching: Sequence[Tensor]) -> Tensor | None:
    """Return the items (n,) with any contact; None where more than 80 % have one, as selecting them costs more."""
    found = torch.stack(list(touching)).any(0)
    items = found.nonzero().squeeze(1)
    return None if len(items) > 0.8 * len(found) else items


def _select(placed: Placed, items: Tensor | None) -> Placed:
    if items is None:
        return placed
    body = placed.body
    names = ("mass", "inertia", "com", "centers", "radii")
    some = replace(body, **{name: take(getattr(body, name), items) for name in names})
    return Placed(some, *(take(x, items) for x in (placed.reference, placed.rotation, placed.velocity, placed.omega)))


def _selected(surface: FixedSurface, items: Tensor | None) -> FixedSurface:
    position, quat, size = (take(x, items) for x in surface.tensors)
    return replace(surface, position=position, quat_wxyz=quat, size=size)


def _on(world: World, items: Tensor | None) -> World:
    return replace(world, ground_offset=take(world.ground[1], items))
