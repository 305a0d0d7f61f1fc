"""Drake as a second truth, so that no threshold knows the engine that judges it: `pip install drake` (100 MB).

Its contacts are others than MuJoCo's and cgwm's: springs between points and the ground, by force and not by
acceleration (a corner's impact is as stiff as a central one), with Hunt and Crossley's damping F = k x (1 + d v). So
restitution falls with the speed of the impact by nature: `velocity_restitution` is no false name for what is seen
here, and the truth says so (`comes_with` of the engine). Friction is Coulomb's, regularised below 0.1 mm/s.

Nulls, measurement effects and all effects that are forces or are there from the start; those that change the contact
in every step are refused. Positions in flight lie on the exact parabola of a start that is slower by g dt / 2.
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

COMES_WITH = ("velocity_restitution",)
NEEDS_MUJOCO = ("rolling_resistance", "torsional_friction", "anisotropic_friction")
"""Beside all that set the contact in every step: what needs the normal force, or a cone that is an ellipse."""

STEP_S = 1e-4
"""Half of MuJoCo's: drake's steps are implicit, and damp a contact by themselves the more, the longer they are."""
_IMPACT_M_S = 1.5
_GROUND_N_M = 1e12


def possible(hidden: Sequence[Hidden]) -> bool:
    """Return whether this engine can hide the effects."""
    return not any(effect.touch or effect.name in NEEDS_MUJOCO for effect in hidden)


def simulate(mechanics: Mechanics, hidden: Sequence[Hidden], start: Start, length_s: float) -> Motion:
    """Return the motion of a body from a first state on; see `mujoco_engine.simulate`.

    Raises:
        ValueError: If an effect is none of those that this engine can hide.
        ImportError: If drake is not installed.
    """
    if not possible(hidden):
        raise ValueError(f"{', '.join(effect.name for effect in hidden)}: not with drake")
    plants: Any = import_module("pydrake.multibody.plant")
    maths: Any = import_module("pydrake.multibody.math")
    analysis: Any = import_module("pydrake.systems.analysis")
    diagram, plant, body = _diagram(mechanics)
    simulator = analysis.Simulator(diagram)
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    reader, pushes = Reader(mechanics), [effect.wrench for effect in hidden if effect.wrench]
    turned = rotation_of(start.quat_wxyz)
    plant.SetPositions(context, np.concatenate((start.quat_wxyz, start.position_m)))
    plant.SetVelocities(context, np.concatenate((turned @ start.omega_body_rad_s, start.velocity_m_s)))
    applied, port = plants.ExternallyAppliedSpatialForce(), plant.get_applied_spatial_force_input_port()
    applied.body_index = body.index()
    applied.p_BoBq_B = mechanics.com_m
    middles, radius = mechanics.thing.spheres
    count = int(np.ceil(length_s / STEP_S)) + 1
    poses, touching = np.empty((count, 7)), np.zeros(count, bool)
    for step in range(count):
        state = plant.GetPositionsAndVelocities(context)
        quat = state[:4] / np.linalg.norm(state[:4])
        poses[step] = np.concatenate((state[4:7], quat))
        rotation = rotation_of(quat)
        touching[step] = state[6] + (middles @ rotation.T)[:, 2].min() < radius
        if pushes:
            unknown = np.full(len(middles), np.nan)
            moment = reader.moment(step * STEP_S, state[4:7], quat, state[10:], rotation.T @ state[7:10], unknown)
            force, torque = (np.sum(parts, axis=0) for parts in zip(*(p(moment) for p in pushes), strict=True))
            applied.F_Bq_W = maths.SpatialForce(torque, force)
            port.FixValue(context, [applied])
        simulator.AdvanceTo((step + 1) * STEP_S)
    if not np.isfinite(poses).all():
        raise ArithmeticError("drake's motion is not finite")
    return Motion(np.arange(count, dtype=np.float64) * STEP_S, poses[:, :3], poses[:, 3:], touching)


def facts(thing: Thing) -> dict[str, Any]:
    """Return what the truth says of the engine."""
    numbers = {"stiffness_n_m": _stiffness(thing), "dissipation_s_m": _dissipation(thing)}
    return {"name": "drake", "version": version("drake"), "comes_with": list(COMES_WITH), **numbers}


def dissipation_of(restitution: float, speed_m_s: float) -> float:
    """Return Hunt and Crossley's d [s/m] that gives a restitution at a speed.

    Their spring and damper lets a body that comes down at v go at e v, where (1 + e) d v = ln((1 + d v) / (1 - e d v))
    (by integrating m v dv/dx = -k x (1 + d v); derived).
    """
    from scipy.optimize import brentq

    def gap(a: float) -> float:
        return (1 + restitution) * a - np.log1p(a) + np.log1p(-restitution * a)

    highest = (1 - 1e-12) / restitution
    return float(brentq(gap, 1e-3, highest)) / speed_m_s  # pyright: ignore[reportArgumentType]


def _diagram(mechanics: Mechanics) -> tuple[Any, Any, Any]:
    """Return drake's diagram, its plant and the body."""
    framework: Any = import_module("pydrake.systems.framework")
    plants: Any = import_module("pydrake.multibody.plant")
    trees: Any = import_module("pydrake.multibody.tree")
    geometry: Any = import_module("pydrake.geometry")
    maths: Any = import_module("pydrake.math")
    thing = mechanics.thing
    builder = framework.DiagramBuilder()
    plant, _ = plants.AddMultibodyPlantSceneGraph(builder, STEP_S)
    plant.set_discrete_contact_approximation(plants.DiscreteContactApproximation.kLagged)
    plant.set_stiction_tolerance(1e-4)
    plant.mutable_gravity_field().set_gravity_vector(mechanics.gravity_m_s2)
    i = mechanics.inertia_kg_m2
    moments = trees.RotationalInertia(i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
    inertia = trees.SpatialInertia.MakeFromCentralInertia(thing.mass_kg, mechanics.com_m, moments)
    body = plant.AddRigidBody("body", inertia)

    def material(stiffness: float) -> Any:
        properties = geometry.ProximityProperties()
        friction = plants.CoulombFriction(thing.friction, thing.friction)
        geometry.AddContactMaterial(_dissipation(thing), stiffness, friction, properties)
        return properties

    middles, radius = thing.spheres
    for k, middle in enumerate(middles):
        place, sphere = maths.RigidTransform(middle), geometry.Sphere(radius)
        plant.RegisterCollisionGeometry(body, place, sphere, f"p{k}", material(_stiffness(thing)))
    ground = (maths.RigidTransform(), geometry.HalfSpace(), "ground", material(_GROUND_N_M))
    plant.RegisterCollisionGeometry(plant.world_body(), *ground)
    plant.Finalize()
    return builder.Build(), plant, body


def _stiffness(thing: Thing) -> float:
    """Return the stiffness [N/m] of a contact at which the whole body's contact takes twice MuJoCo's time."""
    return thing.mass_kg / (2 * thing.natural_time_s) ** 2


def _dissipation(thing: Thing) -> float:
    """Return d [s/m] for the thing's restitution at an impact of 1.5 m/s."""
    return dissipation_of(float(restitution_of(thing.damping_ratio)), _IMPACT_M_S)
