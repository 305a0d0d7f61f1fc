"""Rollouts: the world stepped through time, batched, from given initial states."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ...schemas import InputDataError
from .contact import ContactGroup, Side
from .distance import union_distance
from .driven import Drive
from .motion import Inertia, Motion, advance, finish, start
from .rotation import cross, quat_to_matrix
from .world import Body, State, World

if TYPE_CHECKING:
    from ...datasets.tracks import Track

PAIR_SMOOTHING_M = 1e-3
"""Width of the smooth minimum in distances between two bodies of spheres [m]."""
ROUNDING_M = 1e-9
"""Spheres this near to touching are kept: their distance is computed anew, in other order."""
FASTEST_M_S = 30.0
"""Bodies whose surfaces are further apart than this speed covers in a step cannot touch in it, and are skipped."""


@dataclass(frozen=True)
class ContactRecord:
    """The contacts of a rollout, summed over the steps since the previous frame.

    body_a (C,), body_b (C,) int, -1 for the ground; impulse_n_s (B, T, C, 3) on body a; position_m (B, T, C, 3);
    normal (B, T, C, 3) from b to a; distance_m (B, T, C), negative where they overlap; sliding (B, T, C) bool. World
    frame.
    """

    body_a: Tensor
    body_b: Tensor
    impulse_n_s: Tensor
    position_m: Tensor
    normal: Tensor
    distance_m: Tensor
    sliding: Tensor


@dataclass(frozen=True)
class Rollout:
    """Poses and velocities at the frames: times_s (T,) or (B, T); the others (B, T, nb, ...) as in `State`."""

    times_s: Tensor
    position_m: Tensor
    quat_wxyz: Tensor
    velocity_m_s: Tensor
    omega_body_rad_s: Tensor
    contacts: ContactRecord | None = None


@dataclass(frozen=True)
class _Group:
    """The contacts between one pair of bodies in one step."""

    a: int
    b: int
    gap: Tensor
    normal: Tensor
    point: Tensor
    impulse: Tensor


def simulate(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive] | None = None,
    record_contacts: bool = False,
) -> Rollout:
    """Roll the world out from `state`, open loop.

    Args:
        world: The world; its tensors and the state's broadcast over the batch B.
        state: The state at the first time; driven and fixed bodies take theirs from `driven` or keep it.
        times_s: Frame times [s], increasing, shape (T,) or (B, T).
        driven: The command of each driven body: a track, or a prepared `Drive`.
        record_contacts: Whether to keep the contacts of every frame.

    Returns:
        The rollout at the frame times.

    Raises:
        InputDataError: If a driven body has no track.
    """
    engine = _Engine(world, state, times_s, driven or {}, record_contacts)
    motions = engine.begin(state)
    frames = [engine.frame(motions)]
    records = [engine.record([], motions)] if record_contacts else []
    for interval in range(1, times_s.shape[-1]):
        groups: list[list[_Group]] = []
        for substep in range(engine.substeps[interval - 1]):
            motions, touched = engine.step(motions, interval, substep)
            if record_contacts:
                groups.append(touched)
        frames.append(engine.frame(motions))
        if record_contacts:
            records.append(engine.record(groups, motions))
    position, quat, velocity, omega = (torch.stack([frame[k] for frame in frames], 1) for k in range(4))
    contacts = engine.contacts(records) if record_contacts else None
    return Rollout(times_s, position, quat, velocity, omega, contacts)


class _Engine:
    """The constants of one rollout, and its step."""

    def __init__(
        self,
        world: World,
        state: State,
        times_s: Tensor,
        driven: Mapping[str, Track | Drive],
        every_contact: bool = False,
    ) -> None:
        self.world = world
        self.every_contact = every_contact  # a record of contacts names those that do not touch, too
        self.inertias = [Inertia.of(body) for body in world.bodies]
        self.times = times_s if times_s.ndim == 2 else times_s[None]
        self.lengths = self.times.diff(dim=1)
        longest = self.lengths.amax(0).tolist()
        self.substeps = [max(1, math.ceil(length / world.step_s - 1e-6)) for length in longest]
        self.pairs = contact_pairs(world)
        self.drives: dict[int, Drive] = {}
        for index, body in enumerate(world.bodies):
            if body.motion == "driven":
                if body.name not in driven:
                    raise InputDataError(
                        f"the driven body '{body.name}' has no track in this episode; its track is its command.",
                        todo=f"add rows for '{body.name}' to the episode's tracks file.",
                    )
                command = driven[body.name]
                like = state.position_m.detach()
                self.drives[index] = command if isinstance(command, Drive) else Drive.of([command], like)

    def begin(self, state: State) -> list[Motion]:
        motions = []
        for index, body in enumerate(self.world.bodies):
            position, quat, velocity = (x[:, index] for x in (state.position_m, state.quat_wxyz, state.velocity_m_s))
            if index in self.drives:
                motions.append(self.drives[index].at(self.times[:, 0]))
            elif body.free:
                motions.append(start(body, position, quat, velocity, state.omega_body_rad_s[:, index]))
            else:
                motions.append(Motion(position, quat, torch.zeros_like(position), torch.zeros_like(position)))
        return motions

    def step(self, motions: list[Motion], interval: int, substep: int) -> tuple[list[Motion], list[_Group]]:
        count = self.substeps[interval - 1]
        h = self.lengths[:, interval - 1] / count
        gravity = self.world.gravity
        # free velocities: gravity acts, angular momentum stays
        ahead = [
            Motion(m.com, m.quat_wxyz, m.velocity + h[:, None] * gravity, m.spin) if body.free else m
            for body, m in zip(self.world.bodies, motions, strict=True)
        ]
        rotations = [quat_to_matrix(m.quat_wxyz) for m in motions]
        groups = self._contacts(ahead, rotations, h)
        velocity, spin = self._after(ahead, groups)
        moved = []
        for index, body in enumerate(self.world.bodies):
            if body.free:
                moved.append(advance(self.inertias[index], motions[index], velocity[index], spin[index], h))
            elif index in self.drives:
                moved.append(self.drives[index].at(self.times[:, interval - 1] + (substep + 1) * h))
            else:
                moved.append(motions[index])
        return moved, groups

    def _contacts(self, motions: list[Motion], rotations: list[Tensor], h: Tensor) -> list[_Group]:
        """Return the contacts of a step with their impulses: the closed form, then further sweeps where wanted."""
        paired = {index for a, b in self.pairs if b >= 0 for index in (a, b)}
        centers = {index: self._centers(index, motions[index], rotations[index]) for index in paired}
        groups: list[_Group] = []
        prepared: dict[int, tuple[ContactGroup, Side, Side | None]] = {}
        for a, b in self.pairs:
            if b < 0:
                touching = self._on_plane(a, motions[a]) if self.every_contact else None
                if not self.every_contact:
                    touching = self._touch_ground(a, motions[a], rotations[a], h)
                    if touching is None:
                        continue
                near = {a: self._centers(a, motions[a], rotations[a], touching)}
                gap, normal, point = self._geometry(a, b, near, touching)
            else:
                gap, normal, point = self._geometry(a, b, centers)
            if float(gap.detach().amin()) > FASTEST_M_S * float(h.detach().amax()):
                groups.append(_Group(a, b, gap, normal, point, torch.zeros_like(point)))
                continue
            side_a = self._side(a, motions[a], rotations[a], point)
            side_b = self._side(b, motions[b], rotations[b], point) if b >= 0 else None
            group, impulse = ContactGroup.of(self.world.contact, gap, normal, side_a, side_b, h)
            groups.append(_Group(a, b, gap, normal, point, impulse))
            prepared[len(groups) - 1] = (group, side_a, side_b)
        for _ in range(1, self.world.sweeps if prepared else 1):
            velocity, spin = self._after(motions, groups)
            swept = list(groups)
            for number, (contact, side_a, side_b) in prepared.items():
                group = groups[number]
                relative = side_a.moving(velocity[group.a], spin[group.a]).point_velocity()
                if side_b is not None:
                    relative = relative - side_b.moving(velocity[group.b], spin[group.b]).point_velocity()
                swept[number] = replace(group, impulse=contact.sweep(group.impulse, relative))
            groups = swept
        return groups

    def _after(self, motions: list[Motion], groups: list[_Group]) -> tuple[list[Tensor], list[Tensor]]:
        """Return velocities and angular momenta after the groups' impulses."""
        velocity = [m.velocity for m in motions]
        spin = [m.spin for m in motions]
        for group in groups:
            for index, sign in ((group.a, 1.0), (group.b, -1.0)):
                if index >= 0 and self.world.bodies[index].free:
                    arms = group.point - motions[index].com[:, None]
                    impulse = sign * group.impulse
                    velocity[index] = velocity[index] + impulse.sum(1) / self.inertias[index].mass[:, None]
                    spin[index] = spin[index] + cross(arms, impulse).sum(1)
        return velocity, spin

    def _touch_ground(self, index: int, motion: Motion, rotation: Tensor, h: Tensor) -> Tensor | None:
        """Return which spheres (B, K) of a body touch the ground, as many for each item as any has; None for none.

        The others get no impulse (`ContactGroup.of` gives them no target) and have no part in the crowding, so that
        leaving them out changes nothing. Heights and their rates are products in the body frame, without derivatives:
        n . (R r) = (R^T n) . r and n . (omega x R r) = (R^T (n x omega)) . r.
        """
        body, normal, offset = self.world.bodies[index], self.world.ground_normal, self.world.ground_offset
        assert normal is not None and offset is not None  # a pair with the ground exists only with one
        with torch.no_grad():
            values = (rotation, motion.com, motion.velocity, motion.spin, self.inertias[index].root, body.com, offset)
            rotation, com, velocity, spin, root, body_com, offset = (_plain(value) for value in values)
            root = rotation @ root
            omega = (root @ (root.transpose(-1, -2) @ spin[..., None])).squeeze(-1)
            arms = _plain(body.centers) - body_com[:, None]
            axes = torch.stack((normal.expand_as(omega), cross(normal.expand_as(omega), omega)), -1)
            height, rate = _along(arms, rotation.transpose(-1, -2) @ axes).unbind(-1)
            gap = height + (com @ normal - offset)[:, None] - _plain(body.radii)
            depth = torch.minimum(gap, gap + _plain(h)[:, None] * (rate + (velocity @ normal)[:, None]))
            if body.on_plane is not None:
                depth = torch.full_like(depth, torch.inf).index_copy(1, body.on_plane, depth[:, body.on_plane])
            most = int((depth < ROUNDING_M).sum(1).max())
            return depth.topk(most, dim=1, largest=False, sorted=False).indices if most else None

    def _on_plane(self, index: int, motion: Motion) -> Tensor | None:
        """Return the spheres (B, K) of a body that the ground can touch; None for all."""
        chosen = self.world.bodies[index].on_plane
        return None if chosen is None else chosen.expand(motion.com.shape[0], -1)

    def _centers(self, index: int, motion: Motion, rotation: Tensor, chosen: Tensor | None = None) -> Tensor:
        body = self.world.bodies[index]
        reference = body.com if body.free else torch.zeros_like(body.com)
        arms = _pick(body.centers - reference[:, None], chosen)
        return motion.com[:, None] + arms @ rotation.transpose(-1, -2)

    def _geometry(
        self, a: int, b: int, centers: Mapping[int, Tensor], chosen: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        body_a = self.world.bodies[a]
        if b < 0:
            normal, offset = self.world.ground_normal, self.world.ground_offset
            assert normal is not None and offset is not None  # a pair with -1 exists only with a ground
            radii = _pick(body_a.radii, chosen)
            gap = centers[a] @ normal - offset[:, None] - radii
            point = centers[a] - radii[..., None] * normal
            return gap, normal.expand_as(point), point
        body_b = self.world.bodies[b]
        distance, outward = union_distance(centers[b], centers[a], body_a.radii, PAIR_SMOOTHING_M)
        gap = distance - body_b.radii
        point = centers[b] - (body_b.radii + 0.5 * gap)[..., None] * outward
        return gap, -outward, point

    def _side(self, index: int, motion: Motion, rotation: Tensor, point: Tensor) -> Side:
        body, inertia = self.world.bodies[index], self.inertias[index]
        arms = point - motion.com[:, None]
        if not body.free:
            zero = torch.zeros_like(motion.com[:, 0])
            return Side(motion.velocity, motion.spin, zero, torch.zeros_like(rotation), arms)
        still = Side(motion.velocity, motion.spin, 1 / inertia.mass, rotation @ inertia.root, arms)
        return still.moving(motion.velocity, motion.spin)

    def frame(self, motions: list[Motion]) -> tuple[Tensor, ...]:
        columns = []
        for index, (body, motion) in enumerate(zip(self.world.bodies, motions, strict=True)):
            if body.free:
                columns.append(finish(body, self.inertias[index], motion))
            else:
                omega = (quat_to_matrix(motion.quat_wxyz).transpose(-1, -2) @ motion.spin[..., None]).squeeze(-1)
                columns.append((motion.com, motion.quat_wxyz, motion.velocity, omega))
        batch = max(value.shape[0] for column in columns for value in column)
        return tuple(
            torch.stack([column[k].expand(batch, column[k].shape[-1]) for column in columns], 1) for k in range(4)
        )

    def record(self, steps: list[list[_Group]], motions: list[Motion]) -> tuple[Tensor, ...]:
        """Sum the impulses of an interval; where none acted, tell the geometry at its end."""
        rotations = [quat_to_matrix(m.quat_wxyz) for m in motions]
        centers = {i: self._centers(i, m, r) for i, (m, r) in enumerate(zip(motions, rotations, strict=True))}
        columns = []
        for number, (a, b) in enumerate(self.pairs):
            if b < 0:
                chosen = self._on_plane(a, motions[a])
                near = {a: self._centers(a, motions[a], rotations[a], chosen)}
                gap, normal, point = self._geometry(a, b, near, chosen)
            else:
                gap, normal, point = self._geometry(a, b, centers)
            total = torch.zeros_like(point)
            weighted, weight = torch.zeros_like(point), torch.zeros_like(gap)
            sliding = torch.zeros_like(gap)
            for step in steps:
                group = step[number]
                along = (group.impulse * group.normal).sum(-1)
                across = (group.impulse - along[..., None] * group.normal).square().sum(-1).sqrt()
                total = total + group.impulse
                weighted, weight = weighted + along[..., None] * group.point, weight + along
                slides = across > 0.99 * self.world.contact.friction[:, None] * along
                sliding = sliding + along * slides.to(along.dtype)
            acted = weight > 0
            place = torch.where(acted[..., None], weighted / weight.clamp_min(1e-30)[..., None], point)
            columns.append((total, place, normal, gap, (sliding > 0.5 * weight) & acted))
        if not columns:
            batch = motions[0].com.shape[0] if motions else 1
            empty = self.times.new_zeros((batch, 0))
            vector = self.times.new_zeros((batch, 0, 3))
            return vector, vector, vector, empty, empty.bool()
        return tuple(torch.cat([column[k] for column in columns], 1) for k in range(5))

    def contacts(self, records: list[tuple[Tensor, ...]]) -> ContactRecord:
        counts = [self._count(a, b) for a, b in self.pairs]
        body_a = torch.tensor([a for (a, _), n in zip(self.pairs, counts, strict=True) for _ in range(n)])
        body_b = torch.tensor([b for (_, b), n in zip(self.pairs, counts, strict=True) for _ in range(n)])
        return ContactRecord(body_a, body_b, *(torch.stack([r[k] for r in records], 1) for k in range(5)))

    def _count(self, a: int, b: int) -> int:
        body = self.world.bodies[a if b < 0 else b]
        return body.radii.shape[-1] if b >= 0 or body.on_plane is None else len(body.on_plane)


def _plain(value: Tensor) -> Tensor:
    """Return a tensor without its derivatives, forward or backward."""
    return forward_ad.unpack_dual(value).primal.detach()


def _along(arms: Tensor, axes: Tensor) -> Tensor:
    """Return the components (B, N, 2) of arms (1 or B, N, 3) along axes (B, 3, 2)."""
    if arms.shape[0] > 1:
        return arms @ axes
    return (arms[0] @ axes.transpose(0, 1).flatten(1)).unflatten(1, (-1, 2)).transpose(0, 1)


def _pick(values: Tensor, chosen: Tensor | None) -> Tensor:
    """Return the chosen spheres (B, K, ...) of values (1 or B, N, ...); all for None."""
    if chosen is None:
        return values
    if values.ndim == 3:
        chosen = chosen[..., None].expand(-1, -1, values.shape[-1])
    return values.expand(chosen.shape[0], *values.shape[1:]).gather(1, chosen)


def contact_pairs(world: World) -> list[tuple[int, int]]:
    """Return the pairs of bodies that can touch: each free body with the ground (-1) and with every other body.

    The body with more spheres comes first: its union is the surface that the other's spheres touch.
    """
    pairs = []
    bodies = world.bodies
    for index, body in enumerate(bodies):
        if body.free and world.ground_normal is not None:
            pairs.append((index, -1))
    for i, first in enumerate(bodies):
        for j in range(i + 1, len(bodies)):
            if first.free or bodies[j].free:
                more = _sphere_count(first) >= _sphere_count(bodies[j])
                pairs.append((i, j) if more else (j, i))
    return pairs


def _sphere_count(body: Body) -> int:
    return body.radii.shape[-1]
