"""CUDA kernels that composite tiles, compiled at run time by NVRTC.

They compute the same as the Triton kernels of the same names, faster: a warp takes 8 x 8 pixels, skips spheres that
cannot reach them before any evaluation, and sums eight derivatives at a time by a transposition.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from torch import Tensor

from ..runtime import kernel_build

CHANNELS = 8
"""Maximum number of channels that one launch composites."""
THREADS = 128
"""Threads of a block: four warps, one for each quarter of a tile."""
_FILES = ("composite_tile", "composite_forward", "composite_backward")
"""Files of `cuda/` in the order in which they are compiled."""


def gradient_width(channels: int) -> int:
    """Return the row length of the backward kernel's result: centre, k, log opacity and features, padded to 8."""
    return -(-(5 + channels) // 8) * 8


@cache
def _kernel(name: str, device: int, channels: int, first: int, rays: bool, by_camera: bool) -> Any:
    defines = {"F": channels, "FIRST": first, "COUNT": min(CHANNELS, channels - first), "RAYS": int(rays)}
    defines["BY_CAMERA"] = int(by_camera)
    files = (kernel_build.source_file(__name__, f"cuda/{file}.cuh") for file in _FILES)
    constants = (f"#define {key} {value}\n" for key, value in defines.items())
    return kernel_build.compiled("\n".join(("".join(constants), *files)), name, device)


def launch(
    name: str, blocks: int, tensors: tuple[Tensor | None, ...], numbers: tuple[int | float, ...], first: int = 0
) -> None:
    """Launch a kernel of `cuda/` on torch's current stream.

    Args:
        name: Name of the kernel.
        blocks: Number of blocks, one for each tile of 16 x 16 pixels.
        tensors: Pointers, in order, contiguous; the fourth are the features (N, F) or (C, N, F), the eighth the rays or
            None.
        numbers: The int32 and float32 arguments, in order.
        first: First channel of the forward kernel.

    Raises:
        ValueError: If the features are None.
    """
    features = tensors[3]
    if features is None:
        raise ValueError("the fourth tensor, the features, is None")
    rays, by_camera = tensors[7] is not None, features.dim() == 3
    kernel = _kernel(name, features.device.index or 0, features.shape[-1], first, rays, by_camera)
    words = [np.int32(number) if isinstance(number, int) else np.float32(number) for number in numbers]
    kernel_build.launch(kernel, features.device, blocks, THREADS, tensors, *words)
