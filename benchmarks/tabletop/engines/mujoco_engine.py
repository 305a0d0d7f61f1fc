"""MuJoCo as a truth, with two settings: Coulomb's friction and stiff contacts, and the engine's own defaults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import (
    STEPS_PER_S,
    ContactTruth,
    Motion,
    build_model,
    mujoco,
    simulate,
)
from cgwm.datasets.synthetic.objects import SolidObject

from .stepper import Array, Stepper, Stepping


@dataclass(frozen=True)
class Coulomb:
    """Small steps, stiff elliptic contacts, and friction whose slip decays as Coulomb's law asks."""

    solid: SolidObject
    contact: ContactTruth
    fingertip: bool

    def simulate(
        self, qpos: Array, qvel: Array, start: float, end: float, command: tuple[Array, Array] | None = None
    ) -> Motion:
        """See `Engine`."""
        return simulate(self.model(), qpos, qvel, start, end, command)

    def model(self) -> Any:
        """Return MuJoCo's model of the scene."""
        return build_model(self.solid, self.contact, self.fingertip)


class Pyramid(Coulomb):
    """The same with a pyramid in place of Coulomb's cone: how much of a floor the direction of friction makes."""

    def model(self) -> Any:
        """See `Coulomb`."""
        model = super().model()
        model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
        return model


class Default(Stepping):
    """What a user gets who writes down shapes, masses and sliding friction, and nothing else.

    Contacts of 20 ms that are critically damped (`solref` 0.02 1), pyramidal cones, `impratio` 1, `implicitfast`; the
    ground's restitution is lost.
    """

    def begin(self, qpos: Array, qvel: Array) -> Stepper:
        """See `Stepping`."""
        model = build_model(self.solid, self.contact, self.fingertip)
        model.opt.timestep = 1 / STEPS_PER_S
        model.opt.integrator, model.opt.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_PYRAMIDAL
        model.opt.impratio = 1.0
        model.pair_solref[:] = (0.02, 1.0)
        model.pair_solreffriction[:] = 0.0
        model.pair_solimp[:] = (0.9, 0.95, 0.001, 0.5, 2.0)
        return _Run(model, qpos, qvel)


class _Run:
    def __init__(self, model: object, qpos: Array, qvel: Array) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._data.qpos[:7], self._data.qvel[:6] = qpos, qvel

    def state(self) -> tuple[Array, Array]:
        """See `Stepper`."""
        return np.array(self._data.qpos[:7]), np.array(self._data.qvel[:6])

    def move_fingertip(self, position_m: Array, velocity_m_s: Array) -> None:
        """See `Stepper`."""
        self._data.qpos[7:], self._data.qvel[6:] = position_m, velocity_m_s

    def advance(self) -> None:
        """See `Stepper`."""
        mujoco.mj_step(self._model, self._data)
