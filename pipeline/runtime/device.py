"""Choose the device that a command runs on."""

from __future__ import annotations

import torch

from ...schemas import UsageError


def resolve_device(name: str) -> torch.device:
    """Return the torch device for auto, cpu or cuda.

    Raises:
        UsageError: If CUDA was asked for and is not there.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: no CUDA device was found.", "auto, cpu, cuda.", "run 'cgwm doctor'.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
