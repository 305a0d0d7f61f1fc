"""Compiles the kernel of a structure, and launches it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from torch import Tensor

from ... import nvrtc
from .structure import THREADS, Structure


@cache
def _kernel(structure: Structure, device: int) -> Any:
    return nvrtc.compiled(structure.source(), "rollout", device)


def launch(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Launch the kernel of a structure on torch's current stream.

    Args:
        structure: What it is compiled for.
        tensors: Its pointers, in the order of `PARAMETERS` in the source, contiguous; None for a null pointer.
        numbers: Its int32 arguments, in order; the first is the number of environments.
    """
    device = next(tensor.device for tensor in tensors if tensor is not None)
    blocks = -(-numbers[0] * structure.lanes // THREADS)
    words = [np.int32(number) for number in numbers]
    nvrtc.launch(_kernel(structure, device.index or 0), device, blocks, THREADS, tensors, *words)
