"""Rapier as a truth: impulses, solved by small steps with soft contacts, in single precision; Newton's restitution.

The object is its convex parts, which touch the ground and the fingertip as such. Positions of 0.3 m round to 3e-8 m,
which is at random, and adds up to some micrometres in two seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import FINGERTIP_RADIUS, GRAVITY, matrix_from_quat
from cgwm.datasets.synthetic.hidden_effects.things import restitution_of
from cgwm.datasets.synthetic.objects import SolidObject
from scipy.spatial.transform import Rotation

from .stepper import STEP_S, Array, Stepper, Stepping


class Rapier(Stepping):
    """Rapier's world."""

    def begin(self, qpos: Array, qvel: Array) -> Stepper:
        """See `Stepping`."""
        return _Run(self, qpos, qvel)


class _Run:
    def __init__(self, scene: Rapier, qpos: Array, qvel: Array) -> None:
        rapier: Any = import_module("rapier3d")
        self._com = scene.solid.com
        self._world = rapier.PhysicsWorld(gravity=(0.0, 0.0, -GRAVITY))
        self._world.integration_parameters.dt = STEP_S
        touch = _Touch(rapier, float(restitution_of(scene.contact.damping_ratio)))
        ground = touch(rapier.Collider.halfspace((0.0, 0.0, 1.0)), scene.contact.friction)
        self._world.add_body(rapier.RigidBody.fixed().build(), [ground])
        self._tip: Any = None
        if scene.fingertip:
            ball = touch(rapier.Collider.ball(FINGERTIP_RADIUS), scene.contact.friction_fingertip)
            tip = rapier.RigidBody.kinematic_position_based().translation([0.0, 0.0, 100.0])
            self._tip = self._world.rigid_bodies[self._world.add_body(tip, [ball])]
        self._body = self._world.rigid_bodies[self._add(rapier, scene.solid, qpos, qvel, touch)]

    def _add(self, rapier: Any, solid: SolidObject, qpos: Array, qvel: Array, touch: _Touch) -> Any:
        moments, axes = np.linalg.eigh(solid.inertia)
        axes = axes * np.linalg.det(axes)
        frame = rapier.Rotation3.from_scaled_axis(Rotation.from_matrix(axes).as_rotvec().tolist())
        weight = rapier.MassProperties(solid.com.tolist(), solid.mass, moments.tolist(), frame)
        rotation = matrix_from_quat(qpos[3:7])
        velocity = qvel[:3] + rotation @ np.cross(qvel[3:6], solid.com)
        builder = rapier.RigidBody.dynamic().translation(qpos[:3].tolist())
        builder = builder.rotation(Rotation.from_matrix(rotation).as_rotvec().tolist()).linvel(velocity.tolist())
        builder = builder.angvel((rotation @ qvel[3:6]).tolist()).can_sleep(False).gyroscopic_forces(True)
        builder = builder.ccd_enabled(False).additional_mass_properties(weight)
        # the smaller friction of a pair counts: that of the ground or of the fingertip
        parts = [touch(rapier.Collider.convex_hull(part.tolist()).density(0.0), 10.0) for part in solid.parts]
        return self._world.add_body(builder, parts)

    def state(self) -> tuple[Array, Array]:
        """See `Stepper`."""
        body = self._body
        place, turn, speed, spin = body.translation, body.rotation, body.linvel, body.angvel
        quat = np.array([turn.w, turn.i, turn.j, turn.k])
        quat /= np.linalg.norm(quat)
        rotation = matrix_from_quat(quat)
        omega = rotation.T @ np.array([spin.x, spin.y, spin.z])
        velocity = np.array([speed.x, speed.y, speed.z]) - rotation @ np.cross(omega, self._com)
        return np.concatenate(([place.x, place.y, place.z], quat)), np.concatenate((velocity, omega))

    def move_fingertip(self, position_m: Array, velocity_m_s: Array) -> None:
        """See `Stepper`."""
        self._tip.set_next_kinematic_translation((position_m + STEP_S * velocity_m_s).tolist())

    def advance(self) -> None:
        """See `Stepper`."""
        self._world.step()


class _Touch:
    """Gives colliders their friction and the ground's restitution."""

    def __init__(self, rapier: Any, restitution: float) -> None:
        self._rule, self._restitution = rapier.CoefficientCombineRule, restitution

    def __call__(self, builder: Any, friction: float) -> Any:
        builder = builder.friction(friction).friction_combine_rule(self._rule.MIN)
        return builder.restitution(self._restitution).restitution_combine_rule(self._rule.AVERAGE)
