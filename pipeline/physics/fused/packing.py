"""A world, its start and its commands as the arrays that a fused kernel reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..contact import ContactLaw, coefficients
from ..detection import GROUND, pairs_of, slot_count
from ..driven import Drive
from ..motion import start
from ..rotation import quat_multiply, quat_normalize, quat_rotate
from ..world import Body, State, World
from . import wrenches
from .structure import Structure

if TYPE_CHECKING:
    from ....datasets.tracks import Track

MOST_CONTACTS = 4096


@dataclass(frozen=True)
class Packed:
    """The inputs of a kernel, in the frame whose z axis is the ground's normal.

    table, steps, geometry, drives: as `Problem` in the source names them; they carry the derivatives. substeps
    (T - 1,), spheres (C,), drive_starts, drive_last: int32. turn (4,): the rotation from the world into that frame;
    None where they are one.
    """

    structure: Structure
    table: Tensor
    steps: Tensor
    geometry: Tensor
    drives: Tensor
    substeps: Tensor
    spheres: Tensor
    drive_starts: Tensor
    drive_last: Tensor
    turn: Tensor | None


def reason_against(world: World) -> str | None:
    """Return why no kernel can take a world, on any device; None where one can."""
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
    driven: Mapping[str, Track | Drive],
    record: bool,
) -> Packed:
    """Lay out the arguments of `simulate_fused`, for one thread and no derivative; derivatives flow through.

    The effects have changed the world already.

    Raises:
        InputDataError: If a driven body has no track.
    """
    turn = None if world.ground_normal is None else _upright(world.ground_normal)
    times = times_s if times_s.ndim == 2 else times_s[None]
    like = state.position_m.detach()
    rows = {index: drive_rows(Drive.command(body.name, driven, like), turn) for index, body in enumerate(world.bodies)
            if body.motion == "driven"}  # fmt: skip
    effects = wrenches.coefficients(world)
    turned = turn is not None and len(world.bodies) > 1
    columns = _columns(world, state, turn, turned, effects)
    spheres = [_spheres(body) for body in world.bodies]
    law, substeps = world.contact, world.substeps(times)
    assert isinstance(law, ContactLaw)  # see reason_against
    numbers = torch.tensor(substeps, dtype=torch.int32, device=times.device)
    steps = _steps(law, times, numbers)
    batch = max(
        x.shape[0]
        for x in (*columns, *spheres, steps, *(x for row in rows.values() for x in row))
    )  # fmt: skip
    pairs = tuple((a, b, slot_count(world, (a, b))) for a, b in pairs_of(world))
    single = world.gravity.dtype == torch.float32
    starts = [sum(body.radii.shape[-1] for body in world.bodies[:index]) for index in range(len(world.bodies))]
    listed, lowest = _contact_spheres(world, starts), ()
    if wrenches.takes_heights(world):
        listed, lowest = _with_lowest(world, starts, listed)
    structure = Structure(
        single, False, 1, record, bool(effects), wrenches.magnets(world), wrenches.is_twisted(world), turned,
        tuple(body.free for body in world.bodies),
        tuple(list(rows).index(index) if index in rows else -1 for index in range(len(world.bodies))),
        tuple(body.radii.shape[-1] for body in world.bodies), pairs, lowest,
        surface=wrenches.has_surface(world), elliptic=wrenches.has_ellipse(world),
    )  # fmt: skip
    return Packed(
        structure,
        torch.cat([column.expand(batch, column.shape[-1]) for column in columns], -1),
        steps,
        _joined(spheres, batch),
        _joined([row for row, _ in rows.values()], batch) if rows else times.new_zeros(1, 0, 14),
        numbers,
        listed,
        _drive_starts(rows, times),
        _joined([last[:, None] for _, last in rows.values()], batch).to(torch.int32)
        if rows
        else numbers.new_zeros(1, 0),
        turn,
    )


def _steps(law: ContactLaw, times: Tensor, substeps: Tensor) -> Tensor:
    """Return (1 or B, intervals, 4): step, stiffness, damping, time at the start; one row of zeros and time without."""
    if times.shape[1] == 1:
        return torch.cat((torch.zeros_like(times).expand(times.shape[0], 3), times), -1)[:, None]
    h = times.diff(dim=1) / substeps
    stiffness, damping = coefficients(law.contact_time_s[:, None], law.damping_ratio[:, None], h)
    return torch.stack(torch.broadcast_tensors(h, stiffness, damping, times[:, :-1]), -1)


def _columns(world: World, state: State, turn: Tensor | None, turned: bool, effects: list[Tensor]) -> list[Tensor]:
    """Return the columns of the table: those of the world, then those of each body."""
    zero = torch.zeros_like(world.gravity[:, :1])
    offset = zero if world.ground_offset is None else world.ground_offset[:, None]
    columns = [_turned(turn, world.gravity), offset, world.contact.friction[:, None]]
    if turned and turn is not None:
        columns.append(turn[None])
    columns += [_turned(turn, effect) if effect.shape[-1] == 3 else effect for effect in effects]
    for index, body in enumerate(world.bodies):
        position, quat, velocity = (x[:, index] for x in (state.position_m, state.quat_wxyz, state.velocity_m_s))
        still = torch.zeros_like(position)
        if body.free:
            motion = start(body, position, quat, velocity, state.omega_body_rad_s[:, index])
            position, quat, velocity, spin = motion.com, motion.quat_wxyz, motion.velocity, motion.spin
            inverse = torch.linalg.inv(body.inertia).flatten(1)
            inertia = torch.cat([inverse[:, k : k + 1] for k in (0, 4, 8, 1, 2, 5)], -1)
            columns += [body.mass.reciprocal()[:, None], inertia, body.com]
        else:
            velocity, spin = still, still
            columns += [zero, zero.expand(-1, 6), zero.expand(-1, 3)]
        columns += [_turned(turn, position), _turned_quat(turn, quat), _turned(turn, velocity), _turned(turn, spin)]
    return columns


def drive_rows(drive: Drive, turn: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return a command for the kernel: its samples (1 or B, S, 14) and the index of the last interval (1 or B,)."""
    # the velocities go from a sample to the next; the last sample has none
    parts = (
        drive.times_s[..., None], _turned(turn, drive.position_m), _turned_quat(turn, drive.quat_wxyz),
        _turned(turn, drive.velocity_m_s), _turned(turn, drive.omega_world_rad_s),
    )  # fmt: skip
    return torch.cat(parts, -1), drive.last


def _drive_starts(rows: Mapping[int, tuple[Tensor, Tensor]], like: Tensor) -> Tensor:
    lengths = [row.shape[1] for row, _ in rows.values()]
    starts = [sum(lengths[:index]) for index in range(len(lengths))]
    return torch.tensor(starts, dtype=torch.int32, device=like.device)


def _spheres(body: Body) -> Tensor:
    """Return centres and radii (1 or B, N, 4); an effect may give centres of each item's own, and leave the radii."""
    batch = max(body.centers.shape[0], body.radii.shape[0])
    return torch.cat((body.centers.expand(batch, -1, -1), body.radii.expand(batch, -1)[..., None]), -1)


def _contact_spheres(world: World, starts: list[int]) -> Tensor:
    """Return for each contact (C,) the row of its sphere."""
    parts = [torch.zeros(0, dtype=torch.int64, device=world.gravity.device)]
    for a, b in pairs_of(world):
        on_plane = world.bodies[a].on_plane if b == GROUND else None
        for index in (a,) if b == GROUND else (b, a):
            parts.append(_rows(world.bodies[index], on_plane, starts[index]))
    return torch.cat(parts).to(torch.int32)


def _rows(body: Body, chosen: Tensor | None, start: int) -> Tensor:
    every = torch.arange(body.radii.shape[-1], device=body.radii.device)
    return (every if chosen is None else chosen) + start


def _with_lowest(world: World, starts: list[int], listed: Tensor) -> tuple[Tensor, tuple[tuple[int, int], ...]]:
    """Return the list of spheres, and where in it those are that may be the lowest of each body, and how many.

    They are those of the contacts with the ground; of bodies that touch nothing they are added at the end.
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
        rows = _rows(body, body.on_plane, starts[index]).to(torch.int32)
        lowest.append((len(listed), len(rows)))
        listed = torch.cat((listed, rows))
    return listed, tuple(lowest)


def _joined(parts: list[Tensor], batch: int) -> Tensor:
    """Concatenate along the second dimension; the first is 1 where it is 1 for all, else the batch."""
    shared = all(part.shape[0] == 1 for part in parts)
    return torch.cat([part if shared else part.expand(batch, *part.shape[1:]) for part in parts], 1)


def _upright(normal: Tensor) -> Tensor | None:
    """Return the rotation (4,) that takes the ground's normal to z; None where it is z."""
    x, y, z = normal.detach().tolist()
    if (x, y) == (0.0, 0.0) and z > 0:
        return None
    axis = [0.0, 1.0, 0.0, 0.0] if z < -1 + 1e-12 else [1 + z, y, -x, 0.0]
    return quat_normalize(normal.new_tensor(axis))


def _turned(turn: Tensor | None, vector: Tensor) -> Tensor:
    return vector if turn is None else quat_rotate(turn, vector)


def _turned_quat(turn: Tensor | None, quat: Tensor) -> Tensor:
    return quat if turn is None else quat_multiply(turn, quat)
