"""Limits of memory and threads: one clear error for too little memory, and thread counts for torch and the kernels."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

from ...schemas import NotEnoughMemoryError

_WORDS = ("out of memory", "not enough memory", "allocate memory")


@contextmanager
def enough_memory(tried: str, device: str, todo: str) -> Iterator[None]:
    """Convert out-of-memory errors of torch, numpy or CUDA into one clear error.

    Args:
        tried: What needs the memory, with numbers and sizes.
        device: Device whose memory is used: cpu or cuda.
        todo: Advice that reduces the need for memory.

    Raises:
        NotEnoughMemoryError: If the memory does not suffice.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not ran_out_of_memory(error):
            raise
        elsewhere = "" if device == "cpu" else ", or --device cpu"
        raise NotEnoughMemoryError(
            f"The memory did not suffice on the device '{device}': {tried}.", todo=f"{todo}{elsewhere}."
        ) from error


def ran_out_of_memory(error: BaseException) -> bool:
    """Return whether an error reports too little memory; torch raises a plain RuntimeError on the CPU."""
    text = str(error).lower().replace("_", " ")
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(word in text for word in _WORDS))


_KERNEL_THREADS: ContextVar[int | None] = ContextVar("kernel_threads", default=None)


@contextmanager
def no_garbage_search() -> Iterator[None]:
    """Keep Python from looking at all that is there for garbage again and again: a tenth of a plan's time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def one_torch_thread(kernels_too: bool = False) -> Iterator[None]:
    """Limit torch to one thread on the CPU, and compiled kernels to torch's previous number; a `with` or a decorator.

    Tensors of some thousand values are too small for several threads: on a busy machine, waiting for each other made a
    diagnosis 3 times slower, and a dataset 20 times. With one thread, sums are also equal on every machine.

    Args:
        kernels_too: Whether to limit the kernels to one thread, too.
    """
    before, torch_before = _KERNEL_THREADS.get(), torch.get_num_threads()
    token = _KERNEL_THREADS.set(1 if kernels_too else before or torch_before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torch_before)
        _KERNEL_THREADS.reset(token)


def kernel_threads() -> int:
    """Return the number of threads that a compiled kernel may use."""
    return _KERNEL_THREADS.get() or torch.get_num_threads()
