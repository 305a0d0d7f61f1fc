"""Net contact force and torque on each body, from the labels of a dataset."""

from __future__ import annotations

import numpy as np

from ...datasets.rollouts.rollouts import ContactTable
from ..geometry.viewpoint import rotation_matrix
from .inertia import symmetric


def contact_force_n(contacts: ContactTable, time_s: np.ndarray, bodies: int) -> np.ndarray:
    """Return the mean contact force (T, B, 3) [N] on each body since the previous frame, world frame; 0 at frame 0."""
    impulse = np.zeros((len(time_s), bodies, 3))
    frame = np.repeat(np.arange(len(time_s)), np.diff(contacts.offsets))
    np.add.at(impulse, (frame, contacts.body_a), contacts.impulse_n_s)
    paired = contacts.body_b >= 0  # the ground has no row
    np.add.at(impulse, (frame[paired], contacts.body_b[paired]), -contacts.impulse_n_s[paired])
    return impulse / np.concatenate([[np.inf], np.diff(time_s)])[:, None, None]


def contact_torque_n_m(
    quat_wxyz: np.ndarray, omega_body_rad_s: np.ndarray, inertia_kg_m2: np.ndarray, time_s: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Return the mean torque (T, B, 3) [N m] on free bodies since the previous frame about the centres of mass, world.

    It is the rate of change of the angular momentum R I omega: the torque of contacts, and of effects that turn bodies;
    gravity has no moment about the centre of mass. The sum of arms times impulses would be wrong, since bodies move by
    centimetres between frames.

    Args:
        quat_wxyz: T_world_body, shape (T, B, 4).
        omega_body_rad_s: Shape (T, B, 3).
        inertia_kg_m2: xx yy zz xy xz yz about the centre of mass, body axes, shape (B, 6).
        time_s: Shape (T,).
        free: Which bodies are free, shape (B,); the others get 0.
    """
    matrices = np.array([symmetric(tuple(row)) for row in inertia_kg_m2])
    momentum = np.einsum("tbij,bjk,tbk->tbi", rotation_matrix(quat_wxyz), matrices, omega_body_rad_s)
    length = np.concatenate([[np.inf], np.diff(time_s)])
    torque = np.diff(momentum, axis=0, prepend=momentum[:1]) / length[:, None, None]
    return np.where(free[:, None], torque, 0.0)
