"""Simulation of a world by the fused kernel on CUDA."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ....schemas import UsageError
from ...geometry.rotation import quat_conjugate, quat_multiply, quat_rotate
from ...optimization.forward_mode import dual_of, parts_of
from ...runtime import kernel_build
from ..chains.joint_command import JointCommand
from ..checks import require_physical, require_state
from ..contact_record import ContactRecord
from ..effects.effect import changed_by_effects
from ..kinematic import Drive
from ..paper_law import PaperLaw
from ..rollout import Rollout
from ..state import State
from ..world import World
from .launch import block_room, launch, launch_away
from .packing import Packed, pack, reason_against
from .structure import FRAME_WIDTH, LABEL_WIDTH, SHARED_BYTES, Structure, lanes_for

if TYPE_CHECKING:
    from ....datasets.capture.tracks import Track

LOST = 3
"""Place in the first body's row of a frame of the number of contacts until then for which there was no room, where a
kernel gathers them."""
Launch = Callable[[Structure, tuple[Tensor | None, ...], tuple[int, ...]], None]


def unsupported(world: World) -> str | None:
    """Return why the fused kernel does not support a world on CUDA; None where it does."""
    if "cuda" not in (world.rolls_on, world.gravity.device.type):
        return f"its tensors are on the device '{world.gravity.device.type}', not on CUDA"
    if not kernel_build.available():
        return str(kernel_build.unavailable())
    return world.once(reason_against)


def simulate_fused(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand] | None = None,
    record_contacts: bool = False,
    lanes: int | None = None,
    bodies: tuple[int, ...] | None = None,
) -> Rollout:
    """Simulate a world in one kernel, as `simulate` does, for tensors on one CUDA device or on the CPU.

    A world on the CPU with `World.rolls_on` CUDA is packed on the CPU and copied in one piece.

    Forward derivatives (`dual_of`, `batched_jacobian`) of poses and velocities are exact: the same program runs on
    dual numbers. The contact record has no derivatives, and reverse derivatives are not supported.

    Args:
        world: The world; its tensors and the state's broadcast over the batch B.
        state: The state at the first time; driven and fixed bodies take theirs from `driven` or keep it.
        times_s: Frame times [s], increasing, shape (T,) or (B, T), or (b, T) of a batch in which b rows repeat.
        driven: The command of each driven body: a track, or a prepared `Drive`; of the servos of a chain, under the
            name of the chain: a `JointCommand`.
        record_contacts: Whether to keep the contacts of every frame.
        lanes: Threads per environment, a power of two up to 32 (up to 256 where hulls of links may touch); None for
            the default.
        bodies: Bodies of which the motion is returned, in this order, where it is copied to the CPU; None for all.

    Returns:
        The rollout at the frame times.

    Raises:
        InputDataError: As `simulate` does.
        UsageError: If the kernel does not support the world, or a reverse derivative is requested.
    """
    reason = unsupported(world)
    if reason is not None:
        raise UsageError(f"the fused kernel cannot take this world: {reason}.", todo="use simulate, which can.")
    device = world.gravity.device
    given = world, state, times_s, driven, record_contacts, lanes
    if device.type == "cuda":
        return roll(launch, *given, block_room(device.index))
    return roll(partial(launch_away, bodies=bodies), *given, block_room(None), bodies, pinned=True)


def roll(
    run: Launch,
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand] | None = None,
    record_contacts: bool = False,
    lanes: int | None = None,
    room: int = SHARED_BYTES,
    bodies: tuple[int, ...] | None = None,
    pinned: bool = False,
) -> Rollout:
    """Check and pack the arguments of `simulate_fused`, run the kernel by `run`, and return the rollout.

    `room` is the memory that a block of threads may have where it asks for it [bytes]. Of `bodies`, where they are
    given, `run` brings the frames, after those of the first body; `pinned` if a device copies them, which is then many
    times faster.

    Raises:
        UsageError: If there were more contacts at once than a block of threads has room for.
    """
    require_one_kind(world.gravity, *state.tensors, times_s)
    world.once(require_physical)
    require_state(state, world.body_names)
    changed = changed_by_effects(world)
    if changed is not world:
        require_physical(changed)  # an effect may give a body an impossible inertia
    world = changed
    if record_contacts and isinstance(world.contact, PaperLaw):
        raise UsageError(
            f"the fused kernel has no contact record of the law '{world.contact.name}'.",
            "record_contacts=False.",
            todo="use simulate, which has one.",
        )
    packed = pack(world, state, times_s, driven or {}, record_contacts)
    values, tangents = _values_and_tangents(packed.table, packed.steps, packed.geometry, packed.surfaces, packed.drives)
    dual = any(tangent is not None for tangent in tangents)
    if dual and record_contacts:
        raise UsageError(
            "the fused kernel has no derivatives of the contact record.",
            "record_contacts=False.",
            todo="leave record_contacts out where derivatives are wanted, or roll out on the CPU without the kernel.",
        )
    batch, count = packed.table.shape[0], times_s.shape[-1]
    rows = len(world.bodies) if bodies is None else 1 + len(bodies)
    structure = packed.structure
    shape = (structure.contacts, batch, structure.single, dual, structure.paired)
    links = 0 if structure.tree is None else len(structure.tree.bodies)
    chosen = lanes or lanes_for(*shape, links=links, hulled=structure.hulled)
    structure = structure.launched(dual, chosen, room)
    like: Any = {"dtype": values[0].dtype, "device": values[0].device, "pin_memory": pinned}
    frames = torch.empty(batch, count, rows, FRAME_WIDTH, **like)
    frame_tangents = torch.empty_like(frames) if dual else None
    labels = values[0].new_empty(batch, count, structure.contacts, LABEL_WIDTH) if record_contacts else None
    strides = [0 if x.shape[0] == 1 else x[0].numel() for x in (*values[1:], packed.drive_last)]
    pointers = [x for pair in zip(values, tangents, strict=True) for x in pair]
    pointers += [packed.substeps, packed.spheres, packed.drive_starts, packed.drive_last]
    pointers += [packed.mesh_numbers, packed.mesh_indices]
    run(structure, (*pointers, frames, frame_tangents, labels, None), (batch, count, world.iterations, *strides))
    if structure.gathered:
        require_all_contacts(structure, frames)
    if frame_tangents is not None:
        frames = dual_of(frames, frame_tangents)
    return read_frames(world, times_s, packed, frames if bodies is None else frames[:, :, 1:], labels)


def require_all_contacts(structure: Structure, frames: Tensor) -> None:
    """Check that a kernel that gathers contacts had room for all of them, by the frames that it wrote.

    Raises:
        UsageError: If it had not.
    """
    lost = frames[:, -1, 0, LOST]
    if bool((lost > 0).any()):
        raise UsageError(
            f"there were more contacts at once than {structure.crowd}, for which a block of threads of this GPU has "
            f"room: {int(lost.sum())} were left out, in {int((lost > 0).sum())} of {len(lost)} rollouts.",
            f"up to {structure.crowd}.",
            "take the CPU (--device cpu), or fewer corners, so that fewer touch at once.",
        )


def _values_and_tangents(*inputs: Tensor) -> tuple[list[Tensor], list[Tensor | None]]:
    """Return the values of the kernel's inputs and their forward derivatives, contiguous; None without derivatives.

    Raises:
        UsageError: If the inputs are of several kinds, or a reverse derivative is requested.
    """
    require_one_kind(*inputs)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
        raise UsageError(
            "the fused kernel has no reverse derivatives.",
            "forward ones (batched_jacobian), or none (torch.no_grad()).",
            "use simulate for derivatives in reverse.",
        )
    duals = [parts_of(tensor) for tensor in inputs]
    values = [primal.contiguous() for primal, _ in duals]
    return values, [None if tangent is None else tangent.contiguous() for _, tangent in duals]


def require_one_kind(*tensors: Tensor) -> None:
    """Check that tensors share one type and one device.

    Raises:
        UsageError: If they do not.
    """
    kinds = {(tensor.dtype, tensor.device) for tensor in tensors}
    if len(kinds) > 1:
        found = ", ".join(sorted(f"{dtype} on {device}" for dtype, device in kinds))
        raise UsageError(
            f"the world, the state, the times and the commands are of several kinds: {found}.",
            "one.",
            todo="convert all to one type on one device: .to(world.gravity).",
        )


def read_frames(world: World, times_s: Tensor, packed: Packed, frames: Tensor, labels: Tensor | None) -> Rollout:
    """Return the rollout from the output of a kernel: frames (B, T, nb, 16) and labels (B, T, contacts, 12)."""
    position, quat, velocity = frames[..., :3], frames[..., 4:8], frames[..., 8:11]
    back = None if packed.turn is None else quat_conjugate(packed.turn)
    if back is not None:
        position, velocity = quat_rotate(back, position), quat_rotate(back, velocity)
        quat = quat_multiply(back, quat)
    contacts = None
    if labels is not None:
        impulse, place, normal = labels[..., :3], labels[..., 4:7], labels[..., 8:11]
        if back is not None:
            impulse, place, normal = (quat_rotate(back, vector) for vector in (impulse, place, normal))
        pairs = packed.structure.pairs
        body_a = torch.tensor([a for a, _, count in pairs for _ in range(count)])
        body_b = torch.tensor([b for _, b, count in pairs for _ in range(count)])
        contacts = ContactRecord(
            body_a=body_a,
            body_b=body_b,
            impulse_n_s=impulse,
            position_m=place,
            normal=normal,
            distance_m=labels[..., 3],
            sliding=labels[..., 7] > 0.5,
        )
    return Rollout(
        times_s=times_s,
        position_m=position,
        quat_wxyz=quat,
        velocity_m_s=velocity,
        omega_body_rad_s=frames[..., 12:15],
        contacts=contacts,
    )
