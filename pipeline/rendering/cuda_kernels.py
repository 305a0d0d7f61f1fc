"""The CUDA kernels of the renderer, compiled at run time by NVRTC: tracing, binning and compositing.

When compositing, a warp takes 8 x 8 pixels, skips spheres that cannot reach them before any evaluation, and sums eight
derivatives at a time by a transposition.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..runtime import kernel_build

TILE = 16
"""Side of a tile [px]."""
CHANNELS = 8
"""Maximum number of channels that one launch of `composite_forward` composites."""
BACKWARD_THREADS = 128
"""Threads of a block of `project_backward`: spheres times groups of cameras."""

Name = Literal["trace", "project", "emit", "composite_forward", "composite_backward", "project_backward"]

_BINNING, _COMPOSITING = ("tile_span", "project", "emit"), ("composite_tile", "composite_forward", "composite_backward")
_FILES: dict[Name, tuple[str, ...]] = {
    "trace": ("trace",),
    "project": _BINNING,
    "emit": _BINNING,
    "composite_forward": _COMPOSITING,
    "composite_backward": _COMPOSITING,
    "project_backward": ("project_backward",),
}
"""Files of `cuda/` that are compiled together, in their order."""
_THREADS: dict[Name, int] = {
    "trace": TILE * TILE,
    "project": 128,
    "emit": 128,
    "composite_forward": 128,  # four warps, one for each quarter of a tile
    "composite_backward": 128,
    "project_backward": BACKWARD_THREADS,
}
"""Threads of a block."""


def gradient_width(channels: int) -> int:
    """Return the row length of the backward kernel's result: centre, k, log opacity and features, padded to 8."""
    return -(-(5 + channels) // 8) * 8


def launch(
    name: Name,
    device: torch.device,
    count: int,
    tensors: tuple[Tensor | None, ...],
    numbers: tuple[int | float, ...],
    **defines: int,
) -> None:
    """Launch a kernel of `cuda/` on torch's current stream.

    Args:
        name: Name of the kernel.
        device: The CUDA device of the tensors.
        count: Number of blocks; for `project` and `emit` the number of threads.
        tensors: Pointers in the order of the kernel's parameters, contiguous; None for null.
        numbers: The int32 and float32 arguments, in order.
        defines: Compile-time constants of the kernel.
    """
    threads = _THREADS[name]
    blocks = -(-count // threads) if _FILES[name] == _BINNING else count
    words = [np.int32(number) if isinstance(number, int) else np.float32(number) for number in numbers]
    kernel = _kernel(name, device.index or 0, tuple(defines.items()))
    kernel_build.launch(kernel, device, blocks, threads, tensors, *words)


@cache
def _kernel(name: Name, device: int, defines: tuple[tuple[str, int], ...]) -> Any:
    constants = "".join(f"#define {key} {value}\n" for key, value in defines)
    files = (kernel_build.source_file(__name__, f"cuda/{file}.cuh") for file in _FILES[name])
    return kernel_build.compiled("\n".join((constants, *files)), name, device)
