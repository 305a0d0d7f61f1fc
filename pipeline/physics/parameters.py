"""Physical parameters that a fit may change, by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import torch
from torch import Tensor

from ...schemas.materials import of_pair
from .body import Body
from .chains.values import with_chain_values
from .contact_law import ContactLaw
from .effects.effect import ActiveEffect
from .inertia import stretched_inertia
from .pair_laws import laws_in_use
from .paper_law import PaperLaw
from .world import World

Law = TypeVar("Law", bound=ContactLaw | PaperLaw)


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A bounded parameter of a fit, fitted as its logarithm where it is positive over decades."""

    name: str
    """Name, `effect.parameter` for effects."""
    unit: str
    """Unit."""
    bounds: tuple[float, float]
    """Lower and upper bound, in its unit."""
    logarithmic: bool
    """Whether its natural logarithm is fitted."""
    reveals: str
    """Motion that makes it observable."""
    prior: tuple[float, float]
    """Median and standard deviation before any data, the latter in the fitted coordinate."""
    at_bounds: tuple[str, str] = ("the motion asks for less", "the motion asks for more")
    """Meaning of a fit that ends at the lower, and at the upper bound."""
    shared: Literal["all", "group", "episode"] = "all"
    """Whether one value serves all episodes, each group of episodes, or each episode."""

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


# A single toss hardly identifies some of these; their priors keep them plausible. The contact time is that of the real
# cube tosses: bodies called rigid touch for a few milliseconds.
FRICTION = Parameter(
    name="friction",
    unit="1",
    bounds=(0.001, 2.0),
    logarithmic=True,
    reveals="sliding on the ground",
    prior=(0.3, 0.5),
    at_bounds=(
        "the body slides as if on ice. Check the scale, and [world] ground: it may lie too low to be touched",
        "the body does not slide at all, so that any larger friction fits as well: read it as a lower limit",
    ),
)
CONTACT_TIME = Parameter(
    name="contact_time_s",
    unit="s",
    bounds=(0.001, 0.03),
    logarithmic=True,
    reveals="an impact sampled faster than the contact lasts",
    prior=(0.0033, 0.5),
    at_bounds=(
        "contacts are shorter than the engine's shortest, and nothing in the motion tells them apart: read it as rigid",
        "contacts are as long as those of foam. Check that the body is rigid, the frames are sharp, and [world] "
        "ground lies where the body rests",
    ),
)
DAMPING_RATIO = Parameter(
    name="damping_ratio",
    unit="1",
    bounds=(0.001, 3.0),
    logarithmic=True,
    reveals="an impact and the rebound after it",
    prior=(0.4, 0.6),
    at_bounds=(
        "the body bounces without losing speed. Check gravity, the scale and the frame rate",
        "the body does not bounce at all, so that any larger damping fits as well: read it as a restitution of 0",
    ),
)
GROUND_SHIFT = Parameter(
    name="ground_shift_m",
    unit="m",
    bounds=(-0.02, 0.02),
    logarithmic=False,
    reveals="resting on the ground",
    prior=(0.0, 0.002),
    at_bounds=(
        "the ground seems to lie 2 cm or more below [world] ground. Check that, the scale and the shape",
        "the ground seems to lie 2 cm or more above [world] ground. Check that, the scale and the shape",
    ),
)
GAP = Parameter(
    name="gap_m",
    unit="m",
    bounds=(-0.001, 0.001),
    logarithmic=False,
    reveals="a touch without a load",
    prior=(0.0, 0.0002),
)
"""How much larger a driven body is than its shape, which parts and the frames of their tracks leave open: a nuisance of
what is told by how deep bodies press into each other."""
CONTACT_PARAMETERS = (FRICTION, CONTACT_TIME, DAMPING_RATIO)
"""Coefficients of the contact law."""
PAPER_PARAMETERS = (
    FRICTION,
    replace(CONTACT_TIME, bounds=(0.002, 0.1), prior=(0.02, 0.7)),
    replace(DAMPING_RATIO, bounds=(0.01, 10.0), prior=(1.0, 0.6)),
)
"""Those of the paper's law, K and D by a natural time and a damping ratio; medians: contact model notes, section 11."""


def contact_parameters(world: World, medians: Mapping[str, float] | None = None) -> list[Parameter]:
    """Return the coefficients of the contact laws in use, those of pairs of materials named as `friction[steel,wood]`.

    Args:
        world: The world.
        medians: Medians of their priors by name, where more is known than the priors of `CONTACT_PARAMETERS` say.
    """
    known = medians or {}
    coefficients = PAPER_PARAMETERS if isinstance(world.contact, PaperLaw) else CONTACT_PARAMETERS
    return [
        _of_pair(parameter, pair, known.get(of_pair(parameter.name, pair)))
        for pair in laws_in_use(world).materials
        for parameter in coefficients
    ]


def _of_pair(parameter: Parameter, pair: tuple[str, str] | None, median: float | None) -> Parameter:
    """Return a coefficient of the law of a pair of materials, with another median of its prior where it is given."""
    if median is not None:
        low, high = parameter.bounds
        parameter = replace(parameter, prior=(min(max(median, low), high), parameter.prior[1]))
    if pair is None:
        return parameter
    reveals = f"{parameter.reveals}, between {pair[0]} and {pair[1]}"
    return replace(parameter, name=of_pair(parameter.name, pair), reveals=reveals)


def gap_parameters(world: World) -> list[Parameter]:
    """Return the gaps of driven bodies that push links, whose losses and contacts are small beside them.

    A driven body with flat faces keeps its shape.
    """
    pushing = [body for body in world.bodies if world.chains and body.motion == "driven" and body.hull is None]
    return [replace(GAP, name=f"{body.name}.{GAP.name}") for body in pushing]


def contact_values(world: World) -> dict[str, float]:
    """Return the coefficients of the contact laws in use by the names of `contact_parameters`; of the first item."""
    used = laws_in_use(world)
    return {
        of_pair(name, pair): float(value[0])
        for pair, law in zip(used.materials, used.laws, strict=True)
        for name, value in vars(law).items()
        if isinstance(value, Tensor)
    }


def base_name(name: str) -> str:
    """Return the name of a parameter without the pair of materials, or the group, that it belongs to."""
    return name.partition("[")[0]


PRIOR_SCALES = 5.0
"""Standard deviation of the prior of an effect's parameter, in units of its scale."""


def effect_parameters(world: World) -> list[Parameter]:
    """Return the parameters of the world's effects, named `effect.parameter`."""
    found = []
    for active in world.effects:
        effect = active.effect
        for number in effect.parameters:
            low = 0.0 if number.nonnegative else -number.limit
            name, prior = f"{effect.name}.{number.name}", (0.0, PRIOR_SCALES * number.scale)
            beyond = "the effect would be stronger than its formula admits: something else is missing, or in its place"
            one = "the effect: leave it out"
            if len(effect.parameters) > 1:
                one = f"{number.name}: the other numbers of the effect stay, this one may go from its formula"
            least = f"these data do not show {one}" if number.nonnegative else beyond
            bounds = (low, number.limit)
            found.append(
                Parameter(
                    name=name,
                    unit=number.unit,
                    bounds=bounds,
                    logarithmic=False,
                    reveals=effect.reveals,
                    prior=prior,
                    at_bounds=(least, beyond),
                    shared=number.shared,
                )
            )
    return found


_OUTSIDE = (
    "the centre of mass would lie half the body's size away from where it was. Check the shape and the body's frame"
)
_SPREAD = "the mass would be spread ten times differently than given. Check the shape, or give inertia_kg_m2"


def mass_distribution(body: str, size_m: float) -> tuple[Parameter, ...]:
    """Return the parameters of a body's mass distribution: centre of mass, and factors of its second moments about it.

    The second moment along a body axis, the integral of x^2 dm, may be any positive number, so every inertia made of
    three of them is physically possible.

    Args:
        body: Its name.
        size_m: Distance of its surface from the centre of mass [m]; half of it bounds the shift of the centre.
    """
    centre = [
        Parameter(
            name=f"{body}.com_{axis}_m",
            unit="m",
            bounds=(-0.5 * size_m, 0.5 * size_m),
            logarithmic=False,
            reveals="spinning flight and impacts",
            prior=(0.0, 0.25 * size_m),
            at_bounds=(_OUTSIDE, _OUTSIDE),
        )
        for axis in "xyz"
    ]
    moments = [
        Parameter(
            name=f"{body}.moment_{axis}",
            unit="1",
            bounds=(0.1, 10.0),
            logarithmic=True,
            reveals="impacts that change the spin",
            prior=(1.0, 0.5),
            at_bounds=(_SPREAD, _SPREAD),
        )
        for axis in "xyz"
    ]
    return (*centre, *moments)


def apply_parameters(world: World, parameters: Sequence[Parameter], values: Tensor) -> World:
    """Return the world with the given values (B, P), in the units of `parameters`."""
    column = {parameter.name: values[:, index] for index, parameter in enumerate(parameters)}
    world = replace(
        world,
        contact=_with_coefficients(world.contact, None, column),
        pair_laws={pair: _with_coefficients(law, pair, column) for pair, law in world.pair_laws.items()},
    )
    world = replace(world, effects=tuple(_with_values(active, column) for active in world.effects))
    if "ground_shift_m" in column and world.ground_offset is not None:
        world = replace(world, ground_offset=world.ground_offset + column["ground_shift_m"])
    if world.chains:
        world = with_chain_values(world, column)
    for index, body in enumerate(world.bodies):
        changes = _mass_distribution_of(body, column)
        gap = column.get(f"{body.name}.{GAP.name}")
        if gap is not None:
            changes["radii"] = body.radii + gap[:, None]
        world = world.with_body(index, **changes) if changes else world
    return world


def _with_coefficients(law: Law, pair: tuple[str, str] | None, column: Mapping[str, Tensor]) -> Law:
    """Return the contact law of a pair of materials with the given coefficients (B,), by `of_pair` of their names."""
    given = {name: column[of_pair(name, pair)] for name in vars(law) if of_pair(name, pair) in column}
    return replace(law, **given) if given else law


def _with_values(active: ActiveEffect, column: Mapping[str, Tensor]) -> ActiveEffect:
    """Return an effect with the given values (B,) of its parameters, by `effect.parameter`."""
    values = {name: column.get(f"{active.effect.name}.{name}", value) for name, value in active.values.items()}
    return replace(active, values=values)


def _mass_distribution_of(body: Body, column: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the centre of mass (B, 3) and the inertia (B, 3, 3) of a body, each where values of it are given."""
    changes = {}
    com = [column.get(f"{body.name}.com_{axis}_m") for axis in "xyz"]
    if any(value is not None for value in com):
        given = [body.com[:, k] if value is None else value for k, value in enumerate(com)]
        changes["com"] = torch.stack(torch.broadcast_tensors(*given), -1)
    factors = {axis: column.get(f"{body.name}.moment_{axis}") for axis in "xyz"}
    like = next((factor for factor in factors.values() if factor is not None), None)
    if like is not None:
        known = [torch.ones_like(like) if factor is None else factor for factor in factors.values()]
        changes["inertia"] = scaled_inertia(body.inertia, torch.stack(known, -1))
    return changes


def with_own(world: World, own: Mapping[str, Tensor], repeats: int = 1) -> World:
    """Return the world with group- or episode-specific values of effects' parameters, one per item of a batch.

    Args:
        world: The world.
        own: Values (B,) by `effect.parameter`.
        repeats: Number of repetitions of the batch.
    """
    return replace(world, effects=tuple(_with_own(active, own, repeats) for active in world.effects)) if own else world


def _with_own(active: ActiveEffect, own: Mapping[str, Tensor], repeats: int) -> ActiveEffect:
    specific = {name: own.get(f"{active.effect.name}.{name}") for name in active.values}
    size = next((len(value) for value in specific.values() if value is not None), 0)
    if size == 0:
        return active
    # shared values are expanded to the size of the specific ones
    values = {
        name: (active.values[name].expand(size) if value is None else value).repeat(repeats)
        for name, value in specific.items()
    }
    return replace(active, values=values)


def scaled_inertia(inertia: Tensor, factors: Tensor) -> Tensor:
    """Return the inertia (B, 3, 3) of a body whose second moments along its axes are scaled by factors (B, 3)."""
    return stretched_inertia(inertia, torch.diag_embed(factors.sqrt()))
