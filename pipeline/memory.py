"""Memory that does not suffice, told as one message that says what was tried."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..schemas import NotEnoughMemoryError

_WORDS = ("out of memory", "not enough memory", "allocate memory")


@contextmanager
def enough_memory(tried: str, device: str, todo: str) -> Iterator[None]:
    """Turn what torch, numpy or CUDA raise for want of memory into one clear error.

    Args:
        tried: What needs the memory: numbers and sizes.
        device: Where: cpu or cuda.
        todo: What would need less.

    Raises:
        NotEnoughMemoryError: If the memory did not suffice.
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
    """Tell whether an error is one for want of memory; torch's for the CPU is a RuntimeError like any other."""
    text = str(error).lower().replace("_", " ")
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(word in text for word in _WORDS))
