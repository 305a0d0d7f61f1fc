"""Layout of a world, its initial state and its commands as the input arrays of a fused kernel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..body import Body
from ..chains.joint_command import JointCommand
from ..contact_detection import GROUND, edge_slots, pairs_of, slot_count
from ..contact_law import ContactLaw, coefficients
from ..kinematic import Drive
from ..pair_laws import laws_in_use
from ..paper_law import PaperLaw
from ..rigid_body import start
from ..rollout import rows_of_times
from ..state import State
from ..surfaces.fixed_surface import HALF_SPACE, FixedSurface
from ..world import World
from . import tree, wrenches
from .commands import Commands
from .layout import in_frame, joined, quat_in_frame, upright
from .meshes import PackedMeshes, packed_meshes
from .structure import SURFACE_WIDTH, Structure

if TYPE_CHECKING:
    from ....datasets.capture.tracks import Track

MOST_CONTACTS = 16_384
"""Maximum number of possible contacts of an environment."""
_PLANES, _NO_PLANE_M = 8, 1e30
"""Faces of a hull that are compared at once, and the distance of those that are added to fill the last ones [m]."""


@dataclass(frozen=True, kw_only=True)
class Packed:
    """Inputs of a kernel, in the frame whose z axis is the ground's normal; floating-point ones carry derivatives."""

    structure: Structure
    """Constants of the kernel."""
    table: Tensor
    """Values of each environment, shape (B, columns)."""
    steps: Tensor
    """Step [s], stiffness, damping and start time [s] of each interval, then stiffness and damping of each further
    contact law, shape (1 or B, intervals, 2 + 2 laws).
    """
    geometry: Tensor
    """Centres in the body frame and radii of the spheres [m]; then of each hull three rows a face, as `Hull.faces`,
    one row an edge and one a support: the indices of their spheres within the body; of each edge between different
    planes the indices and two vectors, as `Hull.inward`; and the faces again, as in `_hull_rows`; shape
    (1 or B, rows, 4).
    """
    surfaces: Tensor
    """Positions [m], orientations and sizes [m] of the fixed surfaces, shape (1 or B, surfaces, 10)."""
    mesh_numbers: Tensor
    """Numbers of the meshes of surfaces, one after another, shape (N,)."""
    mesh_indices: Tensor
    """Integers of the meshes of surfaces, int32, shape (I,)."""
    drives: Tensor
    """Samples of the commands, shape (1 or B, samples, 14)."""
    substeps: Tensor
    """Steps of each interval, int32, shape (T - 1,)."""
    spheres: Tensor
    """Row of the sphere of each contact, int32, shape (C,)."""
    drive_starts: Tensor
    """First sample of each command, int32, shape (commands,)."""
    drive_last: Tensor
    """Index of the last interval of each command, int32, shape (1 or B, commands)."""
    turn: Tensor | None
    """Rotation from the world into the kernel's frame, quaternion, shape (4,); None where they are equal."""


def reason_against(world: World) -> str | None:
    """Return why the kernel does not support a world on any device; None where it does."""
    tensors = [world.gravity, *(getattr(body, name) for body in world.bodies for name in ("mass", "com", "centers"))]
    kinds = {tensor.dtype for tensor in tensors}
    if len(kinds) > 1 or kinds - {torch.float32, torch.float64}:
        return "its numbers have several types" if len(kinds) > 1 else "its numbers are neither float32 nor float64"
    if not world.bodies:
        return "it has no bodies"
    reason = wrenches.reason_against(world)
    if reason is not None:
        return reason
    contacts = sum(slot_count(world, pair) for pair in pairs_of(world))
    if contacts > MOST_CONTACTS:
        return f"its bodies may have {contacts} contacts, more than {MOST_CONTACTS}"
    return None


def pack(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand],
    record: bool,
) -> Packed:
    """Pack the arguments of `simulate_fused`, for one thread per environment; derivatives flow through.

    The world has been changed by its effects already.

    Raises:
        InputDataError: If a driven body has no track.
    """
    fixed = world.once(_fixed)
    turn = fixed.turn
    times = times_s if times_s.ndim == 2 else times_s[None]
    commands = Commands.of(world, driven, state.position_m.detach(), turn)
    alone = len(state.position_m) == 1 and not torch.is_inference(state.position_m)
    table, steps, counts = world.latest(_begun, state, times_s) if alone else _begun(world, state, times_s)
    batch = max(len(x) for x in (table, fixed.geometry, fixed.surfaces, steps, *commands.tensors))
    return Packed(
        structure=world.once(_Layout(record, tuple(commands.bodies), tuple(commands.chains))),
        table=table.expand(batch, -1),
        steps=steps if len(steps) in (1, batch) else steps.repeat(batch // len(steps), 1, 1),
        geometry=fixed.geometry,
        surfaces=fixed.surfaces,
        mesh_numbers=fixed.meshes.numbers.to(times),
        mesh_indices=fixed.meshes.indices.to(times.device),
        drives=commands.samples(times),
        substeps=counts,
        spheres=fixed.spheres,
        drive_starts=commands.starts(times),
        drive_last=commands.last(counts),
        turn=turn,
    )


def _begun(world: World, state: State, times_s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return `Packed.table` (1 or B, columns), `Packed.steps` and `Packed.substeps`: what no command changes."""
    fixed = world.once(_fixed)
    columns = _columns(world, state, fixed.turn, fixed.structure.turned, fixed.effects)
    batch = max(map(len, columns))
    table = torch.cat([column.expand(batch, column.shape[-1]) for column in columns], -1)
    return table, *(_paced(world, times_s) if torch.is_inference(times_s) else world.latest(_paced, times_s))


def _paced(world: World, times_s: Tensor) -> tuple[Tensor, Tensor]:
    """Return `Packed.steps` and `Packed.substeps`."""
    times = times_s if times_s.ndim == 2 else times_s[None]
    counts = torch.tensor(world.substeps(times), dtype=torch.int32, device=times.device)
    return _steps(world.once(laws_in_use).laws, times, counts), counts


@dataclass(frozen=True)
class _Layout:
    """Returns the constants of the kernel for a world and its commands."""

    record: bool
    """Whether contacts are recorded."""
    bodies: tuple[int, ...]
    """Bodies with a command."""
    chains: tuple[int, ...]
    """Chains with a command."""

    def __call__(self, world: World) -> Structure:
        return replace(
            world.once(_fixed).structure,
            record=self.record,
            drives=tuple(self.bodies.index(k) if k in self.bodies else -1 for k in range(len(world.bodies))),
            tree=tree.tree_of(world, len(self.bodies), self.chains) if world.chains else None,
        )


@dataclass(frozen=True, kw_only=True)
class _Fixed:
    """What of the inputs depends on the world alone."""

    turn: Tensor | None
    """As in `Packed`."""
    effects: list[Tensor]
    """Columns of the effects' coefficients."""
    geometry: Tensor
    """As in `Packed`."""
    surfaces: Tensor
    """As in `Packed`."""
    spheres: Tensor
    """As in `Packed`."""
    meshes: PackedMeshes
    """Meshes of the surfaces."""
    structure: Structure
    """Constants of the kernel, for one thread per environment, without records, commands, chains and derivatives."""


def _fixed(world: World) -> _Fixed:
    turn = None if world.ground_normal is None else upright(world.ground_normal)
    hulls = [row for body in world.bodies for row in body.once(_hull_rows)]
    surfaces = [_surface(surface, turn) for surface in world.surfaces]
    listed, lowest = _listed_spheres(world)
    effects, meshes = wrenches.coefficients(world), packed_meshes(world.surfaces, _largest_sphere(world))
    published = isinstance(world.contact, PaperLaw)  # the directions of its rows are chosen in the world's frame
    turned = turn is not None and (published or len(world.bodies) > 1 or bool(world.surfaces))
    return _Fixed(
        turn=turn,
        effects=effects,
        geometry=joined([*(body.once(_spheres) for body in world.bodies), *hulls, *_patch_rows(world)]),
        surfaces=joined(surfaces) if surfaces else world.gravity.new_zeros(1, 0, SURFACE_WIDTH),
        spheres=listed,
        meshes=meshes,
        structure=_structure(world, effects=bool(effects), turned=turned, lowest=lowest, mesh_starts=meshes.starts),
    )


def _largest_sphere(world: World) -> float:
    """Return the largest radius of a colliding sphere [m]; 0 without any."""
    return max((float(body.radii.max()) for body in world.bodies if body.radii.shape[-1]), default=0.0)


def _structure(
    world: World,
    *,
    effects: bool,
    turned: bool,
    lowest: tuple[tuple[int, int], ...],
    mesh_starts: tuple[tuple[int, int], ...],
) -> Structure:
    """Return what of the constants of the kernel depends on the world alone.

    Args:
        world: The world.
        effects: Whether effects have coefficients in the table.
        turned: Whether the rotation of the kernel's frame is in the table.
        lowest: First row and number of the candidates for the lowest sphere of each body.
        mesh_starts: First number and index of each surface's mesh.
    """
    return Structure(
        single=world.gravity.dtype == torch.float32,
        dual=False,
        lanes=1,
        record=False,
        effects=effects,
        magnets=wrenches.magnets(world),
        twisted=wrenches.is_twisted(world),
        lifted=wrenches.is_lifted(world),
        turned=turned,
        free=tuple(body.free for body in world.bodies),
        drives=(-1,) * len(world.bodies),
        spheres=tuple(body.radii.shape[-1] for body in world.bodies),
        pairs=tuple((a, b, slot_count(world, (a, b))) for a, b in pairs_of(world)),
        laws=_law_numbers(world),
        hulls=() if isinstance(world.contact, PaperLaw) else _hulls(world),
        areas=() if isinstance(world.contact, PaperLaw) else _area_starts(world),
        lowest=lowest,
        surfaces=tuple(surface.kind for surface in world.surfaces),
        mesh_starts=mesh_starts,
        surface=wrenches.has_surface(world),
        elliptic=wrenches.has_ellipse(world),
        published=world.contact.directions if isinstance(world.contact, PaperLaw) else 0,
    )


def _law_numbers(world: World) -> tuple[int, ...]:
    """Return the number of each pair's contact law; none where all are the same."""
    numbers = laws_in_use(world).of_pair
    return numbers if any(numbers) else ()


def _hulls(world: World) -> tuple[tuple[int, int, int, int, int], ...]:
    """Return by body the first row of its hull in the geometry and the numbers of faces, edges, supports and ridges."""
    row, found = sum(body.radii.shape[-1] for body in world.bodies), []
    for body in world.bodies:
        counts = (0, 0, 0, 0)
        if body.hull is not None:
            hull = body.hull
            counts = (len(hull.faces), len(hull.edges), len(hull.supports), len(hull.ridges))
        found.append((row, *counts))
        row += _hull_size(*counts)
    return tuple(found)


def _hull_size(faces: int, edges: int, supports: int, ridges: int) -> int:
    """Return the number of rows of a hull in the geometry, as in `_hull_rows`."""
    return 3 * faces + edges + supports + 3 * (ridges + _PLANES * -(-faces // _PLANES))


def _steps(laws: Sequence[ContactLaw | PaperLaw], times: Tensor, substeps: Tensor) -> Tensor:
    """Return the rows of `Packed.steps` (1 or B, intervals, 2 + 2 laws); one row where there is no interval."""
    if times.shape[1] == 1:
        zero = torch.zeros_like(times)
        further = zero.expand(times.shape[0], 2 * len(laws) - 2)
        return torch.cat((zero.expand(times.shape[0], 3), times, further), -1)[:, None]
    time, ratio = (
        torch.stack(torch.broadcast_tensors(*(getattr(law, name) for law in laws)), -1)[:, None]
        for name in ("contact_time_s", "damping_ratio")
    )
    times = rows_of_times(times, max(len(time), len(ratio)))
    h = times.diff(dim=1) / substeps
    if isinstance(laws[0], PaperLaw):
        numbers = torch.broadcast_tensors(laws[0].stiffness_n_m, laws[0].damping_n_s_m)
        each = torch.stack(numbers, -1)[:, None, None].expand(-1, h.shape[1], -1, -1)
    else:
        each = torch.stack(coefficients(time, ratio, h[..., None]), -1)
    parts = (h[..., None], each[..., 0, :], times[:, :-1, None], each[..., 1:, :].flatten(-2))
    batch = max(map(len, parts))
    return torch.cat([part.expand(batch, -1, -1) for part in parts], -1)


def _columns(world: World, state: State, turn: Tensor | None, turned: bool, effects: list[Tensor]) -> list[Tensor]:
    """Return the columns of the table: first those of the world, then those of each body."""
    zero = torch.zeros_like(world.gravity[:, :1])
    offset = zero if world.ground_offset is None else world.ground_offset[:, None]
    columns = [in_frame(turn, world.gravity), offset]
    columns += [law.friction[:, None] for law in world.once(laws_in_use).laws]
    if turned and turn is not None:
        columns.append(turn[None])
    if isinstance(world.contact, PaperLaw):
        columns.append(zero.new_tensor([_published_numbers(world.contact)]))
    columns += [in_frame(turn, effect) if effect.shape[-1] == 3 else effect for effect in effects]
    columns += tree.columns(world, state)
    groups = world.once(_groups)
    others = None if all(free for free, _ in groups) else _other_columns(world, state, turn)
    for free, rows in groups:
        if free or others is None:
            columns += [x for index in rows for x in _free_columns(world.bodies[index], index, state, turn)]
        else:
            columns.append(others[:, rows[0] : rows[-1] + 1].flatten(1))
    return columns


def _published_numbers(law: PaperLaw) -> list[float]:
    """Return the numbers of `Published` in `kernels/environment.cuh`; 0 for none."""
    soft = 0.0 if math.isinf(law.softplus_per_n) else law.softplus_per_n
    clamp = (law.clamp_depth_m or 0.0, law.clamp_per_m or 0.0, law.zero_m)
    return [soft, law.sharpness_per_m or 0.0, *clamp]


def _groups(world: World) -> list[tuple[bool, list[int]]]:
    """Return the indices of bodies that follow one another and are free, or are not, and whether they are."""
    free = [body.free for body in world.bodies]
    return [(kind, [*rows]) for kind, rows in groupby(range(len(free)), free.__getitem__)]


def _free_columns(body: Body, index: int, state: State, turn: Tensor | None) -> list[Tensor]:
    """Return the columns of a free body: those of its weight, and its motion."""
    motion = start(body, *(part[:, index] for part in state.tensors))
    moving = (in_frame(turn, x) for x in (motion.velocity, motion.spin))
    pose = in_frame(turn, motion.com), quat_in_frame(turn, motion.quat_wxyz)
    return [*body.once(_weight), *pose, *moving]


def _weight(body: Body) -> list[Tensor]:
    """Return the columns of a body's inverse mass and inertia and its centre of mass."""
    inverse = torch.linalg.inv(body.inertia).flatten(1)
    inertia = torch.cat([inverse[:, k : k + 1] for k in (0, 4, 8, 1, 2, 5)], -1)
    return [body.mass.reciprocal()[:, None], inertia, body.com]


def _other_columns(world: World, state: State, turn: Tensor | None) -> Tensor:
    """Return the columns (B, bodies, columns) that each body has if it is not free: no mass, and its pose."""
    position, quat = in_frame(turn, state.position_m), quat_in_frame(turn, state.quat_wxyz)
    massless, still = position.new_zeros(*position.shape[:2], 10), position.new_zeros(*position.shape[:2], 6)
    for index in tree.free_roots(world):
        motion = (in_frame(turn, x) for x in tree.root_motion(index, state))
        still = torch.cat((still[:, :index], torch.cat((*motion,), -1)[:, None], still[:, index + 1 :]), 1)
    return torch.cat((massless, position, quat, still), -1)


def _spheres(body: Body) -> Tensor:
    """Return centres and radii (1 or B, N, 4) [m]; effects may give each item other centres with common radii."""
    batch = max(body.centers.shape[0], body.radii.shape[0])
    return torch.cat((body.centers.expand(batch, -1, -1), body.radii.expand(batch, -1)[..., None]), -1)


def _surface(surface: FixedSurface, turn: Tensor | None) -> Tensor:
    """Return pose in the kernel's frame and size of a surface, shape (1 or B, 1, 10)."""
    parts = (in_frame(turn, surface.position), quat_in_frame(turn, surface.quat_wxyz), surface.size)
    batch = max(part.shape[0] for part in parts)
    return torch.cat([part.expand(batch, -1) for part in parts], -1)[:, None]


def _hull_rows(body: Body) -> list[Tensor]:
    """Return the rows of faces, edges, supports and ridges of a body's hull (1, rows, 4); none without a hull.

    The numbers of the faces follow once more, the first of all faces, then the second of all, as vectors of a processor
    take them; faces that are added to whole vectors have no normal and are never the highest.
    """
    hull = body.hull
    if hull is None:
        return []

    def rows(x: Tensor) -> Tensor:
        return torch.nn.functional.pad(x, (0, 4 - x.shape[-1])).to(hull.faces)

    ridges = torch.cat((rows(hull.ridges)[:, None], rows(hull.inward)), 1)
    planes = torch.nn.functional.pad(hull.faces.reshape(-1, 12), (0, 0, 0, -len(hull.faces) % _PLANES))
    planes[len(hull.faces) :, 3] = _NO_PLANE_M
    parts = (hull.faces, rows(hull.edges), rows(hull.supports[:, None]), ridges, planes.T)
    return [part.reshape(1, -1, 4) for part in parts]


def _patch_rows(world: World) -> list[Tensor]:
    """Return the rows of the patches (1 or B, rows, 4), as in `_patch_starts`: of each body its points, then areas."""
    found = []
    for body in world.bodies:
        areas = body.plane_areas
        if body.patch is None or areas is None:
            continue
        points, sizes = body.patch.centers(body.centers), body.patch.radii(body.radii)
        batch = max(points.shape[0], sizes.shape[0])
        found.append(torch.cat((points.expand(batch, -1, -1), sizes.expand(batch, -1)[..., None]), -1))
        found.append(torch.nn.functional.pad(areas, (0, -len(areas) % 4)).reshape(1, -1, 4).to(points))
    return found


def _patch_starts(world: World) -> list[tuple[int, int]]:
    """Return by body the rows of the geometry in which the points of its patches and their areas begin."""
    row, found = sum(body.radii.shape[-1] for body in world.bodies), []
    row += sum(_hull_size(*counts) for _, *counts in _hulls(world))
    for body in world.bodies:
        points = 0 if body.patch is None else len(body.patch.areas)
        areas = body.plane_areas
        found.append((row, row + points))
        row += points + (0 if areas is None else -(-len(areas) // 4))
    return found


def _area_starts(world: World) -> tuple[int, ...]:
    """Return by pair the row in which the areas of its contacts begin, -1 where all count alike; empty for no areas."""
    starts = _patch_starts(world)
    found = [starts[a][1] if b == GROUND and world.bodies[a].patch is not None else -1 for a, b in pairs_of(world)]
    return tuple(found) if any(start >= 0 for start in found) else ()


def _listed_spheres(world: World) -> tuple[Tensor, tuple[tuple[int, int], ...]]:
    """Return the row of the sphere of each contact (C,), and the place in it of the candidates for each lowest sphere.

    A place is a first row and a number of rows; there are none if no effect depends on heights.
    """
    starts = [sum(body.radii.shape[-1] for body in world.bodies[:index]) for index in range(len(world.bodies))]
    listed = _contact_spheres(world, starts)
    return _with_lowest(world, starts, listed) if wrenches.takes_heights(world) else (listed, ())


def _contact_spheres(world: World, starts: list[int]) -> Tensor:
    """Return the row of the sphere of each contact, shape (C,)."""
    parts = [torch.zeros(0, dtype=torch.int64, device=world.gravity.device)]
    for a, b in pairs_of(world):
        if b == GROUND:
            parts.append(_plane_rows(world, a, starts[a]))
            continue
        surface = world.surface(b)
        plane = surface is not None and surface.kind == HALF_SPACE
        for index in (a,) if b < 0 else (b, a):
            rows = _rows(world.bodies[index], world.bodies[a].on_plane if plane else None, starts[index])
            parts.append(rows if surface is None else rows.repeat_interleave(surface.contacts_per_sphere))
        if b >= 0:  # contacts of edges have no sphere
            parts.append(torch.zeros_like(parts[-1][:1]).repeat(edge_slots(world.bodies[a], world.bodies[b])))
    return torch.cat(parts).to(torch.int32)


def _plane_rows(world: World, index: int, start: int) -> Tensor:
    """Return the rows of what the ground can touch of a body, in the order of `Body.plane_spheres`."""
    body = world.bodies[index]
    rows = _rows(body, body.on_plane, start)
    if body.patch is None:
        return rows
    points = torch.arange(len(body.patch.areas), device=rows.device) + _patch_starts(world)[index][0]
    return torch.cat((rows, points))


def _rows(body: Body, chosen: Tensor | None, start: int) -> Tensor:
    every = torch.arange(body.radii.shape[-1], device=body.radii.device)
    return (every if chosen is None else chosen) + start


def _with_lowest(world: World, starts: list[int], listed: Tensor) -> tuple[Tensor, tuple[tuple[int, int], ...]]:
    """Return the list of spheres with candidates for the lowest one of each body, and their first row and number.

    The candidates are the spheres that can touch the ground; those of bodies without contact are appended.
    """
    pairs, lowest, begin = pairs_of(world), [], 0
    within = {}
    for pair in pairs:
        count = slot_count(world, pair)
        if pair[1] == GROUND:
            within[pair[0]] = (begin, count)
        begin += count
    for index, body in enumerate(world.bodies):
        if index in within or not body.free or world.ground_normal is None:
            lowest.append(within.get(index, (0, 0)))
            continue
        rows = _plane_rows(world, index, starts[index]).to(torch.int32)
        lowest.append((len(listed), len(rows)))
        listed = torch.cat((listed, rows))
    return listed, tuple(lowest)
