"""A step of MuJoCo in which the contacts of any number of bodies have Coulomb friction.

MuJoCo's convex problem lets a sliding contact fly off by the friction coefficient times the residual slip: with forces
f, the matrix A of the contact space, its regularisation R and the references a_ref, a contact that slides has

    (A f + a_smooth + R f - a_ref)_n = friction |(A f + a_smooth + R f - a_ref)_t|

where Coulomb's law asks for 0. So the normal reference is lowered by the right side, which is repeated until it no
longer changes (the change of variables of De Saxce and the fixed point of Cadoux, see Acary and Brogliato, Numerical
Methods for Nonsmooth Dynamical Systems, 2008, chapter 13). The tangential reference asks for no slip at the end of the
step, so that friction opposes that slip and has its largest value wherever it is not enough to prevent it.

`friction.py` tunes MuJoCo's own problem for one body by the contacts of the last step; it serves any integrator.
"""

from __future__ import annotations

import numpy as np

from .dynamics import mujoco
from .friction import MjData, MjModel

_MOST_PASSES, _SETTLED_M_S2 = 40, 0.01
"""Most repetitions in a step, and the change of the lowered references at which they have settled."""


def ask_for_no_slip(model: MjModel) -> None:
    """Let the pairs of a model ask for no slip at the end of a step; they are explicit and of three dimensions."""
    # MuJoCo's rate of decay is 2 / (impedance * time constant)
    model.pair_solreffriction[:, 0] = 2 * model.opt.timestep / model.pair_solimp[:, 1]
    model.pair_solreffriction[:, 1] = 1.0


def coulomb_step(model: MjModel, data: MjData) -> None:
    """Advance `data` by one step.

    Args:
        model: Prepared by :func:`ask_for_no_slip`, with elliptic cones and an integrator other than RK4.
        data: The state.
    """
    mujoco.mj_step1(model, data)
    contact = data.contact
    active = np.flatnonzero(contact.efc_address >= 0)
    if active.size:
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        _lower(model, data, contact.efc_address[active], contact.friction[active, 0])
    mujoco.mj_step2(model, data)


def _lower(model: MjModel, data: MjData, normal: np.ndarray, friction: np.ndarray) -> None:
    """Lower the references of normal rows (n,) of contacts with friction (n,)."""
    tangents = normal[:, None] + (1, 2)
    jacobian = data.efc_J.reshape(-1, model.nv)[tangents]
    wanted, reference = data.efc_aref[normal].copy(), data.efc_aref[tangents]
    slip = jacobian @ data.qacc_smooth - reference
    lowered = friction * np.linalg.norm(slip, axis=1)
    for _ in range(_MOST_PASSES):
        data.efc_aref[normal] = wanted - lowered
        mujoco.mj_fwdConstraint(model, data)
        slip = jacobian @ data.qacc - reference + data.efc_R[tangents] * data.efc_force[tangents]
        before, lowered = lowered, friction * np.linalg.norm(slip, axis=1)
        if np.abs(lowered - before).max() < _SETTLED_M_S2:
            return
