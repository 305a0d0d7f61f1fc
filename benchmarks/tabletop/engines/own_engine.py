"""Our own law of contact as a truth: what of an error is left where the law is not in doubt.

The object is the spheres that `cgwm fit` makes of its true mesh, and friction, natural time and damping ratio are the
ground's. Only an error budget wants it; it is no judge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic.dynamics import FINGERTIP, STEPS_PER_S, ContactTruth, Motion
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.world import World

from ..true_world import Numbers, Spheres, first_state, spheres_of, true_world
from .stepper import STEP_S, Array, motion_of

_SPHERES: dict[tuple[str, float], Spheres] = {}


@dataclass(frozen=True)
class Own:
    """The engine of cgwm."""

    solid: SolidObject
    contact: ContactTruth
    fingertip: bool

    def simulate(
        self, qpos: Array, qvel: Array, start: float, end: float, command: tuple[Array, Array] | None = None
    ) -> Motion:
        """See `Engine`."""
        world = self._world()
        times = np.arange(round((end - start) * STEPS_PER_S) + 1, dtype=float) * STEP_S
        drives = {}
        if command is not None:
            drives = {FINGERTIP: Track(times, command[0][: len(times)], np.tile([1.0, 0, 0, 0], (len(times), 1)))}
        with torch.no_grad():
            rollout = measure(world, first_state(world, qpos, qvel), torch.as_tensor(times), drives)
        place, turn, speed, spin = (
            values[0, :, 0].numpy()
            for values in (rollout.position_m, rollout.quat_wxyz, rollout.velocity_m_s, rollout.omega_body_rad_s)
        )
        return motion_of(np.hstack((place, turn)), np.hstack((speed, spin)), self.solid, start, command)

    def _world(self) -> World:
        numbers = Numbers(self.contact.natural_time, self.contact.damping_ratio)
        return true_world(self.solid, _spheres(self.solid), self.contact, self.fingertip, numbers)


def _spheres(solid: SolidObject) -> Spheres:
    """Return the spheres of a solid, which take seconds to find, once a process."""
    key = (solid.family, solid.mass)
    if key not in _SPHERES:
        _SPHERES[key] = spheres_of(solid)
    return _SPHERES[key]
