"""Physics of a closed loop: the engine that steps one environment fastest, and its state on the renderer's device."""

from __future__ import annotations

import torch
from torch import Tensor

from ...datasets.models.model import Model
from ..physics.fused.host import lacking
from ..physics.fused.stepping import FusedStepper
from ..physics.model_world import world_of_model
from ..physics.state import State
from ..physics.stepping import Stepper, TorchStepper
from ..physics.world import World

SIZES = {"position_m": 3, "quat_wxyz": 4, "velocity_m_s": 3, "omega_body_rad_s": 3}
"""Fields of a state, and the numbers of each for a body."""


def stepper_of(model: Model, interval_s: float, device: str, dtype: torch.dtype) -> tuple[Stepper, World]:
    """Return the engine for one environment of a model, and its world.

    The kernel on the CPU wherever it can be built: one environment occupies a single warp of a GPU, which takes ten
    times as long for a sub-step as a core. Otherwise the kernel on a CUDA device, or the torch engine on the CPU.

    Raises:
        UsageError: If the kernel supports the world neither on the CPU nor on the CUDA device.
        InputDataError: If the model cannot be simulated.
    """
    world = world_of_model(model, dtype)
    if lacking(world) is None:
        return FusedStepper(world, interval_s), world
    world = world_of_model(model, dtype, device)
    return (FusedStepper if world.gravity.is_cuda else TorchStepper)(world, interval_s), world


def numbers_of(state: State) -> Tensor:
    """Return position, orientation, velocity and angular velocity of all bodies side by side, shape (1, nb, 13)."""
    return torch.cat([getattr(state, name) for name in SIZES], -1)


def state_of(numbers: Tensor) -> State:
    """Return the state of which `numbers_of` returned the numbers; its tensors are views of them."""
    return State(*numbers.split(list(SIZES.values()), -1))


class DeviceState:
    """State of a world on the CPU, as tensors at fixed addresses of a CUDA device, which a CUDA graph can read.

    Args:
        world: The world, on the CPU.
        device: The CUDA device.
    """

    def __init__(self, world: World, device: str) -> None:
        shape, dtype = (1, len(world.bodies), sum(SIZES.values())), world.gravity.dtype
        self._sent = torch.empty(shape, dtype=dtype, pin_memory=True)
        self._there = torch.empty(shape, dtype=dtype, device=device)

    @property
    def state(self) -> State:
        """The state on the device."""
        return state_of(self._there)

    def set(self, state: State) -> State:
        """Copy a state of the CPU to the device, where the previous one must have been read; return that there."""
        self._sent.copy_(numbers_of(state))
        self._there.copy_(self._sent, non_blocking=True)
        return self.state
