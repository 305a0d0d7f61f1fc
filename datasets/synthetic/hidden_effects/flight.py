"""Hidden effects that act in flight: forces of the air, gravity, and the mass distribution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .mechanics import Hidden, Mechanics, Moment, Wrench
from .registry import direction, hidden_effect, horizontal, sign
from .rotation import cross, turn
from .things import Thing

NONE = np.zeros(3)
_MAGNET_RANGE_M = 0.1


@hidden_effect("linear_drag", "flight", 0.15, 0.6)
def linear_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Force -m c u, c [1/s]."""

    def wrench(now: Moment) -> Wrench:
        return -now.mass_kg * size * now.velocity_m_s, NONE

    return Hidden(name="linear_drag", values={"c": size}, form="force -m c u at the centre of mass", wrench=wrench)


@hidden_effect("quadratic_drag", "flight", 0.1, 0.4)
def quadratic_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Quadratic drag, k [1/m], without torque: on a box summed over its sides, on a ball along the velocity."""
    areas = np.prod(thing.half_extents_m) / thing.half_extents_m

    def wrench(now: Moment) -> Wrench:
        return _air(thing, size, areas, now, now.velocity_m_s), NONE

    return Hidden(name="quadratic_drag", values={"k": size}, form=_AIR, wrench=wrench)


_AIR = (
    "box: force -m k (A_i / mean A) |u_i| u_i along each body axis i, A_i the area of its side; ball: -m k |u| u. "
    "No torque"
)


def _air(thing: Thing, k: float, areas: np.ndarray, now: Moment, wind: np.ndarray) -> np.ndarray:
    if thing.kind == "ball":
        return -now.mass_kg * k * np.sqrt(wind @ wind) * wind
    along = wind @ now.rotation
    return -now.mass_kg * k * now.rotation @ (areas / areas.mean() * np.abs(along) * along)


@hidden_effect("wind", "flight", 2.0, 4.0)
def wind(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Quadratic drag relative to air that moves at w [m/s] in a random direction; k = 0.1 1/m, for a large w 0.2."""
    areas = np.prod(thing.half_extents_m) / thing.half_extents_m
    air, k = size * horizontal(rng), 0.1 if size < 3 else 0.2

    def wrench(now: Moment) -> Wrench:
        return _air(thing, k, areas, now, now.velocity_m_s - air), NONE

    values = {"w_x": air[0], "w_y": air[1], "k": k}
    return Hidden(
        name="wind", values=values, form=f"{_AIR}; u - w for u", comes_with=("quadratic_drag",), wrench=wrench
    )


@hidden_effect("magnus_lift", "flight", {"ball": 0.01}, {"ball": 0.04})
def magnus_lift(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Force m s omega x u, s [1] of either sign."""
    s = size * sign(rng)

    def wrench(now: Moment) -> Wrench:
        return now.mass_kg * s * cross(now.omega_rad_s, now.velocity_m_s), NONE

    return Hidden(name="magnus_lift", values={"s": s}, form="force m s omega x u at the centre of mass", wrench=wrench)


@hidden_effect("spin_damping", "flight", 0.2, 1.0)
def spin_damping(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Torque -d I omega, I the mean of the principal moments, d [1/s]."""
    inertia = float(thing.inertia_kg_m2.mean())

    def wrench(now: Moment) -> Wrench:
        return NONE, -size * inertia * now.omega_rad_s

    return Hidden(name="spin_damping", values={"d": size}, form="torque -d (tr I / 3) omega", wrench=wrench)


@hidden_effect("constant_force", "flight", 0.15, 0.4)
def constant_force(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Force m f in the world, f [m/s2] between 30 and 60 degrees above or below the horizon."""
    angle = np.radians(rng.uniform(30, 60)) * sign(rng)
    f = size * (np.cos(angle) * horizontal(rng) + np.sin(angle) * np.array([0.0, 0.0, 1.0]))

    def wrench(now: Moment) -> Wrench:
        return now.mass_kg * f, NONE

    return Hidden(name="constant_force", values=_named("f", f), form="force m f at the centre of mass", wrench=wrench)


@hidden_effect("gravity_tilt", "flight", 0.7, 2.0)
def gravity_tilt(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Gravity rotated about a horizontal axis by an angle [deg]."""
    vector = np.radians(size) * horizontal(rng)

    def build(world: Mechanics) -> Mechanics:
        return replace(world, gravity_m_s2=turn(vector) @ world.gravity_m_s2)

    values = {"tilt_x": vector[0], "tilt_y": vector[1]}
    return Hidden(
        name="gravity_tilt", values=values, form="MuJoCo's gravity turned by exp(tilt_x e_x + tilt_y e_y)", build=build
    )


@hidden_effect("gravity_scale", "flight", 0.01, 0.03)
def gravity_scale(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Gravity (1 + s) g of either sign of s [1]."""
    s = size * sign(rng)

    def build(world: Mechanics) -> Mechanics:
        return replace(world, gravity_m_s2=(1 + s) * world.gravity_m_s2)

    return Hidden(name="gravity_scale", values={"s": s}, form="MuJoCo's gravity times 1 + s", build=build)


@hidden_effect("buoyancy", "flight", 0.1, 0.3)
def buoyancy(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Force m b upwards, b [m/s2]."""

    def wrench(now: Moment) -> Wrench:
        return np.array([0.0, 0.0, now.mass_kg * size]), NONE

    return Hidden(name="buoyancy", values={"b": size}, form="force m b upwards at the centre of mass", wrench=wrench)


@hidden_effect("ground_magnet", "flight", 3.0, 10.0)
def ground_magnet(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Pull m A (1 + h / l)^-4 with the height h of the lowest point, A [m/s2]; it falls to 1/e within 0.28 l."""

    def wrench(now: Moment) -> Wrench:
        height = max(float(now.heights_m.min()), 0.0)
        return np.array([0.0, 0.0, -now.mass_kg * size * (1 + height / _MAGNET_RANGE_M) ** -4]), NONE

    form = "force -m A (1 + h / l)^-4 e_z at the centre of mass, h the height of the lowest point"
    return Hidden(name="ground_magnet", values={"A": size, "l": _MAGNET_RANGE_M}, form=form, wrench=wrench)


@hidden_effect("com_offset", "flight", {"cube": 0.002, "ball": 0.001}, {"cube": 0.006, "ball": 0.004})
def com_offset(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """The centre of mass moved by d [m], body frame; the inertia about it stays."""
    d = size * direction(rng)

    def build(world: Mechanics) -> Mechanics:
        return replace(world, com_m=world.com_m + d)

    return Hidden(name="com_offset", values=_named("d", d), form="MuJoCo's inertial position moved by d", build=build)


@hidden_effect("inertia_shape", "flight", {"cube": 0.1}, {"cube": 0.3})
def inertia_shape(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """The principal moments of the body times 1 + size, 1 and 1 - size, about randomly rotated axes."""
    axes = turn(rng.uniform(0.3, 1.2) * direction(rng))
    factors = rng.permutation([1 + size, 1.0, 1 - size])

    def build(world: Mechanics) -> Mechanics:
        root = axes @ np.diag(np.sqrt(factors)) @ axes.T
        return replace(world, inertia_kg_m2=root @ world.inertia_kg_m2 @ root)

    inertia = build(Mechanics.of(thing, 1)).inertia_kg_m2
    six = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return Hidden(
        name="inertia_shape",
        values={"inertia_kg_m2": six.tolist(), "factors": factors.tolist()},
        form="MuJoCo's inertia is Q I Q, Q symmetric with the roots of the factors as eigenvalues",
        build=build,
    )


def _named(letter: str, vector: np.ndarray) -> dict[str, float]:
    return {f"{letter}_{axis}": float(value) for axis, value in zip("xyz", vector, strict=True)}
