"""Compiles the kernel by NVRTC at run time (no toolkit: it comes with torch's CUDA wheels), and launches it."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .structure import THREADS, Structure


@cache
def _core() -> Any:
    try:
        core = importlib.import_module("cuda.core")
    except ImportError:
        return None
    return core if hasattr(core, "Program") else None  # before 1.0 it was experimental by name


def available() -> bool:
    """Tell whether cuda.core is installed, which compiles and launches the kernel."""
    return _core() is not None


@cache
def _kernel(structure: Structure, device: int) -> Any:
    core = _core()
    core.Device(device).set_current()
    major, minor = torch.cuda.get_device_capability(device)
    options = core.ProgramOptions(std="c++17", arch=f"sm_{major}{minor}")
    return core.Program(structure.source(), "c++", options).compile("cubin").get_kernel("rollout")


@cache
def _config(blocks: int) -> Any:
    return _core().LaunchConfig(grid=blocks, block=THREADS)


def launch(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Launch the kernel of a structure on torch's current stream.

    Args:
        structure: What it is compiled for.
        tensors: Its pointers, in the order of `PARAMETERS` in the source, contiguous; None for a null pointer.
        numbers: Its int32 arguments, in order; the first is the number of environments.
    """
    device = next(tensor.device for tensor in tensors if tensor is not None)
    kernel = _kernel(structure, device.index or 0)
    blocks = -(-numbers[0] * structure.lanes // THREADS)
    pointers = [0 if tensor is None else tensor.data_ptr() for tensor in tensors]
    stream = _core().Stream.from_handle(torch.cuda.current_stream(device).cuda_stream)
    _core().launch(stream, _config(blocks), kernel, *pointers, *(np.int32(number) for number in numbers))
