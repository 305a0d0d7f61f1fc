"""Velocities of a rigid body after one impact in one point: Routh's method, including effects.

The normal impulse P grows from 0 to the measured one, the velocity u of the touching point follows by du = K dp with K
= 1/m - [r]x I^-1 [r]x, and the friction part of dp is opposite to the slip, mu dP at most, or smaller where that stops
the slip (Routh 1905, ch. 5; Stronge 2000, ch. 4). The rebound comes from a spring and damper, whose damping ratio gives
the restitution (`contact.restitution`), integrated in time where an effect changes them with the speed, so that an
effect needs no formula for impacts: its contact function is called as in a rollout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..physics.body import Body
from ..physics.contact_law import ContactLaw, Touch
from ..physics.effects.effect import ActiveEffect, BodyMotion
from ..physics.impulse_solver import tangent_axes
from ..physics.world import World

SLICES = 24
"""Number of increments of the normal impulse."""
STEPS, STEP = 64, 0.055
"""Number of steps of the spring and damper, and their length in natural times: 3.5 of these cover every impact that
ends."""
REACH_M, REACH_STEPS = 0.01, 24
"""Height [m] below which a contact effect may pull on a body before or after contact, and number of steps of that
integral."""


@dataclass(frozen=True, kw_only=True)
class Impact:
    """Impacts (n) of a body on the ground, world frame."""

    before: Tensor
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s], shape (n, 6)."""
    impulse: Tensor
    """Impulse along the normal, shape (n,) [N s]."""
    place: Tensor
    """The touching point, shape (n, 3) [m]."""
    rotation: Tensor
    """Rotation from body to world, shape (n, 3, 3)."""
    arm: Tensor
    """Vector from the centre of mass to the point, shape (n, 3) [m]."""
    inertia: Tensor
    """Inertia about the centre of mass, world axes, shape (n, 3, 3) [kg m2]."""
    mass: Tensor
    """Mass, shape (n,) [kg]."""
    normal: Tensor
    """Normal of the ground, shape (3,)."""
    weight: Tensor
    """Gravity into the ground, shape (n,) [m/s2]."""
    body: Body
    """The body that strikes the ground."""

    @property
    def compliance(self) -> Tensor:
        """K (n, 3, 3) [1/kg]: change of the point's velocity by an impulse there."""
        eye = torch.eye(3).to(self.arm)
        turns = torch.linalg.cross(self.arm[:, None].expand(-1, 3, -1), eye.expand(len(self.arm), 3, 3))  # r x e_k
        return eye / self.mass[:, None, None] + turns @ torch.linalg.solve(self.inertia, turns.mT)


def contact_law(world: World) -> ContactLaw:
    """Return the contact law of a world, which impacts and sliding need.

    Raises:
        TypeError: If the world has another law.
    """
    if not isinstance(world.contact, ContactLaw):
        raise TypeError(f"impacts and sliding need a ContactLaw, not a {type(world.contact).__name__}")
    return world.contact


def point_velocity(twist: Tensor, arm: Tensor) -> Tensor:
    """Return the velocity (n, 3) of the point at an arm (n, 3) from the centre of mass, of twists (n, 6)."""
    return twist[:, :3] + torch.linalg.cross(twist[:, 3:], arm)


def rebound_speed(impact: Impact, law: ContactLaw, effects: Sequence[ActiveEffect]) -> Tensor:
    """Return the speed (n,) [m/s] along the normal at which the point leaves the ground.

    x'' = -x / tau^2 - 2 zeta x' / tau - g - F / m until the ground would have to pull, with tau, zeta and the pull F as
    effects change them; on the way through the effects' reach their pull adds F dh / m to the square of the speed
    before contact, and subtracts it after.
    """
    speed = -(point_velocity(impact.before, impact.arm) @ impact.normal)
    mass = 1 / torch.einsum("i,nij,j->n", impact.normal, impact.compliance, impact.normal)
    heights = REACH_M * (torch.arange(REACH_STEPS) + 0.5) / REACH_STEPS
    pulls = [_pull(impact, effects, float(height)) for height in heights] if _pulling(effects) else []
    work = torch.stack(pulls).sum(0) * REACH_M / REACH_STEPS / mass if pulls else torch.zeros_like(speed)
    down = impact.weight + (_pull(impact, effects, 0.0) / mass if pulls else 0.0)
    u = -(speed.clamp_min(1e-6).square() + 2 * work).sqrt()
    x, out, done = torch.zeros_like(u), torch.zeros_like(u), torch.zeros_like(u, dtype=torch.bool)
    step = STEP * law.contact_time_s.expand_as(u)

    slip = point_velocity(impact.before, impact.arm)
    slip = slip - (slip @ impact.normal)[:, None] * impact.normal
    springs = [active for active in effects if _changes_spring(_touched(impact, law, [active], slip, None), law)]

    def numbers(tau: Tensor, zeta: Tensor) -> tuple[Tensor, Tensor]:
        return tau.square().reciprocal(), 2 * zeta / tau

    stiffness, damping = numbers(law.contact_time_s, law.damping_ratio)

    def push(x: Tensor, u: Tensor) -> Tensor:
        if not springs:
            return -stiffness * x - damping * u
        touch = _touched(impact, law, springs, slip + u[:, None] * impact.normal, None, x)
        k, c = numbers(touch.contact_time_s[:, 0], touch.damping_ratio[:, 0])
        return -k * x - c * u

    before = push(x, u)
    for _ in range(STEPS):
        rate = before - down
        xm, um = x + 0.5 * step * u, u + 0.5 * step * rate
        x, new = x + step * um, u + step * (push(xm, um) - down)
        after = push(x, new)
        share = (before / (before - after).clamp_min(1e-30)).clamp(0.0, 1.0)
        ends = ~done & (after <= 0)
        out = torch.where(ends, u + share * (new - u), out)
        done |= ends
        u, before = new, after
    out = torch.where(done, out, u).clamp_min(0.0)
    return (out.square() - 2 * work).clamp_min(0.0).sqrt()


def after_impact(impact: Impact, law: ContactLaw, effects: Sequence[ActiveEffect]) -> Tensor:
    """Return the twists (n, 6) after the impacts, with the given impulse along the normal."""
    k, normal = impact.compliance, impact.normal
    across = tangent_axes(normal)[1:]  # (2, 3)
    twist = impact.before
    slice_ = impact.impulse / SLICES
    stopping = -torch.linalg.inv(across @ k @ across.T)
    by_slice = slice_[:, None] * ((k @ normal) @ across.T)
    spun = torch.linalg.inv(impact.inertia)
    acting = any(active.effect.has("contact") for active in effects)
    touch = _touched(impact, law, effects, point_velocity(twist, impact.arm), twist[:, 3:])
    cone = _cone(touch)
    for _ in range(SLICES):
        u = point_velocity(twist, impact.arm)
        if acting:
            touch = _touched(impact, law, effects, u, twist[:, 3:])
            cone = _cone(touch)
        # the impulse that would stop the slip, including the change of slip by the normal impulse
        slip = u @ across.T + by_slice
        wanted = (stopping @ slip[..., None])[..., 0]
        friction = within_cone(wanted, slip, cone, slice_)
        push = slice_[:, None] * normal + friction @ across
        turn = torch.linalg.cross(impact.arm, push)
        twist = twist + torch.cat([push / impact.mass[:, None], (spun @ turn[..., None])[..., 0]], -1)
        twist = _braked(impact, touch, slice_, twist)
    return twist


def within_cone(wanted: Tensor, slip: Tensor, cone: Tensor, slice_: Tensor) -> Tensor:
    """Return the friction impulse (n, 2) that stops the slip, or -P M^2 s / |M s| where that lies outside the cone.

    The cone (n, 2, 2) is the symmetric matrix M of an ellipse; with M = mu it is Coulomb's disc.
    """
    # by elements, as an inverse of each of many small matrices takes five times as long
    first, off, last = cone[:, 0, 0] + 1e-9, cone[:, 0, 1], cone[:, 1, 1] + 1e-9
    (x, y), (u, v) = wanted.unbind(-1), slip.unbind(-1)
    size2 = (last * x - off * y).square() + (first * y - off * x).square()
    inside = size2.sqrt() <= slice_ * (first * last - off * off).abs()
    first, last = cone[:, 0, 0], cone[:, 1, 1]
    u, v = first * u + off * v, off * u + last * v
    share = -slice_ / (u * u + v * v).sqrt().clamp_min(1e-12)
    most = torch.stack([share * (first * u + off * v), share * (off * u + last * v)], -1)
    return torch.where(inside[:, None], wanted, most)


def _cone(touch: Touch) -> Tensor:
    """Return M (n, 2, 2) of the friction: mu I, plus the grain of an effect, [[a, b], [b, -a]]."""
    friction = touch.friction.clamp_min(0.0)  # friction never accelerates a slide
    cone = friction[..., None] * torch.eye(2).to(friction)
    grain = touch.anisotropy
    if grain is None:
        return cone
    a, b = grain[:, 0].unbind(-1)
    return cone + torch.stack([torch.stack([a, b], -1), torch.stack([b, -a], -1)], -2)


def _braked(impact: Impact, touch: Touch, slice_: Tensor, twist: Tensor) -> Tensor:
    """Return the twists after one increment's torque against rolling and spinning, which reverses neither."""
    if touch.rolling_m is None and touch.torsion_m is None:
        return twist
    normal, omega = impact.normal, twist[:, 3:]
    spin = (omega @ normal)[:, None] * normal
    for size, part in ((touch.rolling_m, omega - spin), (touch.torsion_m, spin)):
        if size is None:
            continue
        speed = part.norm(dim=-1, keepdim=True)
        way = part / speed.clamp_min(1e-12)
        change = torch.linalg.solve(impact.inertia, way[..., None])[..., 0]
        most = speed[:, 0] / (change * way).sum(-1).clamp_min(1e-12)
        omega = omega - torch.minimum(size.reshape(-1) * slice_, most)[:, None] * change
    return torch.cat([twist[:, :3], omega], -1)


def _touched(
    impact: Impact,
    law: ContactLaw,
    effects: Sequence[ActiveEffect],
    u: Tensor,
    omega: Tensor | None,
    gap: Tensor | None = None,
) -> Touch:
    """Return the contact (n, one point) as effects change it for a velocity (n, 3) of the point."""
    count = len(u)
    friction, contact_time_s, damping_ratio = (
        x.expand(count)[:, None] for x in (law.friction, law.contact_time_s, law.damping_ratio)
    )
    touch = Touch(
        ground=True,
        position=impact.place[:, None],
        normal=impact.normal.expand(count, 1, 3),
        gap=torch.zeros(count, 1).to(u) if gap is None else gap[:, None],
        velocity=u[:, None],
        spin_rad_s=impact.before[:, 3:] if omega is None else omega,
        step_s=STEP * contact_time_s,
        friction=friction,
        contact_time_s=contact_time_s,
        damping_ratio=damping_ratio,
    )
    for active in effects:
        if active.effect.has("contact"):
            touch = active.effect.contact(active.values, touch)
    return touch


def _changes_spring(touch: Touch, law: ContactLaw) -> bool:
    """Return whether effects changed the spring and damper; unchanged values share the law's memory."""
    same = (touch.contact_time_s, law.contact_time_s), (touch.damping_ratio, law.damping_ratio)
    return any(own.data_ptr() != given.data_ptr() for own, given in same)


def changes_rebound(world: World) -> bool:
    """Return whether contact effects of a world change the speed of a rebound: its spring, its damper, or by a pull."""
    law, effects = contact_law(world), [active for active in world.effects if active.effect.phase == "contact"]
    if _pulling(effects):
        return True
    like = world.gravity
    touch = Touch(
        ground=True,
        position=torch.zeros(1, 1, 3).to(like),
        normal=torch.tensor([[[0.0, 0.0, 1.0]]]).to(like),
        gap=torch.zeros(1, 1).to(like),
        velocity=torch.tensor([[[1.0, 0.0, -1.0]]]).to(like),
        spin_rad_s=torch.ones(1, 3).to(like),
        step_s=STEP * law.contact_time_s[:1, None],
        friction=law.friction[:1, None],
        contact_time_s=law.contact_time_s[:1, None],
        damping_ratio=law.damping_ratio[:1, None],
    )
    for active in effects:
        if active.effect.has("contact"):
            touch = active.effect.contact(active.values, touch)
    return _changes_spring(touch, law)


def _pulling(effects: Sequence[ActiveEffect]) -> bool:
    """Return whether any contact effect applies a wrench."""
    return any(active.effect.phase == "contact" and active.effect.has("wrench") for active in effects)


def _pull(impact: Impact, effects: Sequence[ActiveEffect], height: float) -> Tensor:
    """Return the force (n,) [N] of contact effects towards the ground, with the body at a height [m] above it."""
    com = impact.place - impact.arm + height * impact.normal
    motion = BodyMotion(
        body=impact.body,
        mass=impact.mass,
        inertia=impact.inertia,
        com=com,
        rotation=impact.rotation,
        velocity=impact.before[:, :3],
        omega=impact.before[:, 3:],
        up=impact.normal[None],
        normal=impact.normal[None],
        ground_offset=(impact.place @ impact.normal),
    )
    pull = torch.zeros_like(impact.mass)
    for active in effects:
        force = None
        if active.effect.phase == "contact" and active.effect.has("wrench"):
            force = active.effect.wrench(active.values, motion).force
        if force is not None:
            pull = pull - force @ impact.normal
    return pull
