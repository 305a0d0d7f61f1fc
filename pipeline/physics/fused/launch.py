"""Compiles the kernel of a structure, and launches it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ... import nvrtc
from .structure import THREADS, Structure

WRITTEN = (12, 13, 14)
"""Which pointers are of results: frames, their tangents and labels."""


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


def launch_away(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Do what `launch` does, on the current CUDA device, for tensors on the CPU: they go there, results come back.

    A world is packed by a hundred operations on small tensors, each of which takes longer to launch than to do.
    """
    away = [
        None if tensor is None else torch.empty_like(tensor, device="cuda") if k in WRITTEN else tensor.to("cuda")
        for k, tensor in enumerate(tensors)
    ]
    launch(structure, tuple(away), numbers)
    for k in WRITTEN:
        mine, its = tensors[k], away[k]
        if mine is not None and its is not None:
            mine.copy_(its)
