"""Reading of numbers from .pt files, without running anything that a file may carry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.regular_files import require_regular_file

MOST_NUMBERS = 10_000_000
"""Largest tensor that is read."""


def read_tensor(file: Path, columns: int, *, batched: bool = False) -> NDArray[np.float64]:
    """Read a tensor (T, columns), or (1, T, columns) where it may be batched, as an array (T, columns).

    Raises:
        InputDataError: If the file holds something else.
    """
    import torch

    try:
        # weights_only: tensors are read, nothing that the file may carry is executed.
        tensor = torch.load(require_regular_file(file), weights_only=True, map_location="cpu")
    except InputDataError:
        raise
    except Exception:  # torch raises whatever its readers raise, and advises to read without the precaution
        raise InputDataError(
            f"{file}: not a tensor that can be read safely: it is damaged, or holds more than numbers.",
            "a tensor alone, as torch.save writes it; objects of Python are refused: reading them could run code.",
            "take the original, or save the tensor alone.",
        ) from None
    _require_tensor(file, tensor, columns, batched)
    return tensor.reshape(-1, columns).numpy().astype(np.float64)


def _require_tensor(file: Path, tensor: Any, columns: int, batched: bool) -> None:
    """Refuse what is no tensor of real numbers in so many columns."""
    import torch

    dimensions = (2, 3) if batched else (2,)
    if not isinstance(tensor, torch.Tensor) or tensor.shape[-1:] != (columns,) or tensor.dim() not in dimensions:
        shape = tuple(tensor.shape) if isinstance(tensor, torch.Tensor) else type(tensor).__name__
        wanted = f"(1, T, {columns})" if batched else f"(T, {columns})"
        raise InputDataError(
            f"{file}: {shape} where a toss was expected.",
            f"a tensor {wanted}.",
            todo="save each toss as one tensor of this shape with torch.save.",
        )
    _require_numbers(file, tensor)


def _require_numbers(file: Path, tensor: Any) -> None:
    """Refuse very many numbers, or complex ones."""
    if tensor.numel() > MOST_NUMBERS or tensor.is_complex():  # a tensor may repeat few numbers without end
        found = f"{file}: {tensor.numel()} numbers, {tensor.dtype}."
        raise InputDataError(
            found,
            f"at most {MOST_NUMBERS} real numbers.",
            todo="save each toss as one tensor of real numbers with torch.save.",
        )
