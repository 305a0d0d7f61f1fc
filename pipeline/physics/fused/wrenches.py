"""The effects of a world that the fused kernel knows, as coefficients of accelerations in flight."""

from __future__ import annotations

import torch
from torch import Tensor

from ..contact import ContactLaw
from ..effects.buoyancy import Buoyancy
from ..effects.constant_force import ConstantForce
from ..effects.effect import Effect, vector
from ..effects.ground_magnet import GroundMagnet
from ..effects.linear_drag import LinearDrag
from ..effects.magnus_lift import MagnusLift
from ..effects.quadratic_drag import QuadraticDrag
from ..effects.spin_damping import SpinDamping
from ..effects.wind import Wind
from ..world import World

_KNOWN = (LinearDrag, QuadraticDrag, MagnusLift, SpinDamping, ConstantForce, Buoyancy, Wind, GroundMagnet)


def reason_against(world: World) -> str | None:
    """Return what in a world's contact law or effects the kernel does not have; None where it has all."""
    if not isinstance(world.contact, ContactLaw):
        return f"the kernel does not have its contact law '{world.contact.name}'"
    acting = [active.effect for active in world.effects if _acts(active.effect)]
    for effect in acting:
        if type(effect) not in _KNOWN:  # a user's subclass of a known one is another effect
            return f"the kernel does not have its effect '{effect.name}'"
    if sum(isinstance(effect, GroundMagnet) for effect in acting) > 1:
        return "the kernel takes one ground_magnet, and it has several"
    if has_magnet(world) and not world.touching:
        return "the kernel finds the height for ground_magnet by contacts, and its bodies do not touch anything"
    return None


def _acts(effect: Effect) -> bool:
    """Whether an effect acts within the steps; those that change the world or the measurement do so outside."""
    return any(effect.has(hook) for hook in ("flow", "wrench", "contact"))


def has_magnet(world: World) -> bool:
    """Whether the ground pulls."""
    return any(isinstance(active.effect, GroundMagnet) for active in world.effects)


def coefficients(world: World) -> list[Tensor]:
    """Return the coefficients (1 or B, k) of the accelerations, world frame; none where no effect acts.

    In this order: c, k, s, d; f (3) with the buoyancy; wind (3); A, l of the ground's pull:
    a = -(c + k |u|) u + s omega x u + f - A exp(-height / l) n with u = v - wind, and alpha = -d omega.
    """
    if not any(_acts(active.effect) for active in world.effects):
        return []
    zero = torch.zeros_like(world.gravity[:1, :1])
    linear = quadratic = magnus = damping = magnet = zero
    still = torch.zeros_like(world.gravity[:1])
    force, wind, reach = still, still, zero + 1.0
    for active in world.effects:
        values = {name: value[:, None] for name, value in active.values.items()}
        match active.effect:
            case LinearDrag():
                linear = linear + values["c"]
            case QuadraticDrag():
                quadratic = quadratic + values["k"]
            case MagnusLift():
                magnus = magnus + values["s"]
            case SpinDamping():
                damping = damping + values["d"]
            case ConstantForce():
                force = force + vector(active.values, "f_x", "f_y", "f_z")
            case Buoyancy():
                force = force + values["b"] * world.up
            case Wind() as effect:
                wind = wind + effect.along(active.values, world.up)
            case GroundMagnet():
                magnet, reach = values["A"], values["l"]
    return [linear, quadratic, magnus, damping, force, wind, magnet, reach]
