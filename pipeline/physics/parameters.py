"""The physical numbers that a fit may change, by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .contact import ContactLaw
from .world import World


@dataclass(frozen=True)
class Parameter:
    """A number to fit: bounded, and fitted as its logarithm where it is positive over decades.

    `reveals` says which motion makes it observable.
    """

    name: str
    unit: str
    bounds: tuple[float, float]
    logarithmic: bool
    reveals: str

    def encode(self, value: float) -> float:
        """Return the fitted coordinate of a value."""
        return math.log(value) if self.logarithmic else value

    def decode(self, coordinate: Tensor) -> Tensor:
        """Return the value of fitted coordinates, any shape."""
        return coordinate.exp() if self.logarithmic else coordinate

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds of the fitted coordinate."""
        return self.encode(self.bounds[0]), self.encode(self.bounds[1])


FRICTION = Parameter("friction", "1", (0.01, 2.0), True, "sliding on the ground")
CONTACT_TIME = Parameter("contact_time_s", "s", (0.001, 0.03), True, "an impact sampled faster than the contact lasts")
DAMPING_RATIO = Parameter("damping_ratio", "1", (0.02, 3.0), True, "an impact and the rebound after it")
GROUND_SHIFT = Parameter("ground_shift_m", "m", (-0.02, 0.02), False, "resting on the ground")
"""How far the ground lies above where the world has it; it also takes up an error of the body's size."""
CONTACT_PARAMETERS = (FRICTION, CONTACT_TIME, DAMPING_RATIO)


def apply_parameters(world: World, parameters: Sequence[Parameter], values: Tensor) -> World:
    """Return the world with the given values (B, P), in the units of `parameters`."""
    column = {parameter.name: values[:, index] for index, parameter in enumerate(parameters)}
    law = world.contact
    contact = ContactLaw(
        column.get("friction", law.friction),
        column.get("contact_time_s", law.contact_time_s),
        column.get("damping_ratio", law.damping_ratio),
    )
    world = replace(world, contact=contact)
    if "ground_shift_m" in column and world.ground_offset is not None:
        world = replace(world, ground_offset=world.ground_offset + column["ground_shift_m"])
    for index, body in enumerate(world.bodies):
        com = [column.get(f"{body.name}.com_{axis}_m") for axis in "xyz"]
        if any(value is not None for value in com):
            given = [body.com[:, k] if value is None else value for k, value in enumerate(com)]
            world = world.with_body(index, com=torch.stack(torch.broadcast_tensors(*given), -1))
    return world
