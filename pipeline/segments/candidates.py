"""Candidate effects added to a model, all in one world at their neutral values, so that one Jacobian covers all."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..physics.effects.effect import ActiveEffect, Effect
from ..physics.parameters import GROUND_SHIFT, Parameter, contact_parameters, contact_values, effect_parameters
from ..physics.world import World
from .segments import Kind


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing in the model."""

    spec: str
    """As the user types it."""
    effect: Effect
    """The effect."""


@dataclass(frozen=True)
class Variant:
    """A candidate at one combination of its constants."""

    place: int
    """Index of the candidate among the candidates."""
    active: ActiveEffect
    """The effect at its neutral values, under a unique name."""
    constants: dict[str, float]
    """Values of the constants, by name."""

    @property
    def parameters(self) -> list[str]:
        """Names of its parameters as `effect_parameters` gives them."""
        effect = self.active.effect
        return [f"{effect.name}.{number.name}" for number in effect.parameters]


def admissible(
    world: World, candidates: Sequence[Candidate], turned: bool, spun: bool = False
) -> tuple[list[Candidate], dict[str, str]]:
    """Return the candidates that can be tested with a world, and the reasons against the others, by name.

    Args:
        world: The model's world; effects that it already has are no candidates.
        candidates: In any order.
        turned: Whether orientations were measured.
        spun: Whether spins were measured, where the orientations were not.
    """
    present = {active.effect.name for active in world.effects}
    driven = any(body.motion == "driven" for body in world.bodies)
    has = {
        "ground": world.ground_normal is not None,
        "contact": world.ground_normal is not None or len(world.bodies) > 1 or bool(world.surfaces),
        "spin": turned or spun,
        "unmeasured_spin": not (turned or spun),
        "orientation": turned,
        "driven": driven,
        "drag": any("drag" in active.effect.provides for active in world.effects),
    }
    words = {
        "ground": "the world has no ground",
        "contact": "nothing can be touched",
        "spin": "no orientation and no spin was measured",
        "unmeasured_spin": "the spin was measured, so that its lift is magnus_lift",
        "orientation": "no orientation was measured",
        "driven": "no body is driven",
        "drag": "the model has no drag, without which it does nothing",
    }
    kept, refused = [], {}
    for candidate in candidates:
        effect = candidate.effect
        lacking = next((need for need in effect.needs if not has[need]), None)
        if effect.name in present:
            refused[effect.name] = "the model has it"
        elif lacking is not None:
            refused[effect.name] = words[lacking]
        elif driven and effect.phase == "measurement" and "driven" not in effect.needs:
            refused[effect.name] = "the command of the driven body was measured in the same way"
        else:
            kept.append(candidate)
    return kept, refused


def variants_of(candidates: Sequence[Candidate], like: Tensor) -> list[Variant]:
    """Return every candidate at every combination of its constants' grids."""
    found = []
    for place, candidate in enumerate(candidates):
        constants = candidate.effect.constants
        for values in itertools.product(*(constant.grid for constant in constants)):
            chosen = {constant.name: value for constant, value in zip(constants, values, strict=True)}
            own = copy.copy(candidate.effect)
            # a world may hold several copies of one effect, and parameters are found by name
            own.name = f"candidate_{len(found)}"  # pyright: ignore[reportAttributeAccessIssue]
            found.append(Variant(place, ActiveEffect.of(own, chosen, like), chosen))
    return found


def acts_in(variant: Variant, kind: Kind) -> bool:
    """Return whether a candidate can change segments of a kind."""
    return kind == "contact" or variant.active.effect.phase != "contact"


def with_variants(world: World, variants: Sequence[Variant], kind: Kind) -> tuple[World, list[Parameter]]:
    """Return the world with all candidates at their neutral values, and their parameters in the same order."""
    chosen = [variant for variant in variants if acts_in(variant, kind)]
    active = tuple(variant.active for variant in chosen)
    everything = replace(world, effects=(*world.effects, *active))
    names = {name for variant in chosen for name in variant.parameters}
    return everything, [p for p in effect_parameters(everything) if p.name in names]


@dataclass(frozen=True, kw_only=True)
class Together:
    """Candidates in one world, in which those that differ in their constants alone are one effect."""

    world: World
    """The world with one effect for each candidate."""
    parameters: list[Parameter]
    """Parameters of the effects, then their constants, which are not fitted (Q)."""
    columns: list[list[int]]
    """Places of the parameters of each variant among them."""
    constants: list[dict[int, float]]
    """Constants of each variant by their places among them."""

    @staticmethod
    def of(world: World, variants: Sequence[Variant], kind: Kind = "contact") -> Together:
        """Return a world with variants: as constants have a value for each item, the fused kernel takes them at once.

        Args:
            world: Without them.
            variants: All of them act in the segments; those of one candidate may differ in their constants.
            kind: Kind of the segments.
        """
        first: dict[int, Variant] = {}
        for variant in variants:
            first.setdefault(variant.place, variant)
        everything, own = with_variants(world, list(first.values()), kind)
        fixed = [constant for variant in first.values() for constant in _constants(variant)]
        place = {p.name: k for k, p in enumerate((*own, *fixed))}
        columns, constants = [], []
        for variant in variants:
            shared = first[variant.place]
            columns.append([place[name] for name in shared.parameters])
            name = shared.active.effect.name
            constants.append({place[f"{name}.{key}"]: value for key, value in variant.constants.items()})
        return Together(world=everything, parameters=[*own, *fixed], columns=columns, constants=constants)

    def set_constants(self, values: Tensor, first: int, each: int = 1) -> None:
        """Write the constants into values (V each, P) of the variants, of each `each` rows.

        Args:
            values: The values.
            first: Column of the first of `parameters`.
            each: Number of rows of a variant.
        """
        for k, constants in enumerate(self.constants):
            for column, value in constants.items():
                values[k * each : (k + 1) * each, first + column] = value


def _constants(variant: Variant) -> list[Parameter]:
    """Return the constants of a variant as parameters; they are given, so that bounds and prior mean nothing."""
    effect = variant.active.effect
    return [
        Parameter(
            name=f"{effect.name}.{constant.name}",
            unit=constant.unit,
            bounds=(-math.inf, math.inf),
            logarithmic=False,
            reveals=effect.reveals,
            prior=(constant.default, 1.0),
        )
        for constant in effect.constants
    ]


def with_added(world: World, effect: Effect, values: Mapping[str, float] | None = None) -> World:
    """Return the world with one more effect; values that are not given are neutral."""
    active = ActiveEffect.of(effect, values, world.gravity[0, :1])
    return replace(world, effects=(*world.effects, active))


def without_effects(world: World, *names: str) -> World:
    """Return the world without some effects, and without those that act through them."""
    left = tuple(active for active in world.effects if active.effect.name not in names)
    drag = any("drag" in active.effect.provides for active in left)
    return replace(world, effects=tuple(active for active in left if drag or "drag" not in active.effect.needs))


def base_parameters(world: World, kind: Kind) -> list[Parameter]:
    """Return the nuisance parameters of a model: those of its effects, and in contact those of the contact law."""
    # group-specific parameters stay as fitted: a refit here does not know their prior
    own = [p for p in effect_parameters(world) if p.shared == "all" or not world.own_values]
    if kind == "flight":
        acting = {a.effect.name for a in world.effects if a.effect.phase != "contact"}
        return [p for p in own if p.name.partition(".")[0] in acting]
    ground = [GROUND_SHIFT] if world.ground_normal is not None else []
    return [*contact_parameters(world), *ground, *own]


def base_values(world: World, parameters: Sequence[Parameter]) -> Tensor:
    """Return the model's values (P,) of parameters in fitted coordinates; 0 for candidates and the ground shift."""
    law = contact_values(world)
    own = {f"{a.effect.name}.{name}": float(value[0]) for a in world.effects for name, value in a.values.items()}
    values = [p.encode(law[p.name]) if p.name in law else own.get(p.name, 0.0) for p in parameters]
    return torch.tensor(values, dtype=torch.float64).to(world.gravity)
