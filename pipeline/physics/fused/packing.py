"""A world, its start and its commands as the arrays that a fused kernel reads."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ....schemas import InputDataError, UsageError, did_you_mean
from ..contact import ContactLaw
from ..driven import Drive
from ..motion import start
from ..detection import pairs_of
from ..rotation import quat_multiply, quat_normalize, quat_rotate
from ..world import Body, State, World
from .structure import WRENCH_COLUMNS, Structure

if TYPE_CHECKING:
    from ....datasets.tracks import Track

WRENCHES = {
    "linear_drag": (0, 1), "quadratic_drag": (1, 1), "magnus": (2, 1), "spin_damping": (3, 1), "acceleration": (4, 3),
    "wind": (7, 2), "magnet": (10, 1), "magnet_range": (11, 1),
}  # fmt: skip
"""Column and width of each coefficient of the accelerations in flight."""
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
    if any(tensor.dtype not in (torch.float32, torch.float64) for tensor in tensors):
        return "its numbers are neither float32 nor float64"
    if len({tensor.dtype for tensor in tensors}) > 1:
        return "its numbers have several types"
    if not world.bodies:
        return "it has no bodies"
    contacts = sum(_contact_count(world, a, b) for a, b in pairs_of(world))
    if contacts > MOST_CONTACTS:
        return f"its bodies may have {contacts} contacts, more than {MOST_CONTACTS}"
    return None


def pack(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive],
    wrenches: Mapping[str, Tensor],
    record: bool,
) -> Packed:
    """Lay out the arguments of `simulate_fused`, for one thread and no derivative; derivatives flow through.

    Raises:
        InputDataError: If a driven body has no track.
        UsageError: If a wrench has an unknown name or another shape.
    """
    turn = None if world.ground_normal is None else _upright(world.ground_normal)
    times = times_s if times_s.ndim == 2 else times_s[None]
    rows = {index: _drive_rows(_command(body, driven, state), turn) for index, body in enumerate(world.bodies)
            if body.motion == "driven"}  # fmt: skip
    coefficients = _coefficients(world, wrenches, turn)
    columns = _columns(world, state, turn)
    spheres = [torch.cat((body.centers, body.radii[..., None]), -1) for body in world.bodies]
    law, substeps = world.contact, _substeps(times, world.step_s)
    numbers = torch.tensor(substeps, dtype=torch.int32, device=times.device)
    steps = _steps(law, times, numbers)
    batch = max(
        x.shape[0]
        for x in (*columns, *spheres, steps, *(x for row in rows.values() for x in row), *coefficients)
    )  # fmt: skip
    for index, extra in enumerate(coefficients):
        columns.insert(3 + 7 * (index + 1) + index, extra)
    pairs = tuple((a, b, _contact_count(world, a, b)) for a, b in pairs_of(world))
    single = world.gravity.dtype == torch.float32
    starts = [sum(body.radii.shape[-1] for body in world.bodies[:index]) for index in range(len(world.bodies))]
    structure = Structure(
        single, False, 1, record, bool(coefficients), tuple(body.free for body in world.bodies),
        tuple(list(rows).index(index) if index in rows else -1 for index in range(len(world.bodies))),
        tuple(body.radii.shape[-1] for body in world.bodies), pairs,
    )  # fmt: skip
    return Packed(
        structure,
        torch.cat([column.expand(batch, column.shape[-1]) for column in columns], -1),
        steps,
        _joined(spheres, batch),
        _joined([row for row, _ in rows.values()], batch) if rows else times.new_zeros(1, 0, 14),
        numbers,
        _contact_spheres(world, starts),
        _drive_starts(rows, times),
        _joined([last[:, None] for _, last in rows.values()], batch).to(torch.int32)
        if rows
        else numbers.new_zeros(1, 0),
        turn,
    )


def _substeps(times: Tensor, step_s: float) -> list[int]:
    longest = times.detach().diff(dim=1).amax(0).tolist()
    return [max(1, math.ceil(length / step_s - 1e-6)) for length in longest]


def _steps(law: ContactLaw, times: Tensor, substeps: Tensor) -> Tensor:
    """Return (1 or B, intervals, 4): step, stiffness, damping, time at the start; one row of zeros and time without."""
    if times.shape[1] == 1:
        return torch.cat((torch.zeros_like(times).expand(times.shape[0], 3), times), -1)[:, None]
    h = times.diff(dim=1) / substeps
    rows = ContactLaw(*(value[:, None] for value in (law.friction, law.contact_time_s, law.damping_ratio)))
    stiffness, damping = rows.coefficients(h)
    return torch.stack(torch.broadcast_tensors(h, stiffness, damping, times[:, :-1]), -1)


def _columns(world: World, state: State, turn: Tensor | None) -> list[Tensor]:
    """Return the columns of the table without wrenches: 3 of the world, then 7 of each body."""
    zero = torch.zeros_like(world.gravity[:, :1])
    offset = zero if world.ground_offset is None else world.ground_offset[:, None]
    columns = [_turned(turn, world.gravity), offset, world.contact.friction[:, None]]
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


def _coefficients(world: World, wrenches: Mapping[str, Tensor], turn: Tensor | None) -> list[Tensor]:
    """Return the coefficients (1 or B, 12) of each body; none where no wrench is given."""
    if not wrenches:
        return []
    count = len(world.bodies)
    for name, value in wrenches.items():
        if name not in WRENCHES:
            raise UsageError(f"no wrench '{name}'.{did_you_mean(name, WRENCHES)}", f"{', '.join(WRENCHES)}.")
        width = WRENCHES[name][1]
        if value.shape[1:] != ((count,) if width == 1 else (count, width)):
            shape = f"(B, {count})" if width == 1 else f"(B, {count}, {width})"
            raise UsageError(f"the wrench '{name}' has the shape {tuple(value.shape)}.", f"{shape}.")
    tables = []
    for index in range(count):
        parts: list[Tensor] = []
        for name, (_, width) in WRENCHES.items():
            given = wrenches.get(name)
            part = torch.zeros_like(world.gravity[:1, :1]).expand(1, width) if given is None else given[:, index]
            part = part.reshape(part.shape[0], width)
            if name == "magnet_range" and given is None:
                part = part + 1.0
            if name == "wind":
                part = torch.cat((part, torch.zeros_like(part[:, :1])), -1)
            parts.append(_turned(turn, part) if name in ("wind", "acceleration") else part)
        batch = max(part.shape[0] for part in parts)
        tables.append(torch.cat([part.expand(batch, part.shape[-1]) for part in parts], -1))
        assert tables[-1].shape[-1] == WRENCH_COLUMNS
    return tables


def _command(body: Body, driven: Mapping[str, Track | Drive], state: State) -> Drive:
    if body.name not in driven:
        raise InputDataError(
            f"the driven body '{body.name}' has no track in this episode; its track is its command.",
            todo=f"add rows for '{body.name}' to the episode's tracks file.",
        )
    command = driven[body.name]
    return command if isinstance(command, Drive) else Drive.of([command], state.position_m.detach())


def _drive_rows(drive: Drive, turn: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the samples (1 or B, S, 14) and the index of the last interval (1 or B,)."""
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


def _contact_spheres(world: World, starts: list[int]) -> Tensor:
    """Return for each contact (C,) the row of its sphere."""
    parts = []
    for a, b in pairs_of(world):
        index = a if b < 0 else b
        body = world.bodies[index]
        every = torch.arange(body.radii.shape[-1], device=body.radii.device)
        parts.append((every if b >= 0 or body.on_plane is None else body.on_plane) + starts[index])
    if not parts:
        return torch.zeros(0, dtype=torch.int32, device=world.gravity.device)
    return torch.cat(parts).to(torch.int32)


def _contact_count(world: World, a: int, b: int) -> int:
    body = world.bodies[a if b < 0 else b]
    return body.radii.shape[-1] if b >= 0 or body.on_plane is None else len(body.on_plane)


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
