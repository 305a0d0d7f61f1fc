"""CUDA source compiled at run time by NVRTC (no toolkit: it comes with torch's CUDA wheels), and launched."""

from __future__ import annotations

import importlib
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from . import kernel_cache


@cache
def _core() -> Any:
    try:
        core = importlib.import_module("cuda.core")
    except ImportError:
        return None
    return core if hasattr(core, "Program") else None  # before 1.0 it was experimental by name


def available() -> bool:
    """Tell whether cuda.core is installed, which compiles and launches kernels."""
    return _core() is not None


def compiled(source: str, name: str, device: int) -> Any:
    """Return the kernel of that name for a device, built or taken from an earlier process; the caller keeps it."""
    core = _core()
    core.Device(device).set_current()
    major, minor = torch.cuda.get_device_capability(device)
    options = {"std": "c++17", "arch": f"sm_{major}{minor}"}

    def build(work: Path) -> Path:
        found = core.Program(source, "c++", core.ProgramOptions(**options)).compile("cubin")
        (work / "kernel.cubin").write_bytes(bytes(found.code))
        return work / "kernel.cubin"

    recipe = "\n".join((f"cuda.core {core.__version__}, CUDA {torch.version.cuda}", *options.values(), source))
    program = kernel_cache.built(recipe, ".cubin", build, lambda file: core.ObjectCode.from_cubin(file.read_bytes()))
    return program.get_kernel(name)


def launch(
    kernel: Any, device: torch.device, blocks: int, threads: int, tensors: tuple[Tensor | None, ...], *words: Any
) -> None:
    """Launch a kernel on torch's current stream; its pointers come first, null where a tensor is None."""
    pointers = [0 if tensor is None else tensor.data_ptr() for tensor in tensors]
    stream = _stream(torch.cuda.current_stream(device).cuda_stream)
    _core().launch(stream, _config(blocks, threads), kernel, *pointers, *words)


@cache
def _config(blocks: int, threads: int) -> Any:
    return _core().LaunchConfig(grid=blocks, block=threads)


@cache
def _stream(handle: int) -> Any:
    return _core().Stream.from_handle(handle)
