"""Interface of effects: plug-ins that change forces, contacts, bodies or measurements.

An effect is a class with a name, parameters and any of six methods. Everything is plain torch on batches, so that
derivatives flow through it. An effect changes nothing when all its parameters are 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor

from ....schemas import UsageError
from ..impulse_solver import tangent_axes

if TYPE_CHECKING:
    from ..body import Body
    from ..contact_law import Touch
    from ..world import World

Values = Mapping[str, Tensor]
"""The values of an effect's parameters and constants by name, each of shape (1,) or (n,)."""
Phase = Literal["flight", "contact", "measurement"]
"""Where an effect acts."""
Need = Literal["ground", "drag", "contact", "spin", "unmeasured_spin", "orientation", "driven"]
"""Requirements of an effect, see `Effect.needs`."""
HOOKS = ("world", "flow", "wrench", "contact", "times", "observe")
"""Methods of an effect; it overrides those that it needs."""


@dataclass(frozen=True)  # not kw_only: effects of users pass name and unit by position
class EffectParameter:
    """A parameter of an effect, whose neutral value is 0."""

    name: str
    """Name."""
    unit: str
    """Unit."""
    scale: float
    """Magnitude that changes a motion of one second visibly, in its unit."""
    limit: float
    """Largest admitted magnitude, in its unit."""
    nonnegative: bool = False
    """Whether the value cannot be negative."""
    shared: Literal["all", "group", "episode"] = "all"
    """Whether one value serves all episodes, each group of episodes, or each episode."""
    plausible: float = math.inf
    """Largest magnitude that instruments or nature usually have, in its unit; infinite where any size occurs. A larger
    one may be a mistake, such as a wrong frame rate, and has to explain the data better than a force by its odds."""
    possible: float = math.inf
    """Largest magnitude that mistakes or nature reach at all, in its unit; infinite where a mistake has any size."""


@dataclass(frozen=True)
class EffectConstant:
    """A constant of an effect without meaning while the effect is neutral, which a fit tries on a grid."""

    name: str
    """Name."""
    unit: str
    """Unit."""
    grid: tuple[float, ...]
    """Values to try, in its unit."""

    @property
    def default(self) -> float:
        """Middle value of the grid."""
        return self.grid[len(self.grid) // 2]


@dataclass(frozen=True, kw_only=True)
class BodyMotion:
    """Motion of a free body in a step, world frame, as effects receive it."""

    body: Body
    """The body."""
    mass: Tensor
    """Mass [kg], shape (n,)."""
    inertia: Tensor
    """Inertia about the centre of mass, world axes [kg m2], shape (n, 3, 3)."""
    com: Tensor
    """Centre of mass [m], shape (n, 3)."""
    rotation: Tensor
    """Rotation, body to world, shape (n, 3, 3)."""
    velocity: Tensor
    """Velocity of the centre of mass [m/s], shape (n, 3)."""
    omega: Tensor
    """Angular velocity [rad/s], shape (n, 3)."""
    up: Tensor
    """Unit vector against gravity, shape (n or 1, 3)."""
    normal: Tensor
    """Unit normal of the ground, `up` without a ground, shape (n or 1, 3)."""
    ground_offset: Tensor | None = None
    """Offset of the ground along its normal [m], shape (n or 1,); None without a ground."""
    air: Tensor | None = None
    """Velocity of the air [m/s], shape (n or 1, 3); None for still air."""

    @property
    def airspeed(self) -> Tensor:
        """Velocity (n, 3) [m/s] relative to the air, world frame."""
        return self.velocity if self.air is None else self.velocity - self.air

    @property
    def height(self) -> Tensor:
        """Height (n,) [m] of the lowest sphere above the ground, infinite without a ground."""
        return self.lowest_points()[1].amin(-1)

    def lowest_points(self) -> tuple[Tensor, Tensor]:
        """Return the lowest points of the spheres that the ground can touch: arms (n, K, 3) [m], heights (n, K) [m].

        The arms begin in the centre of mass, world axes; the heights are infinite where there is no ground.
        """
        body = self.body
        centers, radii = body.plane_spheres
        normal = self.normal[:, None]
        arms = (centers - body.com[:, None]) @ self.rotation.transpose(-1, -2) - radii[..., None] * normal
        over = ((self.com[:, None] + arms) * normal).sum(-1)
        if self.ground_offset is None:
            return arms, torch.full_like(over, math.inf)
        return arms, over - self.ground_offset[:, None]


@dataclass(frozen=True)
class Wrench:
    """Wrench on a free body, world frame."""

    force: Tensor | None = None
    """Force through the centre of mass [N], shape (n, 3); None for none."""
    torque: Tensor | None = None
    """Torque about the centre of mass [N m], shape (n, 3); None for none."""


@dataclass(frozen=True)
class Poses:
    """Measured poses of the bodies' frames."""

    position_m: Tensor
    """Positions, world frame [m], shape (B, T, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, body to world, shape (B, T, nb, 4)."""
    up: Tensor | None = None
    """Unit vector against gravity, shape (1 or B, 3); None for the world's z."""


class Effect:
    """Base class of physical and measurement effects; subclasses define class variables and the hooks that they need.

    Attributes:
        name: Name on the command line.
        summary: Description in one sentence.
        formula: Formula in plain text, with the parameters' names.
        parameters: Parameters that a fit estimates.
        constants: Constants that a fit tries on a grid.
        phase: Where it acts: in flight, in contact, or only in the measurement.
        needs: Requirements: "ground" of the world; "drag" of the other effects; "contact", "spin" (measured
            orientation), "driven" (a command) of the motion. A world or effects that lack one are refused.
        provides: "drag" where its wrench grows with `BodyMotion.airspeed`, for other effects that need it.
        reveals: Motion that shows it best.
        source: Source of the formula.
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
        """Return the world with changed masses, geometry, gravity or ground; called once for a rollout."""
        return world

    def flow(self, values: Values, motion: BodyMotion) -> Tensor:
        """Return the velocity (n or 1, 3) [m/s] of the air around a free body; called in every step before `wrench`."""
        raise NotImplementedError

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the wrench on a free body; called in every step."""
        raise NotImplementedError

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with changed coefficients; called in every step for every pair of touching bodies."""
        raise NotImplementedError

    def times(self, values: Values, times_s: Tensor) -> Tensor:
        """Return the true times (B, T) [s] of measurements with the given recorded times."""
        raise NotImplementedError

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return the measured poses for the true ones."""
        raise NotImplementedError

    def has(self, hook: Literal["world", "flow", "wrench", "contact", "times", "observe"]) -> bool:
        """Return whether the effect overrides a hook."""
        return getattr(type(self), hook) is not getattr(Effect, hook)


@dataclass(frozen=True)
class ActiveEffect:
    """An effect with values of its parameters and constants."""

    effect: Effect
    """The effect."""
    values: dict[str, Tensor]
    """Values by name, each of shape (1,) or (B,)."""

    @staticmethod
    def of(
        effect: Effect, values: Mapping[str, float | Tensor] | None = None, like: Tensor | None = None
    ) -> ActiveEffect:
        """Build an effect with the given values; missing parameters are 0, missing constants the middle of their grid.

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
    """Check that the world and the other effects have what each effect needs.

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
    """Return the length (..., 1) of vectors (..., d), with derivative 0 at zero vectors."""
    return (x.square().sum(-1, keepdim=True) + 1e-24).sqrt()


def horizontal(components: Tensor, up: Tensor) -> Tensor:
    """Return the vectors (n, 3), world frame, with the given components (n, 2) along the two horizontal axes.

    These are the world's x and y where `up` (n or 1, 3), a unit vector, is its z.
    """
    return (components[..., None, :] @ tangent_axes(up)[..., 1:, :]).squeeze(-2)
