"""Transfer of worlds, states and rollouts between devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from .chains.chain import Chain
from .chains.state import made_likewise
from .state import State

T = TypeVar("T")


def on_device(thing: T, device: torch.device | str, dtype: torch.dtype | None = None) -> T:
    """Copy all tensors of a nested structure to a device; derivatives are kept.

    Args:
        thing: A tensor, a dataclass, a mapping or a tuple of such; anything else is returned as it is.
        device: Target device.
        dtype: Type of the floating-point tensors; None leaves it.
    """
    return _moved(thing, torch.device(device), dtype)


def _moved(thing: Any, device: torch.device, dtype: torch.dtype | None) -> Any:
    if isinstance(thing, Tensor):
        return thing.to(device, dtype if thing.is_floating_point() else None)
    if isinstance(thing, Mapping):
        return {key: _moved(value, device, dtype) for key, value in thing.items()}
    if isinstance(thing, tuple):
        return tuple(_moved(value, device, dtype) for value in thing)
    if is_dataclass(thing) and not isinstance(thing, type):
        moved = {f.name: _moved(getattr(thing, f.name), device, dtype) for f in fields(thing)}
        # what has no tensors stays the same object, with what it has computed
        changed = any(value is not getattr(thing, name) for name, value in moved.items())
        return _copied(thing, moved, device, dtype) if changed else thing
    return thing


def _copied(thing: Any, fields_: Mapping[str, Any], device: torch.device, dtype: torch.dtype | None) -> Any:
    copy = replace(thing, **fields_)
    if isinstance(thing, Chain):
        thing.is_copied_as(copy)
    elif isinstance(thing, State):
        # without it, joints would be found from poses again, by two hundred operations
        made_likewise(thing, copy, lambda values: _moved(values, device, dtype))
    return copy
