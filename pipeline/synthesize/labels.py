"""Labels of a simulated rollout, except its images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ...datasets.models.effect_files import packed_name
from ...datasets.models.mjcf import mujoco_states, write_mjcf
from ...datasets.rollouts.rollouts import JointTable, RolloutLabels
from ...schemas import ModelFile, SamplingPlan
from ..physics.chains.chain import chain_of_model
from ..physics.chains.state import joint_values
from ..physics.net_contact_wrench import contact_force_n, contact_torque_n_m
from ..physics.state import State
from .pusher_paths import commanded_velocity
from .simulator import Motion
from .start_states import Start


def labels_of(motion: Motion, plan: SamplingPlan, seed: int, times_s: np.ndarray) -> RolloutLabels:
    """Return the labels of a motion.

    Args:
        motion: The simulated motion.
        plan: The resolved plan of its draws.
        seed: The root seed.
        times_s: Times of the frames, shape (T,).
    """
    draw, contacts, file = motion.draw, motion.contacts, motion.file
    bodies = file.bodies
    actions, meaning = _actions(file, draw.start, plan, times_s)
    poses = (motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s)
    inertia = np.array([body.inertia_kg_m2 for body in bodies])
    free = np.array([body.motion == "free" for body in bodies])
    joints = joint_table(file, poses)
    known = (
        {} if joints is None else {n: (joints.values[:, k], joints.speeds[:, k]) for k, n in enumerate(joints.names)}
    )
    materials = tuple(body.material for body in bodies)
    return RolloutLabels(
        episode_index=draw.index,
        seed=seed,
        attempt=draw.attempt,
        model_mjcf=write_mjcf(replace(draw.model, file=file), draw.cameras),
        time_s=times_s,
        states=mujoco_states(file, times_s, poses, known),
        actions=actions,
        action_meaning=meaning,
        bodies=tuple(body.name for body in bodies),
        motions=tuple(body.motion for body in bodies),
        mass_kg=np.array([body.mass_kg for body in bodies]),
        com_m=np.array([body.com_m for body in bodies]),
        inertia_kg_m2=inertia,
        position_m=motion.position_m,
        quat_wxyz=motion.quat_wxyz,
        velocity_m_s=motion.velocity_m_s,
        omega_body_rad_s=motion.omega_body_rad_s,
        gravity_m_s2=np.array(file.gravity_m_s2),
        contacts=contacts,
        contact_force_n=contact_force_n(contacts, times_s, len(bodies)),
        contact_torque_n_m=contact_torque_n_m(motion.quat_wxyz, motion.omega_body_rad_s, inertia, times_s, free),
        parameters=draw.parameters,
        effects={packed_name(effect.name): effect.parameters for effect in file.effects},
        cameras=draw.cameras,
        exposures=draw.lighting.exposures,
        light_gain_rgb=draw.lighting.gain_rgb,
        light=draw.lighting.light,
        materials=materials if any(materials) else None,
        joints=joints,
    )


def joint_table(file: ModelFile, poses: tuple[np.ndarray, ...]) -> JointTable | None:
    """Return values and rates of the joints, from the poses and velocities of the links; None without joints.

    A hinge without limits keeps counting where it turns more than once.

    Args:
        file: The model.
        poses: position_m (T, B, 3), quat_wxyz (T, B, 4), velocity_m_s (T, B, 3) and omega_body_rad_s (T, B, 3).
    """
    if not file.articulations:
        return None
    names, state = [body.name for body in file.bodies], State(*map(torch.as_tensor, poses))
    moving = [joint for one in file.articulations for joint in one.joints if joint.kind != "fixed"]
    found = [
        joint_values(names, state, chain_of_model(one, state.position_m), exact=False) for one in file.articulations
    ]
    values, speeds = (torch.cat(each, -1).numpy() for each in zip(*found, strict=True))
    endless = [k for k, joint in enumerate(moving) if joint.kind == "hinge" and None in (joint.lower, joint.upper)]
    values[:, endless] = np.unwrap(values[:, endless], axis=0)
    return JointTable(
        names=tuple(joint.name for joint in moving),
        links=tuple(joint.link for joint in moving),
        kinds=tuple(joint.kind for joint in moving),
        values=values,
        speeds=speeds,
    )


def _actions(file: ModelFile, start: Start, plan: SamplingPlan, times_s: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the actions (T, A), velocities of the driven bodies over the largest push speed, and a description."""
    driven = [index for index, body in enumerate(file.bodies) if body.motion == "driven"]
    if not driven:
        return np.zeros((len(times_s), 1)), "No body is driven: zero."
    scale = max(plan.push_speed_m_s.support[1], 1e-9)
    names = ", ".join(file.bodies[index].name for index in driven)
    commands = []
    for index in driven:
        track = start.driven[file.bodies[index].name]
        commands.append(commanded_velocity(track)[np.searchsorted(track.time_s, times_s, side="right") - 1])
    text = f"Velocity command of {names}, world axes, in units of {scale:g} m/s."
    return np.concatenate(commands, axis=1) / scale, text
