"""Compilation and launch of the kernel of a structure on CUDA."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....schemas import UsageError
from ...runtime import kernel_build
from .structure import THREADS, Structure

WRITTEN = (16, 17, 18)
"""Indices of the pointers to results: frames, their tangents and labels."""
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
def _kernel(structure: Structure, device: int) -> Any:
    return kernel_build.compiled(structure.source(), "rollout", device)


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
    blocks = -(-numbers[0] * structure.lanes // THREADS)
    words = [np.int32(number) for number in numbers]
    kernel_build.launch(_kernel(structure, device.index or 0), device, blocks, THREADS, tensors, *words)


def launch_away(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Launch a kernel on the current CUDA device for tensors on the CPU, which are copied there and results back.

    Packing a world takes a hundred operations on small tensors, which are faster on the CPU than as CUDA launches.
    """
    away = [
        None if tensor is None else torch.empty_like(tensor, device="cuda") if k in WRITTEN else tensor.to("cuda")
        for k, tensor in enumerate(tensors)
    ]
    launch(structure, tuple(away), numbers)
    for k in WRITTEN:
        local, remote = tensors[k], away[k]
        if local is not None and remote is not None:
            local.copy_(remote)
