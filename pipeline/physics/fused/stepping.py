"""Stepwise simulation by the fused kernel: one launch per interval, with arrays that stay on the device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ....schemas import UsageError
from ..chains.joint_command import JointCommand
from ..checks import require_physical, require_state
from ..effects.effect import changed_by_effects
from ..kinematic import Drive
from ..state import State
from ..world import World
from .commands import Commands
from .host import lacking, launch_on_host
from .launch import block_room, launch
from .packing import Packed, pack
from .rollout import Launch, read_frames, require_one_kind, unsupported
from .structure import FRAME_WIDTH, SHARED_BYTES, lanes_for


class FusedStepper:
    """`Stepper` that runs the fused kernel once per interval, on the device of the world.

    The state between steps (motions, and the contact impulses that warm-start the solver) stays in an array on the
    device, so that nothing is packed again. `advance` neither allocates outside of torch's caches nor waits for
    the device: a CUDA graph can capture it.

    Args:
        world: The world, with a batch of one.
        interval_s: Length of an interval [s].
        run: Function that runs the kernel; None for that of the device.
        lanes: Threads of the environment, a power of two up to 32; None for the default, one on a CPU.

    Raises:
        UsageError: If the kernel does not support the world.
        InputDataError: If masses, inertias, contact coefficients or the step cannot be simulated.
    """

    def __init__(self, world: World, interval_s: float, run: Launch | None = None, lanes: int | None = None) -> None:
        cuda = world.gravity.is_cuda
        reason = None if run is not None else unsupported(world) if cuda else lacking(world)
        if reason is not None:
            raise UsageError(f"the fused kernel cannot take this world: {reason}.", todo="use TorchStepper, which can.")
        require_physical(world)
        self._world = changed_by_effects(world)
        if world.effects:
            require_physical(self._world)  # an effect may give a body an impossible inertia
        self._run, self._lanes = run or (launch if cuda else launch_on_host), lanes
        self._times = torch.tensor([[0.0, interval_s]], dtype=torch.float64).to(world.gravity)
        self._resident: _Resident | None = None

    def reset(self, state: State, drives: Mapping[str, Drive | JointCommand]) -> None:
        """See :class:`Stepper`; the state has the device and type of the world, the drives are on the CPU."""
        like = self._world.gravity
        require_one_kind(like, *state.tensors)
        require_state(state, self._world.body_names)
        there = {name: _moved(drive, like.device) for name, drive in drives.items()}
        packed = pack(self._world, state, self._times, there, False)
        if self._resident is None:
            self._resident = _Resident.of(packed, self._lanes)
        self._resident.packed.table.copy_(packed.table)
        self._resident.carried.zero_()
        self.command(drives)

    def command(self, drives: Mapping[str, Drive | JointCommand]) -> None:
        """See :class:`Stepper`; drives lie on the CPU, and the previous interval must have ended."""
        resident = self._started()
        if resident.sent.numel() > 0:
            commands = Commands.of(self._world, drives, resident.sent, resident.turn)
            resident.sent.copy_(commands.samples(resident.sent))
            resident.packed.drives.copy_(resident.sent, non_blocking=True)

    def advance(self) -> State:
        """See :class:`Stepper`; the next call overwrites the state."""
        resident = self._started()
        packed = resident.packed
        pointers = (packed.table, None, packed.steps, None, packed.geometry, None)
        pointers += (packed.surfaces, None, packed.drives, None)
        pointers += (packed.substeps, packed.spheres, packed.drive_starts, packed.drive_last)
        pointers += (packed.mesh_numbers, packed.mesh_indices)
        pointers += (resident.frames, None, None, resident.carried)
        # without strides: all arrays are of one environment
        self._run(packed.structure, pointers, (1, 2, self._world.iterations, 0, 0, 0, 0, 0))
        last = read_frames(self._world, self._times, packed, resident.frames, None)
        return State(*(getattr(last, name)[:, -1] for name in State.__dataclass_fields__))

    def _started(self) -> _Resident:
        if self._resident is None:
            raise UsageError("the stepper has no state yet.", todo="call reset first.")
        return self._resident


def _moved(drive: Drive | JointCommand, device: torch.device) -> Drive | JointCommand:
    return type(drive)(*(value.to(device) for value in vars(drive).values()))


@dataclass(frozen=True, kw_only=True)
class _Resident:
    """Arrays at fixed addresses, so that a CUDA graph can read them."""

    packed: Packed
    """Inputs of the kernel."""
    turn: Tensor | None
    """Rotation of the kernel's frame, on the CPU; see `Packed.turn`."""
    sent: Tensor
    """Commands on their way to the device, pinned memory."""
    frames: Tensor
    """Frames that the kernel writes, shape (1, 2, nb, 16)."""
    carried: Tensor
    """State between launches, see `resume` in `kernels/environment.cuh`, shape (1, lanes, values)."""

    @staticmethod
    def of(packed: Packed, lanes: int | None) -> _Resident:
        kind, bodies, cuda = packed.structure, len(packed.structure.free), packed.table.is_cuda
        if lanes is None:
            lanes = lanes_for(kind.contacts, 1, kind.single, kind.dual, kind.paired) if cuda else 1
        room = block_room(packed.table.device.index) if cuda else SHARED_BYTES
        structure = replace(kind, carried=True).on_lanes(lanes, room)
        arrays = {
            name: getattr(packed, name).contiguous() for name in ("table", "steps", "geometry", "surfaces", "drives")
        }
        drives = arrays["drives"]
        return _Resident(
            packed=replace(packed, structure=structure, **arrays),
            turn=None if packed.turn is None else packed.turn.cpu(),
            sent=torch.empty(drives.shape, dtype=drives.dtype, pin_memory=cuda and drives.numel() > 0),
            frames=drives.new_empty(1, 2, bodies, FRAME_WIDTH),
            carried=drives.new_zeros(1, structure.carried_rows, structure.carried_width),
        )
