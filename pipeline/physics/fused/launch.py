"""Compilation and launch of the kernel of a structure on CUDA."""

from __future__ import annotations

from collections.abc import MutableMapping
from functools import cache
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ....schemas import UsageError
from ...runtime import kernel_build
from .structure import Structure

WRITTEN = (16, 17, 18)
"""Indices of the pointers to results: frames, their tangents and labels."""
LABELS = 18
"""Index of the pointer to labels."""
LASTING = (4, 6, 11, 14, 15)
"""Those of what depends on a world alone: geometry, surfaces, spheres of contacts, and meshes."""
ALIGNMENT = 256
"""Multiple at which each of the tensors begins that are sent together [bytes]."""
_THERE: MutableMapping[Tensor, tuple[int, int, Tensor]] = WeakTensorKeyDictionary()
"""Copies on a device by tensor on the CPU, each with the device and with the version of which it is one."""
MOST_LOCAL_BYTES = 512 * 1024
"""Local memory of a thread of any GPU (CUDA C++ Programming Guide, technical specifications) [B]."""


def require_room(structure: Structure) -> None:
    """Check that a thread has room for the contacts of an environment, where it has them alone.

    Raises:
        UsageError: If it has not.
    """
    if structure.shared or structure.contact_bytes <= MOST_LOCAL_BYTES:
        return
    most = structure.slots * MOST_LOCAL_BYTES // structure.contact_bytes
    raise UsageError(
        f"these bodies may have {structure.contacts} contacts at once, for which a thread of a GPU has no room.",
        f"up to {most}.",
        "take the CPU (--device cpu), or fewer pairs that touch, or fewer corners.",
    )


@cache
def block_room(device: int | None) -> int:
    """Return the memory that a block of threads may have on a CUDA device, by default torch's, if it asks [bytes]."""
    return kernel_build.most_shared_bytes(torch.cuda.current_device() if device is None else device)


@cache
def _kernel(structure: Structure, device: int) -> Any:
    kernel = kernel_build.compiled(structure.source(), "rollout", device)
    if structure.gathered:
        kernel_build.allow_shared_bytes(kernel, structure.shared_bytes, device)
    return kernel


def launch(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Launch the kernel of a structure on torch's current stream.

    Args:
        structure: Compile-time constants of the kernel.
        tensors: Pointers in the order of `PARAMETERS` in `kernels/rollout.cuh`, contiguous; None for a null pointer.
        numbers: The int32 arguments, in order; the first is the number of environments.

    Raises:
        UsageError: If a thread has no room for the contacts of an environment.
    """
    require_room(structure)
    device = next(tensor.device for tensor in tensors if tensor is not None)
    blocks = -(-numbers[0] * structure.lanes // structure.threads)
    words = [np.int32(number) for number in numbers]
    size = structure.shared_bytes if structure.gathered else 0
    kernel = _kernel(structure, device.index or 0)
    kernel_build.launch(kernel, device, blocks, structure.threads, tensors, *words, shared_bytes=size)


def launch_away(
    structure: Structure,
    tensors: tuple[Tensor | None, ...],
    numbers: tuple[int, ...],
    bodies: tuple[int, ...] | None = None,
) -> None:
    """Launch a kernel on the current CUDA device for tensors on the CPU, which are copied there and results back.

    Packing a world takes a hundred operations on small tensors, which are faster on the CPU than as CUDA launches. What
    depends on the world alone stays on the device; all else goes there in one piece. Of the frames come back those of
    the first body and of some others; None for all.
    """
    away = [_room_for(k, tensor, structure) if k in WRITTEN else tensor for k, tensor in enumerate(tensors)]
    for k in LASTING:
        away[k] = _kept_there(away[k])
    _send([k for k, tensor in enumerate(away) if tensor is not None and not tensor.is_cuda], away)
    launch(structure, tuple(away), numbers)
    rows = None if bodies is None else _rows_there((0, *bodies), torch.cuda.current_device())
    for k in WRITTEN:
        local, remote = tensors[k], away[k]
        if local is not None and remote is not None:
            chosen = remote if rows is None or k == LABELS else remote.index_select(2, rows)
            local.copy_(chosen, non_blocking=local.is_pinned())
    torch.cuda.current_stream().synchronize()


def _room_for(index: int, tensor: Tensor | None, structure: Structure) -> Tensor | None:
    """Return memory on the current CUDA device for a result: of frames, for all bodies."""
    if tensor is None:
        return None
    shape = tensor.shape if index == LABELS else (*tensor.shape[:2], len(structure.free), tensor.shape[3])
    return torch.empty(shape, dtype=tensor.dtype, device="cuda")


@cache
def _rows_there(rows: tuple[int, ...], device: int) -> Tensor:
    """Return indices on a CUDA device."""
    return torch.tensor(rows, device=f"cuda:{device}")


def _kept_there(tensor: Tensor | None) -> Tensor | None:
    """Return the copy of a tensor on the current CUDA device, made anew where the tensor is new or was changed."""
    if tensor is None or tensor.is_inference():
        return tensor
    device, kept = torch.cuda.current_device(), _THERE.get(tensor)
    if kept is None or kept[:2] != (device, tensor._version):
        kept = device, tensor._version, tensor.to("cuda")
        _THERE[tensor] = kept
    return kept[2]


def _send(which: list[int], tensors: list[Tensor | None]) -> None:
    """Replace some tensors of a list by copies on the current CUDA device, which are sent in one piece."""
    parts = [(k, tensor) for k in which if (tensor := tensors[k]) is not None]
    sizes = [tensor.numel() * tensor.element_size() for _, tensor in parts]
    starts = [0, *accumulate(-(-size // ALIGNMENT) * ALIGNMENT for size in sizes)]
    sent = torch.empty(starts[-1], dtype=torch.uint8, pin_memory=True)
    for (_, tensor), start, size in zip(parts, starts, sizes, strict=False):
        sent[start : start + size].view(tensor.dtype).view(tensor.shape).copy_(tensor)
    there = sent.to("cuda", non_blocking=True)
    for (k, tensor), start, size in zip(parts, starts, sizes, strict=False):
        tensors[k] = there[start : start + size].view(tensor.dtype).view(tensor.shape)
