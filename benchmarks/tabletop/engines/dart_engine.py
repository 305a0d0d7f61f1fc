"""DART as a truth: a linear complementarity problem of impulses, friction as a pyramid, Newton's restitution.

The body hangs on three sliding axes and a ball joint at its centre of mass: DART integrates the velocity of a free
joint in the body's axes, to first order, which lets a spinning body gain speed in flight. Solids made of boxes alone:
its own collision detector knows no other convex parts, and corners as small spheres take it 30 times longer.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import (
    FINGERTIP,
    FINGERTIP_RADIUS,
    GRAVITY,
    matrix_from_quat,
    quat_from_matrix,
)
from cgwm.datasets.synthetic.hidden_effects.things import restitution_of

from .stepper import STEP_S, Array, Stepper, Stepping

_CARRIER_KG = 1e-9
"""Mass of the link between the sliding axes and the ball joint, which weighs nothing."""
_FINGERTIP_KG = 1e4


def is_box(part: Array) -> bool:
    """Return whether a convex part is a box along the body's axes."""
    middle, half = _middle_and_half(part)
    return len(part) == 8 and bool(np.allclose(np.abs(part - middle), half))


class Dart(Stepping):
    """DART's world."""

    def begin(self, qpos: Array, qvel: Array) -> Stepper:
        """See `Stepping`."""
        return _Run(self, qpos, qvel)


class _Run:
    def __init__(self, scene: Dart, qpos: Array, qvel: Array) -> None:
        dart: Any = import_module("dartpy")
        self._com = scene.solid.com
        self._world, self._body, self._slide, self._turn, self._tip = _world(dart, scene)
        rotation = matrix_from_quat(qpos[3:7])
        self._slide.setPositions(qpos[:3] + rotation @ self._com)
        self._turn.setPositions(dart.dynamics.BallJoint.convertToPositions(rotation))
        self._slide.setVelocities(qvel[:3] + rotation @ np.cross(qvel[3:6], self._com))
        self._turn.setVelocities(qvel[3:6])

    def state(self) -> tuple[Array, Array]:
        """See `Stepper`."""
        rotation, omega = self._body.getWorldTransform().rotation(), self._turn.getVelocities()
        position = self._slide.getPositions() - rotation @ self._com
        velocity = self._slide.getVelocities() - rotation @ np.cross(omega, self._com)
        return np.concatenate((position, quat_from_matrix(rotation))), np.concatenate((velocity, omega))

    def move_fingertip(self, position_m: Array, velocity_m_s: Array) -> None:
        """See `Stepper`."""
        self._tip.setPositions(position_m)
        self._tip.setVelocities(velocity_m_s)

    def advance(self) -> None:
        """See `Stepper`."""
        self._world.step()


def _world(dart: Any, scene: Dart) -> tuple[Any, ...]:
    """Return DART's world, the object, its sliding and its turning joint, and the fingertip's joint or None."""
    dynamics, solid, contact = dart.dynamics, scene.solid, scene.contact
    world = dart.simulation.World()
    world.setTimeStep(STEP_S)
    world.setGravity([0.0, 0.0, -GRAVITY])
    world.getConstraintSolver().setCollisionDetector(dart.collision.DARTCollisionDetector())
    bounce = float(np.sqrt(restitution_of(contact.damping_ratio)))  # DART multiplies the two bodies' numbers
    ground = dynamics.Skeleton("ground")
    floor = ground.createWeldJointAndBodyNodePair()[1]
    slab = floor.createShapeNode(dynamics.BoxShape([100.0, 100.0, 2.0]))
    slab.setRelativeTranslation([0.0, 0.0, -1.0])
    _touches(slab, contact.friction, bounce)
    skeleton = dynamics.Skeleton("object")
    slide, carrier = skeleton.createTranslationalJointAndBodyNodePair()
    carrier.setInertia(dynamics.Inertia(_CARRIER_KG, np.zeros(3), _CARRIER_KG * 1e-3 * np.eye(3)))
    turn, body = skeleton.createBallJointAndBodyNodePair(carrier)
    # the body's frame has its origin at the centre of mass: the shapes are moved instead
    body.setInertia(dynamics.Inertia(solid.mass, np.zeros(3), solid.inertia))
    for part in solid.parts:
        middle, half = _middle_and_half(part)
        node = body.createShapeNode(dynamics.BoxShape(2 * half))
        node.setRelativeTranslation(middle - solid.com)
        _touches(node, 10.0, bounce)  # DART takes the smaller friction of a pair: that of the other
    world.addSkeleton(ground)
    world.addSkeleton(skeleton)
    tip = None
    if scene.fingertip:
        finger = dynamics.Skeleton(FINGERTIP)
        tip, ball = finger.createTranslationalJointAndBodyNodePair()
        ball.setInertia(dynamics.Inertia(_FINGERTIP_KG, np.zeros(3), _FINGERTIP_KG * np.eye(3)))
        ball.setGravityMode(False)
        _touches(ball.createShapeNode(dynamics.SphereShape(FINGERTIP_RADIUS)), contact.friction_fingertip, bounce)
        world.addSkeleton(finger)
    return world, body, slide, turn, tip


def _middle_and_half(part: Array) -> tuple[Array, Array]:
    return (part.max(axis=0) + part.min(axis=0)) / 2, (part.max(axis=0) - part.min(axis=0)) / 2


def _touches(node: Any, friction: float, bounce: float) -> None:
    node.createCollisionAspect()
    node.createDynamicsAspect()
    node.getDynamicsAspect().setFrictionCoeff(friction)
    node.getDynamicsAspect().setRestitutionCoeff(bounce)
