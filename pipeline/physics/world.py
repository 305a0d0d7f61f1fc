"""World model of the engine: bodies, the ground, gravity, contact laws and effects, ready to simulate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import TypeVar, cast

import torch
from torch import Tensor

from ...schemas import InputDataError, UsageError
from ...schemas.materials import pair_of
from .body import Body
from .chains.chain import Chain
from .contact_law import ContactLaw
from .effects.effect import ActiveEffect
from .kept import Kept
from .paper_law import PaperLaw
from .state import State
from .surfaces.fixed_surface import FixedSurface

T = TypeVar("T")

MOST_STEPS = 2_000_000_000
"""Maximum number of steps of a rollout: some hours; the kernels count them in 32 bits."""


def called(source: str, what: str) -> str:
    """Return what messages call a part of a world that was built from a file, or from none: ""."""
    return f"{source}: {what}" if source else what


@dataclass(frozen=True, kw_only=True)
class World(Kept):
    """The bodies of a scene, the ground, gravity, the contact law and the effects."""

    bodies: tuple[Body, ...]
    """The bodies, in the order of the state."""
    gravity: Tensor
    """Gravitational acceleration, world frame [m/s2], shape (B, 3)."""
    ground_normal: Tensor | None
    """Unit normal of the ground, world frame, shape (3,); None without a ground."""
    ground_offset: Tensor | None
    """Offset of the ground along its normal [m], shape (B,); None without a ground."""
    contact: ContactLaw | PaperLaw
    """The contact law and its coefficients, for all pairs that `pair_laws` does not have."""
    pair_laws: Mapping[tuple[str, str], ContactLaw] = field(default_factory=dict)
    """The laws of pairs of materials, by `pair_of` of their names."""
    ground_material: str | None = None
    """Material of the ground; None where it does not matter."""
    surfaces: tuple[FixedSurface, ...] = ()
    """Fixed surfaces besides the ground."""
    step_s: float = 0.001
    """Largest time step [s]."""
    iterations: int = 10
    """Projected Jacobi iterations over all contacts of a step; 1 is the closed form alone."""
    effects: tuple[ActiveEffect, ...] = ()
    """Effects in addition to gravity and contact."""
    touching: bool = True
    """Whether bodies can touch at all; without contact every motion is free flight, at a tenth of the cost."""
    rolls_on: str | None = None
    """Device on which `engine.rollout` computes before it returns results to the device of the tensors; None for that
    of the tensors.
    """
    own_values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Group- or episode-specific values of effects' parameters: by episode, then by `effect.parameter`."""
    chains: tuple[Chain, ...] = ()
    """Jointed bodies, whose links are bodies with motion "link"."""
    source: str = ""
    """File of the model that it was built from, for messages; empty where there is none."""

    def called(self, what: str) -> str:
        """Return what messages call a part of the world: with the file that it comes from."""
        return called(self.source, what)

    def latest(self, make: Callable[..., T], *inputs: State | Tensor) -> T:
        """Return `make(self, *inputs)`, kept with the world until it is asked for with other objects.

        For callers that simulate one start, or the same times, under several commands. Tensors that were changed in
        place are others.
        """
        kept: dict[object, object] = self.__dict__.setdefault("_kept", {})
        parts = [x.tensors if isinstance(x, State) else (x,) for x in inputs]
        versions = [tensor._version for tensors in parts for tensor in tensors]
        found = cast("tuple[tuple[State | Tensor, ...], list[int], T] | None", kept.get((World.latest, make)))
        if found is None or any(a is not b for a, b in zip(found[0], inputs, strict=True)) or found[1] != versions:
            found = inputs, versions, make(self, *inputs)
            kept[World.latest, make] = found
        return found[2]

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of the state."""
        return [body.name for body in self.bodies]

    @property
    def free(self) -> list[int]:
        """Indices of the free bodies."""
        return [index for index, body in enumerate(self.bodies) if body.free]

    @property
    def tracked(self) -> list[int]:
        """Indices of the bodies that physics moves: free ones, and links that joints or a free root move."""
        return [index for index in range(len(self.bodies)) if self.moves(index)]

    @property
    def driven(self) -> list[str]:
        """Names of the bodies whose tracks are commands: driven ones, and roots of driven chains."""
        roots = {chain.root for chain in self.chains if chain.base == "driven"}
        return [body.name for body in self.bodies if body.motion == "driven" or body.name in roots]

    def chain_of(self, index: int) -> int:
        """Return the number of the chain of which a body is a link, -1 for none."""
        name = self.bodies[index].name
        return next((k for k, chain in enumerate(self.chains) if name in chain.links), -1)

    def moves(self, index: int) -> bool:
        """Return whether contact moves a body: a free one, or a link that a joint or a free root moves."""
        chain = self.chain_of(index) if self.chains else -1
        return self.bodies[index].free or (chain >= 0 and self.chains[chain].moves(self.bodies[index].name))

    @property
    def ground(self) -> tuple[Tensor, Tensor]:
        """Normal (3,) of the ground and its offset (1 or B,) [m] along the normal.

        Raises:
            UsageError: If the world has no ground.
        """
        if self.ground_normal is None or self.ground_offset is None:
            raise UsageError("this world has no ground.", todo="give the ground in capture.toml, under [world].")
        return self.ground_normal, self.ground_offset

    def surface(self, index: int) -> FixedSurface | None:
        """Return the fixed surface of the second index of a pair, -2 for the first one; None for others."""
        return self.surfaces[-2 - index] if index < -1 else None

    def named(self, index: int) -> str:
        """Return what messages call the second of a pair: the ground, a surface or a body."""
        surface = self.surface(index)
        if surface is not None:
            return f"surface '{surface.name}'"
        return "the ground" if index < 0 else f"body '{self.bodies[index].name}'"

    def substeps(self, times_s: Tensor) -> list[int]:
        """Return the number of steps in each interval of times (B, T) [s], none of them longer than `step_s`.

        Raises:
            InputDataError: If these are more than `MOST_STEPS`.
        """
        longest = times_s.detach().diff(dim=1).amax(0).tolist()
        steps = sum(longest) / self.step_s
        if steps > MOST_STEPS:
            raise InputDataError(
                f"{sum(longest):.4g} s of motion in steps of {self.step_s:g} s are {steps:.3g} steps.",
                f"up to {MOST_STEPS:.3g} steps.",
                "check the times (seconds?) and the step_s of the model.",
            )
        return [max(1, math.ceil(length / self.step_s - 1e-6)) for length in longest]

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """The pairs that can touch: each free body with the ground (-1), fixed surfaces (-2, ...) and other bodies.

        Links of chains are as free bodies; but of one chain only those touch each other that it lists, and a link that
        no joint moves only touches what moves.
        """
        if not self.touching:
            return []
        solid = [k for k, body in enumerate(self.bodies) if body.radii.shape[-1] > 0]
        moving = [k for k in solid if self.moves(k)]
        within = {name for chain in self.chains for name in chain.within}
        inner = {k for k in solid if self.bodies[k].name in within}
        outer = [k for k in moving if k not in inner]
        on_ground = [] if self.ground_normal is None else [(i, -1) for i in outer]
        on_surfaces = [(i, -2 - s) for i in outer for s in range(len(self.surfaces))]
        return on_ground + on_surfaces + self._between(solid, moving, inner)

    def _between(self, solid: Sequence[int], moving: Sequence[int], inner: set[int]) -> list[tuple[int, int]]:
        """Return the pairs of solid bodies that can touch each other, of which one at least moves: that one first.

        Those that are `inner` touch nothing but links of their chain.
        """
        chain = {k: self.chain_of(k) if self.chains else -1 for k in solid}
        own = {frozenset(pair) for one in self.chains for pair in one.touching}
        names = self.body_names
        apart = [
            (i, j)
            for i, j in combinations(solid, 2)
            if (frozenset((names[i], names[j])) in own if 0 <= chain[i] == chain[j] else not inner & {i, j})
        ]
        ordered = [(i, j) if i in moving else (j, i) for i, j in apart]
        return [pair for pair in ordered if pair[0] in moving]

    @property
    def laws(self) -> tuple[ContactLaw | PaperLaw, ...]:
        """All contact laws: that of pairs without a law of their own, then those of `pair_laws`."""
        return (self.contact, *self.pair_laws.values())

    def material_of(self, index: int) -> str | None:
        """Return the material of a body, of the ground for -1, of a surface below."""
        surface = self.surface(index)
        if surface is not None:
            return surface.material
        return self.ground_material if index < 0 else self.bodies[index].material

    def materials_of(self, a: int, b: int) -> tuple[str, str] | None:
        """Return the materials of a pair, by index, where they have a law of their own; else None."""
        return self.pair_between(self.material_of(a), self.material_of(b))

    def law_of(self, a: int, b: int) -> ContactLaw | PaperLaw:
        """Return the contact law of two bodies, by index; -1 is the ground, surfaces follow."""
        return self.law_between(self.material_of(a), self.material_of(b))

    def law_between(self, first: str | None, second: str | None) -> ContactLaw | PaperLaw:
        """Return the contact law of two materials in either order: `contact` where the pair has none of its own."""
        pair = self.pair_between(first, second)
        return self.contact if pair is None else self.pair_laws[pair]

    def pair_between(self, first: str | None, second: str | None) -> tuple[str, str] | None:
        """Return the pair of two materials where it has a law of its own, else None."""
        pair = None if first is None or second is None else pair_of(first, second)
        return pair if pair in self.pair_laws else None

    @property
    def up(self) -> Tensor:
        """Unit vector (1 or B, 3) against gravity; without gravity the ground's normal, or the world's z."""
        size = self.gravity.square().sum(-1, keepdim=True)
        other = torch.eye(3).to(self.gravity)[2] if self.ground_normal is None else self.ground_normal
        safe = torch.where(size > 0, size, torch.ones_like(size))
        return torch.where(size > 0, -self.gravity / safe.sqrt(), other)

    def with_body(self, index: int, **changes: Tensor) -> World:
        """Return a copy in which some tensors of one body are replaced; other spheres have no hull."""
        bodies = list(self.bodies)
        other = {"hull": None} if {"centers", "radii"} & set(changes) else {}
        bodies[index] = replace(bodies[index], **changes, **other)
        return replace(self, bodies=tuple(bodies))
