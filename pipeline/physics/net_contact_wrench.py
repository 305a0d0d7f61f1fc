"""The net force and torque of the contacts on each body, from labels."""

from __future__ import annotations

import numpy as np

from ..datasets.rollouts import ContactTable
from .physics.world import symmetric
from .sampling import rotation_matrix


def contact_force_n(contacts: ContactTable, time_s: np.ndarray, bodies: int) -> np.ndarray:
    """Return the mean force (T, B, 3) [N] of all contacts on each body since the frame before, world; 0 at frame 0."""
    impulse = np.zeros((len(time_s), bodies, 3))
    frame = np.repeat(np.arange(len(time_s)), np.diff(contacts.offsets))
    np.add.at(impulse, (frame, contacts.body_a), contacts.impulse_n_s)
    paired = contacts.body_b >= 0  # the ground has no row
    np.add.at(impulse, (frame[paired], contacts.body_b[paired]), -contacts.impulse_n_s[paired])
    return impulse / np.concatenate([[np.inf], np.diff(time_s)])[:, None, None]


def contact_torque_n_m(
    quat_wxyz: np.ndarray, omega_body_rad_s: np.ndarray, inertia_kg_m2: np.ndarray, time_s: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Return the mean torque (T, B, 3) [N m] on free bodies since the frame before, about their centres of mass, world.

    It is the change of the angular momentum R I omega over the time: what contacts do, gravity having no moment about
    the centre of mass, and effects where they turn bodies. Arms times impulses would be wrong between frames, in which
    bodies move by centimetres.

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
