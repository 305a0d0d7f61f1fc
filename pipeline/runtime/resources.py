"""How many threads work on the CPU: one for torch where its tensors are small, all for the compiled kernels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_KERNEL_THREADS: ContextVar[int | None] = ContextVar("kernel_threads", default=None)


@contextmanager
def one_torch_thread(kernels_too: bool = False) -> Iterator[None]:
    """Let torch work in one thread on the CPU, and the compiled kernels in as many as torch had; for a `with` or a def.

    Tensors of some thousand numbers are too small to share out: beside other work, threads that wait for each other
    made a diagnosis 3 times slower, and a dataset 20 times. Sums also come out the same on every machine then.

    Args:
        kernels_too: Let the kernels work in one thread, too.
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
    """Return how many threads a compiled kernel may take."""
    return _KERNEL_THREADS.get() or torch.get_num_threads()
