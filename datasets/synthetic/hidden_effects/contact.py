"""Hidden effects that act in contact with the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .mechanics import STEP_S, Hidden, Mechanics, Moment, Wrench
from .registry import hidden_effect, horizontal, sign
from .rotation import cross
from .things import Array, Thing, damping_ratio_of, restitution_of

_STRIBECK_SPEED_M_S = 0.4
_ADHESION_GAP_M = 0.002
_LEAST_FRICTION = 0.02
_TOUCHING_M = 5e-5
"""Height below which a point counts as touching: MuJoCo intermittently lifts sliding points by some micrometres [m]."""


@hidden_effect("rolling_resistance", "contact", {"ball": 3e-4}, {"ball": 1.5e-3})
def rolling_resistance(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Torque -c_r N tanh(|omega_t| / 1 rad/s) against the part of the spin along the ground, c_r [m]."""

    def wrench(now: Moment) -> Wrench:
        spin = now.omega_rad_s * (1.0, 1.0, 0.0)
        return np.zeros(3), -_held(now, size, spin) * spin

    form = "torque -c_r N tanh(|omega_t| / 1 rad/s) omega_t / |omega_t|, N MuJoCo's normal force"
    return Hidden(name="rolling_resistance", values={"c_r": size}, form=form, wrench=wrench)


@hidden_effect("torsional_friction", "contact", {"cube": 0.004, "ball": 3e-4}, {"cube": 0.015, "ball": 1.2e-3})
def torsional_friction(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Torque -c_t N tanh(|omega_n| / 1 rad/s) against the spin about the vertical, c_t [m]."""

    def wrench(now: Moment) -> Wrench:
        spin = now.omega_rad_s * (0.0, 0.0, 1.0)
        return np.zeros(3), -_held(now, size, spin) * spin

    form = "torque -c_t N tanh(|omega_n| / 1 rad/s) sign(omega_n) n, N MuJoCo's normal force"
    return Hidden(name="torsional_friction", values={"c_t": size}, form=form, wrench=wrench)


@hidden_effect("viscous_friction", "contact", 0.35, 1.4)
def viscous_friction(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Force -c_v v_t, divided equally among the touching points; c_v [N s/m] is the magnitude [1/s] times the mass."""
    c_v = size * thing.mass_kg

    def wrench(now: Moment) -> Wrench:
        share = (now.heights_m < _TOUCHING_M).astype(float)
        return _at_points(now, -c_v * now.velocities_m_s * (1.0, 1.0, 0.0), share / max(share.sum(), 1.0))

    return Hidden(
        name="viscous_friction",
        values={"c_v": c_v},
        form="force -c_v v_t, shared by the points that touch",
        wrench=wrench,
    )


@hidden_effect("stribeck_friction", "contact", 0.1, 0.25)
def stribeck_friction(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Friction mu + d exp(-(v_t / v_s)^2) of each point, d [1], v_s 0.4 m/s."""

    def touch(now: Moment, friction: Array, ratio: Array) -> None:
        slip = np.hypot(now.velocities_m_s[:, 0], now.velocities_m_s[:, 1])
        friction[:] = (thing.friction + size * np.exp(-((slip / _STRIBECK_SPEED_M_S) ** 2)))[:, None]

    form = "mu + d exp(-(v_t / v_s)^2) in every contact and step"
    return Hidden(name="stribeck_friction", values={"d": size, "v_s": _STRIBECK_SPEED_M_S}, form=form, touch=touch)


@hidden_effect("anisotropic_friction", "contact", 0.05, 0.15)
def anisotropic_friction(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """An elliptic cone: mu + a along x, mu - a along y, a [1] of either sign."""
    a = size * sign(rng)

    def build(world: Mechanics) -> Mechanics:
        # MuJoCo's first tangent on a level plane is the world's y
        return replace(world, friction=(max(thing.friction - a, _LEAST_FRICTION), thing.friction + a))

    return Hidden(
        name="anisotropic_friction",
        values={"a": a, "b": 0.0},
        form="MuJoCo's cone with mu + a in x, mu - a in y",
        build=build,
    )


@hidden_effect("friction_patch", "contact", 0.12, 0.3)
def friction_patch(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A disc near the origin with another friction: higher, or, for a small effect, higher or lower.

    Its radius is 0.2 m; for a ball 0.5 m with the edge near the origin, because a ball soon rolls, and rolling does not
    depend on the friction.
    """
    change = size if size > 0.2 else size * sign(rng)
    radius, near, far = (0.5, 0.3, 0.5) if thing.kind == "ball" else (0.2, 0.05, 0.2)
    middle = rng.uniform(near, far) * horizontal(rng)
    inside = max(thing.friction + change, _LEAST_FRICTION)

    def touch(now: Moment, friction: Array, ratio: Array) -> None:
        place = now.com_m[:2] + now.arms_m[:, :2] - middle[:2]
        friction[:] = np.where((place**2).sum(1) < radius**2, inside, thing.friction)[:, None]

    values = {"change": inside - thing.friction, "x_m": middle[0], "y_m": middle[1], "radius_m": radius}
    return Hidden(name="friction_patch", values=values, form="mu + change inside a disc with a sharp edge", touch=touch)


@hidden_effect("velocity_restitution", "contact", 0.1, 0.4)
def velocity_restitution(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Restitution e / (1 + r v) of each point, v its impact speed [m/s], r [s/m]."""
    bounce = restitution_of(thing.damping_ratio)
    held = np.zeros(0)

    def touch(now: Moment, friction: Array, ratio: Array) -> None:
        nonlocal held
        if now.time_s == 0.0 or held.shape != ratio.shape:
            held = np.full(ratio.shape, thing.damping_ratio)
        free = now.heights_m > 0
        speed = np.maximum(-now.velocities_m_s[free, 2], 0.0)
        held[free] = damping_ratio_of(bounce / (1 + size * speed))
        ratio[:] = held

    form = "MuJoCo's damping ratio of a contact set when it begins, for a restitution e / (1 + r v)"
    return Hidden(name="velocity_restitution", values={"r": size}, form=form, touch=touch)


@hidden_effect("adhesion", "contact", 3.0, 10.0)
def adhesion(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A pull of F [N] (the magnitude [m/s2] times the mass) within a gap of 2 mm, which falls linearly with height."""
    pull = size * thing.mass_kg

    def wrench(now: Moment) -> Wrench:
        near = (1 - now.heights_m / _ADHESION_GAP_M).clip(0.0, 1.0)
        share = near * (near.max() / max(near.sum(), 1e-12))
        return _at_points(now, np.array([[0.0, 0.0, -pull]]), share)

    values = {"F": pull, "g": _ADHESION_GAP_M}
    return Hidden(
        name="adhesion",
        values=values,
        form="force -F (1 - h / g) e_z at the points within the gap, shared",
        wrench=wrench,
    )


def _held(now: Moment, length: float, spin: Array) -> float:
    """Return torque over spin [N m s] for a friction of `length` [m], limited so that the spin is not reversed."""
    speed = float(np.sqrt(spin @ spin))
    if not speed:
        return 0.0
    most = 0.5 * float(np.diag(now.inertia_kg_m2).min()) / STEP_S
    return min(length * float(now.pressed_n.sum()) * np.tanh(speed) / speed, most)


def _at_points(now: Moment, forces: Array, share: Array) -> Wrench:
    """Return the wrench of forces (n or 1, 3) [N] at the points, each multiplied by its share (n,)."""
    force, torque = np.zeros(3), np.zeros(3)
    forces = np.broadcast_to(forces, now.arms_m.shape)
    for k in np.flatnonzero(share):
        one = share[k] * forces[k]
        force, torque = force + one, torque + cross(now.arms_m[k], one)
    return force, torque
