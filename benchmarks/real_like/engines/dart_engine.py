"""DART as a truth (`dartpy`): contacts as a linear complementarity problem of impulses, friction as a pyramid.

Restitution is Newton's and the same at every speed above 0.1 m/s, where DART stops bouncing; depth is corrected by
DART's own error reduction. The body hangs on three sliding axes and a ball joint at its centre of mass: DART integrates
the velocity of a free joint in the body's axes, to first order, which lets a spinning body gain speed in flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Mechanics, Motion, Reader, Start
from cgwm.datasets.synthetic.hidden_effects.rotation import rotation_of
from cgwm.datasets.synthetic.hidden_effects.things import Thing, restitution_of

STEP_S = 4e-4
_CARRIER_KG = 1e-9
"""Mass of the link between the sliding axes and the ball joint, which weighs nothing."""
_NEEDS_FORCE = ("rolling_resistance", "torsional_friction", "anisotropic_friction")


def possible(hidden: Sequence[Hidden]) -> bool:
    """Return whether this engine can hide the effects."""
    return not any(effect.touch or effect.name in _NEEDS_FORCE for effect in hidden)


def simulate(mechanics: Mechanics, hidden: Sequence[Hidden], start: Start, length_s: float) -> Motion:
    """Return the motion of a body from a first state on; see `hidden_effects.mujoco_engine.simulate`.

    Raises:
        ImportError: If dartpy is not installed.
    """
    dart: Any = import_module("dartpy")
    world, body, slide, turn = _world(dart, mechanics)
    rotation, com = rotation_of(start.quat_wxyz), mechanics.com_m
    slide.setPositions(start.position_m + rotation @ com)
    turn.setPositions(dart.dynamics.BallJoint.convertToPositions(rotation))
    slide.setVelocities(start.velocity_m_s + rotation @ np.cross(start.omega_body_rad_s, com))
    turn.setVelocities(start.omega_body_rad_s)
    reader, pushes = Reader(mechanics), [effect.wrench for effect in hidden if effect.wrench]
    middles, radius = mechanics.thing.spheres
    count = int(np.ceil(length_s / STEP_S)) + 1
    poses, touching, unknown = np.empty((count, 7)), np.zeros(count, bool), np.full(len(middles), np.nan)
    for step in range(count):
        rotation = body.getWorldTransform().rotation()
        position, quat = slide.getPositions() - rotation @ com, _quat(rotation)
        poses[step] = np.concatenate((position, quat))
        touching[step] = position[2] + (middles @ rotation.T)[:, 2].min() < radius
        if pushes:
            omega = turn.getVelocities()
            velocity = slide.getVelocities() - rotation @ np.cross(omega, com)
            moment = reader.moment(step * STEP_S, position, quat, velocity, omega, unknown)
            force, torque = (np.sum(parts, axis=0) for parts in zip(*(p(moment) for p in pushes), strict=True))
            body.setExtForce(force, [0.0, 0.0, 0.0], False, True)
            body.setExtTorque(torque, False)
        world.step()
    if not np.isfinite(poses).all():
        raise ArithmeticError("DART's motion is not finite")
    return Motion(np.arange(count, dtype=np.float64) * STEP_S, poses[:, :3], poses[:, 3:], touching)


def facts(thing: Thing) -> dict[str, Any]:
    """Return what the truth says of the engine."""
    return {"name": "dart", "version": version("dartpy"), "comes_with": [], "restitution": _restitution(thing)}


def _restitution(thing: Thing) -> float:
    return float(restitution_of(thing.damping_ratio))


def _world(dart: Any, mechanics: Mechanics) -> tuple[Any, Any, Any, Any]:
    """Return DART's world, the body, and its sliding and its turning joint."""
    thing, dynamics = mechanics.thing, dart.dynamics
    world = dart.simulation.World()
    world.setTimeStep(STEP_S)
    world.setGravity(mechanics.gravity_m_s2)
    world.getConstraintSolver().setCollisionDetector(dart.collision.DARTCollisionDetector())
    ground = dynamics.Skeleton("ground")
    _, floor = ground.createWeldJointAndBodyNodePair()
    slab = floor.createShapeNode(dynamics.BoxShape([100.0, 100.0, 2.0]))
    slab.setRelativeTranslation([0.0, 0.0, -1.0])
    _touches(slab, thing)
    skeleton = dynamics.Skeleton("thing")
    slide, carrier = skeleton.createTranslationalJointAndBodyNodePair()
    light = dynamics.Inertia(_CARRIER_KG, np.zeros(3), _CARRIER_KG * 1e-3 * np.eye(3))
    carrier.setInertia(light)
    turn, body = skeleton.createBallJointAndBodyNodePair(carrier)
    # the body's frame has its origin at the centre of mass: the spheres are moved instead
    body.setInertia(dynamics.Inertia(thing.mass_kg, np.zeros(3), mechanics.inertia_kg_m2))
    middles, radius = thing.spheres
    for middle in middles:
        node = body.createShapeNode(dynamics.SphereShape(radius))
        node.setRelativeTranslation(middle - mechanics.com_m)
        _touches(node, thing)
    world.addSkeleton(ground)
    world.addSkeleton(skeleton)
    return world, body, slide, turn


def _touches(node: Any, thing: Thing) -> None:
    node.createCollisionAspect()
    node.createDynamicsAspect()
    aspect = node.getDynamicsAspect()
    aspect.setFrictionCoeff(thing.friction)
    aspect.setRestitutionCoeff(float(np.sqrt(_restitution(thing))))  # DART multiplies the two bodies' numbers


def _quat(rotation: Any) -> Any:
    """Return the unit quaternion wxyz of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
