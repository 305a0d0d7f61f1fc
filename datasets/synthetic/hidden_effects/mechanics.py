"""Interface between hidden effects and a simulator: the quantities that effects change, and those that they read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .rotation import cross, cross_rows, rotation_of
from .things import Array, Thing

GRAVITY_M_S2 = 9.81
STEP_S = 2e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanics:
    """Parameters of the world that the simulator receives before it starts; effects may change them.

    Args:
        thing: The body.
        law: Contact law: 1, 2 or 3.
        com_m: The centre of mass, body frame (3,).
        inertia_kg_m2: About the centre of mass, body axes (3, 3).
        gravity_m_s2: World axes (3,).
        friction: Coefficients along the world's y and x (2,): MuJoCo's cone may be an ellipse.
    """

    thing: Thing
    law: int
    com_m: Array
    inertia_kg_m2: Array
    gravity_m_s2: Array
    friction: tuple[float, float]

    @classmethod
    def of(cls, thing: Thing, law: int) -> Mechanics:
        """Return the world without any effect."""
        inertia, gravity = np.diag(thing.inertia_kg_m2), np.array([0.0, 0.0, -GRAVITY_M_S2])
        return cls(
            thing=thing,
            law=law,
            com_m=np.zeros(3),
            inertia_kg_m2=inertia,
            gravity_m_s2=gravity,
            friction=(thing.friction, thing.friction),
        )


@dataclass(eq=False, kw_only=True)
class Moment:
    """The state at one time, in world axes.

    time_s; com_m, velocity_m_s (of the centre of mass), omega_rad_s (3,); rotation body to world (3, 3); inertia_kg_m2
    about the centre of mass (3, 3). For the points that may touch: arms_m from the centre of mass (n, 3),
    heights_m (n,), velocities_m_s (n, 3), pressed_n (n,): the ground's normal force in the previous step.
    """

    time_s: float
    mass_kg: float
    com_m: Array
    velocity_m_s: Array
    omega_rad_s: Array
    rotation: Array
    inertia_kg_m2: Array
    arms_m: Array
    heights_m: Array
    velocities_m_s: Array
    pressed_n: Array


Wrench = tuple[Array, Array]
"""Force [N] at the centre of mass and torque [N m] about it, world axes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Hidden:
    """One effect with its true parameter values and its hooks; a hook that is None does nothing.

    Args:
        name: Name of the effect, as in `cgwm effects list` if it is listed there.
        values: True parameter values, as written into the truth.
        form: Description of the true law.
        comes_with: Other effects of the library that the true law implies.
        build: Changes the world before the simulation.
        wrench: Returns force and torque at a time.
        touch: Sets friction (n, 2) and damping ratio (n,) of the points for the next step, in place.
        clock: Measured time over true time [1].
        observe: Returns the measured positions (T, 3) and rotations body to world (T, 3, 3).
    """

    name: str
    values: dict[str, Any]
    form: str
    comes_with: tuple[str, ...] = ()
    build: Callable[[Mechanics], Mechanics] | None = None
    wrench: Callable[[Moment], Wrench] | None = None
    touch: Callable[[Moment, Array, Array], None] | None = None
    clock: float = 1.0
    observe: Callable[[Array, Array], tuple[Array, Array]] | None = None


@dataclass(frozen=True, eq=False)
class Start:
    """An initial state: the body frame's origin and its velocity (world axes), quat_wxyz, omega in BODY axes."""

    position_m: Array
    quat_wxyz: Array
    velocity_m_s: Array
    omega_body_rad_s: Array


@dataclass(frozen=True, eq=False)
class Motion:
    """The true motion at every step: time_s (T,), position_m of the body frame's origin (T, 3), quat_wxyz (T, 4).

    touching (T,): whether any point is in contact.
    """

    time_s: Array
    position_m: Array
    quat_wxyz: Array
    touching: NDArray[np.bool_]


def build(mechanics: Mechanics, hidden: Sequence[Hidden]) -> Mechanics:
    """Return the world after the `build` hooks of the effects."""
    for effect in hidden:
        mechanics = effect.build(mechanics) if effect.build else mechanics
    return mechanics


class Reader:
    """Computes the state that effects read from the state of a simulator."""

    def __init__(self, mechanics: Mechanics) -> None:
        middles, self._radius = mechanics.thing.spheres
        self._com, self._arms = mechanics.com_m, middles - mechanics.com_m
        self._mass, self._inertia = mechanics.thing.mass_kg, mechanics.inertia_kg_m2

    def moment(
        self, time_s: float, position: Array, quat_wxyz: Array, velocity: Array, omega_body: Array, pressed_n: Array
    ) -> Moment:
        """Return the state in world axes; pose and velocity are those of the body frame's origin."""
        rotation = rotation_of(quat_wxyz)
        omega, offset = rotation @ omega_body, rotation @ self._com
        com, moving = position + offset, velocity + cross(omega, offset)
        arms = self._arms @ rotation.T
        arms[:, 2] -= self._radius
        inertia = rotation @ self._inertia @ rotation.T
        heights, points = com[2] + arms[:, 2], moving + cross_rows(omega, arms)
        return Moment(
            time_s=time_s,
            mass_kg=self._mass,
            com_m=com,
            velocity_m_s=moving,
            omega_rad_s=omega,
            rotation=rotation,
            inertia_kg_m2=inertia,
            arms_m=arms,
            heights_m=heights,
            velocities_m_s=points,
            pressed_n=pressed_n,
        )
