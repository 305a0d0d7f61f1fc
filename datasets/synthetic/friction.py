"""Coulomb friction in MuJoCo: in every step the time constant of slip is set so that friction saturates at its limit.

MuJoCo solves contact as a convex problem. If friction cannot reach the deceleration that its time constant requests,
the contact is pushed apart by the friction coefficient times the shortfall: a body that slides during an impact is
lifted, most of all with a stiff friction. Here the time constant is chosen so that a sliding contact requests only
slightly more than the available friction force, so that sliding follows Coulomb's law and sticking stays stiff. Derived
from the optimality conditions in MuJoCo's documentation, "Computation"; checked against analytic oblique impacts in the
tests.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MjModel: TypeAlias = Any
"""A `mujoco.MjModel`; MuJoCo has no type stubs."""
MjData: TypeAlias = Any
"""A `mujoco.MjData`."""

_EXCESS = 0.2
"""Margin by which the request of a sliding contact exceeds the available friction [1], so that it is never smaller."""
_SLOWEST_RATE, _FASTEST_RATE = 20.0, 2000.0
"""Bounds of the requested decay rate of slip [1/s]; the upper one is used for sticking contacts."""

_STUCK_M_S, _PAUSE_STEPS = 1e-3, 3
"""While nothing slips faster than this, rates are kept for several steps: bodies at rest use most of the time."""


_TANGENTS = np.array([1, 2])
"""Places of a contact's rows along its tangents, behind that along its normal."""
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Axes that follow and precede each axis. As arrays: a list is converted in every call, for a microsecond."""


class CoulombFriction:
    """Sets `pair_solreffriction` of a model after every step, from that step's contacts.

    Args:
        model: All contacts are explicit pairs of three dimensions, each with one geom of `body`.
        body: Name of the free body.
    """

    def __init__(self, model: MjModel, body: str) -> None:
        self._model, self._body = model, model.body(body).id
        geoms = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        self._pairs = {frozenset(pair): index for index, pair in enumerate(geoms)}
        self._pause = 0
        self._dof = int(model.body_dofadr[self._body])
        # MuJoCo's rate is 2 / (impedance * time constant)
        self._time_times_rate = 2 / model.pair_solimp[:, 1]
        model.pair_solreffriction[:, 0] = self._time_times_rate / _SLOWEST_RATE
        model.pair_solreffriction[:, 1] = 1.0

    def update(self, data: MjData) -> None:
        """Set the time constants for the step that follows the one in `data`."""
        if self._pause:
            self._pause -= 1
            return
        self._model.pair_solreffriction[:, 0] = self._time_times_rate / _SLOWEST_RATE  # no jump in a new contact
        contact = data.contact
        addresses = contact.efc_address
        active = (addresses >= 0).nonzero()[0]
        if not active.size:
            return
        first = addresses[active]
        rows = first[:, None] + _TANGENTS
        slip = data.efc_vel[rows]
        speed = np.sqrt((slip * slip).sum(1)) + 1e-9
        if speed.max() < _STUCK_M_S:
            self._pause = _PAUSE_STEPS
        along = slip / speed[:, None]
        frames = contact.frame[active].reshape(-1, 3, 3)
        direction = (along[:, :, None] * frames[:, 1:]).sum(1)
        pressed, held = data.efc_force[first], -(data.efc_force[rows] * along).sum(1)

        # slip: velocity of the second geom minus that of the first; only `body` is free
        geoms = contact.geom[active]
        sign = np.where(self._model.geom_bodyid[geoms[:, 1]] == self._body, 1.0, -1.0)
        rotation = data.xmat[self._body].reshape(3, 3)
        arms = contact.pos[active] - data.xipos[self._body]
        turn = _cross(arms, direction) @ data.ximat[self._body].reshape(3, 3)
        mobility = 1 / self._model.body_mass[self._body] + turn**2 @ (1 / self._model.body_inertia[self._body])
        linear, angular = data.qacc[self._dof : self._dof + 3], rotation @ data.qacc[self._dof + 3 : self._dof + 6]
        acceleration = linear + _cross(angular[None], contact.pos[active] - data.xpos[self._body])
        unopposed = sign * (acceleration * direction).sum(1) + mobility * held

        pairs = np.array([self._pairs[frozenset(pair)] for pair in geoms.tolist()])
        friction = _friction_along(self._model.pair_friction[pairs, :2], along)  # effects may have changed it
        wanted = (1 + _EXCESS) * mobility * friction * pressed - unopposed
        rate = np.where(pressed > 0, wanted / speed, 0.0).clip(_SLOWEST_RATE, _FASTEST_RATE)
        for pair in set(pairs.tolist()):
            fastest = rate[pairs == pair].max()
            self._model.pair_solreffriction[pair, 0] = self._time_times_rate[pair] / fastest


def _friction_along(friction: Array, along: Array) -> Array:
    """Return the friction coefficient (n,) along unit vectors (n, 2), for elliptic cones with half axes (n, 2)."""
    if (friction[:, 0] == friction[:, 1]).all():
        return friction[:, 0]
    return 1 / np.sqrt(((along / friction) ** 2).sum(1).clip(1e-6))  # without slip there is no direction


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products of rows, five times as fast as `np.cross` for a few rows."""
    return a.take(_NEXT, 1) * b.take(_LAST, 1) - a.take(_LAST, 1) * b.take(_NEXT, 1)
