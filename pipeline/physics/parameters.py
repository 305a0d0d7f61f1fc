"""The physical numbers that a fit may change, by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from .effects.effect import ActiveEffect
from .world import World, stretched_inertia


@dataclass(frozen=True)
class Parameter:
    """A number to fit: bounded, and fitted as its logarithm where it is positive over decades.

    reveals: which motion makes it observable; prior: median and standard deviation before any data, the latter in the
    fitted coordinate (natural logarithm where the parameter is logarithmic); at_bounds: what it means when a fit ends
    at the lower and at the upper bound; shared: whether one value serves all episodes, or each
    group of episodes, or each episode, has its own.
    """

    name: str
    unit: str
    bounds: tuple[float, float]
    logarithmic: bool
    reveals: str
    prior: tuple[float, float]
    at_bounds: tuple[str, str] = ("the motion asks for less", "the motion asks for more")
    shared: Literal["all", "group", "episode"] = "all"

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


# One toss hardly shows some of these; their priors keep them plausible. The contact time is that of the real cube
# tosses: what is called rigid touches for a few milliseconds.
FRICTION = Parameter(
    "friction",
    "1",
    (0.01, 2.0),
    True,
    "sliding on the ground",
    (0.3, 0.5),
    (
        "the body slides as if on ice. Check the scale, and [world] ground: it may lie too low to be touched",
        "the body does not slide at all, so that any larger friction fits as well: read it as a lower limit",
    ),
)
CONTACT_TIME = Parameter(
    "contact_time_s",
    "s",
    (0.001, 0.03),
    True,
    "an impact sampled faster than the contact lasts",
    (0.0033, 0.5),
    (
        "contacts are shorter than the engine's shortest, and nothing in the motion tells them apart: read it as rigid",
        "contacts are as long as those of foam. Check that the body is rigid, the frames are sharp, and [world] "
        "ground lies where the body rests",
    ),
)
DAMPING_RATIO = Parameter(
    "damping_ratio",
    "1",
    (0.02, 3.0),
    True,
    "an impact and the rebound after it",
    (0.4, 0.6),
    (
        "the body bounces without losing speed. Check gravity, the scale and the frame rate",
        "the body does not bounce at all, so that any larger damping fits as well: read it as a restitution of 0",
    ),
)
GROUND_SHIFT = Parameter(
    "ground_shift_m",
    "m",
    (-0.02, 0.02),
    False,
    "resting on the ground",
    (0.0, 0.002),
    (
        "the ground seems to lie 2 cm or more below [world] ground. Check that, the scale and the shape",
        "the ground seems to lie 2 cm or more above [world] ground. Check that, the scale and the shape",
    ),
)
CONTACT_PARAMETERS = (FRICTION, CONTACT_TIME, DAMPING_RATIO)


PRIOR_SCALES = 5.0
"""Width of the prior of an effect's parameter, in scales that matter."""


def effect_parameters(world: World) -> list[Parameter]:
    """Return the parameters of the world's effects, named `effect.parameter`."""
    found = []
    for active in world.effects:
        effect = active.effect
        for number in effect.parameters:
            low = 0.0 if number.nonnegative else -number.limit
            name, prior = f"{effect.name}.{number.name}", (0.0, PRIOR_SCALES * number.scale)
            beyond = "the effect would be stronger than its formula admits: something else is missing, or in its place"
            least = "these data do not show the effect: leave it out" if number.nonnegative else beyond
            bounds = (low, number.limit)
            found.append(
                Parameter(name, number.unit, bounds, False, effect.reveals, prior, (least, beyond), number.shared)
            )
    return found


_OUTSIDE = (
    "the centre of mass would lie half the body's size away from where it was. Check the shape and the body's frame"
)
_SPREAD = "the mass would be spread ten times differently than it was said. Check the shape, or give inertia_kg_m2"


def mass_distribution(body: str, size_m: float) -> tuple[Parameter, ...]:
    """Return the parameters of where a body's mass is: its centre, and factors of its second moments about it.

    The second moment along a body axis, the integral of x^2 dm, may be any positive number, so that every inertia made
    of three of them is one that a body can have.

    Args:
        body: Its name.
        size_m: Distance of its surface from the centre of mass [m], which bounds how far that may move.
    """
    centre = [
        Parameter(
            f"{body}.com_{axis}_m",
            "m",
            (-0.5 * size_m, 0.5 * size_m),
            False,
            "spinning flight and impacts",
            (0.0, 0.25 * size_m),
            (_OUTSIDE, _OUTSIDE),
        )
        for axis in "xyz"
    ]
    moments = [
        Parameter(
            f"{body}.moment_{axis}",
            "1",
            (0.1, 10.0),
            True,
            "impacts that change the spin",
            (1.0, 0.5),
            (_SPREAD, _SPREAD),
        )
        for axis in "xyz"
    ]
    return (*centre, *moments)


def apply_parameters(world: World, parameters: Sequence[Parameter], values: Tensor) -> World:
    """Return the world with the given values (B, P), in the units of `parameters`."""
    column = {parameter.name: values[:, index] for index, parameter in enumerate(parameters)}
    law = world.contact
    world = replace(world, contact=replace(law, **{name: column[name] for name in vars(law) if name in column}))
    effects = [
        replace(
            active,
            values={name: column.get(f"{active.effect.name}.{name}", value) for name, value in active.values.items()},
        )
        for active in world.effects
    ]
    world = replace(world, effects=tuple(effects))
    if "ground_shift_m" in column and world.ground_offset is not None:
        world = replace(world, ground_offset=world.ground_offset + column["ground_shift_m"])
    for index, body in enumerate(world.bodies):
        com = [column.get(f"{body.name}.com_{axis}_m") for axis in "xyz"]
        if any(value is not None for value in com):
            given = [body.com[:, k] if value is None else value for k, value in enumerate(com)]
            world = world.with_body(index, com=torch.stack(torch.broadcast_tensors(*given), -1))
        factors = [column.get(f"{body.name}.moment_{axis}") for axis in "xyz"]
        if any(factor is not None for factor in factors):
            known = [torch.ones_like(values[:, 0]) if factor is None else factor for factor in factors]
            world = world.with_body(index, inertia=scaled_inertia(body.inertia, torch.stack(known, -1)))
    return world


def with_own(world: World, own: Mapping[str, Tensor], repeats: int = 1) -> World:
    """Return the world with an own value for each item of a batch.

    Args:
        world: The world.
        own: Values (B,) by `effect.parameter`.
        repeats: How often the batch is repeated.
    """
    return replace(world, effects=tuple(_with_own(active, own, repeats) for active in world.effects)) if own else world


def _with_own(active: ActiveEffect, own: Mapping[str, Tensor], repeats: int) -> ActiveEffect:
    mine = {name: own.get(f"{active.effect.name}.{name}") for name in active.values}
    size = next((len(value) for value in mine.values() if value is not None), 0)
    if size == 0:
        return active
    # what is stacked with an own number has as many values
    values = {
        name: (active.values[name].expand(size) if value is None else value).repeat(repeats)
        for name, value in mine.items()
    }
    return replace(active, values=values)


def scaled_inertia(inertia: Tensor, factors: Tensor) -> Tensor:
    """Return the inertia (B, 3, 3) of a body whose second moments along its axes are scaled by factors (B, 3)."""
    return stretched_inertia(inertia, torch.diag_embed(factors.sqrt()))
