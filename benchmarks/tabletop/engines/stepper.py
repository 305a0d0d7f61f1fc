"""What an engine must do, and the loop that records its motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from cgwm.datasets.synthetic.dynamics import STEPS_PER_S, ContactTruth, Motion, matrix_from_quat
from cgwm.datasets.synthetic.objects import SolidObject
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_S = 1 / STEPS_PER_S
_TOUCHES_M = 1e-4
"""How near to the ground the lowest corner touches it: engines of impulses keep bodies apart by as much."""
_STRUCK_M_S = 0.005
"""Faster along the ground than this is what was at rest until the fingertip struck it."""


class Engine(Protocol):
    """An engine with one object, the ground z = 0 and perhaps a fingertip."""

    def simulate(
        self, qpos: Array, qvel: Array, start: float, end: float, command: tuple[Array, Array] | None = None
    ) -> Motion:
        """Simulate and record every step; arguments and result as of `dynamics.simulate`."""
        ...


class Stepper(Protocol):
    """A motion that is under way."""

    def state(self) -> tuple[Array, Array]:
        """Return position [m] and quat_wxyz (7,), and velocity of the origin [m/s] and omega_body [rad/s] (6,)."""
        ...

    def move_fingertip(self, position_m: Array, velocity_m_s: Array) -> None:
        """Put the fingertip where it is at the beginning of a step."""
        ...

    def advance(self) -> None:
        """Go on by `STEP_S`."""
        ...


@dataclass(frozen=True)
class Stepping(ABC):
    """An engine that records the steps of a stepper.

    Args:
        solid: The object.
        contact: Its contact.
        fingertip: Whether there is a fingertip.
    """

    solid: SolidObject
    contact: ContactTruth
    fingertip: bool

    @abstractmethod
    def begin(self, qpos: Array, qvel: Array) -> Stepper:
        """Return a motion in its first state."""

    def simulate(
        self, qpos: Array, qvel: Array, start: float, end: float, command: tuple[Array, Array] | None = None
    ) -> Motion:
        """See `Engine`."""
        return recorded(self.begin(qpos, qvel), self.solid, start, end, command)


def recorded(
    stepper: Stepper, solid: SolidObject, start: float, end: float, command: tuple[Array, Array] | None
) -> Motion:
    """Record every step of a motion.

    Args:
        stepper: The motion, in its first state.
        solid: The object.
        start: Time of the first state [s].
        end: Time of the last recorded state [s].
        command: Position [m] and velocity [m/s] of the fingertip at every step, each (step, 3), or None.

    Raises:
        ArithmeticError: If the motion is not finite.
    """
    count = round((end - start) * STEPS_PER_S) + 1
    qpos, qvel = np.empty((count, 7)), np.empty((count, 6))
    for step in range(count):
        if command is not None:
            stepper.move_fingertip(command[0][step], command[1][step])
        qpos[step], qvel[step] = stepper.state()
        stepper.advance()
    return motion_of(qpos, qvel, solid, start, command)


def motion_of(
    qpos: Array, qvel: Array, solid: SolidObject, start: float, command: tuple[Array, Array] | None
) -> Motion:
    """Return the motion of an object, with that of its fingertip, from its states at every step.

    Args:
        qpos: Position [m] and quat_wxyz of the object, shape (step, 7).
        qvel: Velocity of its origin [m/s] and omega_body [rad/s], shape (step, 6).
        solid: The object.
        start: Time of the first state [s].
        command: Of the fingertip, as of `recorded`.

    Raises:
        ArithmeticError: If the motion is not finite.
    """
    if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
        raise ArithmeticError("the engine's motion is not finite")
    count = len(qpos)
    touched = _struck(qvel, start) if command is not None else _landed(solid, qpos)
    first = start + int(touched.argmax()) * STEP_S if touched.any() else None
    if command is not None:
        qpos, qvel = np.hstack((qpos, command[0][:count])), np.hstack((qvel, command[1][:count]))
    return Motion(start, qpos, qvel, first)


def _landed(solid: SolidObject, qpos: Array) -> NDArray[np.bool_]:
    low = [row[2] + (solid.vertices @ matrix_from_quat(row[3:7])[2]).min() for row in qpos]
    return np.asarray(low) < _TOUCHES_M


def _struck(qvel: Array, start: float) -> NDArray[np.bool_]:
    """Return in which steps an object that lay at rest at time zero moves."""
    moves = np.linalg.norm(qvel[:, :2], axis=1) > _STRUCK_M_S
    moves[: max(0, round(-start * STEPS_PER_S))] = False  # it settles before
    return moves
