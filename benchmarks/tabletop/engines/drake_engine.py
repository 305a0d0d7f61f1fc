"""Drake as a truth: contacts are springs by force with Hunt and Crossley's damping, friction is Coulomb's.

A pair of Drake's shapes touches in one point, so that a face would rock on the ground: the ground touches small spheres
at the corners of the object's hull, which are all of it that a plane can touch, and the fingertip touches the parts.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import FINGERTIP, FINGERTIP_RADIUS, GRAVITY
from cgwm.datasets.synthetic.hidden_effects.rotation import rotation_of
from cgwm.datasets.synthetic.hidden_effects.things import restitution_of
from hidden_effects.drake_engine import dissipation_of

from .hull_corners import CORNER_RADIUS_M, corner_spheres
from .stepper import STEP_S, Array, Stepper, Stepping

_STEPS = 2
"""Drake's steps in one of the record: they are implicit, and damp a contact the more, the longer they are."""
_IMPACT_M_S = 1.0
"""Speed of an impact at which a ball has the ground's restitution."""
_RIGID_N_M = 1e12
_FINGERTIP_KG = 1e4
"""So heavy that contact does not deflect it within a step."""


class Drake(Stepping):
    """Drake's discrete plant."""

    def begin(self, qpos: Array, qvel: Array) -> Stepper:
        """See `Stepping`."""
        return _Run(self, qpos, qvel)


class _Run:
    def __init__(self, scene: Drake, qpos: Array, qvel: Array) -> None:
        analysis: Any = import_module("pydrake.systems.analysis")
        diagram, self._plant, self._tip = _diagram(scene)
        self._simulator = analysis.Simulator(diagram)
        self._context = self._plant.GetMyContextFromRoot(self._simulator.get_mutable_context())
        joint = self._plant.GetJointByName("object")
        self._at = joint.position_start()
        self._rate = self._plant.num_positions() + joint.velocity_start()
        whole = self._plant.GetPositionsAndVelocities(self._context)
        whole[self._at : self._at + 7] = np.concatenate((qpos[3:7], qpos[:3]))
        omega = rotation_of(qpos[3:7]) @ qvel[3:6]
        whole[self._rate : self._rate + 6] = np.concatenate((omega, qvel[:3]))
        self._plant.SetPositionsAndVelocities(self._context, whole)
        self._step = 0

    def state(self) -> tuple[Array, Array]:
        """See `Stepper`."""
        whole = self._plant.GetPositionsAndVelocities(self._context)
        pose, rate = whole[self._at : self._at + 7], whole[self._rate : self._rate + 6]
        quat = pose[:4] / np.linalg.norm(pose[:4])
        omega_body = rotation_of(quat).T @ rate[:3]
        return np.concatenate((pose[4:], quat)), np.concatenate((rate[3:], omega_body))

    def move_fingertip(self, position_m: Array, velocity_m_s: Array) -> None:
        """See `Stepper`."""
        for joint, place, speed in zip(self._tip, position_m, velocity_m_s, strict=True):
            joint.set_translation(self._context, place)
            joint.set_translation_rate(self._context, speed)

    def advance(self) -> None:
        """See `Stepper`."""
        self._step += 1
        self._simulator.AdvanceTo(self._step * STEP_S)


def _diagram(scene: Drake) -> tuple[Any, Any, list[Any]]:
    """Return Drake's diagram, its plant and the joints of the fingertip."""
    framework: Any = import_module("pydrake.systems.framework")
    plants: Any = import_module("pydrake.multibody.plant")
    trees: Any = import_module("pydrake.multibody.tree")
    geometry: Any = import_module("pydrake.geometry")
    maths: Any = import_module("pydrake.math")
    solid, contact = scene.solid, scene.contact
    builder = framework.DiagramBuilder()
    plant, scenery = plants.AddMultibodyPlantSceneGraph(builder, STEP_S / _STEPS)
    plant.set_discrete_contact_approximation(plants.DiscreteContactApproximation.kLagged)
    plant.set_stiction_tolerance(1e-4)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -GRAVITY])
    i = solid.inertia
    moments = trees.RotationalInertia(i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
    body = plant.AddRigidBody("object", trees.SpatialInertia.MakeFromCentralInertia(solid.mass, solid.com, moments))
    plant.AddJoint(trees.QuaternionFloatingJoint("object", plant.world_frame(), body.body_frame()))
    stiffness = solid.mass / (2 * contact.natural_time) ** 2
    dissipation = dissipation_of(float(restitution_of(contact.damping_ratio)), _IMPACT_M_S)

    def material(friction: float, stiff_n_m: float) -> Any:
        properties = geometry.ProximityProperties()
        coulomb = plants.CoulombFriction(friction, friction)
        geometry.AddContactMaterial(dissipation, stiff_n_m, coulomb, properties)
        return properties

    corners = [
        plant.RegisterCollisionGeometry(
            body, maths.RigidTransform(corner), geometry.Sphere(CORNER_RADIUS_M), f"corner{k}",
            material(contact.friction, stiffness),
        )
        for k, corner in enumerate(corner_spheres(solid))
    ]  # fmt: skip
    ground = plant.RegisterCollisionGeometry(
        plant.world_body(), maths.RigidTransform(), geometry.HalfSpace(), "ground",
        material(contact.friction, _RIGID_N_M),
    )  # fmt: skip
    joints: list[Any] = []
    if scene.fingertip:
        joints, tip = _fingertip(plant, trees, geometry, maths, material(contact.friction_fingertip, _RIGID_N_M))
        parts = [
            plant.RegisterCollisionGeometry(
                body, maths.RigidTransform(), geometry.Convex(points=part.T, label=f"part{k}"), f"part{k}",
                material(contact.friction_fingertip, stiffness),
            )
            for k, part in enumerate(solid.parts)
        ]  # fmt: skip
        scenery.collision_filter_manager().Apply(
            geometry.CollisionFilterDeclaration()
            .ExcludeBetween(geometry.GeometrySet(tip), geometry.GeometrySet([*corners, ground]))
            .ExcludeBetween(geometry.GeometrySet(parts), geometry.GeometrySet(ground))
        )
    plant.Finalize()
    return builder.Build(), plant, joints


def _fingertip(plant: Any, trees: Any, geometry: Any, maths: Any, material: Any) -> tuple[list[Any], Any]:
    """Add the fingertip on three sliding axes without gravity; return its joints and its geometry."""
    joints, parent = [], plant.world_body()
    for k, axis in enumerate(np.eye(3)):
        mass = _FINGERTIP_KG if k == 2 else 1e-6
        inertia = trees.SpatialInertia.SolidSphereWithMass(mass, FINGERTIP_RADIUS)
        link = plant.AddRigidBody(FINGERTIP if k == 2 else f"axis{k}", inertia)
        joint = trees.PrismaticJoint(f"axis{k}", parent.body_frame(), link.body_frame(), axis)
        joints.append(plant.AddJoint(joint))
        parent = link
    plant.set_gravity_enabled(plant.GetModelInstanceByName("DefaultModelInstance"), True)
    tip = plant.RegisterCollisionGeometry(
        parent, maths.RigidTransform(), geometry.Sphere(FINGERTIP_RADIUS), FINGERTIP, material
    )
    return joints, tip
