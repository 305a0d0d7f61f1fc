"""Effects that the fused kernel supports: their coefficients in flight and in contact."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..contact_law import ContactLaw
from ..effects.adhesion import Adhesion
from ..effects.anisotropic_friction import AnisotropicFriction
from ..effects.buoyancy import Buoyancy
from ..effects.constant_force import ConstantForce
from ..effects.effect import Effect, Values, vector
from ..effects.friction_patch import FrictionPatch
from ..effects.ground_magnet import GroundMagnet
from ..effects.linear_drag import LinearDrag
from ..effects.magnus_lift import MagnusLift
from ..effects.quadratic_drag import QuadraticDrag
from ..effects.residual_wrench import ResidualWrench
from ..effects.rolling_resistance import RollingResistance
from ..effects.spin_damping import SpinDamping
from ..effects.spin_lift import SpinLift
from ..effects.stribeck_friction import StribeckFriction
from ..effects.torsional_friction import TorsionalFriction
from ..effects.velocity_restitution import VelocityRestitution
from ..effects.viscous_friction import ViscousFriction
from ..effects.wind import Wind
from ..pair_laws import laws_in_use
from ..paper_law import PaperLaw
from ..world import World

_KNOWN = (
    LinearDrag,
    QuadraticDrag,
    MagnusLift,
    SpinLift,
    SpinDamping,
    ConstantForce,
    Buoyancy,
    Wind,
    GroundMagnet,
    ResidualWrench,
)
_DIRECTED = (AnisotropicFriction, FrictionPatch)
_GROUND = (*_DIRECTED, Adhesion)
_SURFACE = (
    *_GROUND, RollingResistance, StribeckFriction, TorsionalFriction, VelocityRestitution, ViscousFriction,
)  # fmt: skip


def reason_against(world: World) -> str | None:
    """Return the part of a world's contact law or effects that the kernel lacks, in words; None where it has all."""
    acting = [active.effect for active in world.effects if _acts(active.effect)]
    if not isinstance(world.contact, ContactLaw):
        return _against_published(world, world.contact, acting)
    for effect in acting:
        if type(effect) not in (*_KNOWN, *_SURFACE):  # a user's subclass of a known one is another effect
            return f"the kernel does not have its effect '{effect.name}'"
    for kind in _SURFACE:
        if sum(isinstance(effect, kind) for effect in acting) > 1:
            return f"the kernel takes one {kind.name}, and it has several"
    if world.chains and any(isinstance(effect, GroundMagnet) for effect in acting):
        return f"the kernel has '{GroundMagnet.name}' for free bodies only"
    if not world.touching and any(isinstance(effect, Adhesion) for effect in acting):
        return f"the kernel finds the height for {Adhesion.name} by contacts, and its bodies do not touch anything"
    return _against_surface(world, acting)


def _against_published(world: World, law: PaperLaw, acting: Sequence[Effect]) -> str | None:
    """Return why the kernel does not support a world with the paper's law; None where it does."""
    if world.pair_laws or world.chains or world.surfaces:
        beside = "other laws" if world.pair_laws else "chains" if world.chains else "fixed surfaces"
        return f"the kernel does not have the contact law '{law.name}' beside {beside}"
    if acting:
        return f"the kernel does not have the contact law '{law.name}' with the effect '{acting[0].name}'"
    if law.sharpness_per_m is None and len(world.bodies) > 1:
        return f"the kernel has the contact law '{law.name}' between bodies with a sharpness of their distance alone"
    return None


def _against_surface(world: World, acting: Sequence[Effect]) -> str | None:
    """Return why the kernel does not support the contact effects of a world; None where it does, or without any."""
    surface = next((effect for effect in acting if isinstance(effect, _SURFACE)), None)
    if surface is not None and (len(world.bodies) > 1 or (world.ground_normal is None and not world.surfaces)):
        return f"the kernel has '{surface.name}' for one body only, on a ground or fixed surfaces"
    upon = next((effect for effect in acting if isinstance(effect, _GROUND)), None)
    if upon is not None and (world.surfaces or world.ground_normal is None):
        return f"the kernel has '{upon.name}' for one body on the ground only"
    if surface is not None and world.surfaces and len(laws_in_use(world).laws) > 1:
        return f"the kernel has '{surface.name}' beside fixed surfaces of one material only"
    directed = next((effect for effect in acting if isinstance(effect, _DIRECTED)), None)
    if directed is not None and world.ground_normal is not None and world.ground_normal.tolist() != [0.0, 0.0, 1.0]:
        return f"the kernel has '{directed.name}' for an upright ground only"
    return None


def _acts(effect: Effect) -> bool:
    """Return whether an effect acts within the steps, not only on the world before or on the measurement."""
    return any(effect.has(hook) for hook in ("flow", "wrench", "contact"))


def magnets(world: World) -> int:
    """Return the number of attractions by the ground."""
    return sum(isinstance(active.effect, GroundMagnet) for active in world.effects)


def takes_heights(world: World) -> bool:
    """Return whether heights above the ground are needed in addition to contacts."""
    return magnets(world) > 0 or has_surface(world)


def is_twisted(world: World) -> bool:
    """Return whether a constant angular acceleration acts."""
    return any(isinstance(active.effect, ResidualWrench) for active in world.effects)


def is_lifted(world: World) -> bool:
    """Return whether the lift of a spin that was not measured acts."""
    return any(isinstance(active.effect, SpinLift) for active in world.effects)


def has_surface(world: World) -> bool:
    """Return whether an effect changes the contact with the ground; never where bodies do not touch."""
    return world.touching and any(isinstance(active.effect, _SURFACE) for active in world.effects)


def has_ellipse(world: World) -> bool:
    """Return whether the friction depends on the direction."""
    return world.touching and any(isinstance(active.effect, AnisotropicFriction) for active in world.effects)


def coefficients(world: World) -> list[Tensor]:
    """Return the coefficients (1 or B, k) of the effects, world frame; empty where no effect acts.

    Order: c, k, s, d; f (3) with the buoyancy; wind (3); a constant angular acceleration (3) if any; the lift q (3) of
    a spin that was not measured if any; A, l of each attraction by the ground:
    a = -(c + k |u|) u + (s omega + q) x u + f - sum A exp(-height / l) n with u = v - wind, and
    alpha = twist - d omega. Then the coefficients of the contact, if any, in the order of `Surface` in
    `kernels/surface.cuh`.
    """
    if not any(_acts(active.effect) for active in world.effects):
        return []
    zero = torch.zeros_like(world.gravity[:1, :1])
    linear = quadratic = magnus = damping = zero
    still = torch.zeros_like(world.gravity[:1])
    force, wind, twist, lift, pulls = still, still, still, still, []
    for active in world.effects:
        values = {name: value[:, None] for name, value in active.values.items()}
        match active.effect:
            case LinearDrag():
                linear = linear + values["c"]
            case QuadraticDrag():
                quadratic = quadratic + values["k"]
            case MagnusLift():
                magnus = magnus + values["s"]
            case SpinLift():
                lift = lift + vector(active.values, "q_x", "q_y", "q_z")
            case SpinDamping():
                damping = damping + values["d"]
            case ConstantForce():
                force = force + vector(active.values, "f_x", "f_y", "f_z")
            case Buoyancy():
                force = force + values["b"] * world.up
            case Wind() as effect:
                wind = wind + effect.along(active.values, world.up)
            case GroundMagnet():
                pulls += [values["A"], values["l"]]
            case ResidualWrench() as effect:
                force = force + effect.acceleration(active.values)
                twist = twist + effect.angular_acceleration(active.values)
    given = [*([twist] if is_twisted(world) else []), *([lift] if is_lifted(world) else [])]
    found = [linear, quadratic, magnus, damping, force, wind, *given, *pulls]
    return [*found, *_surface(world, zero)] if has_surface(world) else found


def _surface(world: World, zero: Tensor) -> list[Tensor]:
    """Return the columns (1 or B, 1) of `Surface`; lengths and speeds of effects that do not act are 1."""
    law = laws_in_use(world).laws[0]  # the surface is that of one body on the ground
    values: dict[type[Effect], Values] = {type(active.effect): active.values for active in world.effects}

    def number(kind: type[Effect], name: str, otherwise: float = 0.0) -> Tensor:
        return values[kind][name][:, None] if kind in values else zero + otherwise

    spots = [number(FrictionPatch, parameter.name) for parameter in FrictionPatch.parameters]
    return [
        number(StribeckFriction, "d"), number(StribeckFriction, "v_s", 1.0),
        number(AnisotropicFriction, "a"), number(AnisotropicFriction, "b"),
        *spots, number(FrictionPatch, "p", 1.0), number(ViscousFriction, "c_v"), number(RollingResistance, "c_r"),
        number(TorsionalFriction, "c_t"), number(VelocityRestitution, "r"), law.contact_time_s[:, None],
        law.damping_ratio[:, None], number(Adhesion, "F"), number(Adhesion, "g", 1.0),
    ]  # fmt: skip
