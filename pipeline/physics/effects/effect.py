"""What a physical effect is: a plug-in that changes forces, contacts, bodies or what is measured.

An effect is a class with a name, parameters and any of six methods; the others stay as they are. Everything is plain
torch on batches, so that derivatives flow through it. It changes nothing when its parameters have the value 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor

from ....schemas import UsageError
from ..sweeps import tangent_axes

if TYPE_CHECKING:
    from ..contact import Touch
    from ..world import Body, World

Values = Mapping[str, Tensor]
"""The values of an effect's parameters and constants by name, each of shape (1,) or (n,)."""
Phase = Literal["flight", "contact", "measurement"]
Need = Literal["ground", "drag", "contact", "spin", "driven"]


@dataclass(frozen=True)
class EffectParameter:
    """A number of an effect; 0 is neutral.

    scale: a magnitude that matters, in its unit: what changes a motion of one second visibly; limit: the largest
    magnitude admitted; nonnegative: whether it may not be negative; shared: whether one value serves all episodes, or
    each group of episodes, or each episode, has its own.
    """

    name: str
    unit: str
    scale: float
    limit: float
    nonnegative: bool = False
    shared: Literal["all", "group", "episode"] = "all"


@dataclass(frozen=True)
class EffectConstant:
    """A number that means nothing while the effect is neutral: it is tried at each value of a grid."""

    name: str
    unit: str
    grid: tuple[float, ...]

    @property
    def default(self) -> float:
        """The value in the middle of the grid."""
        return self.grid[len(self.grid) // 2]


@dataclass(frozen=True)
class BodyMotion:
    """A free body in a step, world frame.

    body; mass (n,) [kg]; inertia (n, 3, 3) [kg m2] about the centre of mass, world axes; com (n, 3) [m]; rotation
    (n, 3, 3), body to world; velocity (n, 3) [m/s] of the centre of mass; omega (n, 3) [rad/s]; up (n or 1, 3):
    against gravity; normal (n or 1, 3): of the ground, up where there is none; ground_offset (n or 1,) [m] along it,
    None where there is no ground; air (n or 1, 3) [m/s]: velocity of the air, None where it stands still.
    """

    body: Body
    mass: Tensor
    inertia: Tensor
    com: Tensor
    rotation: Tensor
    velocity: Tensor
    omega: Tensor
    up: Tensor
    normal: Tensor
    ground_offset: Tensor | None = None
    air: Tensor | None = None

    @property
    def airspeed(self) -> Tensor:
        """Velocity (n, 3) [m/s] relative to the air."""
        return self.velocity if self.air is None else self.velocity - self.air

    @property
    def height(self) -> Tensor:
        """Height (n,) [m] of the lowest sphere over the ground, infinite where there is none."""
        return self.lowest_points()[1].amin(-1)

    def lowest_points(self) -> tuple[Tensor, Tensor]:
        """Return the lowest points of the spheres that the ground can touch: arms (n, K, 3) [m], heights (n, K) [m].

        The arms begin in the centre of mass, world axes; the heights are infinite where there is no ground.
        """
        body = self.body
        centers, radii = body.centers, body.radii
        if body.on_plane is not None:
            centers, radii = centers[:, body.on_plane], radii[:, body.on_plane]
        normal = self.normal[:, None]
        arms = (centers - body.com[:, None]) @ self.rotation.transpose(-1, -2) - radii[..., None] * normal
        over = ((self.com[:, None] + arms) * normal).sum(-1)
        if self.ground_offset is None:
            return arms, torch.full_like(over, math.inf)
        return arms, over - self.ground_offset[:, None]


@dataclass(frozen=True)
class Wrench:
    """Force (n, 3) [N] through the centre of mass and torque (n, 3) [N m] about it, world frame."""

    force: Tensor | None = None
    torque: Tensor | None = None


@dataclass(frozen=True)
class Poses:
    """Poses of the bodies' frames as measured: position_m (B, T, nb, 3), quat_wxyz (B, T, nb, 4).

    up (1 or B, 3): against gravity; None where that is the world's z.
    """

    position_m: Tensor
    quat_wxyz: Tensor
    up: Tensor | None = None


class Effect:
    """A physical or a measurement effect. Subclass it, fill in the class variables, and write the hooks that it needs.

    Attributes:
        name: What the user types.
        summary: What it is, in one sentence.
        formula: In plain text, with the parameters' names.
        parameters: Its numbers.
        constants: Numbers that are tried on a grid.
        phase: Where it acts: in flight, in contact, or in the measurement alone.
        needs: What it cannot do without: of the world "ground"; of the other effects "drag"; of the motion "contact",
            "spin" (measured orientation), "driven" (a command). What the world or the effects lack is refused.
        provides: What it is to other effects: "drag" where its wrench grows with `BodyMotion.airspeed`.
        reveals: The motion that shows it best.
        source: Where the formula comes from.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    formula: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    constants: ClassVar[tuple[EffectConstant, ...]] = ()
    phase: ClassVar[Phase]
    needs: ClassVar[tuple[Need, ...]] = ()
    provides: ClassVar[tuple[Literal["drag"], ...]] = ()
    reveals: ClassVar[str]
    source: ClassVar[str]

    def world(self, values: Values, world: World) -> World:
        """Return the world with other masses, geometry, gravity or ground; called once for a rollout."""
        return world

    def flow(self, values: Values, motion: BodyMotion) -> Tensor:
        """Return the velocity (n or 1, 3) [m/s] of the air around a free body; called in every step before `wrench`."""
        raise NotImplementedError

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the wrench on a free body; called in every step."""
        raise NotImplementedError

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with other numbers; called in every step for every pair of bodies that touches."""
        raise NotImplementedError

    def times(self, values: Values, times_s: Tensor) -> Tensor:
        """Return the true times (B, T) [s] of measurements at the times that were recorded."""
        raise NotImplementedError

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return what is measured of the true poses."""
        raise NotImplementedError

    def has(self, hook: Literal["world", "flow", "wrench", "contact", "times", "observe"]) -> bool:
        """Whether the effect has a hook of its own."""
        return getattr(type(self), hook) is not getattr(Effect, hook)


@dataclass(frozen=True)
class ActiveEffect:
    """An effect with the values (1 or B,) of its parameters and constants."""

    effect: Effect
    values: dict[str, Tensor]

    @staticmethod
    def of(
        effect: Effect, values: Mapping[str, float | Tensor] | None = None, like: Tensor | None = None
    ) -> ActiveEffect:
        """Return an effect at the given values; parameters left out are 0, constants at the middle of their grids.

        Raises:
            KeyError: If a name is not one of the effect's.
        """
        known = {p.name: 0.0 for p in effect.parameters} | {c.name: c.default for c in effect.constants}
        unknown = set(values or {}) - set(known)
        if unknown:
            raise KeyError(f"{effect.name} has no {sorted(unknown)[0]}; it has {', '.join(known)}")
        like = torch.zeros(1, dtype=torch.float64) if like is None else like
        return ActiveEffect(
            effect,
            {
                name: torch.as_tensor(value, dtype=like.dtype, device=like.device).reshape(-1)
                for name, value in (known | dict(values or {})).items()
            },
        )

    def at(self, items: Tensor | None) -> Values:
        """Return the values of some items (n,) of the batch; all for None."""
        if items is None:
            return self.values
        return {name: v if v.shape[0] == 1 else v.index_select(0, items) for name, v in self.values.items()}


def check_needs(effects: Sequence[ActiveEffect], ground: bool) -> None:
    """Refuse effects that lack something in the world or among the other effects.

    Raises:
        UsageError: If one needs a ground and there is none, or a drag and no other effect is one.
    """
    for active in effects:
        effect = active.effect
        if "ground" in effect.needs and not ground:
            raise UsageError(
                f"the effect '{effect.name}' needs a ground, and this world has none.",
                todo="give the ground in capture.toml, under [world], or leave the effect out.",
            )
        if "drag" in effect.needs and not any("drag" in other.effect.provides for other in effects):
            raise UsageError(
                f"the effect '{effect.name}' acts through air resistance, and the model has none.",
                todo=f"add a drag: --effects {effect.name},linear_drag or {effect.name},quadratic_drag.",
            )


def changed_by_effects(world: World) -> World:
    """Return the world with the masses, geometry, gravity and ground that its effects give it.

    Raises:
        UsageError: See :func:`check_needs`.
    """
    check_needs(world.effects, world.ground_normal is not None)
    for active in world.effects:
        world = active.effect.world(active.values, world)
    return world


def vector(values: Values, *names: str) -> Tensor:
    """Return values stacked as vectors (n, len(names))."""
    return torch.stack([values[name] for name in names], -1)


def length(x: Tensor) -> Tensor:
    """Return the length (..., 1) of vectors (..., d), with derivative 0 where it vanishes."""
    return (x.square().sum(-1, keepdim=True) + 1e-24).sqrt()


def horizontal(components: Tensor, up: Tensor) -> Tensor:
    """Return the vectors (n, 3), world frame, with the given components (n, 2) along the two horizontal axes.

    These are the world's x and y where `up` (n or 1, 3), a unit vector, is its z.
    """
    return (components[..., None, :] @ tangent_axes(up)[..., 1:, :]).squeeze(-2)
