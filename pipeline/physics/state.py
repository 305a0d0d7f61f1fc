"""Poses and velocities of the bodies of a world at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass(frozen=True)
class State:
    """Poses and velocities of all bodies at one time, in the order of the world's bodies."""

    position_m: Tensor
    """Origins of the body frames, world frame [m], shape (B, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, body to world, shape (B, nb, 4)."""
    velocity_m_s: Tensor
    """Velocities of the body frames' origins, world frame [m/s], shape (B, nb, 3)."""
    omega_body_rad_s: Tensor
    """Angular velocities, body frame [rad/s], shape (B, nb, 3)."""

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The fields in their order, from which `State(*tensors)` is made again."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def at(self, rows: Tensor | Sequence[int] | slice) -> State:
        """Return the state at some rows of the batch."""
        return State(*(getattr(self, field.name)[rows] for field in fields(self)))

    def repeat(self, times: int) -> State:
        """Return the state with its batch repeated, as `Tensor.repeat` does."""
        return State(*(getattr(self, field.name).repeat(times, 1, 1) for field in fields(self)))

    @staticmethod
    def joined(*states: State) -> State:
        """Concatenate the batches of several states."""
        return State(*(torch.cat([getattr(state, field.name) for state in states]) for field in fields(State)))
