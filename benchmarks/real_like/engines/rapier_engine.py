"""Rapier as a truth (`rapier3d`): impulses, solved by small steps with soft contacts, in single precision.

Restitution is Newton's; a resting contact is a spring of 30 Hz, 10 times overdamped (Rapier's own defaults). Single
precision rounds positions by 6e-8 m; a step of 1 ms keeps the rounding of gravity's part of a step below 3e-5 of it.
Rapier's rotation in flight is a symplectic Euler step with its gyroscopic term.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Mechanics, Motion, Reader, Start
from cgwm.datasets.synthetic.hidden_effects.rotation import rotation_of
from cgwm.datasets.synthetic.hidden_effects.things import Array, Thing, restitution_of

STEP_S = 1e-3
_BOUNCE_M_S = 0.05
"""Change of the velocity in a step beyond gravity's from which on it was a contact: no effect pushes so hard."""
_NEEDS_FORCE = ("rolling_resistance", "torsional_friction", "anisotropic_friction")


def possible(hidden: Sequence[Hidden]) -> bool:
    """Return whether this engine can hide the effects."""
    return not any(effect.touch or effect.name in _NEEDS_FORCE for effect in hidden)


def simulate(mechanics: Mechanics, hidden: Sequence[Hidden], start: Start, length_s: float) -> Motion:
    """Return the motion of a body from a first state on; see `hidden_effects.mujoco_engine.simulate`.

    Raises:
        ImportError: If rapier3d is not installed.
    """
    rapier: Any = import_module("rapier3d")
    world, body = _world(rapier, mechanics, start)
    reader, pushes = Reader(mechanics), [effect.wrench for effect in hidden if effect.wrench]
    middles, radius = mechanics.thing.spheres
    count = int(np.ceil(length_s / STEP_S)) + 1
    poses, touching, unknown = np.empty((count, 7)), np.zeros(count, bool), np.full(len(middles), np.nan)
    gravity_m_s, last = mechanics.gravity_m_s2 * STEP_S, None
    for step in range(count):
        place, turn = body.translation, body.rotation
        position = np.array([place.x, place.y, place.z])
        quat = np.array([turn.w, turn.i, turn.j, turn.k])
        quat /= np.linalg.norm(quat)
        rotation = rotation_of(quat)
        poses[step] = np.concatenate((position, quat))
        speed = body.linvel
        moving = np.array([speed.x, speed.y, speed.z])  # of the centre of mass
        touching[step] = position[2] + (middles @ rotation.T)[:, 2].min() < radius + 1e-4
        # a bounce within one step leaves no pose on the ground
        touching[step] |= last is not None and float(np.abs(moving - last - gravity_m_s).max()) > _BOUNCE_M_S
        last = moving
        if pushes:
            spin = body.angvel
            omega = rotation.T @ np.array([spin.x, spin.y, spin.z])
            velocity = moving - rotation @ np.cross(omega, mechanics.com_m)
            moment = reader.moment(step * STEP_S, position, quat, velocity, omega, unknown)
            force, torque = (np.sum(parts, axis=0) for parts in zip(*(p(moment) for p in pushes), strict=True))
            body.reset_forces()
            body.reset_torques()
            body.add_force(force.tolist())
            body.add_torque(torque.tolist())
        world.step()
    if not np.isfinite(poses).all():
        raise ArithmeticError("Rapier's motion is not finite")
    return Motion(np.arange(count, dtype=np.float64) * STEP_S, poses[:, :3], poses[:, 3:], touching)


def facts(thing: Thing) -> dict[str, Any]:
    """Return what the truth says of the engine."""
    restitution = float(restitution_of(thing.damping_ratio))
    return {"name": "rapier", "version": version("rapier3d"), "comes_with": [], "restitution": restitution}


def _world(rapier: Any, mechanics: Mechanics, start: Start) -> tuple[Any, Any]:
    """Return Rapier's world and the body in its first state."""
    thing, com = mechanics.thing, mechanics.com_m
    world = rapier.PhysicsWorld(gravity=tuple(mechanics.gravity_m_s2.tolist()))
    world.integration_parameters.dt = STEP_S
    restitution, mean = float(restitution_of(thing.damping_ratio)), rapier.CoefficientCombineRule.AVERAGE

    def touches(builder: Any) -> Any:
        builder = builder.friction(thing.friction).friction_combine_rule(mean)
        return builder.restitution(restitution).restitution_combine_rule(mean)

    ground = rapier.RigidBody.fixed().build()
    world.add_body(ground, [touches(rapier.Collider.halfspace((0.0, 0.0, 1.0)))])
    moments, axes = np.linalg.eigh(mechanics.inertia_kg_m2)
    axes = axes * np.linalg.det(axes)
    from scipy.spatial.transform import Rotation

    frame = rapier.Rotation3.from_scaled_axis(Rotation.from_matrix(axes).as_rotvec().tolist())
    weight = rapier.MassProperties(com.tolist(), thing.mass_kg, moments.tolist(), frame)
    rotation = rotation_of(start.quat_wxyz)
    velocity = start.velocity_m_s + rotation @ np.cross(start.omega_body_rad_s, com)
    builder = rapier.RigidBody.dynamic().translation(start.position_m.tolist())
    builder = builder.rotation(Rotation.from_matrix(rotation).as_rotvec().tolist()).linvel(velocity.tolist())
    builder = builder.angvel((rotation @ start.omega_body_rad_s).tolist()).can_sleep(False)
    builder = builder.gyroscopic_forces(True).ccd_enabled(False).additional_mass_properties(weight)
    middles, radius = thing.spheres
    colliders = [_massless(rapier, touches(rapier.Collider.ball(radius).translation(m.tolist())), m) for m in middles]
    return world, world.rigid_bodies[world.add_body(builder, colliders)]


def _massless(rapier: Any, collider: Any, middle: Array) -> Any:
    """Return a collider whose mass properties are exactly zero in the frame of the body.

    Rapier (0.36.1) adds those of all colliders to those of the body. A collider of density zero beside the origin
    counts as not zero: the sum is diagonalised again, and the axes of two moments come out exchanged. Cubes then turned
    in flight by up to 45 mrad in 0.5 s otherwise than bodies with their moments do.
    """
    return collider.mass_properties(rapier.MassProperties((-middle).tolist(), 0.0, (0.0, 0.0, 0.0)))
